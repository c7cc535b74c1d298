r"""Which experiments to do: those that tell wanted numbers of a robot to wanted intervals.

Each candidate is an experiment that the fits take, with what it observes, predicted by the model that fits
it, and the noise of that. With J the derivatives of the predictions by the logarithms z of all numbers that
are uncertain, and R the noise's covariance, what is known after it is

$$ \Lambda' = \Lambda + J^T R^{-1} J, \qquad \mathrm{sd}(z_i) = \sqrt{(\Lambda'^{-1})_{ii}}, $$

from Λ, the robot file's own `uncertain` numbers. The next experiment is the one after which wanted intervals
are the fewest times too wide, in the mean of logarithms over those that still are; nothing is done that
narrows no such interval by 2 %. Numbers at 0, such as drag, count in their unit: z is their value over a
tenth of the robot's axial friction.

What the model misses of a robot is in no interval here: walks count with 2 % of their speed and turning as
noise, which is what `compliant` misses of the twin, and not less however long they are.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from srs_twin.comparison.metrics import plant_metrics
from srs_twin.control.gait import Gait
from srs_twin.errors import InputError
from srs_twin.identification.unknowns import unknowns, with_values
from srs_twin.plants.analytical import AnalyticalSnake
from srs_twin.pneumatics import LagPneumatics
from srs_twin.pneumatics.chambers import air_bend
from srs_twin.robot.spec import GRAVITY, RobotSpec
from srs_twin.rollout import rollout

PULL_SHARE = 0.015
"""Standard error of a mean of ten pulls over the force: 0.0015 of 0.0966 (Section 3.4.1)."""

LENGTH_M, BEND_RAD, MASS_KG = 4e-4, 0.01, 1e-3
"""Noise of a length by markers over a walk, of a bend, of a scale."""

WALK = 0.02
"""What `compliant` misses of a walk's speed and turning, as a share."""

_AGAIN = 3  # times an experiment is worth repeating
_LEAST = 0.98
_STEP = 0.05  # of z: metrics of walks are rough in their third digit
_WIDE = 3.0  # standard deviation of z where the file says nothing


@dataclass(frozen=True)
class Experiment:
    """Something to record.

    Attributes:
        what: what to do, for the sheet.
        minutes: how long it takes.
        predict: a robot → what would be observed.
        noise: a prediction → its standard deviations.
    """

    what: str
    minutes: float
    predict: Callable[[RobotSpec], np.ndarray]
    noise: Callable[[np.ndarray], np.ndarray]


def candidates(spec: RobotSpec) -> Iterator[Experiment]:
    """Yield what may be recorded of a robot: lengths, masses, pulls, held pressures, steps, walks."""

    def constant(sd: float) -> Callable[[np.ndarray], np.ndarray]:
        return lambda seen: np.full(len(seen), sd)

    def share(of: float) -> Callable[[np.ndarray], np.ndarray]:
        return lambda seen: of * np.maximum(np.abs(seen), 1e-6)

    def lengths(robot: RobotSpec) -> np.ndarray:
        return np.array([robot.geometry.segment_length, robot.geometry.rigid_gap, robot.geometry.half_track])

    yield Experiment(
        "markers on connectors: calibrate locomotion gives the lengths", 10, lengths, constant(LENGTH_M)
    )
    yield Experiment("weigh connectors", 5, lambda r: r.mass.array(), constant(MASS_KG))
    for load in (0.0, 2.0 * spec.mass.total):
        words = f" with {1000 * load:.0f} g on it" if load else ""

        def along(robot: RobotSpec, load: float = load) -> np.ndarray:
            return np.array([robot.friction.mu_t * (robot.mass.total + load) * GRAVITY + robot.friction.drag])

        def across(robot: RobotSpec, load: float = load) -> np.ndarray:
            return np.array([robot.friction.mu_n * (robot.mass.total + load) * GRAVITY])

        yield Experiment(f"10 pulls along{words}, hoses as in use, moving", 10, along, share(PULL_SHARE))
        yield Experiment(f"10 pulls across{words}, wheels fixed, moving", 10, across, share(PULL_SHARE))
    supply = spec.supply.nominal
    held = np.linspace(0.2, 1.0, 5) * supply

    def static(robot: RobotSpec) -> np.ndarray:
        pressure = np.zeros((len(held), robot.segments, 2))
        pressure[:, 0, 0] = held
        return air_bend(robot, pressure)[:, 0]

    yield Experiment(
        f"held pressures up to {supply / 1e3:.0f} kPa, segments lifted: calibrate actuator --static",
        20, static, constant(BEND_RAD),
    )  # fmt: skip

    def steps(robot: RobotSpec) -> np.ndarray:
        chambers, out = LagPneumatics(robot, supply_pa=supply), []
        for state in (1, -1):
            valves = np.full((robot.segments, 2), -1)
            valves[0, 0] = state
            span = 4 * max(spec.actuator.tau_fill, spec.actuator.tau_vent)
            out.append(
                chambers.advance(chambers.schedule(valves, span), np.linspace(0, span, 41)[1:]).bend[:, 0]
            )
        return np.concatenate(out)

    yield Experiment(
        f"steps of lifted segments, {supply / 1e3:.0f} kPa: calibrate actuator",
        10,
        steps,
        constant(BEND_RAD),
    )
    for frequency, offset in ((1.0, 0.0), (1.5, 0.0), (2.0, 0.0), (1.0, 0.3), (2.0, 0.3)):

        def walk(robot: RobotSpec, frequency: float = frequency, offset: float = offset) -> np.ndarray:
            snake = AnalyticalSnake(robot, model="compliant", friction="wheel", supply_pa=supply)
            seen = plant_metrics(rollout(snake, Gait(frequency, offset=offset), 6.0))
            found = [seen["com_speed_m_s"], *seen["bend_amplitude_rad"]]
            return np.array(found + ([seen["yaw_rate_rad_s"]] if offset else []))

        def doubt(seen: np.ndarray) -> np.ndarray:
            noise = np.maximum(WALK * np.abs(seen), 1e-4)
            noise[1 : 1 + spec.segments] = np.hypot(BEND_RAD, WALK * seen[1 : 1 + spec.segments])
            return noise

        words = (
            f"walk at {frequency:g} Hz, offset {offset:g}, {supply / 1e3:.0f} kPa, 20 s: calibrate locomotion"
        )
        yield Experiment(words, 5, walk, doubt)


@dataclass(frozen=True)
class Design:
    """What to record, in this order.

    Attributes:
        chosen: experiments.
        after: wanted number → half of its 95 % interval after each of them, as a share of the number (in its
            own unit where the number is 0).
        before: the same before the first.
        wanted: what was asked for.
    """

    chosen: tuple[Experiment, ...]
    after: Mapping[str, tuple[float, ...]]
    before: Mapping[str, float]
    wanted: Mapping[str, float]

    @property
    def unmet(self) -> tuple[str, ...]:
        """Wanted numbers that stay wider than asked for."""
        return tuple(
            name
            for name, each in self.after.items()
            if (each or (self.before[name],))[-1] > self.wanted[name]
        )

    def document(self) -> dict[str, Any]:
        """Return plain data of it."""
        rows = [
            {
                "do": each.what,
                "minutes": each.minutes,
                "after": {name: after[k] for name, after in self.after.items()},
            }
            for k, each in enumerate(self.chosen)
        ]
        return {
            "before": dict(self.before),
            "wanted": dict(self.wanted),
            "experiments": rows,
            "unmet": list(self.unmet),
        }


def design(spec: RobotSpec, known: Mapping[str, tuple[float, float]], wanted: Mapping[str, float]) -> Design:
    """Choose experiments.

    Args:
        spec: the robot as far as it is known.
        known: uncertain number → its value and standard deviation, from the robot's file.
        wanted: number → half of the 95 % interval that is wanted, as a share of it.

    Raises:
        InputError: nothing is wanted.
    """
    if not wanted:
        raise InputError("--want names nothing; names such as friction.mu_t=5%")
    small = 0.1 * spec.friction.mu_t * spec.mass.total * GRAVITY
    names = list(dict.fromkeys([*wanted, *known]))
    values = {name: known[name][0] if name in known else _value(spec, name) for name in names}
    scale = np.array([abs(values[name]) or small for name in names])
    spread = np.array([known[name][1] if name in known else np.inf for name in names]) / scale
    information = np.diag(1 / np.minimum(spread, _WIDE) ** 2)
    offered = list(candidates(spec))
    told = [_information(each, spec, names, values, scale) for each in offered]
    places = [names.index(name) for name in wanted]
    goals = np.array(list(wanted.values()))
    units = np.array([1.0 if values[name] else small for name in wanted])

    def widths(matrix: np.ndarray) -> np.ndarray:
        return np.asarray(1.96 * np.sqrt(np.diag(np.linalg.inv(matrix))[places]) * units)

    before = widths(information)
    chosen: list[int] = []
    after: list[np.ndarray] = []
    now = before
    while (now > goals).any():
        open_ = now > goals
        scores = [
            np.inf
            if chosen.count(k) >= _AGAIN
            else np.log(np.maximum(widths(information + each) / goals, 1.0)[open_]).mean()
            for k, each in enumerate(told)
        ]
        best = int(np.argmin(scores))
        narrowed = widths(information + told[best])
        if not np.isfinite(scores[best]) or not (narrowed[open_] < _LEAST * now[open_]).any():
            break
        information, now = information + told[best], narrowed
        chosen.append(best)
        after.append(now)
    columns = {name: tuple(float(row[i]) for row in after) for i, name in enumerate(wanted)}
    experiments = tuple(offered[k] for k in chosen)
    return Design(experiments, columns, dict(zip(wanted, map(float, before), strict=True)), dict(wanted))


def _value(spec: RobotSpec, name: str) -> float:
    return float(unknowns(spec, [name])[0].start)


def _information(
    experiment: Experiment,
    spec: RobotSpec,
    names: Sequence[str],
    values: Mapping[str, float],
    scale: np.ndarray,
) -> np.ndarray:
    """Return JᵀR⁻¹J by central differences, one-sided at 0."""
    seen = experiment.predict(spec)
    columns = []
    for name, size in zip(names, scale, strict=True):
        up = values[name] + _STEP * size
        down = values[name] - _STEP * size if values[name] else 0.0
        ends = [experiment.predict(with_values(spec, {name: value})) for value in (up, down)]
        columns.append((ends[0] - ends[1]) / ((up - down) / size))
    slopes = np.stack(columns, axis=1) / experiment.noise(seen)[:, None]
    return np.asarray(slopes.T @ slopes)
