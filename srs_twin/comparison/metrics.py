"""Metrics of single runs, descriptions of metrics, and summaries of results."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from typing import Any, NamedTuple, NotRequired, TypedDict

import numpy as np

from srs_twin.comparison.contacts import (
    CONTACT_EVENTS,
    CONTACT_MEANINGS,
    CONTACT_UNITS,
    OBJECT_MEANINGS,
    OBJECT_UNITS,
    contact_metrics,
    object_metrics,
)
from srs_twin.comparison.gait import (
    ENERGY_MEANINGS,
    SPATIAL_DIFFERENCE_MEANINGS,
    SPATIAL_DIFFERENCES,
    SPATIAL_MEANINGS,
    SPATIAL_UNITS,
    GaitWindow,
    energy_metrics,
    running_rates,
    spatial_metrics,
    turning_radius,
)
from srs_twin.comparison.learning import (
    LEARNING_LIST_UNITS,
    LEARNING_MEANINGS,
    LEARNING_UNITS,
    is_learning,
    learning_metrics,
)
from srs_twin.comparison.sampling import (
    STRAIGHT_RAD_S,
    ZERO,
    MetricGroup,
    body_length,
    check_columns,
    extension_groups,
    is_near_zero,
    meanings_of,
    metric_groups,
    split_unit,
    units_of,
)
from srs_twin.comparison.tracking import (
    READING_MEANINGS,
    READING_UNITS,
    TRACKING_MEANINGS,
    TRACKING_UNITS,
    reading_metrics,
    tracking_metrics,
)
from srs_twin.errors import InputError
from srs_twin.extensions import (
    READING,
    allow_plugin,
    import_plugin,
    module_of,
    plugin_parts,
    registered,
)
from srs_twin.trajectory import Trajectory

PlantMetrics = dict[str, Any]
"""Value of each metric, which is a number, a boolean, a list, or None if undefined."""


class PartMetrics(TypedDict, total=False):
    """Metrics of a part of a run.

    Attributes:
        plants: metrics of each plant, keyed by plant name.
        end_s: end of the part, s. The entry is absent if the part is the whole run.
    """

    plants: dict[str, PlantMetrics]
    end_s: float


class StoredIntervals(TypedDict, total=False):
    """Uncertainty intervals returned by `experiment.stored_intervals`."""

    stale: str | None
    file: str
    renew: str
    plants: Mapping[str, Mapping[str, object]]
    segments: Mapping[str, Sequence[float]] | None


class MainCause(TypedDict):
    """Effect of compliant bends, computed by `attribution.main_cause`.

    Attributes:
        name: name of the assumption.
        window_s: duration of the part without contact, s. The entry is absent if the
            effects cover the whole run.
    """

    name: str
    com_speed_m_s: float
    yaw_rate_rad_s: float
    window_s: NotRequired[float]


class RunMetrics(PartMetrics, total=False):
    """Content of metrics.json. Entries that do not apply to a run are absent.

    Attributes:
        comparison: differences between the plants, or None if only one plant ran.
        events: faults, contacts and early ends of each run, keyed by plant name.
        changes: changed fields of the scenario (`scenario.modified.Changes`).
        ignores_obstacles: plants that ignore the obstacles in the scenario.
        before_contact: speeds and yaw rates before the first contact.
        body_overlap_m: maximum overlap of two body parts, m, keyed by plant name.
        residuals: differences from the recording, keyed by plant name.
        attribution: result of `Attribution.document`.
        cause: result of `attribution.main_cause`.
        preset: preset of the twin.
        expectations: results of the expectations (`expectation.ExpectationRow`).
        left_out: expectations that changed fields invalidate.
        versions: versions of the packages, keyed by package name.
    """

    scenario: str
    robot: str
    comparison: PlantMetrics | None
    events: Mapping[str, Sequence[Mapping[str, object]]]
    changes: Sequence[Mapping[str, object]]
    ignores_obstacles: Sequence[str]
    before_contact: PartMetrics
    body_overlap_m: Mapping[str, float]
    residuals: Mapping[str, object]
    attribution: Mapping[str, Any]
    cause: MainCause
    preset: str
    intervals: StoredIntervals
    expectations: list[Any]
    left_out: Sequence[Mapping[str, object]]
    versions: Mapping[str, str]


RELATIVE = {
    "com_speed_m_s",
    "travel_speed_m_s",
    "turning_radius_m",
    "path_length_m",
    "mean_bend_amplitude_rad",
    "final_bend_rad",
    "mechanical_power_w",
    "cost_of_transport",
    "pneumatic_power_w",
    "pneumatic_cost_of_transport",
    "rise_time_s",
    "settling_2_s",
    "settling_5_s",
    "ripple_pp_rad",
    "ripple_rms_rad",
    "measured_ripple_pp_rad",
    "steady_rms_rad",
    "error_rms_rad",
    "amplitude_rel",
    "fit_residual_rad",
    "inlet_openings",
    "outlet_openings",
    "path_radius_m",
    "path_speed_m_s",
    "duty_lowest",
    "duty_highest",
    "reading_error_rad",
    "reading_backstep_rad",
    "reading_range_t",
}
"""Metrics whose difference is also printed in per cent of the analytical value.

Metric groups add further metrics with this property (`MetricGroup.relative`).
"""

_TENTH = 0.05
"""Relative difference (per cent) below which only one significant digit is printed."""

_NOT_COMPARED = ("wall_s", "realtime_factor")
"""Metrics of computing time, whose difference between the plants is not shown."""


def _per_cent(metric: str, reference: float, value: float) -> str:
    """Format (value − reference)/reference in per cent.

    The text is empty if the values differ in sign or the reference is close to zero.
    """
    if reference * value <= 0 or is_near_zero(reference, value, split_unit(metric)[1]):
        return ""
    per_cent = 100 * (value - reference) / reference
    if per_cent == 0:
        return "0"
    if abs(per_cent) < _TENTH:
        return f"{per_cent:+.1g}"
    return f"{per_cent:+.1f}"


def published(
    expectations: Sequence[Mapping[str, Any]],
) -> dict[str, tuple[float, str]]:
    """Return the published value of each metric, and the source of this value."""
    return {
        row["metric"]: (row["near"], row["source"])
        for row in expectations
        if row.get("near") is not None
        and row.get("source")
        and row.get("of") != "comparison"
    }


METRICS_LISTED = "`srs-twin list metrics`"

_PLANT_MEANINGS = meanings_of("""
com_speed_m_s: forward speed of the centre of mass, mean over whole gait periods after the first two
path_length_m: length of the path of the centre of mass over the whole run
yaw_rate_rad_s: mean yaw rate over the periods used for com_speed_m_s; positive to the left
turning_radius_m: radius of the path; none for a straight path
mean_bend_amplitude_rad: half the range of the bend, mean over the segments
bend_amplitude_rad: half the range of the bend of each segment, head first
bend_bias_rad: mean bend of each segment, head first
valve_switches: openings of the + and − valve of each segment, head first
""")
_BENCH_MEANINGS = {"final_bend_rad": "bend of the first segment at the end"}
_MEASURED_MEANINGS = meanings_of("""
measured_com_speed_rel: difference from the speed of the recorded robot, divided by the recorded speed
measured_yaw_rate_abs: magnitude of the yaw rate difference
measured_shape_rms_m: RMS distance between simulated and recorded connectors, with centre and heading aligned
measured_path_rms_m: RMS distance between the centres of mass
measured_bend_rms_rad: RMS difference of the bends
measured_heading_rms_rad: RMS difference of the headings
""")
_TIME_MEANINGS = meanings_of("""
wall_s: computing time of the simulation
realtime_factor: simulated time divided by computing time
""")
_COMPARISON_MEANINGS = meanings_of("""
com_speed_rel: speed difference (twin minus analytical) divided by the analytical speed
gap_factor: factor by which the analytical speed was multiplied for the comparison, 1 unless requested
yaw_rate_abs: magnitude of the yaw rate difference
shape_rms_m: RMS distance between corresponding connectors, with centre and heading aligned
shape_rms_body: RMS distance between corresponding connectors divided by the body length
path_rms_m: RMS distance between the centres of mass at equal times
bend_rms_rad: RMS difference of the bends
bend_rms_rel: RMS difference of the bends divided by the RMS bend of the analytical model
heading_rms_rad: RMS difference of the headings
""")
MEANINGS = (
    _PLANT_MEANINGS,
    ENERGY_MEANINGS,
    _BENCH_MEANINGS,
    TRACKING_MEANINGS,
    LEARNING_MEANINGS,
    READING_MEANINGS,
    SPATIAL_MEANINGS,
    OBJECT_MEANINGS,
    CONTACT_MEANINGS,
    _MEASURED_MEANINGS,
    _TIME_MEANINGS,
    _COMPARISON_MEANINGS,
    SPATIAL_DIFFERENCE_MEANINGS,
)
"""Metric descriptions by topic, in the order of `srs-twin list metrics`."""

LIST_METRIC_UNITS = (
    units_of(("bend_amplitude_rad", "bend_bias_rad", "valve_switches"))
    | LEARNING_LIST_UNITS
)
"""Units of metrics whose values are lists.

Learning metrics have one entry per period (`LEARNING_LIST_UNITS`). The other metrics
have one entry per segment, ordered from the head.
"""

MEASURED_UNITS = units_of(_MEASURED_MEANINGS) | {"measured_yaw_rate_abs": "rad/s"}
"""Units of the differences between a plant and a recording."""

METRIC_UNITS = {
    **units_of(name for name in _PLANT_MEANINGS if name not in LIST_METRIC_UNITS),
    **units_of([*ENERGY_MEANINGS, *_BENCH_MEANINGS]),
    **TRACKING_UNITS,
    **LEARNING_UNITS,
    **READING_UNITS,
    **SPATIAL_UNITS,
    **OBJECT_UNITS,
    **{
        name: unit for group in extension_groups() for name, unit in group.units.items()
    },
    **CONTACT_UNITS,
    **MEASURED_UNITS,
    **units_of(_TIME_MEANINGS),
}
"""Units of the scalar metrics of a plant, without plug-in metrics."""

COMPARISON_UNITS = (
    units_of(_COMPARISON_MEANINGS) | {"yaw_rate_abs": "rad/s"} | SPATIAL_DIFFERENCES
)
"""Units of the scalar metrics computed by `compare`.

The units are defined here so that commands can list them without importing `compare`.
"""


def metric_units() -> dict[str, str]:
    """Return the units of all scalar metrics of a plant, including plug-in metrics."""
    return METRIC_UNITS | {
        name: unit for group in metric_groups() for name, unit in group.units.items()
    }


def check_plugin_metrics() -> None:
    """Raise an `InputError` if a plug-in redefines a metric of another module."""
    own = METRIC_UNITS | LIST_METRIC_UNITS | COMPARISON_UNITS
    owners = dict.fromkeys(own, "srs-twin")
    for module, group in plugin_parts(MetricGroup):
        # A plug-in may import the metrics of the package or of another plug-in.
        home = group.measure.__module__
        for name in group.meanings:
            owner = owners.setdefault(name, home)
            if owner != home and not home.startswith("srs_twin."):
                raise InputError(
                    f"metric '{module}:{name}' is not allowed, because {owner} has a"
                    " metric of this name; rename it"
                )


def all_units() -> dict[str, str]:
    """Return the units of all metrics."""
    return metric_units() | LIST_METRIC_UNITS | COMPARISON_UNITS


def is_yes_no(metric: str) -> bool:
    """Return whether a metric is boolean."""
    return any(metric in group.yes_no for group in metric_groups())


def metric_name(name: str) -> str:
    """Import the module of a metric, and return the name of the metric in results.

    A metric from a plug-in or an installed distribution is written as
    ``module:metric``. If a name without a module is unknown, all metrics that installed
    distributions register are imported.

    Raises:
        ValueError: the module is not allowed or cannot be imported.
    """
    module, _, metric = name.rpartition(":")
    if READING.get():
        return metric
    modules = [module] if module else []
    if not module and metric not in all_units():
        modules = [module_of(entry) for entry in registered("metric").values()]
    try:
        for each in modules:
            allow_plugin(import_plugin(each))
    except InputError as error:
        raise ValueError(str(error)) from error
    return metric


def written_name(metric: str) -> str:
    """Return the name of a metric in files, ``module:metric`` for a plug-in metric."""
    for module, group in plugin_parts(MetricGroup):
        if metric in group.meanings:
            return f"{module}:{metric}"
    return metric


def meanings() -> dict[str, str]:
    """Return the one-line descriptions of all metrics, keyed by metric."""
    tables = (*MEANINGS, *(group.meanings for group in metric_groups()))
    return {name: text for table in tables for name, text in table.items()}


VALIDATION = (
    "Both plants are simulations. Only values published in the dissertation and"
    " replayed recordings compare them with hardware. All other differences are between"
    " the two plants."
)
"""Statement about validation in every report."""

_SAME_RATIO = 0.01
"""Relative difference below which a summary says that the plants agree."""
_PRESET = (
    "The twin ran with preset {}, which is meant for searches: cite a run without it"
    " (docs/verification.md#presets)."
)
_OVERLAP = (
    "Parts of the body overlap by up to {:.0f} mm ({}), which is impossible for a robot"
    " (docs/objects.md#limits)."
)
_COMPLIANCE = (
    "Compliance: the segments of the twin yield to loads, those of the model do not."
)
_MIN_CAUSE_RATIO = 0.25
"""Minimum fraction of a difference that a cause must explain to be mentioned."""

_LEARNT = (
    "Learning brought the amplitudes to their targets. It does not control the path,"
    " whose curvature changed from {:.2g} to {:.2g} 1/m (docs/module.md)."
)


def headline(metrics: RunMetrics) -> str:
    """Summarise the results in a few sentences.

    The summary begins with contacts with obstacles or objects. It then compares the
    plants over the whole run and before the first contact, and names the main cause of
    each difference. The last sentences explain terms and limitations.
    """
    text = _summary(metrics)
    sentences = [*_contacts(metrics), text]
    if "compliance" in text:
        sentences.append(_COMPLIANCE)
    if preset := metrics.get("preset"):
        sentences.append(_PRESET.format(preset))
    plants = metrics["plants"]
    shown = plants.get("twin") or plants.get("analytical") or {}
    ends = [shown.get(f"path_curvature_{name}per_m") for name in ("before_", "")]
    if shown.get("periods_to_converge") is not None and None not in ends:
        sentences.append(_LEARNT.format(*ends))
    if overlaps := metrics.get("body_overlap_m"):
        sentences.append(
            _OVERLAP.format(1e3 * max(overlaps.values()), " and ".join(overlaps))
        )
    return " ".join(sentences)


def _contacts(metrics: RunMetrics) -> Iterator[str]:
    names = {"twin": "the twin", "analytical": "the model"}
    plants = {name: plant for name, plant in metrics["plants"].items() if name in names}
    if any(plant.get("contacts") for plant in plants.values()):
        texts = [
            f"{names[name]} {_meeting(metrics, name)}"
            for name in names
            if name in plants
        ]
        yield f"{'; '.join(texts).capitalize()}."


def _meeting(metrics: RunMetrics, name: str) -> str:
    plant = metrics["plants"][name]
    events = metrics["events"][name]
    begins = [event["time"] for event in events if event["kind"] in CONTACT_EVENTS]
    ignores = name in metrics.get("ignores_obstacles", ())
    if not begins:
        return "ignores obstacles" if ignores else "touches none"
    if ignores:
        text = "ignores obstacles and overlaps one"
    elif plant.get("object_moved_m") is None:
        text = "touches an obstacle"
    else:
        text = "touches an object"
    if len(begins) > 1:
        text += f" {len(begins)} times, first"
    return f"{text} at {begins[0]:.3g} s, for {plant['contact_time_s']:.2g} s"


def _summary(metrics: RunMetrics) -> str:
    plants = metrics["plants"]
    model = plants.get("analytical")
    twin = plants.get("twin")
    if model and twin:
        return _summary_of_both(metrics, model, twin)
    name = "twin" if twin else "model"
    return f"The {name} {_summary_of_one(model or twin or {})}."


def _summary_of_one(plant: PlantMetrics) -> str:
    final = plant.get("final_bend_rad")
    if final is not None:
        return f"ends with a bend of {final:.3g} rad in its first segment"
    travel = plant.get("travel_speed_m_s")
    if travel is not None:
        return f"travels at {travel:.3g} m/s, {_direction(plant)} of its heading"
    speed = plant.get("com_speed_m_s")
    if speed is not None:
        turn = plant.get("yaw_rate_rad_s") or 0.0
        how = "straight on"
        if abs(turn) >= STRAIGHT_RAD_S:
            how = f"turning by {turn:.3g} rad/s"
        moved = plant.get("object_moved_m")
        if moved is not None:
            how += f"; it moves an object by {moved:.2g} m"
        return f"crawls at {speed:.3g} m/s, {how}"
    if plant.get("goal_reached") is not None:
        return _arrives(plant)
    error = plant.get("error_rms_rad")
    if error is not None:
        return f"follows its reference within {error:.2g} rad RMS"
    return f"moves by {plant.get('path_length_m') or 0.0:.3g} m"


def _summary_of_both(
    metrics: RunMetrics, model: PlantMetrics, twin: PlantMetrics
) -> str:
    def both_have(metric: str) -> bool:
        return model.get(metric) is not None and twin.get(metric) is not None

    if both_have("goal_reached"):
        return f"The twin {_arrives(twin)}; the model {_arrives(model)}."
    if both_have("error_rms_rad"):
        return (
            "The twin follows its reference within"
            f" {twin['error_rms_rad']:.2g} rad RMS, the model within"
            f" {model['error_rms_rad']:.2g}."
        )
    if both_have("travel_speed_m_s"):
        text = _compared(metrics, metrics, "travel_speed_m_s", "m/s")
        return (
            f"The twin travels {text}, {_direction(twin)}; the model"
            f" {_direction(model)}."
        )
    if both_have("final_bend_rad") or not both_have("com_speed_m_s"):
        bend_rms = (metrics.get("comparison") or {}).get("bend_rms_rad") or 0.0
        return f"The bends of twin and model differ by {bend_rms:.2g} rad RMS."
    text = f"he twin crawls {_crawling(metrics, metrics)}.{_over_segments(metrics)}"
    if (before := metrics.get("before_contact")) is None:
        return f"T{text}"
    text = f"Over the whole run, t{text} Before the contact"
    if before["plants"]["twin"]["com_speed_m_s"] is None:
        return f"{text}, too few whole gait periods pass to explain a difference."
    return (
        f"{text} (first {before['end_s']:.3g} s), it crawls"
        f" {_crawling(metrics, before)}."
    )


def _crawling(metrics: RunMetrics, part: PartMetrics) -> str:
    text = _compared(metrics, part, "com_speed_m_s", "m/s")
    rates = [
        abs(part["plants"][name].get("yaw_rate_rad_s") or 0.0)
        for name in ("analytical", "twin")
    ]
    if max(rates) >= STRAIGHT_RAD_S:
        text += f", and turns {_compared(metrics, part, 'yaw_rate_rad_s', 'rad/s')}"
    return text


def _over_segments(metrics: RunMetrics) -> str:
    ranges = (metrics.get("intervals") or {}).get("segments")
    reference = metrics["plants"]["analytical"]["com_speed_m_s"]
    if not ranges or reference < ZERO:
        return ""
    low, high = (
        round(100 * (speed / reference - 1))
        for speed in ranges["stiffness_and_damping"]
    )
    if high <= 0:
        text = f"between {-low} and {-high} % slower"
    elif low >= 0:
        text = f"between {low} and {high} % faster"
    else:
        text = f"between {-low} % slower and {high} % faster"
    return (
        " For plausible values of the stiffness and damping of its segments, it is"
        f" {text}."
    )


def _direction(plant: PlantMetrics) -> str:
    direction = math.degrees(plant["travel_direction_rad"])
    side = "left" if direction > 0 else "right"
    return f"{abs(direction):.0f}° to the {side}"


def _arrives(plant: PlantMetrics) -> str:
    reached = "reaches its goal" if plant["goal_reached"] else "does not reach its goal"
    cross_track = plant.get("cross_track_rms_m")
    if cross_track is None:
        return reached
    return f"{reached}, {1e3 * cross_track:.0f} mm RMS from its path"


def _compared(metrics: RunMetrics, part: PartMetrics, metric: str, unit: str) -> str:
    """Compare a metric of the twin with the model, and name the main cause.

    The argument `part` contains the metrics to compare, either for the whole run or for
    the time before the first contact.
    """
    reference, value = (
        part["plants"][plant][metric] for plant in ("analytical", "twin")
    )
    both = f"{value:.3g} against {reference:.3g} {unit}"
    near_zero = is_near_zero(reference, value, unit)
    if near_zero and is_near_zero(value, reference, unit):
        return f"like the model ({both})"
    if near_zero or reference * value <= 0:
        return f"unlike the model ({both})"
    relative = value / reference - 1
    if abs(relative) < _SAME_RATIO:
        return f"like the model ({both})"
    causes = _causes(metrics, metric, part.get("end_s"))
    why = _main_cause(causes, reference, relative, alone="attribution" not in metrics)
    direction = "slower" if relative < 0 else "faster"
    return f"{abs(100 * relative):.0f} % {direction} than the model ({both}{why})"


def _main_cause(
    causes: Sequence[tuple[str, float]],
    reference: float,
    relative: float,
    *,
    alone: bool,
) -> str:
    """Describe the main cause of a relative difference, given as a fraction.

    If `alone` is true, the effect of the cause was computed by switching only this
    cause, and the text contains "would". The text is empty if no cause explains a
    sufficient part of the difference.
    """
    whole = round(100 * relative)
    for name, change in causes:
        effect = round(100 * change / reference)
        is_opposite = effect * relative <= 0
        if is_opposite or abs(change / reference) <= _MIN_CAUSE_RATIO * abs(relative):
            continue
        rest = whole - effect
        verb = "alone would " if alone else ""
        verb += "slow" if relative < 0 else "speed"
        if not alone:
            verb += "s"
        direction = "it" if relative < 0 else "it up"
        does = f"{verb} {direction} by {abs(effect)} %"
        if not rest:
            return f"; {name} {does}"
        if rest * relative > 0:
            others = f"by another {abs(rest)} %"
        else:
            others = f"offset {abs(rest)} %"
        return f"; {name} {does}, other effects {others}"
    return ""


def _causes(
    metrics: RunMetrics, metric: str, window: float | None
) -> list[tuple[str, float]]:
    effects = []
    if (attribution := metrics.get("attribution")) is not None:
        if attribution.get("window_s") == window:
            k = list(attribution["measures"]).index(metric)
            effects = [
                (share["name"], share["value"][k]) for share in attribution["shares"]
            ]
    elif (cause := metrics.get("cause")) and cause.get("window_s") == window:
        effects = [(cause["name"], cause[metric])]  # type: ignore[literal-required]
    return sorted(effects, key=lambda effect: -abs(effect[1]))


_MEASURED = (
    "measured_shape_rms_m measured_path_rms_m measured_bend_rms_rad"
    " measured_heading_rms_rad"
)
_GAIT = f"""
    com_speed_m_s yaw_rate_rad_s turning_radius_m path_length_m mean_bend_amplitude_rad
    travel_speed_m_s travel_direction_rad body_height_m contact_fraction supports roll_turns object_moved_m
    contacts contact_time_s clearance_m
    periods_to_converge amplitude_error_end_rel path_speed_m_s path_curvature_before_per_m
    path_curvature_per_m mechanical_power_w cost_of_transport pneumatic_power_w {_MEASURED} realtime_factor
""".split()
# Metrics in the short table for a run on a bench or with a bend reference.
_BENCH = f"""
    final_bend_rad {_MEASURED} rise_time_s overshoot_rel settling_5_s settling_2_s steady_error_rad
    steady_rms_rad ripple_pp_rad error_rms_rad amplitude_rel phase_lag_rad fit_residual_rad inlet_openings
    outlet_openings contacts contact_time_s clearance_m
    reading_r_squared reading_error_rad reading_backstep_rad reading_range_t realtime_factor
""".split()
_COMPARISON = ("shape_rms_m", "path_rms_m", "bend_rms_rad", *SPATIAL_DIFFERENCES)


def chosen(plants: Mapping[str, PlantMetrics]) -> Sequence[str]:
    """Return the metrics in the short table, which depends on the kind of run."""

    def measured(*names: str) -> bool:
        return any(
            plant.get(name) is not None for plant in plants.values() for name in names
        )

    additional = [
        name
        for group in metric_groups()
        if not group.main
        for name in group.short_table
    ]
    for group in metric_groups():
        if group.main and measured(group.main):
            return [*group.short_table, *additional, *_COMPARISON]
    usual = _BENCH if measured("error_rms_rad", "final_bend_rad") else _GAIT
    return [*usual, *additional, *_COMPARISON]


def tidy(metric: str, value: object) -> object:
    """Convert a metric value for display.

    Booleans become "yes" or "no", and negligible rates and differences become 0.
    """
    if is_yes_no(metric) and value is not None:
        return "yes" if value else "no"
    is_rate = metric.endswith(("_m_s", "_rad_s", "_abs"))
    if is_rate and isinstance(value, float) and abs(value) < ZERO:
        return 0.0
    return value


class ResultRow(NamedTuple):
    """Row of a results table, with all values as text."""

    metric: str
    unit: str
    values: list[str]
    difference: str
    per_cent: str


def result_rows(
    metrics: RunMetrics, names: Iterable[str], text: Callable[[object], str]
) -> Iterator[ResultRow]:
    """Yield the rows of a results table, omitting metrics without a value."""
    units = all_units()
    plants = metrics["plants"]
    for name in names:
        unit = "" if units[name] == "1" else units[name]
        values = [plant.get(name) for plant in plants.values()]
        between = None
        if name in COMPARISON_UNITS:
            between = (metrics.get("comparison") or {}).get(name)
        if between is not None:
            difference = text(tidy(name, between))
            yield ResultRow(name, unit, [""] * len(plants), difference, "")
        elif any(value is not None for value in values):
            texts = [text(tidy(name, value)) for value in values]
            yield ResultRow(name, unit, texts, *_differences(metrics, name, text))


def _differences(
    metrics: RunMetrics, metric: str, text: Callable[[object], str]
) -> tuple[str, str]:
    """Format twin − analytical in the unit of the metric and in per cent.

    The difference is 0 if both values have the same printed text.
    """
    model, twin = (
        tidy(metric, metrics["plants"].get(p, {}).get(metric))
        for p in ("analytical", "twin")
    )
    if (
        metric in _NOT_COMPARED
        or is_yes_no(metric)
        or not isinstance(model, int | float)
        or not isinstance(twin, int | float)
    ):
        return "", ""
    if metric == "com_speed_m_s":
        model *= (metrics.get("comparison") or {}).get("gap_factor") or 1.0
    if text(model) == text(twin):
        twin = model
    difference = "0" if twin == model else f"{twin - model:+.3g}"
    relative = RELATIVE.union(*(group.relative for group in metric_groups()))
    if metric in relative:
        return difference, _per_cent(metric, model, twin)
    return difference, ""


_GAIT_METRICS = (
    "com_speed_m_s",
    "yaw_rate_rad_s",
    "turning_radius_m",
    "bend_amplitude_rad",
    "bend_bias_rad",
    "mean_bend_amplitude_rad",
    *ENERGY_MEANINGS,
)
"""Metrics that require whole gait periods."""


def plant_metrics(
    trajectory: Trajectory, *, wall_s: float | None = None
) -> PlantMetrics:
    """Compute the metrics of one run.

    Gait metrics are means over whole gait periods after a warm-up of two periods
    (`GaitWindow`). Gait metrics are None if the run is not periodic or has fewer than
    three whole periods:

    - ``com_speed_m_s``: length of the period-averaged path of the centre of mass,
      divided by the duration. The speed is negative if the snake moves opposite to the
      mean heading.
    - ``yaw_rate_rad_s``: derivative of the period-averaged heading, positive for turns
      to the left.
    - ``turning_radius_m``: radius of the circle on which the centre of mass moves from
      period to period, positive for turns to the left, or None for a straight path
      (`gait.turning_radius`).
    - ``bend_amplitude_rad``: half the range of the bend in a period, averaged over all
      periods.

    Further metrics are described in `gait.energy_metrics`, `tracking.tracking_metrics`,
    `learning.learning_metrics` and `tracking.reading_metrics`. Extensions add metric
    groups (`extensions.METRICS`). Differences from a recording (``measured_…``) are
    None here and are computed by `compare.MeasuredDifference`. The valve openings
    (``valve_switches``) are None if the plant does not count them.

    Args:
        trajectory: run with ``body_length_m`` and ``gait_frequency_hz`` in its
            metadata.
        wall_s: computing time, s.

    Returns:
        Metrics as JSON values, keyed by name.

    Raises:
        InputError: columns or metadata are missing or unusable.
    """
    check_columns(trajectory, "com_x", "com_y", "heading", "bend")
    metrics: PlantMetrics = dict.fromkeys(_GAIT_METRICS)
    metrics |= dict.fromkeys((*TRACKING_UNITS, *LEARNING_UNITS, *LEARNING_LIST_UNITS))
    window = GaitWindow.from_trajectory(trajectory)
    if window is not None:
        metrics |= _gait_metrics(trajectory, window)
    if trajectory.has("reference"):
        metrics |= tracking_metrics(trajectory)
    if is_learning(trajectory):
        metrics |= learning_metrics(trajectory)
    metrics |= reading_metrics(trajectory)
    metrics |= spatial_metrics(trajectory)
    metrics |= object_metrics(trajectory)
    for group in metric_groups():
        metrics |= group.compute(trajectory)
    metrics |= contact_metrics(trajectory)
    metrics |= dict.fromkeys((*MEASURED_UNITS, "final_bend_rad"))
    if trajectory.metadata.get("base") == "clamped" and not trajectory.has("reference"):
        metrics["final_bend_rad"] = float(trajectory["bend_1"][-1])
    steps = np.diff(trajectory.com, axis=0)
    metrics["path_length_m"] = float(np.hypot(steps[:, 0], steps[:, 1]).sum())
    metrics["valve_switches"] = trajectory.metadata.get("valve_switches")
    metrics |= {"wall_s": wall_s, "realtime_factor": None}
    if wall_s:
        simulated = float(trajectory.time[-1] - trajectory.time[0])
        metrics["realtime_factor"] = simulated / wall_s
    return metrics


def _gait_metrics(trajectory: Trajectory, window: GaitWindow) -> dict[str, object]:
    speeds, yaw_rates = running_rates(trajectory, window)
    speed = float(speeds.mean())
    yaw_rate = float(yaw_rates.mean())
    bend = trajectory.stack("bend")
    amplitude = window.amplitude(trajectory, bend)
    return {
        "com_speed_m_s": speed,
        "yaw_rate_rad_s": yaw_rate,
        "turning_radius_m": turning_radius(
            speed, yaw_rate, window.period, body_length(trajectory)
        ),
        "bend_amplitude_rad": amplitude.tolist(),
        "bend_bias_rad": window.mean(trajectory, bend).tolist(),
        "mean_bend_amplitude_rad": float(amplitude.mean()),
        **energy_metrics(trajectory, window, speed),
    }
