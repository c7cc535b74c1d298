"""Stretch and View: what the engine did over some steps, and what can be seen of the bodies."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class Stretch:
    """What the engine did over some steps.

    Attributes:
        states: at the end of each step: time, qpos, qvel; shape (steps, 1 + nq + nv).
        floor_force: of the floor on each wheel during each step, shape (steps, N, 2, 3), N, world.
        foot_velocity: of the points of the connectors above the contacts, at each step's beginning, same
            shape, m/s.
        energy: kinetic energy at each step's beginning, shape (steps,), J.
        obstacle_force: of all obstacles on each connector with the halves of its segments during each step,
            shape (steps, N, 3), N, world.
        obstacle_power: that the snake spends on them at each step's beginning, shape (steps,), W.
    """

    states: np.ndarray
    floor_force: np.ndarray
    foot_velocity: np.ndarray
    energy: np.ndarray
    obstacle_force: np.ndarray
    obstacle_power: np.ndarray


@dataclass(frozen=True)
class View:
    """What can be seen of the bodies at some moments, the samples first, connectors head first, world frame.

    Attributes:
        qpos: generalised positions, shape (samples, nq).
        com: centre of mass, shape (samples, 3), m.
        com_velocity: same shape, m/s.
        positions: connectors, shape (samples, N, 3), m.
        headings: theirs, shape (samples, N), wrapped to (−π, π], rad.
        bends: shape (samples, segments), rad.
        bend_rates: same shape, rad/s.
    """

    qpos: np.ndarray
    com: np.ndarray
    com_velocity: np.ndarray
    positions: np.ndarray
    headings: np.ndarray
    bends: np.ndarray
    bend_rates: np.ndarray
