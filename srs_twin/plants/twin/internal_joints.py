r"""Energy that the twin's joints store and dissipate without bending a segment as a whole.

A segment has n hinges, each with the stiffness n k and the damping n c, and one moment of the air, T_a, acts
on all of them. With q_k = q/n + δ_k, where Σ δ_k = 0, the power of the hinges is

$$ \sum_k \bigl(T_a - n k (q_k - b/n) - n c\,\dot q_k\bigr)\,\dot q_k
   = T\,\dot q - \frac{d}{dt} \sum_k \tfrac12 n k\,\delta_k^2 - \sum_k n c\,\dot\delta_k^2, \qquad
   T = T_a - k (q - b) - c\,\dot q . $$

So the work of the torque, ∫ T q̇ dt, covers what body and floor receive and what the hinges store and
dissipate as they move against each other. The pitch and roll joints do the same with their whole angles.

Under a preloaded contact pitch and roll are left out. There the wheels, which are pressed down, spring on the
floor and shake these joints. That energy comes from the finite time step of the normal forces, not from the
torques: in gen2_turn the joints dissipate 35 mW with steps of 1 ms and 1.6 mW with 0.25 ms, but 0.006 mW
under a loaded contact.
"""

from __future__ import annotations

import mujoco
import numpy as np

from srs_twin.plants.twin.mjcf.numerics import ModelSettings
from srs_twin.robot.spec import RobotSpec


class InternalJoints:
    """Joint motions of a twin that leave its bends unchanged.

    Attributes:
        hinges: velocity indices of the hinges, shape (segments, hinges per segment).
        others: velocity indices of the pitch and roll joints that count, shape (joints,).
        damping: of each velocity, shape (nv,), N·m·s/rad; 0 of those that are no such joint.
    """

    def __init__(self, model: mujoco.MjModel, spec: RobotSpec, settings: ModelSettings) -> None:
        """Look up the joints of a compiled twin.

        Args:
            model: compiled scene.
            spec: the robot.
            settings: its discretisation and contact.
        """
        hinges = [
            [model.joint(f"hinge_{j + 1}_{k + 1}").id for k in range(settings.hinges_per_segment)]
            for j in range(spec.segments)
        ]
        kinds = ("pitch_", "roll_") if settings.loaded else ()
        others = [j for j in range(model.njnt) if model.joint(j).name.startswith(kinds)]
        joints = np.array([*np.ravel(hinges), *others], dtype=int)
        self.hinges = model.jnt_dofadr[np.array(hinges)].astype(int)
        self.others = model.jnt_dofadr[np.array(others, dtype=int)].astype(int)
        stiffness = model.jnt_stiffness.reshape(model.njnt, -1)[:, 0]
        # The model's damping lacks what the integrator adds by taking springs at the end of a step.
        added = model.opt.timestep * stiffness[joints]
        self.damping = np.zeros(model.nv)
        self.damping[model.jnt_dofadr[joints]] = model.dof_damping[model.jnt_dofadr[joints]] + added
        self._places = model.jnt_qposadr[np.array(hinges)], model.jnt_qposadr[np.array(others, dtype=int)]
        self._stiffness = stiffness[joints]
        dofs = np.array([*self.hinges.ravel(), *self.others], dtype=int)
        self._dampers = self.damping[dofs]

    def stored(self, qpos: np.ndarray) -> np.ndarray:
        """Return the elastic energy beyond that of the bends, J.

        Args:
            qpos: generalised positions, shape (…, nq).
        """
        return _weighted(self._stiffness, qpos, *self._places) / 2

    def dissipated(self, qvel: np.ndarray) -> np.ndarray:
        """Return the power that the dampers take beyond that of the bends, W.

        Args:
            qvel: generalised velocities, shape (…, nv).
        """
        return _weighted(self._dampers, qvel, self.hinges, self.others)


def _weighted(weights: np.ndarray, values: np.ndarray, hinges: np.ndarray, others: np.ndarray) -> np.ndarray:
    """Return Σ w δ² over the last axis; the δ of a hinge is its difference from the mean of its segment."""
    own = values[..., hinges]
    apart = (own - own.mean(axis=-1, keepdims=True)).reshape(*values.shape[:-1], hinges.size)
    total: np.ndarray = (weights * np.concatenate([apart, values[..., others]], axis=-1) ** 2).sum(axis=-1)
    return total
