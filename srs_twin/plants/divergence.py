"""Divergence that no integrator sees, found within a tick.

A number that was wrong before a step need not hurt it: a place of 1e15 m, a pressure of infinity that the
engine takes for nought, a valve state that is no number.
"""

from __future__ import annotations

from dataclasses import fields
from typing import Any

import numpy as np

from srs_twin.errors import DivergedError
from srs_twin.plants.base import SnakeState
from srs_twin.plausible import LARGEST, implausible, plausible

_STATES = np.iinfo(np.int8)


def believed(plant: str, state: SnakeState) -> SnakeState:
    """Return a moment or a history that is plausible.

    Args:
        plant: the plant's name.
        state: what it says of itself.

    Raises:
        DivergedError: it is not plausible; the error's `history` holds the samples before.
    """
    # The other fields follow from these. Single numbers apart: to numpy each costs as much as an array.
    singles: tuple[Any, ...] = (state.heading, state.work, state.air)
    moment = not isinstance(state.time, np.ndarray)
    fine = all(abs(each) < LARGEST for each in singles) if moment else plausible(*singles)
    if fine and plausible(state.com, state.bend, state.pressure):
        return state
    history = SnakeState.history([state])
    for k, time in enumerate(np.asarray(history.time)):
        for each in fields(history):
            wrong = implausible(getattr(history, each.name)[k])
            if wrong is not None:
                before = history.at(slice(k)) if k else None
                what = f"{each.name} is {wrong:g}, which no snake reaches"
                raise DivergedError(plant, float(time), what, history=before)
    return state


def refuse_wild(who: str, time: float, valves: Any) -> None:
    """Tell commands that have diverged from those that are merely wrong, which the chambers refuse.

    Args:
        who: gives the commands.
        time: of the tick for which they are, s.
        valves: as commanded, any shape.

    Raises:
        DivergedError: a valve state that is not a number, infinite, or too large for int8.
    """
    states = np.asarray(valves)
    if states.dtype == np.int8 or states.dtype.kind not in "fiu":
        return
    wild = states[~((states >= _STATES.min) & (states <= _STATES.max))]
    if wild.size:
        raise DivergedError(who, time, f"it commands the valve state {wild.flat[0]:g}")
