r"""Energy that the segment joints of the twin store and dissipate.

A segment with stiffness k and damping c has n hinges, each with stiffness n k and
damping n c. The angle q_k of hinge k deviates by e_k = q_k − q_f/n from an equal share
of the free bend q_f. The segment has the bend q = Σ q_k and the torque T = k (q_f − q)
+ c (q̇_f − q̇). The compressed air delivers the power

$$ T\,\dot q_f = P + \frac{d}{dt} \sum_k \tfrac12 n k\,e_k^2 + \sum_k n c\,\dot e_k^2 . $$

Here P is the power that is transferred to the body and the floor. For a pitch or roll
joint, e_k is the joint angle.

With preloaded contact, the pitch and roll joints are excluded, because bouncing wheels
make them vibrate. The energy of this vibration is a discretisation error of the normal
forces and not work of the air.
"""

from __future__ import annotations

import mujoco
import numpy as np

from srs_twin.plants.twin.mjcf.numerics import ModelSettings, bend_joints
from srs_twin.robot.spec import RobotSpec


class InternalJoints:
    """Springs and dampers in the segments of a twin.

    Attributes:
        hinges: indices in `qvel` of the bending hinges, shape (segments, hinges per
            segment). For a spatial robot, the tilt hinges follow in additional rows,
            shape (2 · segments, hinges per segment).
        hinge_positions: indices in `qpos` of the same hinges.
        out_of_plane: indices in `qvel` of the pitch and roll joints, shape (joints,).
            The array is empty without loaded contact.
        damping: damping coefficient of each degree of freedom, shape (nv,), N·m·s/rad.
            It is 0 for joints that are neither in `hinges` nor in `out_of_plane`.
    """

    def __init__(
        self, model: mujoco.MjModel, spec: RobotSpec, settings: ModelSettings
    ) -> None:
        """Find the segment joints of a compiled model."""
        hinges = np.array(
            [
                [
                    model.joint(f"{kind}_{j + 1}_{k + 1}").id
                    for k in range(settings.hinges_per_segment)
                ]
                for kind in bend_joints(spec)
                for j in range(spec.segments)
            ]
        )
        kinds = ("pitch_", "roll_") if settings.loaded else ()
        others = [j for j in range(model.njnt) if model.joint(j).name.startswith(kinds)]
        out_of_plane = np.array(others, dtype=int)
        joints = np.append(hinges, out_of_plane)
        self._spatial = spec.is_spatial
        self.hinges = model.jnt_dofadr[hinges].astype(int)
        self.out_of_plane = model.jnt_dofadr[out_of_plane].astype(int)
        stiffness = model.jnt_stiffness.reshape(model.njnt, -1)[:, 0]
        # The damping coefficients in the model exclude the damping that the integrator
        # adds to springs (`mjcf.classes`).
        added = model.opt.timestep * stiffness[joints]
        dofs = model.jnt_dofadr[joints]
        self._joint_damping = model.dof_damping[dofs] + added
        self.damping = np.zeros(model.nv)
        self.damping[dofs] = self._joint_damping
        self.hinge_positions = model.jnt_qposadr[hinges]
        self._out_of_plane_positions = model.jnt_qposadr[out_of_plane]
        self._stiffness = stiffness[joints]

    def stored(self, qpos: np.ndarray, free_bend: np.ndarray) -> np.ndarray:
        """Return the elastic energy of the segments at each sample, shape (…,), J.

        Args:
            qpos: generalised positions, shape (…, nq).
            free_bend: free bends, rad, shape (…, segments). The shape is (…, segments,
                2) for a spatial robot.
        """
        deviations = self._deviations(
            qpos, free_bend, self.hinge_positions, self._out_of_plane_positions
        )
        energy: np.ndarray = (self._stiffness * deviations**2).sum(axis=-1) / 2
        return energy

    def dissipated(self, qvel: np.ndarray, free_rate: np.ndarray) -> np.ndarray:
        """Return the power dissipated by the segments' dampers, shape (…,), W.

        Args:
            qvel: generalised velocities, shape (…, nv).
            free_rate: rates of the free bends, rad/s, with the shape of `free_bend` in
                `stored`.
        """
        deviations = self._deviations(qvel, free_rate, self.hinges, self.out_of_plane)
        power: np.ndarray = (self._joint_damping * deviations**2).sum(axis=-1)
        return power

    def _deviations(
        self,
        values: np.ndarray,
        free: np.ndarray,
        hinges: np.ndarray,
        out_of_plane: np.ndarray,
    ) -> np.ndarray:
        if self._spatial:  # bending hinges precede tilt hinges
            free = np.concatenate([free[..., 0], free[..., 1]], axis=-1)
        angles = values[..., hinges] - free[..., None] / hinges.shape[1]
        flat = angles.reshape(*values.shape[:-1], hinges.size)
        return np.concatenate([flat, values[..., out_of_plane]], axis=-1)
