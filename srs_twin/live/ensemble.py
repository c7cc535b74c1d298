"""Ensemble Kalman filter for the pose, bends and pressures of a robot.

The state of each ensemble member contains a pose, velocities, bends, chamber pressures,
and the gains and biases of the modules. The model error is represented by a disturbance
of each bend, which is modelled as a first-order Gauss–Markov process. The pressures and
bends are predicted with the `compliant` model (`member_dynamics`), and the body motion
is computed from the bend changes (`odometry`). Measurements do not correct the gains
and biases, because correlations in a small ensemble are partly spurious. Instead, the
gains and biases are drawn from the distributions that the fault detector estimates.

The ensemble square root filter (Whitaker and Hamill 2002) processes the measurements
one after another:

- With localisation, a bend sensor or a pressure sensor corrects only the states of its
  own segment. Motion capture corrects the pose, all bends and all disturbances.
- If an innovation exceeds four standard deviations, the noise variance of the
  measurement is increased.
- The noise of motion capture frames is estimated (Desroziers and others 2005).
"""

from __future__ import annotations

import copy
import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from itertools import accumulate, pairwise
from typing import NamedTuple

import numpy as np

from srs_twin.compute.compiled import allocating, compiled
from srs_twin.live.member_dynamics import STEP_S, Air, MemberDynamics, ValveInput
from srs_twin.live.odometry import LocalConnection, Odometry
from srs_twin.live.pressure_table import PressureRates
from srs_twin.live.uncertain import Estimates
from srs_twin.pneumatics.chambers import AMBIENT_PA
from srs_twin.robot.geometry import body_shape, measured_bend, relative_headings
from srs_twin.robot.spec import RobotSpec

_OUTLIER = 4.0
"""Innovation, in standard deviations, above which a measurement is an outlier."""
_NOISE_FRAMES = 10
"""Number of motion capture frames over which the estimated noise is averaged."""
_LEAST_NOISE = {"place": 0.4, "heading": 1.0}
"""Lower limit of the estimated frame noise, as a fraction of the assumed noise.

The errors due to the assumption of circular arcs are nearly constant in time, so the
innovations underestimate the heading noise."""
_LARGEST_NOISE = 10.0
"""Upper limit of the estimated frame noise, as a multiple of the assumed noise."""
_MOVED_SD = 6.0
"""Median innovation, in standard deviations, above which the robot may have been moved.
"""
_MOVED_FRAMES = 5
"""Number of successive frames with large innovations that indicate a moved robot."""
_PLACE_FACTOR = 5.0
"""Initial standard deviation of the position, as a multiple of the position noise."""
_HEADING_FACTOR = 2.0
"""Initial standard deviation of the heading, as a multiple of the heading noise."""
_POSE = slice(0, 3)


@dataclass(frozen=True)
class ModelError:
    """Standard deviations of the model errors.

    Attributes:
        disturbance: standard deviation of the disturbance of each bend, rad.
        disturbance_s: time constant of the disturbances, s.
        pressure: initial random walk of the pressures per √s, relative to the nominal
            supply pressure.
        position: random walk of the position, m/√s. Division by half the body length
            yields the random walk of the heading, rad/√s.
    """

    disturbance: float = 0.05
    disturbance_s: float = 0.12
    pressure: float = 0.15
    position: float = 0.003


@dataclass(frozen=True)
class MeasurementNoise:
    """Standard deviations of the measurement noise.

    Attributes:
        bend: noise of a bend sensor, rad.
        pressure: noise of a pressure sensor, Pa.
        place: noise of a connector position, including the error due to the assumption
            of circular arcs, m.
        heading: noise of a connector heading, rad.
    """

    bend: float = 0.02
    pressure: float = 500.0
    place: float = 0.0015
    heading: float = 0.02


class EnsembleFilter:
    """Ensemble Kalman filter for the state of a robot.

    Attributes:
        members: states of the ensemble members, one row per member.
        columns: columns of `members`, keyed by name. The names are `x`, `y`, `heading`,
            `motion`, `bend`, `pressure`, `lagged`, `disturbance`, `gain` and `bias`.
            The `motion` columns contain the forward velocity, the lateral velocity, the
            yaw rate and the bend rates. The `lagged` columns contain the pressures
            after the first-order lag that precedes the free bends.
        placed: whether the poses have been initialised by motion capture.
    """

    placed: bool

    def __init__(
        self,
        spec: RobotSpec,
        *,
        members: int = 32,
        seed: int = 0,
        error: ModelError = ModelError(),
    ) -> None:
        """Initialise members at rest with empty chambers and an unknown position."""
        self.spec = spec
        self.error = error
        self.noise = MeasurementNoise()
        self._rng = np.random.default_rng((seed, 0xE5))
        n = self._segments = spec.segments
        sizes = {
            "x": 1,
            "y": 1,
            "heading": 1,
            "motion": 3 + n,
            "bend": n,
            "pressure": 2 * n,
            "lagged": 2 * n,
            "disturbance": n,
            "gain": 2 * n,
            "bias": n,
        }
        ends = accumulate(sizes.values(), initial=0)
        self.columns: Mapping[str, slice] = {
            name: slice(*pair) for name, pair in zip(sizes, pairwise(ends), strict=True)
        }
        self._dynamics = MemberDynamics(spec)
        self.members = np.zeros((members, sum(sizes.values())))
        self._draws = {name: self._random(name) for name in ("gain", "bias")}
        self._modules = Estimates(np.tile([1.0, 1.0, 0.0], (n, 1)), np.zeros((n, 3)))
        self._masks = self._localisation()
        self.rates = PressureRates(n, spec.supply.nominal, error.pressure)
        self._frame_noise: dict[str, float] = {
            name: getattr(self.noise, name) for name in _LEAST_NOISE
        }
        connection = LocalConnection(spec, self._dynamics.mass)
        self.odometry = Odometry(connection, self._of("bend"), self._rng)
        self._restart()
        self._moved_frames = 0

    @property
    def heading_noise_scale(self) -> float:
        """Estimated heading noise of motion capture, divided by the assumed noise."""
        return self._frame_noise["heading"] / self.noise.heading

    def set_modules(self, modules: Estimates) -> None:
        """Set the gains and biases of the members to samples around estimated values.

        Each member keeps its deviation from the mean, measured in standard deviations.

        Args:
            modules: estimated gains g⁺ and g⁻ and bias (rad) of each module, shape
                (segments, 3).
        """
        self._modules = modules
        mean, sd = modules
        gain_sd = sd[:, :2].ravel()
        self._of("gain")[:] = mean[:, :2].ravel() + gain_sd * self._draws["gain"]
        self._of("bias")[:] = mean[:, 2] + sd[:, 2] * self._draws["bias"]

    def predict(self, valves: ValveInput, dt: float, step: float = STEP_S) -> None:
        """Advance the members in time.

        Args:
            valves: valve duties, supply pressures and leaks of the chambers.
            dt: duration, s.
            step: maximum time step, s.
        """
        error = self.error
        disturbance = self._of("disturbance")
        decay = math.exp(-dt / error.disturbance_s)
        sd = error.disturbance * math.sqrt(1 - decay**2)
        disturbance *= decay
        disturbance += sd * self._random("disturbance")
        self._run(valves, dt, step)
        self.odometry.advance(dt)
        half = self.spec.geometry.body_length / 2
        # The random walks of the heading and of the position displace the ends of the
        # body by equal distances.
        walk = self._rng.normal(size=(len(self.members), 3)) * [1.0, 1.0, 1 / half]
        self.members[:, _POSE] += error.position * math.sqrt(dt) * walk

    def update_bends(self, readings: np.ndarray) -> np.ndarray:
        """Correct the members with bend readings.

        Args:
            readings: bend readings, or NaN if missing, shape (segments,), rad.

        Returns:
            Innovations in standard deviations, or NaN for missing readings.
        """
        variances = np.full(self._segments, self.noise.bend**2)
        predicted = self._of("bend").copy()
        return self._measurement_update(
            predicted, readings, variances, self._masks["bend"]
        )

    def update_pressures(self, pressure: np.ndarray) -> np.ndarray:
        """Correct the members with measured pressures.

        Args:
            pressure: gauge pressures, or NaN if missing, shape (segments, 2), Pa.

        Returns:
            Innovations in standard deviations, or NaN for missing pressures.
        """
        predicted = self._of("pressure").copy()
        innovation = pressure - predicted.mean(axis=0).reshape(-1, 2)
        # The pressure rates are learnt first, because the correction of the pressures
        # would hide errors in the rates.
        self.rates.update(innovation, self.noise.pressure)
        variances = np.full(pressure.size, self.noise.pressure**2)
        measured = pressure.ravel()
        return self._measurement_update(
            predicted, measured, variances, self._masks["pressure"]
        )

    def update_poses(self, poses: np.ndarray) -> np.ndarray:
        """Correct the members with a motion capture frame.

        The first frame initialises the poses of the members. If several frames show
        that the robot has been moved by hand, the poses are initialised again.

        Args:
            poses: position x, y (m) and heading (rad) of each connector, or NaN if
                missing, shape (connectors, 3).

        Returns:
            Innovations in standard deviations, shape (3 connectors,).
        """
        self.apply_odometry()
        if not self.placed:
            self._place(poses)
            self.odometry.interrupt()
        pose = self.members[:, _POSE].mean(axis=0)
        bend = self.mean("bend")
        predicted = self.poses()
        turn = poses[:, 2] - predicted[:, :, 2].mean(axis=0)
        # Measured headings may differ from estimated headings by multiples of 2π.
        poses = poses.copy()
        poses[:, 2] -= 2 * np.pi * np.round(turn / (2 * np.pi))
        before = poses - predicted.mean(axis=0)
        place = self._frame_noise["place"]
        noise = np.square([place, place, self._frame_noise["heading"]])
        innovation = self._measurement_update(
            predicted.reshape(len(self.members), -1),
            poses.ravel(),
            np.tile(noise, len(poses)),
            self._masks["pose"],
            correlated=True,
        )
        moved = False
        if not np.isnan(innovation).all():
            after = poses - self.poses().mean(axis=0)
            for name, axes in (("place", slice(2)), ("heading", 2)):
                self._estimate_noise(name, before[:, axes], after[:, axes])
            moved = bool(np.nanmedian(np.abs(innovation)) > _MOVED_SD)
        if moved:
            self.odometry.interrupt()
        self.odometry.learn(pose, bend, self.members[:, _POSE], self._of("bend"))
        self._moved_frames = self._moved_frames + 1 if moved else 0
        if self._moved_frames >= _MOVED_FRAMES:
            self.placed = False
            self._moved_frames = 0
        return innovation

    def apply_odometry(self) -> None:
        """Move the members according to the bend changes since the last call."""
        self.odometry.apply(self.members[:, _POSE], self._of("bend"))

    def poses(self) -> np.ndarray:
        """Return the connector poses (m, m, rad), shape (members, connectors, 3)."""
        bend = self._of("bend")
        g = self.spec.geometry
        x, y, heading = self.members[:, _POSE].T[..., None]
        shape = body_shape(bend, self._dynamics.mass, g.segment_length, g.rigid_gap)
        c = np.cos(heading)
        s = np.sin(heading)
        return np.stack(
            [
                x + c * shape[..., 0] - s * shape[..., 1],
                y + s * shape[..., 0] + c * shape[..., 1],
                heading + relative_headings(bend),
            ],
            axis=-1,
        )

    def mean(self, name: str) -> np.ndarray:
        """Return the ensemble mean of the columns with the given name."""
        return np.asarray(self._of(name).mean(axis=0))

    def sd(self, name: str) -> np.ndarray:
        """Return the ensemble standard deviation of the columns with the given name."""
        return np.asarray(self._of(name).std(axis=0, ddof=1))

    def copy(self, members: int | None = None) -> EnsembleFilter:
        """Return a copy with at most `members` members, for use in another thread."""
        kept = self.members[:members]
        copied = kept.copy()
        if len(kept) < len(self.members):
            # The copied members are shifted and scaled to the mean and the standard
            # deviation of all members.
            scale = self.members.std(axis=0) / np.maximum(kept.std(axis=0), 1e-300)
            deviation = kept - kept.mean(axis=0)
            copied = self.members.mean(axis=0) + scale * deviation
        bend = self.columns["bend"]
        other = copy.copy(self)
        vars(other).update(
            members=copied,
            rates=copy.deepcopy(self.rates),
            odometry=self.odometry.forecaster(kept[:, bend], copied[:, bend]),
            _draws={name: draws[:members] for name, draws in self._draws.items()},
            _rng=np.random.default_rng(0),
        )
        return other

    def forecast(self, inputs: Iterable[ValveInput], dt: float) -> np.ndarray:
        """Advance the members over several intervals, and return the predicted poses.

        Args:
            inputs: chamber inputs in successive intervals.
            dt: duration of each interval, s.

        Returns:
            Position x, y (m) and heading (rad) of each member at the end of each
            interval, shape (intervals, members, 3).
        """
        poses = []
        for valves in inputs:
            self.predict(valves, dt)
            self.apply_odometry()
            poses.append(self.members[:, _POSE].copy())
        return np.array(poses)

    def _of(self, name: str) -> np.ndarray:
        return self.members[:, self.columns[name]]

    def _random(self, name: str) -> np.ndarray:
        numbers = self._rng.normal(size=self._of(name).shape)
        return np.asarray(numbers - numbers.mean(axis=0))

    def _localisation(self) -> dict[str, np.ndarray]:
        n = self._segments
        width = self.members.shape[1]
        bend = np.zeros((n, width))
        pressure = np.zeros((2 * n, width))
        first = {name: columns.start for name, columns in self.columns.items()}
        for k in range(2 * n):
            j = k // 2
            # A pressure sensor also corrects the bend, because an error in the pressure
            # causes an error in the bend.
            own = [first["bend"] + j, first["disturbance"] + j, first["motion"] + 3 + j]
            own += [first["pressure"] + k, first["lagged"] + k]
            bend[j, own] = 1.0
            pressure[k, own] = 1.0
        pose = np.zeros(width)
        for name in ("x", "y", "heading", "bend", "disturbance"):
            pose[self.columns[name]] = 1.0
        return {
            "bend": bend,
            "pressure": pressure,
            "pose": np.tile(pose, (3 * (n + 1), 1)),
        }

    def _measurement_update(
        self,
        predicted: np.ndarray,
        measured: np.ndarray,
        variances: np.ndarray,
        masks: np.ndarray,
        *,
        correlated: bool = False,
    ) -> np.ndarray:
        normalised = measurement_update(
            self.members, predicted, measured, variances, masks, correlated
        )
        # Gauge pressures may be negative, because a moving body can enlarge a closed
        # chamber, but absolute pressures cannot be negative.
        pressure = self._of("pressure")
        np.maximum(pressure, -AMBIENT_PA, out=pressure)
        return np.asarray(normalised)

    def _estimate_noise(self, name: str, before: np.ndarray, after: np.ndarray) -> None:
        if np.isnan(before * after).all():
            return
        usual = getattr(self.noise, name)
        variance = self._frame_noise[name] ** 2
        # In a consistent filter, the product of the residuals before and after the
        # correction has the noise variance as its expected value. The product is
        # limited, so that a single outlier has little effect.
        product = min(max(float(np.nanmean(before * after)), 0.0), 4 * variance)
        estimate = math.sqrt(variance + (product - variance) / _NOISE_FRAMES)
        self._frame_noise[name] = min(
            max(estimate, _LEAST_NOISE[name] * usual), _LARGEST_NOISE * usual
        )

    def _place(self, poses: np.ndarray) -> None:
        seen = ~np.isnan(poses).any(axis=1)
        if not seen.any():
            return
        heading = self._of("heading")[:, 0]
        noise = self.noise
        turn = measured_bend(poses[seen, 2], self.poses()[:, seen, 2])
        # Differences from the first angle are averaged, because angles close to ±π
        # cannot be averaged directly.
        heading += turn[0, 0] + measured_bend(turn, turn[0, 0]).mean(axis=1)
        shift = poses[seen, :2] - self.poses()[:, seen, :2]
        self.members[:, :2] += shift.mean(axis=1)
        draws = self._rng.normal(size=(len(self.members), 3))
        place_sd = _PLACE_FACTOR * noise.place
        heading_sd = _HEADING_FACTOR * noise.heading
        self.members[:, _POSE] += draws * [place_sd, place_sd, heading_sd]
        self.placed = True

    def _run(self, valves: ValveInput, dt: float, step: float) -> None:
        shape = len(self.members), self._segments, 2
        air = Air(
            **{
                name: self._of(name).reshape(shape).copy()
                for name in ("pressure", "lagged", "gain")
            },
            noise=self._random("pressure").reshape(shape),
        )
        drive = self._dynamics.drive(valves, dt, step, air, self.rates)
        self._of("pressure")[:] = air.pressure.reshape(len(self.members), -1)
        self._of("lagged")[:] = air.lagged.reshape(len(self.members), -1)
        bias = self._of("bias") + self._of("disturbance")
        velocity = self._of("motion").copy()
        pose = self.members[:, _POSE]
        bend = self._of("bend")
        bend[:], valid = self._dynamics.bend(pose, bend, velocity, drive, bias)
        self._of("motion")[:] = velocity
        if not valid.any():
            self._restart()
            self.odometry.restart(self._of("bend"))
        elif not valid.all():
            # Diverged members are replaced by copies of valid members.
            others = self._rng.choice(np.flatnonzero(valid), size=int((~valid).sum()))
            self.members[~valid] = self.members[others]

    def _restart(self) -> None:
        self.members[:] = 0.0
        self._of("disturbance")[:] = self.error.disturbance * self._random(
            "disturbance"
        )
        self.set_modules(self._modules)
        self._of("bend")[:] = self._of("bias")
        self.placed = False


class _Innovation(NamedTuple):
    value: float
    mean: float
    spread: float
    total: float
    reduction: float


@allocating
def measurement_update(members, predicted, measured, variances, masks, correlated):  # type: ignore[no-untyped-def]  # noqa: D417
    """Correct the ensemble members in place, one measurement after another.

    Args:
        members: states of the members, shape (members, columns).
        predicted: measurements predicted by each member, shape (members, measurements),
            which are corrected in place if `correlated` is true.
        measured: measurements, or NaN if missing, shape (measurements,).
        variances: noise variance of each measurement, shape (measurements,).
        masks: localisation weights from 0 to 1, shape (measurements, columns).
        correlated: whether each measurement also corrects the predictions of the
            following measurements.

    Returns:
        Innovations in standard deviations, shape (measurements,).
    """
    normalised = np.full(measured.shape[0], np.nan)
    for k in range(measured.shape[0]):
        if not np.isnan(measured[k]):
            own = predicted[:, k]
            innovation = _innovation(own, measured[k], variances[k])
            scale = math.sqrt(innovation.spread + variances[k])
            normalised[k] = innovation.value / scale
            _correct_members(members, masks[k], own, innovation)
            if correlated:
                _correct_predictions(predicted[:, k + 1 :], own, innovation)
    return normalised


@compiled
def _innovation(predicted, measured, variance):  # type: ignore[no-untyped-def]
    mean = _mean(predicted)
    spread = _covariance(predicted, mean, predicted, mean)
    value = measured - mean
    # The noise variance of an outlier is increased, so that the innovation equals
    # `_OUTLIER` standard deviations.
    noise = max(variance, (value / _OUTLIER) ** 2 - spread)
    total = spread + noise
    # The square root filter reduces the gain for deviations from the mean. The ensemble
    # then has the correct variance without perturbed measurements.
    reduction = 1 / (1 + math.sqrt(noise / total))
    return _Innovation(value, mean, spread, total, reduction)


@compiled
def _correct_members(members, mask, predicted, innovation):  # type: ignore[no-untyped-def]
    for column in range(members.shape[1]):
        if mask[column] > 0.0:
            values = members[:, column]
            cross_covariance = _significant_covariance(values, predicted, innovation)
            kalman_gain = mask[column] * cross_covariance / innovation.total
            _shift(values, kalman_gain, predicted, innovation)


@compiled
def _correct_predictions(others, predicted, innovation):  # type: ignore[no-untyped-def]
    for later in range(others.shape[1]):
        values = others[:, later]
        cross_covariance = _covariance(predicted, innovation.mean, values, 0.0)
        _shift(values, cross_covariance / innovation.total, predicted, innovation)


@compiled
def _mean(values):  # type: ignore[no-untyped-def]
    mean = 0.0
    count = values.shape[0]
    for m in range(count):
        mean += values[m] / count
    return mean


@compiled
def _covariance(first, first_mean, second, second_mean):  # type: ignore[no-untyped-def]
    covariance = 0.0
    count = first.shape[0]
    for m in range(count):
        covariance += (first[m] - first_mean) * (second[m] - second_mean) / (count - 1)
    return covariance


@compiled
def _significant_covariance(values, predicted, innovation):  # type: ignore[no-untyped-def]
    middle = _mean(values)
    covariance = 0.0
    own = 0.0
    count = values.shape[0]
    for m in range(count):
        deviation = values[m] - middle
        covariance += (predicted[m] - innovation.mean) * deviation / (count - 1)
        own += deviation**2 / (count - 1)
    # The covariance is reduced, because the squared correlation of a small sample is
    # too large on average.
    square = covariance**2 / max(own * innovation.spread, 1e-300)
    significant = max(1 - (1 - square) / ((count - 2) * max(square, 1e-12)), 0.0)
    return significant * covariance


@compiled
def _shift(values, kalman_gain, predicted, innovation):  # type: ignore[no-untyped-def]
    for m in range(values.shape[0]):
        deviation = predicted[m] - innovation.mean
        values[m] += kalman_gain * (innovation.value - innovation.reduction * deviation)
