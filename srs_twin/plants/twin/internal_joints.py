r"""Energy that the twin's joints store and dissipate without bending a segment as a whole.

A segment has n hinges, each with the stiffness n k and the damping n c, and one moment of the air, T_a, acts
on all of them. With q_k = q/n + δ_k, where Σ δ_k = 0, the power of the hinges is

$$ \sum_k \bigl(T_a - n k (q_k - b/n) - n c\,\dot q_k\bigr)\,\dot q_k
   = T\,\dot q - \frac{d}{dt} \sum_k \tfrac12 n k\,\delta_k^2 - \sum_k n c\,\dot\delta_k^2, \qquad
   T = T_a - k (q - b) - c\,\dot q . $$

So the work of the torque, ∫ T q̇ dt, is the energy that body and floor receive plus the energy that the
hinges store and dissipate in their relative motion δ. The pitch and roll joints store and dissipate energy
with their whole angles.

Under a preloaded contact the pitch and roll joints are not counted. The preloaded wheels bounce on the floor
and shake these joints with energy that comes from the finite time step of the normal forces, not from the
torques: in gen2_turn the joints dissipate 35 mW with steps of 1 ms and 1.6 mW with 0.25 ms, but 0.006 mW
under a loaded contact.
"""

from __future__ import annotations

import mujoco
import numpy as np

from srs_twin.plants.twin.mjcf.numerics import ModelSettings
from srs_twin.robot.spec import RobotSpec


def bend_joints(spec: RobotSpec) -> tuple[str, ...]:
    """Return the kinds of joints that bend a segment."""
    return ("hinge", "tilt") if spec.is_spatial else ("hinge",)


class InternalJoints:
    """Joint motions of a twin that leave its bends unchanged.

    Attributes:
        hinges: velocity indices of the bending hinges, shape (segments, hinges per segment); those of the
            tilt hinges of a spatial robot follow, shape (2 segments, hinges per segment).
        out_of_plane: velocity indices of the pitch and roll joints that count, shape (joints,).
        damping: damping of each velocity, shape (nv,), N·m·s/rad; 0 for velocities of other joints.
    """

    def __init__(self, model: mujoco.MjModel, spec: RobotSpec, settings: ModelSettings) -> None:
        """Look up the joints of a compiled twin.

        Args:
            model: compiled scene.
            spec: the robot.
            settings: discretisation and contact of the scene.
        """
        hinges = [
            [model.joint(f"{kind}_{j + 1}_{k + 1}").id for k in range(settings.hinges_per_segment)]
            for kind in bend_joints(spec)
            for j in range(spec.segments)
        ]
        kinds = ("pitch_", "roll_") if settings.loaded else ()
        out_of_plane = [j for j in range(model.njnt) if model.joint(j).name.startswith(kinds)]
        joints = np.array([*np.ravel(hinges), *out_of_plane], dtype=int)
        self.hinges = model.jnt_dofadr[np.array(hinges)].astype(int)
        self.out_of_plane = model.jnt_dofadr[np.array(out_of_plane, dtype=int)].astype(int)
        stiffness = model.jnt_stiffness.reshape(model.njnt, -1)[:, 0]
        # The integrator evaluates springs at the end of a step, which adds the damping h k; the damping in
        # the model is smaller by that much (`mjcf.classes`).
        added = model.opt.timestep * stiffness[joints]
        self.damping = np.zeros(model.nv)
        self.damping[model.jnt_dofadr[joints]] = model.dof_damping[model.jnt_dofadr[joints]] + added
        self._hinge_positions = model.jnt_qposadr[np.array(hinges)]
        self._out_of_plane_positions = model.jnt_qposadr[np.array(out_of_plane, dtype=int)]
        self._stiffness = stiffness[joints]
        dofs = np.array([*self.hinges.ravel(), *self.out_of_plane], dtype=int)
        self._joint_damping = self.damping[dofs]

    def stored(self, qpos: np.ndarray) -> np.ndarray:
        """Return the elastic energy of the joint motions that leave the bends unchanged, J.

        Args:
            qpos: generalised positions, shape (…, nq).

        Returns:
            Shape (…,).
        """
        places = self._hinge_positions, self._out_of_plane_positions
        return _weighted_squares(self._stiffness, qpos, *places) / 2

    def dissipated(self, qvel: np.ndarray) -> np.ndarray:
        """Return the power that dampers dissipate in joint motions that leave the bends unchanged, W.

        Args:
            qvel: generalised velocities, shape (…, nv).

        Returns:
            Shape (…,).
        """
        return _weighted_squares(self._joint_damping, qvel, self.hinges, self.out_of_plane)


def _weighted_squares(
    weights: np.ndarray, values: np.ndarray, hinges: np.ndarray, out_of_plane: np.ndarray
) -> np.ndarray:
    """Return Σ w δ² over the last axis; δ of a hinge is its deviation from the mean of its segment."""
    angles = values[..., hinges]
    deviation = (angles - angles.mean(axis=-1, keepdims=True)).reshape(*values.shape[:-1], hinges.size)
    deltas = np.concatenate([deviation, values[..., out_of_plane]], axis=-1)
    total: np.ndarray = (weights * deltas**2).sum(axis=-1)
    return total
