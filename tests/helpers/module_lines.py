"""Rows of the table in docs/module.md: quantities of Chapter 4, published values and criteria."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

PLANTS = ("analytical", "twin")
DEGREES = 180 / math.pi


@dataclass(frozen=True)
class Values:
    """Results of one bench in docs/module.json.

    Attributes:
        figures: content of the file.
        plant: name of the bench.
    """

    figures: Mapping[str, Any]
    plant: str

    def select(
        self, scenario: str, *metrics: str, unit: float = 1.0
    ) -> tuple[float, ...]:
        """Return metrics of module_<scenario>, for both controllers if the name ends in an underscore."""
        names = (
            [scenario + item for item in ("direct", "iterative")]
            if scenario[-1] == "_"
            else [scenario]
        )
        runs = [
            self.figures["scenarios"][f"module_{name}"][self.plant] for name in names
        ]
        return tuple(unit * run[metric] for run in runs for metric in metrics)

    def drawn(self, metric: str, which: str) -> tuple[float, ...]:
        """Return the mean or deviation over the draws with a leak, for both controllers."""
        drawn = self.figures["leak"]["of"]
        return tuple(
            drawn[kind][self.plant][metric][which] for kind in ("direct", "iterative")
        )


Numbers = Callable[[Values], tuple[float, ...]]


@dataclass(frozen=True)
class Line:
    """Row of the table.

    Attributes:
        what: quantity.
        text: value in the dissertation.
        numbers: compared values.
        shape: format of these values and of `beside`, as for str.format.
        scenario: source of the values.
        met: criterion of the dissertation, or of the project where `text` says so.
        beside: additional values that are not compared.
    """

    what: str
    text: str
    numbers: Numbers
    shape: str
    scenario: str = ""
    met: Callable[..., bool] = lambda *numbers: True
    beside: Numbers = lambda values: ()

    def cells(self, figures: Mapping[str, Any]) -> list[str]:
        """Return the cells of the row."""
        item = [Values(figures, plant) for plant in PLANTS]
        result = [self.numbers(values) for values in item]
        written = [
            self.shape.format(*n, *self.beside(v))
            for n, v in zip(result, item, strict=True)
        ]
        marked = [
            w if self.met(*n) else f"**{w}**"
            for w, n in zip(written, result, strict=True)
        ]
        fractions = [
            abs(theirs / ours - 1) for ours, theirs in zip(*result, strict=True) if ours
        ]
        return [
            self.what,
            self.text,
            *marked,
            f"{max(fractions, default=0.0):.1%}",
            self.scenario,
        ]


def metric(scenario: str, *names: str, unit: float = 1.0) -> Numbers:
    """Return a function that selects metrics of a scenario."""
    return lambda values: values.select(scenario, *names, unit=unit)


def drawn(name: str, which: str = "mean") -> Numbers:
    """Return a function that selects a metric from the draws with a leak."""
    return lambda values: values.drawn(name, which)


def ratio(scenario: str, name: str) -> Numbers:
    """Return a function that divides the metric of iterative by that of direct."""

    def numbers(values: Values) -> tuple[float, ...]:
        direct, iterative = values.select(scenario, name)
        return (iterative / direct,)

    return numbers


def more(values: Values) -> tuple[float, ...]:
    """Return the relative difference of the amplitude at 6 Hz, direct above iterative, %."""
    direct, iterative = values.select("sine_6hz_", "amplitude_rel")
    return (100 * (direct / iterative - 1),)


def less(values: Values) -> tuple[float, ...]:
    """Return the lag of iterative minus the lag of direct at 6 Hz, rad."""
    direct, iterative = values.select("sine_6hz_", "phase_lag_rad")
    return (iterative - direct,)


LINES = (
    Line(
        "static bend at 11 psi",
        "75° (Fig. 41)",
        metric("static", "final_bend_rad", unit=DEGREES),
        "{:.1f}°",
        "static, sweep fig41",
        lambda bend: abs(bend / 75 - 1) <= 0.1,
    ),
    Line(
        "direct, 25° step: settled within 5 %",
        "0.2 s; our bound: at most 0.25 s",
        metric("step_direct", "settling_5_s"),
        "{:.3f} s",
        "step_direct",
        lambda time: time <= 0.25,
    ),
    Line(
        "… overshoot",
        "less than its fluctuation",
        metric("step_direct", "overshoot_rad", "measured_ripple_pp_rad", unit=DEGREES),
        "{:.1f}° (sensed: {:.1f}° peak to peak)",
        met=lambda over, ripple: over < ripple,
    ),
    Line(
        "… rise, 10 to 90 %",
        "–",
        metric("step_direct", "rise_time_s", unit=1e3),
        "{:.0f} ms",
    ),
    Line(
        "iterative, 25° step: overshoot",
        "40 %",
        metric("step_iterative", "overshoot_rel", unit=100),
        "{:.1f} %",
        "step_iterative",
        lambda over: over >= 30,
    ),
    Line(
        "… settled within 5 %",
        "0.4 s",
        metric("step_iterative", "settling_5_s"),
        "{:.3f} s",
        met=lambda time: abs(time / 0.4 - 1) <= 0.3,
    ),
    Line(
        "… over that of direct",
        "larger than 1",
        ratio("step_", "settling_5_s"),
        "{:.1f}",
        met=lambda times: times > 1,
    ),
    Line(
        "peak to peak at rest, direct; iterative",
        "–",
        metric("step_", "ripple_pp_rad", unit=DEGREES),
        "{:.1f}°; {:.1f}°",
        "step",
    ),
    Line(
        "direct stops switching at the target",
        "yes",
        metric("step_direct", "inlet_openings"),
        "{:g} opening per inlet valve in total",
        "step_direct",
        lambda openings: openings <= 2,
    ),
    Line(
        "0.25 Hz: amplitude, direct; iterative",
        "little difference",
        metric("sine_025hz_", "amplitude_rel"),
        "{:.2f}; {:.2f}",
        "sine_025hz",
        lambda direct, iterative: abs(direct - iterative) < 0.05,
    ),
    Line(
        "… residual of the sine fit, direct; iterative",
        "direct fluctuates more",
        metric("sine_025hz_", "fit_residual_rad", unit=DEGREES),
        "{:.2f}°; {:.2f}°",
        met=lambda direct, iterative: direct > iterative,
    ),
    Line(
        "1 Hz: amplitude, direct; iterative",
        "little difference below 1 Hz",
        metric("sine_1hz_", "amplitude_rel"),
        "{:.2f}; {:.2f}",
        "sine_1hz",
        lambda direct, iterative: abs(direct - iterative) < 0.1,
    ),
    Line(
        "… residual of the sine fit, direct; iterative",
        "–",
        metric("sine_1hz_", "fit_residual_rad", unit=DEGREES),
        "{:.2f}°; {:.2f}°",
    ),
    Line(
        "4 Hz: amplitude, direct; iterative",
        "direct larger",
        metric("sine_4hz_", "amplitude_rel"),
        "{:.2f}; {:.2f}",
        "sine_4hz",
        lambda direct, iterative: direct > iterative,
    ),
    Line(
        "6 Hz: amplitude of direct relative to iterative",
        "15 % more",
        more,
        "{:.1f} %",
        "sine_6hz",
        lambda fraction: fraction >= 15,
    ),
    Line(
        "… lag of iterative minus lag of direct",
        "0.5 rad",
        less,
        "{:.2f} rad",
        met=lambda rad: 0.375 <= rad <= 0.625,
    ),
    Line(
        "… lag of direct",
        "at most about 0.5 rad",
        metric("sine_6hz_direct", "phase_lag_rad"),
        "{:.3f} rad",
        met=lambda lag: lag <= 0.5,
    ),
    Line(
        "… 10 s: openings, direct",
        "67",
        metric("sine_6hz_direct", "inlet_openings"),
        "{:g}",
        met=lambda openings: abs(openings / 67 - 1) <= 0.3,
    ),
    Line(
        "… iterative",
        "349",
        metric("sine_6hz_iterative", "inlet_openings"),
        "{:g}",
        met=lambda openings: abs(openings / 349 - 1) <= 0.3,
    ),
    Line(
        "… ratio",
        "5.2; our bound: at least 3.5",
        ratio("sine_6hz_", "inlet_openings"),
        "{:.1f}",
        met=lambda times: times >= 3.5,
    ),
    Line(
        "2 Hz square, 10 s: openings, direct",
        "26",
        metric("square_2hz_direct", "inlet_openings"),
        "{:g}",
        "square_2hz",
        lambda openings: abs(openings / 26 - 1) <= 0.3,
    ),
    Line(
        "… iterative",
        "213",
        metric("square_2hz_iterative", "inlet_openings"),
        "{:g}",
        met=lambda openings: abs(openings / 213 - 1) <= 0.3,
    ),
    Line(
        "… ratio",
        "8.2; our bound: at least 6",
        ratio("square_2hz_", "inlet_openings"),
        "{:.1f}",
        met=lambda times: times >= 6,
    ),
    Line(
        "leak of 0.5 1/s: RMS error at rest, direct; iterative",
        "direct drifts",
        drawn("steady_rms_rad"),
        "{0:.2f} ± {2:.2f}°; {1:.2f} ± {3:.2f}°",
        "hold_leak, draws",
        lambda direct, iterative: direct > iterative,
        drawn("steady_rms_rad", "deviation"),
    ),
    Line(
        "… peak to peak",
        "direct oscillates much more",
        drawn("ripple_pp_rad"),
        "{0:.2f} ± {2:.2f}°; {1:.2f} ± {3:.2f}°",
        met=lambda direct, iterative: direct > iterative,
        beside=drawn("ripple_pp_rad", "deviation"),
    ),
    Line(
        "… peak to peak of the mean over a carrier period",
        "–",
        drawn("drift"),
        "{0:.2f} ± {2:.2f}°; {1:.2f} ± {3:.2f}°",
        beside=drawn("drift", "deviation"),
    ),
    Line(
        "… openings in 6 s",
        "–",
        drawn("inlet_openings"),
        "{0:.1f} ± {2:.1f}; {1:.0f} ± {3:.1f}",
        beside=drawn("inlet_openings", "deviation"),
    ),
)
