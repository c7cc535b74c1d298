"""Stiffness and damping of a segment, fitted to free oscillations after a release.

A free oscillation determines the damping time T, but only the ratio k/m of stiffness to
mass. The stiffness k is identifiable because the mass m and the weight are known.

**Fit.** All recordings share the same stiffness k, damping time T and leak rate,
whereas each recording has its own initial state and rest bend. Two exponentials
describe the slow recovery of the rest bend after a segment has been held bent.

If the pressures were not measured, closed chambers are assumed to be at ambient
pressure at the first sample, when the segment is at rest. The amount of air at the
start of the free swing is computed from the leak rate and the recorded bends. The
effect of the enclosed air can be separated from the stiffness because the rest bend is
recorded before and after the release.

**Intervals.** The residuals are scaled by the combined standard deviation of the noise
and a model error of 1 % of the amplitude. The model assumes viscous damping, so its
loss factor η = 2π f T is proportional to the frequency f. To estimate the error due to
this assumption, the model is fitted to simulated swings of a material with a nearly
constant loss factor. At the frequency f, this material has the fitted stiffness and
loss factor.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from scipy.interpolate import CubicSpline

from srs_twin.errors import InputError, check_choice
from srs_twin.identification.decay import Decay, calm_samples
from srs_twin.identification.estimate import (
    FitEstimate,
    Parameter,
    Residual,
    Verdict,
    half_width,
    verdict_on,
    with_value,
)
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
from srs_twin.identification.least_squares import (
    Refit,
    SearchOptions,
    Watch,
    least_squares,
)
from srs_twin.identification.parameters import FreeParameter, free_parameters
from srs_twin.pneumatics.chambers import (
    AMBIENT_PA,
    air_bend,
    bend_law_of,
    chamber_gains,
)
from srs_twin.robot.spec import RobotSpec

NAMES = ("bending.stiffness_nm_per_rad", "bending.damping_time_s")
VALVES = ("open", "closed")

_MODEL_ERROR = 0.01
"""Assumed model error of the bends, as a fraction of the swing amplitude."""

_CREEP_RATIOS = (3.0, 12.0)
"""Time constants with which the rest bend recovers, as multiples of 1/ω."""

_MAX_CALM_SAMPLES = 25
"""Maximum number of samples at rest that are treated as independent."""

_FIRST_LEAK = 0.1
"""Initial value of the leak rate in a search, 1/s."""

_LEAKS = (-2.0, 30.0)
"""Bounds of the leak rate, 1/s.

The lower bound is negative so that the confidence interval of a small leak rate is not
truncated.
"""

_STAGES = (2.0, 4.0, 8.0)
"""Numbers of swings that are fitted in successive stages.

A search that starts with all swings could miscount the periods and converge to a wrong
frequency.
"""

_SEARCH = SearchOptions(step=1e-3, tolerance=1e-8)
"""Search settings for a model in which the stiffness of the enclosed air has kinks."""

_ERROR_STEP = 1e-3
"""Finite-difference step for derived quantities, in standard errors of a parameter."""

_UPSAMPLING = 4
"""Number of interpolated pressures per recorded sample."""


@dataclass(frozen=True)
class HangingBody:
    """Body that hangs at the end of a segment.

    Attributes:
        mass: mass m, kg.
        inertia: moment of inertia J about the centre of the body, kg·m².
    """

    mass: float
    inertia: float

    @classmethod
    def of(
        cls, spec: RobotSpec, mass: float | None = None, inertia: float | None = None
    ) -> HangingBody:
        """Return a body with the mass and inertia of the first connector.

        The arguments `mass` (kg) and `inertia` (kg·m²) override these values. If only
        `mass` is given, the body keeps the radius of gyration of the connector.
        """
        if spec.skin is not None or spec.chamber.directions is not None:
            raise InputError(
                f"{spec.name}: a decay can be fitted only for planar segments between"
                " connectors, but this robot has a skin or bends in space"
            )
        connector = spec.mass.connectors[0]
        if mass is None:
            mass = connector
        if inertia is None:
            inertia = float(spec.yaw_inertia()[0]) * mass / connector
        if not (0 < mass < math.inf and 0 <= inertia < math.inf):
            raise InputError(
                f"mass {mass:g} kg with inertia {inertia:g} kg·m² is not allowed; the"
                " mass must be above 0 and the inertia at least 0"
            )
        return cls(mass, inertia)

    def segment(self, spec: RobotSpec, encloses_air: bool) -> HangingSegment:
        """Return the first segment of a robot with this body attached to its end."""
        g = spec.geometry
        plus, minus = chamber_gains(spec)[0].tolist()
        return HangingSegment(
            g.segment_length,
            g.rigid_gap,
            self.mass,
            self.inertia,
            plus,
            minus,
            bend_law_of(spec),
            spec.chamber.dead_volume,
            spec.chamber.displacement,
            encloses_air,
        )


def fit_damping(
    decays: Sequence[Decay],
    spec: RobotSpec,
    *,
    valves: str = "open",
    body: HangingBody | None = None,
    leak: float | None = None,
    watch: Watch | None = None,
) -> FitEstimate:
    """Estimate stiffness, damping time, frequency and loss factor.

    The chambers are open to the air or closed, as stated by `valves` ("open" or
    "closed"). By default, `body` has the mass and inertia of the first connector. If
    `leak` (1/s) is None, the leak rate is estimated.
    """
    check_choice("valves", valves, VALVES)
    if not decays:
        raise InputError("a fit needs at least one recorded decay, but none is given")
    measured = [decay.pressure is not None for decay in decays]
    if any(measured) and (valves == "open" or not all(measured)):
        raise InputError(
            "measured pressures can be used only with closed valves, and only if all"
            " files contain them; set `valves` to closed, or remove the pressures"
        )
    fit = _DampingFit(
        decays, spec, body or HangingBody.of(spec), valves == "closed", leak
    )
    for swings in _STAGES:
        fit.search(fit.unknowns(coarse=True), watch=watch, swings=swings)
    start = fit.search(fit.unknowns(), watch=watch)
    # The fitted frequency hardly depends on the assumed damping law. The frequency
    # error is therefore taken from the first fit, before the bias of k and T is
    # included.
    error = fit.frequency_error()
    estimate = fit.search(fit.unknowns(), watch=watch, refit=fit.refit)
    derived: tuple[Parameter, ...] = ()
    if estimate.values.keys() >= set(NAMES):
        frequency = _derived(start, fit, "frequency", "Hz", error)
        derived = (frequency, _derived(estimate, fit, "loss_factor", "1"))
    count = len(NAMES)  # the stiffness and the damping time come first
    return replace(
        estimate,
        parameters=estimate.parameters[:count],
        correlation=estimate.correlation[:count, :count],
        derived=derived,
        held=fit.held(),
    )


class _Swing(NamedTuple):
    """Predicted bends (rad) and final product p V of the air in each chamber (J)."""

    bend: np.ndarray
    air: np.ndarray


class _DampingFit:
    def __init__(
        self,
        decays: Sequence[Decay],
        spec: RobotSpec,
        body: HangingBody,
        closed: bool,
        leak: float | None,
    ) -> None:
        self.decays = decays
        self.spec = spec
        self.body = body
        self.closed = closed
        self.encloses_air = closed and decays[0].pressure is None
        self.segment = body.segment(spec, self.encloses_air)
        self.free_leak = self.encloses_air and leak is None
        self.calm = [calm_samples(decay) for decay in decays if self.encloses_air]
        self.grids = [_grid(decay) for decay in decays]
        self.air = [
            _measured_air(decay, spec, grid)
            for decay, grid in zip(decays, self.grids, strict=True)
        ]
        self.values = self._first_values()
        self.values["leak"] = 0.0
        if self.encloses_air:
            self.values["leak"] = _FIRST_LEAK if leak is None else leak

    def _first_values(self) -> dict[str, float]:
        first = self.decays[0]
        # The squared frequency is a linear function of k, because the weight adds a
        # constant, and the stiffness due to the air is proportional to k.
        segment = self.body.segment(self.spec, self.closed)
        air = self._air_at_end()
        one, two = (
            ringing(segment, Material(k, 0.0), 0.0, air).frequency ** 2
            for k in (1.0, 2.0)
        )
        squared = first.half_period**-2 / 4
        values = {
            NAMES[0]: max(1 + (squared - one) / (two - one), 0.05 * squared / one),
            NAMES[1]: 2 * first.log_decrement / (math.pi * first.pulsation),
        }
        for k, decay in enumerate(self.decays):
            values[f"bend_{k}"], values[f"rate_{k}"] = decay.first_state()
            values[f"rest_{k}"] = float(np.median(decay.bend[len(decay.bend) // 2 :]))
            values |= {f"creep_{j}_{k}": 0.0 for j in range(len(_CREEP_RATIOS))}
        return values

    def unknowns(self, *, coarse: bool = False) -> list[FreeParameter]:
        """Return the free parameters of a complete or coarse fit.

        A coarse fit estimates neither the leak rate nor the recovery of the rest bend.
        """

        def free(
            name: str, unit: str, bounds: tuple[float, float], scale: float
        ) -> FreeParameter:
            start = min(max(self.values[name], bounds[0]), bounds[1])
            return FreeParameter(name, unit, start, *bounds, scale)

        unknowns = list(free_parameters(self.spec, NAMES, starts=self.values))
        if self.free_leak and not coarse:
            unknowns.append(free("leak", "1/s", _LEAKS, 1.0))
        for k, decay in enumerate(self.decays):
            size = float(np.ptp(decay.bend))
            speed = size * decay.pulsation
            unknowns += [
                free(f"bend_{k}", "rad", (-4.0, 4.0), size),
                free(f"rate_{k}", "rad/s", (-20 * speed, 20 * speed), speed),
                free(f"rest_{k}", "rad", (-4.0, 4.0), size),
            ]
            for j in range(0 if coarse else len(_CREEP_RATIOS)):
                unknowns.append(
                    free(f"creep_{j}_{k}", "rad", (-3 * size, 3 * size), size)
                )
        return unknowns

    def search(
        self,
        unknowns: Sequence[FreeParameter],
        *,
        bends: Sequence[np.ndarray] | None = None,
        watch: Watch | None = None,
        refit: Refit | None = None,
        swings: float = math.inf,
    ) -> FitEstimate:
        """Fit the parameters to the first swings of the recorded or given bends."""
        fitted = bends or [decay.bend for decay in self.decays]

        def residuals(values: Mapping[str, float]) -> list[Residual]:
            result = []
            for k, (decay, bend) in enumerate(zip(self.decays, fitted, strict=True)):
                used = decay.time <= decay.time[0] + 2 * swings * decay.half_period
                difference = (bend - self._swing(values, k).bend)[used]
                result.append(
                    Residual(f"{decay.name} bend", "rad", difference, _scale(decay))
                )
            # The first swings do not determine the leak rate, and a wrong leak rate
            # would contradict the bend at rest.
            if swings == math.inf:
                result += self._rest_residuals(values)
            return result

        estimate = least_squares(
            residuals, unknowns, watch=watch, refit=refit, options=_SEARCH
        )
        if bends is None:
            self.values |= estimate.values
        return estimate

    def _rest_residuals(self, values: Mapping[str, float]) -> Iterator[Residual]:
        for k, calm in enumerate(self.calm):
            decay = self.decays[k]
            bend = float(decay.before[:calm].mean())
            rest = bend - weight_moment(self.segment, bend) / values[NAMES[0]]
            scale = _scale(decay) / math.sqrt(min(calm, _MAX_CALM_SAMPLES))
            yield Residual(
                f"{decay.name} rest",
                "rad",
                np.array([rest - values[f"rest_{k}"]]),
                scale,
            )

    def refit(self, values: Mapping[str, float]) -> Mapping[str, float]:
        pulsation = 2 * math.pi * self.small_swing(values).frequency
        bends = [
            self._swing(values, k, pulsation).bend for k in range(len(self.decays))
        ]
        fitted = self.search(self.unknowns(), bends=bends).values
        return self.values | dict(values) | fitted

    def frequency_error(self) -> float:
        """Return the error of ln(frequency) caused by assuming viscous damping."""
        pulsation = 2 * math.pi * self.small_swing(self.values).frequency
        true = self.small_swing(self.values, pulsation).frequency
        return math.log(self.small_swing(self.refit(self.values)).frequency / true)

    def _material(self, values: Mapping[str, float]) -> Material:
        return Material(values[NAMES[0]], values[NAMES[1]], values["leak"])

    def small_swing(
        self, values: Mapping[str, float], constant_about: float | None = None
    ) -> Ringing:
        """Return the small oscillation about the rest position of the first recording.

        If `constant_about` is an angular frequency (rad/s), the loss factor is nearly
        constant around this frequency. Otherwise, the loss factor is proportional to
        the frequency.
        """
        values = self.values | dict(values)
        material = self._material(values)
        branches = NO_BRANCHES
        if self.encloses_air:
            air = self._swing(values, 0, constant_about).air
        else:
            air = self._air_at_end()
        if constant_about is not None:
            material, branches, _ = constant_loss(material, constant_about, 0.0)
        segment = self.body.segment(self.spec, self.closed)
        return ringing(segment, material, values["rest_0"], air, branches)

    def _swing(
        self, values: Mapping[str, float], k: int, constant_about: float | None = None
    ) -> _Swing:
        values = self.values | dict(values)
        decay = self.decays[k]
        grid = self.grids[k]
        material = self._material(values)
        branches = NO_BRANCHES
        moments = np.empty(0)
        air = self._enclosed_air(decay, material.leak)
        rest = values[f"rest_{k}"] + self.air[k]
        for j, ratio in enumerate(_CREEP_RATIOS):
            rest = rest + values[f"creep_{j}_{k}"] * np.exp(
                (grid[0] - grid) * decay.pulsation / ratio
            )
        rate = values[f"rate_{k}"]
        if constant_about is not None:
            material, branches, moments = constant_loss(material, constant_about, rate)
        start = np.concatenate([[values[f"bend_{k}"], rate], air, moments])
        path, end = swing(
            grid, start, rest, decay.pulsation, material, self.segment, branches
        )
        return _Swing(path[:: len(grid) // len(decay.time)], end[2:4])

    def _enclosed_air(self, decay: Decay, leak: float) -> np.ndarray:
        """Return p V of each chamber at the start of the free swing, J."""
        volumes = self._volumes(decay.before)
        # Because of the leak, the amount of air tends to its value at ambient pressure,
        # which depends on the volume of the chamber.
        kept = np.exp(-leak * (decay.time[0] - decay.before_time))
        weights = np.append(np.diff(kept), 0.0)
        amounts: np.ndarray = AMBIENT_PA * (kept[0] * volumes[0] + weights @ volumes)
        return amounts

    def _air_at_end(self) -> np.ndarray:
        """Return p V of each chamber at the end of the first recording, J."""
        first = self.decays[0]
        end = slice(-(len(first.time) // 4), None)
        pressure = 0.0 if first.pressure is None else first.pressure[end].mean(axis=0)
        amounts: np.ndarray = (AMBIENT_PA + pressure) * self._volumes(
            np.median(first.bend[end])
        )
        return amounts

    def _volumes(self, bend: np.ndarray) -> np.ndarray:
        chamber = self.spec.chamber
        grown = np.maximum(0.0, np.stack([bend, np.negative(bend)], axis=-1))
        return np.asarray(chamber.dead_volume + chamber.displacement * grown)

    def held(self) -> dict[str, float]:
        held = {"mass_kg": self.body.mass, "inertia_kg_m2": self.body.inertia}
        if self.closed:
            held["air_stiffness_nm_per_rad"] = self.small_swing(
                self.values
            ).air_stiffness
        if self.encloses_air and not self.free_leak:
            held["leak_per_s"] = self.values["leak"]
        return held


def _grid(decay: Decay) -> np.ndarray:
    if decay.pressure is None:
        return decay.time
    samples = np.arange(len(decay.time))
    fine = np.arange(len(samples) * _UPSAMPLING) / _UPSAMPLING
    return np.asarray(np.interp(fine, samples, decay.time))


def _measured_air(decay: Decay, spec: RobotSpec, grid: np.ndarray) -> np.ndarray:
    if decay.pressure is None:
        return np.zeros(len(grid))
    pressure = np.zeros((len(decay.time), spec.segments, 2))
    pressure[:, 0] = decay.pressure
    return np.asarray(CubicSpline(decay.time, air_bend(spec, pressure)[:, 0])(grid))


def _scale(decay: Decay) -> float:
    return math.hypot(decay.noise, _MODEL_ERROR * float(np.ptp(decay.bend)) / 2)


def _derived(
    estimate: FitEstimate,
    fit: _DampingFit,
    name: str,
    unit: str,
    model_error: float = 0.0,
) -> Parameter:
    """Return the attribute `name` of `Ringing` with linearly propagated errors.

    The argument `model_error` is an additional error of the logarithm of this
    attribute.
    """

    def logarithm(changes: Mapping[str, float]) -> float:
        return math.log(getattr(fit.small_swing(estimate.values | dict(changes)), name))

    rows = with_value(estimate.parameters)
    row = np.empty(len(rows))
    for i, k in enumerate(rows):
        parameter = estimate.parameters[k]
        value = parameter.value or 0.0
        step = _ERROR_STEP * (parameter.standard_error or 0.0)
        up, down = (
            logarithm({parameter.name: value + sign * step}) for sign in (1, -1)
        )
        row[i] = (up - down) / (2 * _ERROR_STEP)
    variance = float(row @ estimate.correlation[np.ix_(rows, rows)] @ row)
    error = math.hypot(math.sqrt(max(variance, 0.0)), model_error)
    freedom = max(estimate.independent - len(estimate.parameters), 1.0)
    half = half_width(error, freedom)
    value = math.exp(logarithm({}))
    verdict: Verdict = "cannot tell" if estimate.misfit else verdict_on(error, 1.0)
    return Parameter(
        name,
        unit,
        verdict,
        value,
        standard_error=value * error,
        low=value * math.exp(-half),
        high=value * math.exp(half),
    )
