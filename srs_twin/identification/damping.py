r"""Stiffness and damping of a segment from the decay of its free swing (`hanging_segment`).

A recording is a CSV file with ``time_s`` and ``bend_rad`` (or ``bend_deg``), at 100 Hz or more. The segment
hangs with a known body at its end, is held bent and is released. Only the known mass and the weight turn the
frequency into a stiffness: the decay alone shows k/m and T. Optional ``pressure_plus_kpa`` and
``pressure_minus_kpa`` are gauge pressures of closed chambers.

**Fit.** All recordings share k, T and the leak rate. Each has its own start, rest bend, and two exponentials
with which its rest bend recovers from having been held. Without measured pressures, closed chambers are at
ambient pressure at the first sample of the recording. Their air at the release follows from the recorded
bends until then and the leak rate.

**Intervals.** Residuals are weighted with their noise, the smallest singular values of the recording's
trajectory matrix, and an allowance for the model. The widening by correlated residuals is that of all fits
(`least_squares`). k and T are those of viscous damping, η = 2π f T. A material with a constant loss factor
has another decay with an equal stiffness and loss at f. Its fit is the reference that measures the model
error. The frequency does not depend on the law, so its interval is that of a fit without model error.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from scipy.interpolate import CubicSpline

from srs_twin.errors import InputError, check_choice
from srs_twin.identification.estimate import (
    IDENTIFIED_ERROR,
    FitEstimate,
    Parameter,
    Residual,
    Role,
)
from srs_twin.identification.fit_file import DataSet
from srs_twin.identification.hanging_segment import (
    NO_BRANCHES,
    HangingSegment,
    Material,
    Ringing,
    constant_loss,
    ringing,
    swing,
    weight_moment,
)
from srs_twin.identification.least_squares import SearchOptions, Watch, least_squares
from srs_twin.identification.parameters import FreeParameter, free_parameters
from srs_twin.io.files import StrPath
from srs_twin.pneumatics.chambers import AMBIENT_PA, air_bend, bend_law, chamber_gains
from srs_twin.recordings.csv_table import CLOCK, read_table
from srs_twin.recordings.recorded_file import read_file
from srs_twin.recordings.signals.units import ANGLES, PRESSURES
from srs_twin.robot.spec import RobotSpec

NAMES = ("bending.stiffness_nm_per_rad", "bending.damping_time_s")
VALVES = ("open", "closed")

DECAY_COLUMNS = "time_s,bend_rad"
"""First line of a recording of a decay."""

_MIN_RATE_HZ = 100.0
_MIN_SAMPLES = 20
_MIN_SAMPLES_PER_SWING = 5.0
_MIN_HALF_SWINGS = 3
_MIN_TURN = 6.0
"""Smallest visible half swing, in standard deviations of the noise."""

_MIN_SIZE = 12.0
"""Smallest range of the bends, in standard deviations of the noise, which alone has a range of about 6."""

_MIN_TURN_SHARE = 0.02
"""Smallest visible half swing, as a fraction of the largest bend."""

_MODEL_ERROR = 0.01
"""Allowance for the model, as a fraction of the largest bend."""

_WINDOW = 12
"""Columns of the trajectory matrix, more than the exponentials of a swing."""

_KEPT_SPANS = 2.0
"""Length of the used part, in lengths of the visible swing."""

_LEAST_DECREMENT = 0.01
"""Smallest logarithmic decrement with which a search starts."""

_CREEP_RATIOS = (3.0, 12.0)
"""Time constants of the recovery, as multiples of 1/ω."""

_STAGES = (2.0, 4.0, 8.0)
"""Swings to which the model is fitted first, because a wrong frequency slips by whole swings later on."""

_MIN_CALM_SAMPLES = 5
_MAX_CALM_SAMPLES = 25
"""Samples at rest that count for the rest bend; further ones share errors of the model."""

_FIRST_LEAK = 0.1
"""Leak rate with which a search starts, 1/s."""

_SEARCH = SearchOptions(step=1e-3, tolerance=1e-8)
"""Steps across which the kinks of the air's stiffness at zero bend average out."""

_UPSAMPLING = 4
"""Points per sample between which measured pressures are interpolated linearly."""


@dataclass(frozen=True)
class Decay:
    """Free swing of a released segment.

    Attributes:
        name: name of the data.
        sha256: SHA-256 of the file.
        time: times of the free swing, shape (samples,), s.
        bend: measured bends, shape (samples,), rad.
        before: bends recorded before the free swing, and its first one, shape (earlier samples + 1,), rad.
        before_time: times of these bends, s.
        pressure: measured gauge pressures, + before −, shape (samples, 2), Pa; None if not measured.
        noise: standard deviation of a bend, rad.
        half_period: mean time between two turning points, s.
        log_decrement: mean logarithm of the ratio of two successive half swings.
    """

    name: str
    sha256: str
    time: np.ndarray
    bend: np.ndarray
    before: np.ndarray
    before_time: np.ndarray
    pressure: np.ndarray | None
    noise: float
    half_period: float
    log_decrement: float

    @property
    def pulsation(self) -> float:
        """Approximate ringing frequency ω, rad/s."""
        return math.pi / self.half_period

    def text(self) -> str:
        """Return what was found in the recording, one line."""
        return (
            f"{self.name}: free swing from {self.time[0]:.3f} to {self.time[-1]:.3f} s, about "
            f"{0.5 / self.half_period:.3g} Hz, noise {self.noise:.2g} rad"
        )

    def data_set(self, role: Role) -> DataSet:
        """Return name, hash and size of the data."""
        return DataSet(
            self.name, self.sha256, role, len(self.time), float(self.time[0]), float(self.time[-1])
        )


def read_decay(path: StrPath, *, start: float | None = None, noise: float | None = None) -> Decay:
    """Read the free swing in a recording.

    Args:
        path: CSV file.
        start: time from which the segment swings freely, s; None: the
            time of its largest speed, about a quarter of a swing after the release.
        noise: standard deviation of a bend, rad; None: estimated.

    Raises:
        InputError: a column is missing, or the recording does not show a swing that tells k and T apart.
    """
    pressures = dict.fromkeys(("pressure_plus", "pressure_minus"), PRESSURES)
    table = read_table(read_file(path), CLOCK | {"bend": ANGLES} | pressures)
    file = table.file
    by_name = {column.name: column for column in table.columns if not column.number}
    if "bend" not in by_name:
        raise file.error(f"no column 'bend_rad'; a recording of a decay has {DECAY_COLUMNS}", 1)
    measured = [name for name in pressures if name in by_name]
    if len(measured) == 1:
        raise file.error(f"{measured[0]} alone; give the pressures of both chambers or none", 1)
    clock = table.clock(f"no time; a recording of a decay has {DECAY_COLUMNS}")
    rows = table.read_timed(clock, [by_name[name] for name in ("bend", *measured)])
    known = np.isfinite(rows.values).all(axis=1)
    time, values = rows.time[known], rows.values[known]
    if len(time) < _MIN_SAMPLES or not (np.diff(time) > 0).all():
        problem = f"{len(time)} samples; at least {_MIN_SAMPLES} with increasing times are needed"
        raise file.error(problem)
    rate = 1 / float(np.median(np.diff(time)))
    if rate < _MIN_RATE_HZ * (1 - 1e-3):
        raise file.error(f"{rate:.3g} samples per second; {_MIN_RATE_HZ:g} Hz or more is needed")
    pressure = values[:, 1:] if measured else None
    return free_swing(file.name, file.sha256, time, values[:, 0], pressure, start=start, noise=noise)


def free_swing(
    name: str,
    sha256: str,
    time: np.ndarray,
    bend: np.ndarray,
    pressure: np.ndarray | None = None,
    *,
    start: float | None = None,
    noise: float | None = None,
) -> Decay:
    """Return the free swing in recorded bends; the arguments are those of `Decay` and `read_decay`.

    Raises:
        InputError: the swing is too small, too short, overdamped or too fast for the sampling.
    """
    noise = _noise(bend) if noise is None else noise
    if start is None:
        first = int(np.argmax(np.abs(np.diff(bend) / np.diff(time)))) + 1
    else:
        first = int(np.searchsorted(time, start))
    size = float(np.ptp(bend[max(first - 1, 0) :])) if first < len(bend) else 0.0
    threshold = max(_MIN_TURN * noise, _MIN_TURN_SHARE * size)
    if size <= _MIN_SIZE * noise:
        raise InputError(
            f"{name}: the amplitude is within the noise ({noise:.2g} rad); release the segment from a larger "
            "bend"
        )
    turns = [first + turn for turn in _turning_points(bend[first:], threshold)]
    if len(turns) < _MIN_HALF_SWINGS:
        raise InputError(
            f"{name}: {len(turns)} visible half swings; {_MIN_HALF_SWINGS} or more are needed. An overdamped "
            "decay tells only the product k T: hang a heavier body, or record longer"
        )
    half_period = float(time[turns[-1]] - time[turns[0]]) / (len(turns) - 1)
    spacing = float(np.median(np.diff(time)))
    if 2 * half_period < _MIN_SAMPLES_PER_SWING * spacing:
        raise InputError(
            f"{name}: {2 * half_period / spacing:.2g} samples per swing; {_MIN_SAMPLES_PER_SWING:g} or more are "
            "needed: record faster, or hang a heavier body"
        )
    end = time[first] + _KEPT_SPANS * (time[turns[-1]] - time[first])
    used = slice(first, int(np.searchsorted(time, end, side="right")))
    if len(time[used]) < _MIN_SAMPLES:
        problem = f"{len(time[used])} samples of free swing; {_MIN_SAMPLES} or more are needed"
        raise InputError(f"{name}: {problem}")
    swings = np.abs(np.diff(bend[turns]))
    decrement = float(np.mean(np.log(swings[:-1] / swings[1:])))
    return Decay(
        name,
        sha256,
        time[used],
        bend[used],
        bend[: first + 1],
        time[: first + 1],
        None if pressure is None else pressure[used],
        noise,
        half_period,
        max(decrement, _LEAST_DECREMENT),
    )


def _noise(bend: np.ndarray) -> float:
    windows = sliding_window_view(bend - bend.mean(), _WINDOW)
    singular = np.linalg.svd(windows, compute_uv=False)
    return max(float(singular[-3]) / math.sqrt(len(windows)), 1e-9)


def _turning_points(bend: np.ndarray, threshold: float) -> list[int]:
    """Return the samples at which the bend turns back by more than a threshold."""
    turns: list[int] = []
    extreme, direction = 0, 0.0
    for k, value in enumerate(bend):
        ahead = (value - bend[extreme]) * direction
        if direction == 0.0 and abs(value - bend[0]) > threshold:
            extreme, direction = k, math.copysign(1.0, value - bend[0])
        elif ahead > 0:
            extreme = k
        elif ahead < -threshold:
            turns.append(extreme)
            extreme, direction = k, -direction
    return turns


@dataclass(frozen=True)
class HangingBody:
    """Body at the end of the segment.

    Attributes:
        mass: mass m, kg.
        inertia: moment of inertia J about its centre, kg·m².
    """

    mass: float
    inertia: float

    @classmethod
    def of(cls, spec: RobotSpec, mass: float | None = None, inertia: float | None = None) -> HangingBody:
        """Return the first connector of a robot, or a body with another mass or moment of inertia.

        Without `inertia`, the body has the connector's radius of gyration.

        Raises:
            InputError: a value is not positive, or the robot has no segment of this kind.
        """
        if spec.skin is not None or spec.chamber.directions is not None:
            raise InputError(
                f"{spec.name}: a decay is only fitted for planar segments between connectors; this robot has "
                "a skin or bends in space"
            )
        connector = spec.mass.connectors[0]
        mass = connector if mass is None else mass
        inertia = float(spec.yaw_inertia()[0]) * mass / connector if inertia is None else inertia
        if not (math.isfinite(mass) and mass > 0 and math.isfinite(inertia) and inertia >= 0):
            raise InputError(
                f"mass {mass:g} kg with inertia {inertia:g} kg·m² is not allowed; give more than 0"
            )
        return cls(mass, inertia)

    def segment(self, spec: RobotSpec, encloses_air: bool) -> HangingSegment:
        """Return the first segment of a robot with this body at its end."""
        g, chamber = spec.geometry, spec.chamber
        plus, minus = (float(gain) for gain in chamber_gains(spec)[0])
        air = (plus, minus, bend_law(spec), chamber.dead_volume, chamber.displacement)
        return HangingSegment(g.segment_length, g.rigid_gap, self.mass, self.inertia, *air, encloses_air)


def fit_damping(
    decays: Sequence[Decay],
    spec: RobotSpec,
    *,
    valves: str = "open",
    body: HangingBody | None = None,
    leak: float | None = None,
    watch: Watch | None = None,
) -> FitEstimate:
    """Estimate stiffness and damping time, with the ringing frequency and the loss factor.

    Args:
        decays: free swings of the same segment with the same body.
        spec: robot whose geometry and chambers are used.
        valves: whether the chambers were open to the air or closed.
        body: hanging body; None: the first connector.
        leak: leak rate of closed chambers, 1/s; None: fitted.
        watch: progress callback, see `least_squares`.

    Raises:
        InputError: there is no decay, or the valves are unknown or contradict measured pressures.
    """
    check_choice("valves", valves, VALVES)
    if not decays:
        raise InputError("a fit needs decays; give at least one")
    measured = [decay.pressure is not None for decay in decays]
    if any(measured) and (valves == "open" or not all(measured)):
        raise InputError("measured pressures need closed valves, and all files must have them")
    body = body or HangingBody.of(spec)
    fit = _DampingFit(decays, spec, body, valves == "closed", leak)
    bends = [decay.bend for decay in decays]
    values: dict[str, float] = {}
    for swings in _STAGES:
        values |= fit.search(fit.coarse_unknowns(values), bends, watch, swings=swings).values
    start = fit.search(fit.unknowns(values), bends, watch)
    values |= start.values
    estimate = fit.search(fit.unknowns(values), bends, watch, fit.refit)
    frequency = _derived(start, fit, "frequency", "Hz", fit.frequency_error(values))
    loss = _derived(estimate, fit, "loss_factor", "1")
    kept = [k for k, parameter in enumerate(estimate.parameters) if parameter.name in NAMES]
    return replace(
        estimate,
        parameters=tuple(estimate.parameters[k] for k in kept),
        correlation=estimate.correlation[np.ix_(kept, kept)],
        derived=tuple(quantity for quantity in (frequency, loss) if quantity is not None),
        held=fit.held(estimate.values),
    )


class _DampingFit:
    """Model of several decays as a function of the unknowns."""

    def __init__(
        self, decays: Sequence[Decay], spec: RobotSpec, body: HangingBody, closed: bool, leak: float | None
    ) -> None:
        self.decays, self.spec, self.body, self.closed = decays, spec, body, closed
        self.encloses_air = closed and decays[0].pressure is None
        self.segment = body.segment(spec, self.encloses_air)
        self.defaults: dict[str, float] = {}
        self.free_leak = self.encloses_air and leak is None
        self.leak = _FIRST_LEAK if self.free_leak else leak or 0.0
        self.calm = [_calm_samples(decay) for decay in decays] if self.encloses_air else []
        self.grids = [_grid(decay) for decay in decays]
        self.air = [_measured_air(decay, spec, grid) for decay, grid in zip(decays, self.grids, strict=True)]

    def unknowns(self, known: Mapping[str, float] | None = None) -> list[FreeParameter]:
        """Return the free parameters, which start at known values or at those of the recordings."""
        unknowns = self.coarse_unknowns(known)
        starts = known or {}
        if self.free_leak:
            unknowns.append(_free("leak", "1/s", starts, _FIRST_LEAK, (-2.0, 30.0), 1.0))
        for k, decay in enumerate(self.decays):
            size = float(np.ptp(decay.bend))
            unknowns += [
                _free(f"creep_{j}_{k}", "rad", starts, 0.0, (-3 * size, 3 * size), size)
                for j in range(len(_CREEP_RATIOS))
            ]
        return unknowns

    def coarse_unknowns(self, known: Mapping[str, float] | None = None) -> list[FreeParameter]:
        """Return the free parameters without the leak and the recovery, which short swings do not show."""
        first, starts = self.decays[0], known or {}
        # The squared frequency is linear in k: the weight adds a constant, the air a share of k.
        segment, squared = self.body.segment(self.spec, self.closed), first.half_period**-2 / 4
        air = self.air_at_end(first)
        rings = (ringing(segment, Material(k, 0.0), 0.0, air) for k in (1.0, 2.0))
        one, two = (ring.frequency**2 for ring in rings)
        stiffness = max(1 + (squared - one) / (two - one), 0.05 * squared / one)
        damping_time = 2 * first.log_decrement / (math.pi * first.pulsation)
        guesses = dict(zip(NAMES, (stiffness, damping_time), strict=True)) | starts
        unknowns = list(free_parameters(self.spec, NAMES, starts=guesses))
        for k, decay in enumerate(self.decays):
            size = float(np.ptp(decay.bend))
            speed = size * decay.pulsation
            rate = float(np.polyfit(decay.time[:3] - decay.time[0], decay.bend[:3], 1)[0])
            rest = float(np.median(decay.bend[len(decay.bend) // 2 :]))
            unknowns += [
                _free(f"bend_{k}", "rad", starts, float(decay.bend[0]), (-4.0, 4.0), size),
                _free(f"rate_{k}", "rad/s", starts, rate, (-20 * speed, 20 * speed), speed),
                _free(f"rest_{k}", "rad", starts, rest, (-4.0, 4.0), size),
            ]
        return unknowns

    def material(self, values: Mapping[str, float]) -> Material:
        return Material(values[NAMES[0]], values[NAMES[1]], values.get("leak", self.leak))

    def small_swing(self, values: Mapping[str, float]) -> Ringing:
        """Return the small oscillation at the end of the first recording."""
        first, segment = self.decays[0], self.body.segment(self.spec, self.closed)
        if self.encloses_air:
            air = self._swing(values, 0)[1][2:4]
        else:
            air = self.air_at_end(first)
        rest = values.get("rest_0", self.defaults["rest_0"])
        return ringing(segment, self.material(values), rest, air)

    def air_at_end(self, decay: Decay) -> np.ndarray:
        """Return the amounts of air for the mean pressures in the last quarter of a recording, J."""
        end = slice(-(len(decay.time) // 4), None)
        pressure = 0.0 if decay.pressure is None else decay.pressure[end].mean(axis=0)
        amounts: np.ndarray = (AMBIENT_PA + pressure) * self._volumes(np.median(decay.bend[end]))
        return amounts

    def _volumes(self, bend: np.ndarray | float) -> np.ndarray:
        """Return the volumes of the chambers, + before −, shape (…, 2), m³."""
        chamber = self.spec.chamber
        grown = np.maximum(0.0, np.stack([bend, np.negative(bend)], axis=-1))
        return np.asarray(chamber.dead_volume + chamber.displacement * grown)

    def held(self, values: Mapping[str, float]) -> dict[str, float]:
        """Return the values on which the estimates depend."""
        held = {"mass_kg": self.body.mass, "inertia_kg_m2": self.body.inertia}
        if self.closed and values.keys() >= set(NAMES):
            held["air_stiffness_nm_per_rad"] = self.small_swing(values).air_stiffness
        if self.closed and not self.free_leak:
            held["leak_per_s"] = self.leak
        return held

    def predict(self, values: Mapping[str, float], *, constant: bool = False) -> list[np.ndarray]:
        """Return the bends of all recordings.

        Args:
            values: values of the unknowns.
            constant: whether the loss factor is constant instead of proportional to the frequency.
        """
        pulsation = 2 * math.pi * self.small_swing(values).frequency if constant else None
        return [self._swing(values, k, pulsation)[0] for k in range(len(self.decays))]

    def _swing(
        self, values: Mapping[str, float], k: int, constant_about: float | None = None
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return the bends of a recording and the last state; with a constant loss about a frequency (rad/s)."""
        values = self.defaults | dict(values)
        decay, grid, material = self.decays[k], self.grids[k], self.material(values)
        branches, moments = NO_BRANCHES, np.empty(0)
        air = self._enclosed_air(decay, material.leak)
        rest = values[f"rest_{k}"] + self.air[k]
        for j, ratio in enumerate(_CREEP_RATIOS):
            fade = np.exp((grid[0] - grid) * decay.pulsation / ratio)
            rest = rest + values.get(f"creep_{j}_{k}", 0.0) * fade
        bend, rate = values[f"bend_{k}"], values[f"rate_{k}"]
        if constant_about is not None:
            material, branches, moments = constant_loss(material, constant_about, rate)
        start = np.concatenate([[bend, rate], air, moments])
        path, end = swing(grid, start, rest, decay.pulsation, material, self.segment, branches)
        return path[:: len(grid) // len(decay.time)], end

    def _enclosed_air(self, decay: Decay, leak: float) -> np.ndarray:
        """Return the amounts of air at the start of the free swing, + chamber before −, J."""
        if not self.encloses_air:
            return np.zeros(2)
        volumes = self._volumes(decay.before)
        # The air tends to that of ambient pressure, which changes with the volume.
        kept = np.exp(-leak * (decay.time[0] - decay.before_time))
        weights = np.append(np.diff(kept), 0.0)
        amounts: np.ndarray = AMBIENT_PA * (kept[0] * volumes[0] + weights @ volumes)
        return amounts

    def search(
        self,
        unknowns: Sequence[FreeParameter],
        bends: Sequence[np.ndarray],
        watch: Watch | None = None,
        refit: Callable[[Mapping[str, float]], Mapping[str, float]] | None = None,
        swings: float = math.inf,
    ) -> FitEstimate:
        """Fit the unknowns to the bends of the first swings."""

        def residuals(values: Mapping[str, float]) -> list[Residual]:
            result = []
            for decay, bend, path in zip(self.decays, bends, self.predict(values), strict=True):
                used = decay.time <= decay.time[0] + 2 * swings * decay.half_period
                difference = (bend - path)[used]
                result.append(Residual(f"{decay.name} bend", "rad", difference, _scale(decay)))
            return [*result, *self._rest_residuals(values)]

        # A parameter without a value keeps its start, so that predictions remain possible.
        self.defaults = {unknown.name: unknown.start for unknown in unknowns}
        return least_squares(residuals, unknowns, watch=watch, refit=refit, options=_SEARCH)

    def frequency_error(self, values: Mapping[str, float]) -> float:
        """Return ln of the fitted over the true frequency for a material with a constant loss factor."""
        fitted = self.small_swing(self.refit(values)).frequency
        pulsation = 2 * math.pi * self.small_swing(values).frequency
        air = (
            self._swing(values, 0, pulsation)[1][2:4]
            if self.encloses_air
            else self.air_at_end(self.decays[0])
        )
        material, branches, _ = constant_loss(self.material(values), pulsation, 0.0)
        segment = self.body.segment(self.spec, self.closed)
        return math.log(fitted / ringing(segment, material, values["rest_0"], air, branches).frequency)

    def _rest_residuals(self, values: Mapping[str, float]) -> Iterator[Residual]:
        """Yield the rest bends that follow from closed chambers at rest before they are bent."""
        k = values[NAMES[0]]
        for i, calm in enumerate(self.calm):
            decay = self.decays[i]
            bend = float(decay.before[:calm].mean())
            rest = bend - weight_moment(self.segment, bend) / k
            scale = _scale(decay) / math.sqrt(min(calm, _MAX_CALM_SAMPLES))
            yield Residual(f"{decay.name} rest", "rad", np.array([rest - values[f"rest_{i}"]]), scale)

    def refit(self, values: Mapping[str, float]) -> Mapping[str, float]:
        """Return the fit to decays of a material with a constant loss factor."""
        bends = self.predict(values, constant=True)
        return dict(values) | self.search(self.unknowns(values), bends).values


def _calm_samples(decay: Decay) -> int:
    """Return the number of samples at rest at the start of a recording.

    Raises:
        InputError: the recording begins with a bent or moving segment.
    """
    moved = np.abs(decay.before - np.median(decay.before[:_MIN_CALM_SAMPLES])) > _MIN_TURN * decay.noise
    calm = int(np.argmax(moved)) if moved.any() else len(moved)
    held = decay.before[decay.before_time < decay.time[0] - decay.half_period]
    bent = float(np.abs(held - decay.before[0]).max(initial=0.0))
    if calm < _MIN_CALM_SAMPLES or bent < float(np.ptp(decay.bend)) / 4:
        raise InputError(
            f"{decay.name}: the recording of closed valves begins with a bent or moving segment; close the "
            "valves at rest, start recording, and only then bend and release it (or record the pressures)"
        )
    return calm


def _grid(decay: Decay) -> np.ndarray:
    if decay.pressure is None:
        return decay.time
    samples = np.arange(len(decay.time))
    return np.interp(np.arange(len(samples) * _UPSAMPLING) / _UPSAMPLING, samples, decay.time)


def _measured_air(decay: Decay, spec: RobotSpec, grid: np.ndarray) -> np.ndarray:
    """Return the bends due to measured pressures on a grid, shape (points,), rad."""
    if decay.pressure is None:
        return np.zeros(len(grid))
    pressure = np.zeros((len(decay.time), spec.segments, 2))
    pressure[:, 0] = decay.pressure
    return np.asarray(CubicSpline(decay.time, air_bend(spec, pressure)[:, 0])(grid))


def _scale(decay: Decay) -> float:
    return math.hypot(decay.noise, _MODEL_ERROR * float(np.ptp(decay.bend)) / 2)


def _free(
    name: str,
    unit: str,
    known: Mapping[str, float],
    guess: float,
    bounds: tuple[float, float],
    scale: float | None = None,
) -> FreeParameter:
    start = min(max(known.get(name, guess), bounds[0]), bounds[1])
    return FreeParameter(name, unit, start, *bounds, scale)


def _derived(
    estimate: FitEstimate, fit: _DampingFit, name: str, unit: str, model_error: float = 0.0
) -> Parameter | None:
    """Return a quantity of the small oscillation with the interval that follows from all parameters.

    The interval is that of its logarithm, with linear propagation of errors.

    Args:
        estimate: estimate with all unknowns.
        fit: model.
        name: attribute of `Ringing`.
        unit: unit of the quantity.
        model_error: further error of the logarithm.
    """
    values = estimate.values
    if not values.keys() >= set(NAMES):
        return None

    def logarithm(changed: Mapping[str, float]) -> float:
        return math.log(getattr(fit.small_swing(changed), name))

    rows = [k for k, parameter in enumerate(estimate.parameters) if parameter.value is not None]
    known = [estimate.parameters[k] for k in rows]
    slopes = []
    for parameter in known:
        error = parameter.standard_error or 0.0
        step = 1e-3 * error
        up, down = values[parameter.name] + step, values[parameter.name] - step
        change = logarithm(values | {parameter.name: up}) - logarithm(values | {parameter.name: down})
        slopes.append(change / 2e-3)
    row = np.array(slopes)
    error = math.sqrt(max(float(row @ estimate.correlation[np.ix_(rows, rows)] @ row), 0.0))
    error = math.hypot(error, model_error)
    stiffness = estimate[NAMES[0]]
    half = math.log(stiffness.high / stiffness.low) / 2 * stiffness.value / stiffness.standard_error
    value = math.exp(logarithm(values))
    low, high = value * math.exp(-half * error), value * math.exp(half * error)
    verdict, why = stiffness.verdict, stiffness.why
    if verdict != "cannot tell":
        verdict = "identified" if error <= IDENTIFIED_ERROR else "weakly identified"
        why = ""
    return Parameter(name, unit, verdict, value, value * error, low, high, why)
