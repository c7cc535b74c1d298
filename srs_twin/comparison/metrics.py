"""All metrics of one trajectory, and what a table says beside them: differences and published values."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from typing import Any

import numpy as np

from srs_twin.comparison.gait import (
    ENERGY_METRICS,
    GaitWindow,
    energy_metrics,
    running_rates,
    turning_radius,
)
from srs_twin.comparison.group import metric_groups
from srs_twin.comparison.learning import (
    LEARNING_LIST_UNITS,
    LEARNING_UNITS,
    is_learning,
    learning_metrics,
)
from srs_twin.comparison.reading import READING_UNITS, reading_metrics
from srs_twin.comparison.sampling import body_length, require, units_of
from srs_twin.comparison.tracking import TRACKING_UNITS, tracking_metrics
from srs_twin.trajectory import Trajectory

RELATIVE = set(
    """
    com_speed_m_s turning_radius_m path_length_m mean_bend_amplitude_rad final_bend_rad
    mechanical_power_w cost_of_transport pneumatic_power_w pneumatic_cost_of_transport
    rise_time_s settling_2_s settling_5_s ripple_pp_rad ripple_rms_rad sensed_ripple_pp_rad steady_rms_rad
    error_rms_rad amplitude_rel fit_residual_rad inlet_openings outlet_openings
    path_radius_m path_speed_m_s duty_lowest duty_highest
    reading_error_rad reading_backstep_rad reading_range_t
    """.split()
).union(*(group.relative for group in metric_groups()))
"""Metrics whose difference is given over the analytical value; of others in their own unit."""

_ROUNDING = 1e-9  # of a value: what two ways of adding up may differ by
_NOT_COMPARED = {"wall_s", "realtime_factor"}  # how long a computer took tells the plants nothing


def difference(metrics: Mapping[str, Any], metric: str) -> str:
    """Return twin − analytical in words, over the (signed) analytical value where that is usual.

    Args:
        metrics: what stands in metrics.json.
        metric: name of the metric.

    Returns:
        E.g. "-11.5 %" or "+0.0432"; empty where there is nothing to compare.
    """
    ours, theirs = (metrics["plants"].get(plant, {}).get(metric) for plant in ("analytical", "twin"))
    if metric in _NOT_COMPARED or not isinstance(ours, int | float) or not isinstance(theirs, int | float):
        return ""
    if metric == "com_speed_m_s":
        ours *= (metrics.get("comparison") or {}).get("gap_factor") or 1.0
    return relative_difference(ours, theirs) if metric in RELATIVE else _apart(ours, theirs)


def relative_difference(of: float, value: float) -> str:
    """Return value − of in per cent of `of`: "-11.5 %"; in its own unit where a share says nothing."""
    # A share of nothing, or of the other direction.
    return f"{100 * (value - of) / of:+.1f} %" if of * value > 0 else _apart(of, value)


def _apart(of: float, value: float) -> str:
    return "0" if abs(value - of) <= _ROUNDING * abs(of) else f"{value - of:+.3g}"


def published(expectations: Sequence[Mapping[str, Any]]) -> dict[str, tuple[float, str]]:
    """Return metric → published value and its source, of the expectations that state both."""
    stated = [e for e in expectations if e.get("near") is not None and e.get("source")]
    return {each["metric"]: (each["near"], each["source"]) for each in stated}


MEASURED_UNITS = units_of("""
    measured_com_speed_rel measured_yaw_rate_abs measured_shape_rms_m measured_path_rms_m
    measured_bend_rms_rad measured_heading_rms_rad
""") | {"measured_yaw_rate_abs": "rad/s"}
"""Metrics of a plant against what was measured of the robot: plant less measured, as in `compare`."""

METRICS_LISTED = "`srs-twin schema`"
"""What prints the names of all metrics, for messages."""

METRIC_UNITS = {
    **units_of("com_speed_m_s path_length_m yaw_rate_rad_s turning_radius_m mean_bend_amplitude_rad"),
    **units_of(ENERGY_METRICS),
    **units_of("final_bend_rad"),
    **TRACKING_UNITS,
    **LEARNING_UNITS,
    **READING_UNITS,
    **{name: unit for group in metric_groups() for name, unit in group.units.items()},
    **MEASURED_UNITS,
    **units_of("wall_s realtime_factor"),
}
"""Metrics of a plant that are one number each: what an expectation can name."""

LIST_METRIC_UNITS = units_of("bend_amplitude_rad bend_bias_rad valve_switches") | LEARNING_LIST_UNITS
"""Metrics of a plant that are lists, head first; those of learning have a list a period."""

COMPARISON_UNITS = units_of("""
    com_speed_rel gap_factor yaw_rate_abs shape_rms_m shape_rms_body path_rms_m
    bend_rms_rad bend_rms_rel heading_rms_rad
""") | {"yaw_rate_abs": "rad/s"}
"""Metrics of `compare`, each one number; they stand here so that naming them needs nothing else."""


_MEANINGS = """
com_speed_m_s: forward speed of the centre of mass, mean over whole gait periods after two
path_length_m: way of the centre of mass over the whole run
yaw_rate_rad_s: mean rate of the heading over the same periods; to the left positive
turning_radius_m: speed over yaw rate; none when it goes straight
mean_bend_amplitude_rad: half the range of a bend, mean over the segments
bend_amplitude_rad: the same of each segment, head first
bend_bias_rad: mean bend of each segment, head first
valve_switches: openings of each segment's + and - valve, head first
mechanical_power_w: work of the torques of the segments, over time
internal_power_w: mechanical power dissipated by a segment's hinges as they move against each other
cost_of_transport: mechanical power over weight times speed
pneumatic_power_w: energy of the air that the chambers draw, over time
pneumatic_cost_of_transport: pneumatic power over weight times speed
final_bend_rad: bend of the first segment at the end
rise_time_s: from 10 to 90 % of a step
overshoot_rel: bend beyond a step's end, over the step
overshoot_rad: the same as an angle
settling_2_s: until the bend stays within 2 % of the step
settling_5_s: until the bend stays within 5 % of the step
steady_error_rad: mean error while the reference rests, in its second half
steady_rms_rad: RMS error there
ripple_pp_rad: peak-to-peak of the bend there
ripple_rms_rad: RMS of the bend about its mean there
sensed_ripple_pp_rad: peak-to-peak of what the sensor reads there
error_rms_rad: RMS of reference less bend over the run
amplitude_rel: amplitude of the bend over that of a sine reference
amplitude_spread_rel: its standard deviation from period to period
phase_lag_rad: phase by which the bend follows a sine reference
phase_lag_spread_rad: its standard deviation from period to period
fit_residual_rad: RMS of the bend about the sine fitted to it
inlet_openings: how often inlet valves opened
outlet_openings: how often outlet valves opened
amplitude_growth_rel: amplitude before the first learnt change over that of the first period, less 1
periods_to_converge: first period from which all amplitudes stay within 5 % of their targets
amplitude_error_end_rad: largest error of an amplitude in the last period
amplitude_error_end_rel: the same over its target
amplitude_error_rad: error of each chamber's amplitude in each period
duty: learnt duty of each chamber in each period
duty_lowest: lowest duty of the last period
duty_highest: highest duty of the last period
path_speed_m_s: way from period to period over time, in the last five periods
path_curvature_before_per_m: curvature of the path before learning began; to the left positive
path_curvature_per_m: curvature of the path in the last five periods
path_bend_before_per_m: size of the curvature before learning began
path_bend_per_m: size of the curvature in the last five periods
path_bend_left_rel: what is left of the size of the curvature
path_radius_m: radius of the path in the last five periods
path_radius_spread_rel: largest less smallest radius of these periods, over their mean
heading_drift_rad: turn of the heading in a period, mean over the last five
heading_drift_by_period_rad: turn of the heading in each period
box_left_m: how far the body reaches to the left of its path; negative
box_right_m: how far the body reaches to the right of its path
reading_r_squared: R² of a line through sensor readings over bends
reading_error_rad: RMS of readings about the bends
reading_backstep_rad: how far the reading falls while the bend grows
reading_backstep_at_rad: bend at which it falls most
reading_range_t: range of the sensor's magnetic field
plan_found: 1 where a path was found, else 0
plan_length_m: length of the planned path
plan_nodes: nodes that the search expanded
plan_kink_rad: largest change of direction between two parts of the path
goal_reached: 1 where the snake came to its goal, and not through an obstacle, else 0
arrival_error_m: distance from the goal at the end
arrival_heading_error_rad: angle between heading and goal at the end
cross_track_rms_m: RMS distance of the centre of mass from the planned path
cross_track_max_m: largest distance of the centre of mass from the planned path
inside_share: share of time at which the whole body is inside the planned footprint
inside_50mm_share: share of time at which the whole body is inside the text's box of 50 mm
contacts: how often the body touched an obstacle
contact_time_s: how long it touched one
clearance_m: least distance of the body from obstacles
following_time_s: how long the way took
replans: plans after the first
measured_com_speed_rel: speed less that of the recorded robot, over it
measured_yaw_rate_abs: size of the difference of the yaw rates
measured_shape_rms_m: RMS distance of the connectors from the recorded ones, centre and heading aligned
measured_path_rms_m: RMS distance of the centres of mass
measured_bend_rms_rad: RMS difference of the bends
measured_heading_rms_rad: RMS difference of the headings
wall_s: time that the simulation took
realtime_factor: simulated time over that
com_speed_rel: twin's speed less the analytical model's, over the latter
gap_factor: by which the analytical speed was multiplied for it, 1 unless asked for
yaw_rate_abs: size of the difference of the yaw rates
shape_rms_m: RMS distance of like connectors, centre and heading aligned
shape_rms_body: the same over the body's length
path_rms_m: RMS distance of the centres of mass at equal times
bend_rms_rad: RMS difference of the bends
bend_rms_rel: the same over the analytical model's RMS bend
heading_rms_rad: RMS difference of the headings
"""


def meanings() -> dict[str, str]:
    """Return metric → what it is, in a line: of plants, lists of plants, and the comparison."""
    return dict(line.split(": ", 1) for line in _MEANINGS.split("\n") if line)


VALIDATION = (
    "Both plants are simulations. Held against hardware are only the values that the dissertation publishes "
    "and recordings that were replayed; all other differences are between the two plants."
)
"""What is validated and what is not, for every report."""

_ALIKE = 0.01  # of a value: plants that differ by less agree
_TURNS = 0.05  # rad/s: slower is straight
_NOTHING = 5e-5  # m/s, rad/s
_PRESET = "The twin ran with preset {}, for searching: cite a run without it (docs/models.md#presets)."
_A_CAUSE = 0.25  # of a difference: smaller shares are not named


def headline(metrics: Mapping[str, Any]) -> str:
    """Return in one sentence what a run says, and in another with which preset, where it was not the default.

    Args:
        metrics: what stands in metrics.json.
    """
    said, preset = _said(metrics), metrics.get("preset")
    return f"{said} {_PRESET.format(preset)}" if preset else said


def _said(metrics: Mapping[str, Any]) -> str:
    plants = metrics["plants"]
    ours, theirs = plants.get("analytical"), plants.get("twin")
    one = ours or theirs or {}
    if ours and theirs:
        return _of_both(metrics, ours, theirs)
    name = "twin" if theirs else "model"
    if one.get("com_speed_m_s") is not None:
        turn = one.get("yaw_rate_rad_s") or 0.0
        how = "straight on" if abs(turn) < _TURNS else f"turning by {turn:.3g} rad/s"
        return f"The {name} crawls at {one['com_speed_m_s']:.3g} m/s, {how}."
    if one.get("goal_reached") is not None:
        return f"The {name} {_arrives(one)}."
    if one.get("error_rms_rad") is not None:
        return f"The {name} follows its reference within {one['error_rms_rad']:.2g} rad RMS."
    return f"The {name} moves by {one.get('path_length_m') or 0.0:.3g} m."


def _of_both(metrics: Mapping[str, Any], ours: Mapping[str, Any], theirs: Mapping[str, Any]) -> str:
    if ours.get("goal_reached") is not None and theirs.get("goal_reached") is not None:
        return f"The twin {_arrives(theirs)}; the model {_arrives(ours)}."
    if ours.get("error_rms_rad") is not None and theirs.get("error_rms_rad") is not None:
        errors = f"{theirs['error_rms_rad']:.2g} rad RMS, the model within {ours['error_rms_rad']:.2g}"
        return f"The twin follows its reference within {errors}."
    if ours.get("com_speed_m_s") is None or theirs.get("com_speed_m_s") is None:
        apart = (metrics.get("comparison") or {}).get("bend_rms_rad") or 0.0
        return f"The bends of twin and model differ by {apart:.2g} rad RMS."
    text = f"The twin crawls {_compared(metrics, 'com_speed_m_s', 'slower', 'faster', 'm/s')}"
    if max(abs(each.get("yaw_rate_rad_s") or 0.0) for each in (ours, theirs)) >= _TURNS:
        text += f", and turns {_compared(metrics, 'yaw_rate_rad_s', 'slower', 'faster', 'rad/s')}"
    return f"{text}."


def _arrives(plant: Mapping[str, Any]) -> str:
    reached = "reaches its goal" if plant["goal_reached"] else "does not reach its goal"
    off = plant.get("cross_track_rms_m")
    return reached if off is None else f"{reached}, {1e3 * off:.0f} mm RMS from its path"


def _compared(metrics: Mapping[str, Any], metric: str, less: str, more: str, unit: str) -> str:
    of, value = (metrics["plants"][plant][metric] for plant in ("analytical", "twin"))
    both = f"{value:.3g} against {of:.3g} {unit}"
    if of * value <= 0:
        return f"otherwise than the model ({both})"
    share = value / of - 1
    if abs(share) < _ALIKE:
        return f"like the model ({both})"
    why = _main_cause(metrics, metric, of, share)
    return f"{abs(100 * share):.0f} % {less if share < 0 else more} than the model ({both}{why})"


def _main_cause(metrics: Mapping[str, Any], metric: str, of: float, share: float) -> str:
    """Return the main cause of a relative difference in words, in whole per cents that add up to it.

    A cause that was switched on alone "would" have its effect; the shares of an attribution are averages over
    the orders of switching. Empty where no cause acts in the direction of the difference.
    """
    whole = round(100 * share)
    for name, change in _causes(metrics, metric):
        effect = round(100 * change / of)
        if effect * share <= 0 or abs(change / of) <= _A_CAUSE * abs(share):
            continue
        alone, rest = "attribution" not in metrics, whole - effect
        verb = ("slow" if share < 0 else "speed") + ("" if alone else "s")
        does = f"{'alone would ' if alone else ''}{verb} it{' up' if share > 0 else ''} by {abs(effect)} %"
        if not rest:
            return f"; {name} {does}"
        others = f"by another {abs(rest)} %" if rest * share > 0 else f"offset {abs(rest)} %"
        return f"; {name} {does}, other effects {others}"
    return ""


def _causes(metrics: Mapping[str, Any], metric: str) -> list[tuple[str, float]]:
    """Return assumptions and what each changes of a metric, the largest change first."""
    if (attribution := metrics.get("attribution")) is not None:
        k = list(attribution["measures"]).index(metric)
        found = [(share["name"], share["value"][k]) for share in attribution["shares"]]
    else:
        cause = metrics.get("cause") or {}
        found = [(cause["name"], cause[metric])] if cause else []
    return sorted(found, key=lambda each: -abs(each[1]))


_MEASURED = "measured_shape_rms_m measured_path_rms_m measured_bend_rms_rad measured_heading_rms_rad"
_GAIT = f"""
    com_speed_m_s yaw_rate_rad_s turning_radius_m path_length_m mean_bend_amplitude_rad
    periods_to_converge amplitude_error_end_rel path_speed_m_s path_curvature_before_per_m
    path_curvature_per_m mechanical_power_w cost_of_transport pneumatic_power_w {_MEASURED} realtime_factor
""".split()
# Of a run whose bends follow a reference, or of one on a bench.
_BENCH = f"""
    final_bend_rad {_MEASURED} rise_time_s overshoot_rel settling_5_s settling_2_s steady_error_rad
    steady_rms_rad ripple_pp_rad error_rms_rad amplitude_rel phase_lag_rad fit_residual_rad inlet_openings
    outlet_openings reading_r_squared reading_error_rad reading_backstep_rad reading_range_t realtime_factor
""".split()
_COMPARISON = ("shape_rms_m", "path_rms_m", "bend_rms_rad")


def chosen(plants: Mapping[str, Mapping[str, Any]]) -> Sequence[str]:
    """Return the metrics that a short table shows: by whether plants followed a plan or a reference."""

    def measured(*names: str) -> bool:
        return any(each.get(name) is not None for each in plants.values() for name in names)

    for group in metric_groups():
        if measured(group.main):
            return [*group.short_table, *_COMPARISON]
    return [*(_BENCH if measured("error_rms_rad", "final_bend_rad") else _GAIT), *_COMPARISON]


def tidy(metric: str, value: Any) -> Any:
    """Return a metric's value as it is shown: a rate that moves nothing is 0."""
    rate = isinstance(value, float) and metric.endswith(("_m_s", "_rad_s"))
    return 0.0 if rate and abs(value) < _NOTHING else value


def result_rows(
    metrics: Mapping[str, Any], names: Iterable[str], text: Callable[[Any], str]
) -> Iterator[tuple[str, str, list[str], str]]:
    """Yield the rows of a table of results: metric, unit, a cell a plant, difference.

    Args:
        metrics: what stands in metrics.json.
        names: metrics of plants and of the comparison; what has no value is left out.
        text: writes a value.
    """
    units, plants = METRIC_UNITS | LIST_METRIC_UNITS | COMPARISON_UNITS, metrics["plants"].values()
    for name in names:
        values = [plant.get(name) for plant in plants]
        between = (metrics.get("comparison") or {}).get(name) if name in COMPARISON_UNITS else None
        if between is not None:
            yield name, units[name], [""] * len(plants), text(between)
        elif any(value is not None for value in values):
            yield name, units[name], [text(tidy(name, value)) for value in values], difference(metrics, name)


_GAIT_METRICS = f"""
    com_speed_m_s yaw_rate_rad_s turning_radius_m
    bend_amplitude_rad bend_bias_rad mean_bend_amplitude_rad {ENERGY_METRICS}
""".split()
_NOT_LEARNING = dict.fromkeys(LEARNING_UNITS | LEARNING_LIST_UNITS)


def plant_metrics(trajectory: Trajectory, *, wall_s: float | None = None) -> dict[str, Any]:
    """Measure one run.

    The gait metrics are taken over whole gait periods after a warm-up of two (`GaitWindow`), and are None
    where nothing is periodic or the run has fewer than three whole periods:

    - ``com_speed_m_s``: arc length of the period-averaged path of the centre of mass over its time, negative
      where that path runs against the period-mean heading.
    - ``yaw_rate_rad_s``: slope of the period-mean heading, positive to the left.
    - ``turning_radius_m``: radius of the circle on which each period carries the centre of mass, positive
      where its centre lies on the left; None when straight (`gait.turning_radius`).
    - ``bend_amplitude_rad``: half the peak-to-peak of each period, averaged over them; head first.
      ``mean_bend_amplitude_rad`` is the mean over the segments.
    - ``bend_bias_rad``: mean bend, head first.
    - what it costs: see `gait.energy_metrics`.

    A run with a reference for the bends has `tracking.tracking_metrics`, one under iterative learning
    `learning.learning_metrics`; they are None without. A run on a bench without a reference has
    ``final_bend_rad``, the first segment's bend at its end. A run with a sensor that is not ideal has
    `reading.reading_metrics`; extensions add their groups (`extensions.METRICS`).
    What is said against a measured robot (`measured_…`) is None here; see `compare.MeasuredDifference`.

    The others cover the whole run: ``path_length_m`` of the raw path, ``valve_switches`` as [+, −] openings
    a segment (None where nothing counted them), ``wall_s``, and ``realtime_factor``, simulated seconds over
    wall seconds (both None without a wall time).

    Args:
        trajectory: one run, with ``body_length_m`` and ``gait_frequency_hz`` in its metadata.
        wall_s: how long it took to compute, s.

    Returns:
        JSON values by the names above; units in `METRIC_UNITS` and `LIST_METRIC_UNITS`.

    Raises:
        InputError: columns or metadata are missing or unusable.
    """
    require(trajectory, "com_x", "com_y", "heading", "bend")
    steps = np.diff(trajectory.com, axis=0)
    simulated = float(trajectory.time[-1] - trajectory.time[0])
    window = GaitWindow.of(trajectory)
    gait = dict.fromkeys(_GAIT_METRICS) if window is None else _gait_metrics(trajectory, window)
    following = trajectory.has("reference")
    ends = trajectory.metadata.get("base") == "clamped" and not following
    return {
        **gait,
        **(tracking_metrics(trajectory) if following else dict.fromkeys(TRACKING_UNITS)),
        **(learning_metrics(trajectory) if is_learning(trajectory) else _NOT_LEARNING),
        **reading_metrics(trajectory),
        **{name: value for group in metric_groups() for name, value in group.measure(trajectory).items()},
        **dict.fromkeys(MEASURED_UNITS),
        "final_bend_rad": float(trajectory["bend_1"][-1]) if ends else None,
        "path_length_m": float(np.hypot(steps[:, 0], steps[:, 1]).sum()),
        "valve_switches": trajectory.metadata.get("valve_switches"),
        "wall_s": wall_s,
        "realtime_factor": simulated / wall_s if wall_s else None,
    }


def _gait_metrics(trajectory: Trajectory, window: GaitWindow) -> dict[str, Any]:
    speeds, yaw_rates = running_rates(trajectory, window)
    speed, yaw_rate = float(speeds.mean()), float(yaw_rates.mean())
    bend = trajectory.stack("bend")
    amplitude = window.amplitude(trajectory, bend)
    return {
        "com_speed_m_s": speed,
        "yaw_rate_rad_s": yaw_rate,
        "turning_radius_m": turning_radius(speed, yaw_rate, window.period, body_length(trajectory)),
        "bend_amplitude_rad": amplitude.tolist(),
        "bend_bias_rad": window.mean(trajectory, bend).tolist(),
        "mean_bend_amplitude_rad": float(amplitude.mean()),
        **energy_metrics(trajectory, window, speed),
    }
