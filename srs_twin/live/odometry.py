r"""Body motion of a wheeled snake as a function of its bend changes.

If inertia is negligible, the motion depends on the sequence of body shapes, but not on
the speed at which the shape changes (Kelly and Murray 1995):

$$ ξ = A(q) \, \dot q , \qquad A = A_w(q) + \sum_k W_k \, φ_k(\tanh(q / q_0)) , \quad
φ(x) = (1, x_i, x_i x_j, x_i x_j x_k) , $$

where q contains the bends, and ξ contains the forward velocity, the lateral velocity
and the yaw rate. The matrix A_w gives the motion that minimises the dissipation in
wheels with viscous friction. The weights W describe how the motion of the robot differs
from the prediction of A_w. These weights are fitted to successive motion capture
frames by regularised least squares. Cubic features φ are needed, for example, because a
turning gait is slower than a straight gait.
"""

from __future__ import annotations

import copy
import math
from collections.abc import Mapping
from itertools import combinations_with_replacement

import numpy as np

from srs_twin.compute.arrays import Array
from srs_twin.io.saved_state import Stateful
from srs_twin.robot.geometry import body_shape, relative_headings
from srs_twin.robot.spec import RobotSpec

PRIOR = 0.1
"""Prior standard deviation of the weights W, rad/rad."""
_MODEL_ERROR_RANGE = 0.01, 0.05
"""Lower and upper limits on the standard deviation of A, rad/rad.

The lower limit is needed, because cubic features do not describe every robot exactly.
"""
_SATURATION_RAD = 0.7
"""Bend q₀ at which the features φ saturate, rad.

Without saturation, a fit to small bends would be extrapolated to large bends."""
_BLOCK = 30
"""Number of motion capture frames between two fits of W."""
_KEPT_BLOCKS = 10
"""Number of blocks over which the variance of the displacements is averaged."""
_FORGETTING_FRAMES = 3000
"""Number of frames after which the influence of a frame on the fit falls to 1/e."""
_NOISE_RAD = 0.02
"""Prior standard deviation of a measured heading, rad."""
_SCATTER = 0.001, 0.001, 0.02
"""Prior standard deviations of the errors in forward motion (m), lateral motion (m)
and yaw (rad) per frame.
"""
_ERROR_INFLATION = 1.3
"""Factor by which the standard deviation of W is multiplied.

The factor accounts for errors that recur in each gait period and are therefore
correlated."""
_DIFFERENCE_RAD = 1e-4
"""Step of the bends for numerical differentiation, rad."""


class LocalConnection(Stateful):
    """Local connection A(q) of a robot, as defined in the module docstring.

    Attributes:
        weights: weights W, with one row for each product of a feature and a bend
            change. The columns contain forward motion (m), lateral motion (m) and yaw
            (rad).
    """

    state_attributes = (
        "weights",
        "_gram",
        "_sums",
        "_noise",
        "_scatter",
        "_frames",
        "_block",
    )

    def __init__(self, spec: RobotSpec, mass: Array) -> None:
        """Initialise the weights W to 0, given the lumped connector masses (kg)."""
        n = spec.segments
        self._spec = spec
        self._mass = mass
        self._powers = [
            np.array(list(combinations_with_replacement(range(n), power)))
            for power in (1, 2, 3)
        ]
        count = n * (1 + sum(map(len, self._powers)))
        self.weights: Array = np.zeros((count, 3))
        self._gram = np.zeros((count, count))
        self._sums = np.zeros((count, 3))
        self._noise = _NOISE_RAD**2
        self._scatter = np.square(_SCATTER)
        self._frames = 0
        self._block = np.zeros(3)
        self._root: Array = np.eye(count) * PRIOR / _NOISE_RAD

    def snapshot(self) -> LocalConnection:
        """Return a copy for predictions in another thread."""
        made = object.__new__(LocalConnection)
        # The copy can share these arrays, because they are never changed in place.
        for name in ("_spec", "_mass", "_powers", "weights", "_root", "_scatter"):
            setattr(made, name, getattr(self, name))
        return made

    def features(self, before: Array, after: Array) -> Array:
        """Return the products φ ⊗ dq for a bend change (rad), shape (rows of W,)."""
        return np.outer(self._features((before + after) / 2), after - before).ravel()

    def matrix(self, bends: Array) -> Array:
        """Return the matrix A for given bends (rad), shape (3, segments).

        The rows contain forward motion (m/rad), lateral motion (m/rad) and yaw
        (rad/rad).
        """
        features = self._features(bends)
        learnt = self.weights.reshape(len(features), self._spec.segments, 3)
        matrix: Array = self.kinematic_matrix(bends) + np.einsum(
            "k,kjc->cj", features, learnt
        )
        return matrix

    def kinematic_matrix(self, bends: Array) -> Array:
        """Return the matrix A_w for given bends (rad), with the shape of `matrix`."""
        g = self._spec.geometry
        mu = self._spec.friction
        n = self._spec.segments
        varied = bends + _DIFFERENCE_RAD * np.eye(n + 1, n, -1)
        shapes = body_shape(varied, self._mass, g.segment_length, g.rigid_gap)
        place = shapes[0]
        moves = (shapes[1:] - shapes[0]) / _DIFFERENCE_RAD
        heading = relative_headings(bends)
        forward = np.stack([np.cos(heading), np.sin(heading)], axis=-1)
        lateral = forward[:, ::-1] * [-1.0, 1.0]
        # Rows scaled by the square roots of the friction coefficients turn the
        # minimisation of the dissipation into a least-squares problem.
        directions = np.stack(
            [math.sqrt(mu.mu_t) * forward, math.sqrt(mu.mu_n) * lateral]
        )
        turns = np.stack([-place[:, 1], place[:, 0]], axis=-1)
        levers = np.sum(directions * turns, axis=-1, keepdims=True)
        body = np.concatenate([directions, levers], axis=-1).reshape(-1, 3)
        own = np.einsum("kic,jic->kij", directions, moves).reshape(-1, n)
        return np.asarray(-np.linalg.lstsq(body, own, rcond=None)[0])

    def sample_model_error(self, features: Array, draws: Array) -> Array:
        """Return random displacements due to the uncertainty of W, shape (members, 3).

        Args:
            features: products φ ⊗ dq, as returned by the method `features`.
            draws: standard normal random numbers, shape (members, rows of W, 3).
        """
        spread = _ERROR_INFLATION * features @ self._root
        sd = math.sqrt(self._scatter[2]) * float(np.linalg.norm(spread))
        least, most = np.multiply(
            _MODEL_ERROR_RANGE, np.linalg.norm(features[: self._spec.segments])
        )
        factor = min(max(sd, least), most) / max(sd, 1e-12)
        return np.asarray(
            factor * np.sqrt(self._scatter) * np.einsum("f,rfc->rc", spread, draws)
        )

    def learn(self, features: Array, residual: Array) -> None:
        """Update the fit with the products φ ⊗ dq of the motion between two frames.

        The residual (m, m, rad) is the measured displacement minus the prediction
        A_w dq.
        """
        remembered = 1 - 1 / _FORGETTING_FRAMES
        self._gram *= remembered
        self._sums *= remembered
        self._gram += np.outer(features, features)
        self._sums += np.outer(features, residual)
        error = residual - features @ self.weights
        self._noise += (error[2] ** 2 - self._noise) / 100
        self._block += error
        self._frames += 1
        if self._frames % _BLOCK:
            return
        # The noise of a frame enters two successive displacements with opposite signs,
        # so it cancels in the sum over a block. The variance of the displacements is
        # therefore computed from these sums.
        kept = max(min(self._frames // _BLOCK, _KEPT_BLOCKS), 2)
        self._scatter = self._scatter + (self._block**2 / _BLOCK - self._scatter) / kept
        self._block = np.zeros(3)
        self.weights = np.asarray(np.linalg.solve(self._normal(), self._sums))

    def load_state_dict(self, memory: Mapping[str, object]) -> None:
        """Restore saved values."""
        super().load_state_dict(memory)
        if self._frames >= _BLOCK:
            self._normal()

    def _normal(self) -> Array:
        gram: Array = self._gram + self._noise / PRIOR**2 * np.eye(len(self._gram))
        self._root = np.asarray(np.linalg.inv(np.linalg.cholesky(gram)).T)
        return gram

    def _features(self, bends: Array) -> Array:
        bends = np.tanh(bends / _SATURATION_RAD)
        return np.concatenate(
            [[1.0], *(bends[index].prod(axis=1) for index in self._powers)]
        )


_LONGEST_FRAME_INTERVAL_S = 0.2
"""Maximum interval between two frames that are used for the fit, s."""


class Odometry:
    """Body motion of the ensemble members, computed with the local connection.

    All members move according to the change of the mean bends, because the bend
    fluctuations of a single member would rotate its body randomly. Random displacements
    represent the uncertainty of the local connection.

    Attributes:
        twist: mean forward velocity, lateral velocity (m/s) and yaw rate (rad/s) in the
            last step.
    """

    def __init__(
        self, connection: LocalConnection, bends: Array, rng: np.random.Generator
    ) -> None:
        """Initialise the odometry of ensemble members with given bends (rad)."""
        self.connection = connection
        self.twist = np.zeros(3)
        self._features = np.zeros(len(connection.weights))
        draws = rng.normal(size=(len(bends), len(self._features), 3))
        self._draws = draws - draws.mean(axis=0)
        self._forecasting = False
        # Bends at the last call of `apply`, and the time since that call.
        self._bends = bends.copy()
        self._elapsed = 0.0
        self._frame_age = math.inf

    def advance(self, dt: float) -> None:
        """Add a time step (s) to the elapsed time without moving the bodies."""
        self._elapsed += dt
        self._frame_age += dt

    def apply(self, pose: Array, bends: Array) -> None:
        """Update the poses in place for the bend changes since the last call."""
        if not self._elapsed:
            return
        before = self._bends.mean(axis=0)
        after = bends.mean(axis=0)
        features = self.connection.features(before, after)
        change = after - before
        if self._forecasting:
            change = bends - self._bends
        step = change @ self.connection.matrix((before + after) / 2).T
        step = step + self.connection.sample_model_error(features, self._draws)
        # The heading in the middle of the step makes the integration second-order
        # accurate.
        heading = pose[:, 2] + step[:, 2] / 2
        c = np.cos(heading)
        s = np.sin(heading)
        x = step[:, 0]
        y = step[:, 1]
        pose += np.column_stack([c * x - s * y, s * x + c * y, step[:, 2]])
        self.twist = step.mean(axis=0) / self._elapsed
        self._features = self._features + features
        self._bends = bends.copy()
        self._elapsed = 0.0

    def learn(self, pose: Array, bend: Array, poses: Array, bends: Array) -> None:
        """Update the fit of the local connection with a motion capture frame.

        Args:
            pose: mean pose (m, m, rad) before the correction by the frame.
            bend: mean bends before the correction, rad.
            poses: corrected poses (m, m, rad) of the ensemble members.
            bends: corrected bends of the ensemble members, rad.
        """
        connection = self.connection
        now = bends.mean(axis=0)
        if self._frame_age < _LONGEST_FRAME_INTERVAL_S:
            x, y, turn = poses.mean(axis=0) - pose
            c = math.cos(pose[2])
            s = math.sin(pose[2])
            residual = np.array([c * x + s * y, c * y - s * x, turn])
            # The predicted pose already contains the motion due to W. This motion is
            # added back, because W is fitted to the whole deviation from A_w.
            residual += self._features @ connection.weights
            residual -= connection.kinematic_matrix((bend + now) / 2) @ (now - bend)
            connection.learn(self._features + connection.features(bend, now), residual)
        self._features = np.zeros_like(self._features)
        self._frame_age = 0.0
        self._bends[:] = bends

    def interrupt(self) -> None:
        """Exclude the motion since the last frame from the fit."""
        self._frame_age = math.inf

    def restart(self, bends: Array) -> None:
        """Set the bends (rad) of the members without moving the bodies."""
        self._bends = bends.copy()
        self.interrupt()

    def forecaster(self, before: Array, bends: Array) -> Odometry:
        """Return a copy for predictions, in which each member follows its own bends.

        The bends (rad) of the copied members are changed from `before` to `bends`.
        """
        other = copy.copy(self)
        vars(other).update(
            connection=self.connection.snapshot(),
            _forecasting=True,
            _draws=self._draws[: len(bends)],
            _bends=self._bends[: len(bends)] + bends - before,
        )
        return other
