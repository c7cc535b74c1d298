"""Write report.html: what ran, what came out, how far the plants lie apart, and plots of it, in one page.

The part of the report that says why the plants differ.
"""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

from srs_twin.comparison.compare import MEASURES, Attribution
from srs_twin.comparison.following import following
from srs_twin.comparison.learning import is_learning
from srs_twin.comparison.metrics import (
    COMPARISON_UNITS,
    LIST_METRIC_UNITS,
    METRIC_UNITS,
    difference,
    published,
)
from srs_twin.robot.spec import RobotSpec
from srs_twin.scenario.expectation import tally, verdict
from srs_twin.trajectory import Trajectory
from srs_twin.viewing.html.page import Markup, element, folded, page, picture, table
from srs_twin.viewing.plots.plan_view import following_plot, plan_view
from srs_twin.viewing.plots.runs import (
    bend_plot,
    error_plot,
    learning_plot,
    measured_plot,
    pressure_plot,
    reading_plot,
    speed_plot,
    tracking_plot,
    waterfall,
)
from srs_twin.viewing.plots.signals import check_drawable

if TYPE_CHECKING:
    from srs_twin.comparison.compare import Attribution, Comparison, MeasuredDifference


_NOTHING = 5e-6  # in m, m/s, rad and rad/s alike: below what any two of these runs mean

_READING = (
    "Rows add up to the whole gap, twin minus analytical; of the body shape it is the distance between the "
    "two bodies. 'Averaged' assumptions are the analytical model's: every subset of them was switched to "
    "what the twin has, and each one's share is its Shapley value, the average over all orders of switching; "
    "in brackets the least and the most of it over these orders. 'First' comes what has to, before them.",
    "'Refined' ones belong to one plant alone: it was run again with this made smaller, and what that "
    "changed was carried on to nothing. What none of them explains is the last row. 'Matched' is what is "
    "left between the plants when both have stiff bends and the same friction at the same points. The column "
    "of the body shape splits a distance: a negative share there brings the bodies nearer.",
)


def why_section(attribution: Attribution) -> list[Markup]:
    """Return heading, picture, table and how to read them."""
    headings = ["assumption", "what it is", "how", *(f"{t}, {u}" for t, u in MEASURES.values())]
    rows = [
        [share.name, share.title, share.how, *map(_cell, share.value, share.low, share.high)]
        for share in attribution.shares
    ]
    whole = [("not explained", attribution.remainder), ("gap", attribution.gap)]
    rows += [[name, "", "", *map(_number, values)] for name, values in whole]
    left = "stiff bends and the same friction on both sides: what is left"
    rows.append(["matched (stiff bends)", left, "", *map(_number, attribution.matched)])
    same = ", ".join(attribution.same)
    return [
        element("h2", "Why the plants differ"),
        picture(
            waterfall(attribution), "From the analytical model to the twin, one assumption after another."
        ),
        table(headings, rows, numbers=range(3, len(headings))),
        *(element("p", sentence) for sentence in _READING),
        *([element("p", f"Not a difference in this scenario: {same}.")] if same else []),
    ]


def _cell(value: float, low: float, high: float) -> str:
    text = _number(value)
    return text if low == high else f"{text} [{_number(low)}, {_number(high)}]"


def _number(value: float) -> str:
    return f"{value:+.3g}" if abs(value) >= _NOTHING else "0"


# How the names of metrics end, longest first, and what is said instead.
_ENDINGS = {
    "_rad_s": "", "_m_s": "", "_per_m": "", "_rad": "", "_m": "", "_s": "", "_w": "", "_t": "",
    "_rel": ", relative", "_abs": ", size of difference", "_body": " over body length",
}  # fmt: skip

_ALWAYS_READING = (
    "Reading, of a sensor that is not ideal: means over 1° of bend each, and of these the R² of a line, the "
    "largest error, and how far the reading falls at most while the bend grows (0: it never turns back).",
    "A published value is what the dissertation states for this experiment; an expectation is what the "
    "scenario file allows. A dash means that there is no such number: nothing periodic, or a straight path.",
)
_GAIT_READING = (
    "Both plants got the same valve commands. The analytical model (dashed, a ghost in the recording) is the "
    "reference, the MuJoCo twin (solid) the candidate; differences are twin minus analytical, in per cent "
    "where that is marked.",
    "CoM speed is that of the period-averaged path of the centre of mass over whole gait periods after a "
    "warm-up of two, forward positive. Yaw rates, bends and turning radii are positive to the left. Bends "
    "are listed head first.",
    "Shape difference: both bodies are laid centre of mass on centre of mass at zero mean heading; the rest "
    "is the distance of like connectors, root mean square. Path difference: the distance of the centres of "
    "mass at equal times; it grows with every difference of speed or heading.",
    *_ALWAYS_READING,
)
_OWN_CONTROLLERS = (
    "Each plant was driven by a controller of its own, with the same settings, which knows the bend from its "
    "sensor only. The analytical model (dashed, a ghost in the recording) is the reference, the MuJoCo twin "
    "(solid) the candidate; differences are twin minus analytical, in per cent where that is marked."
)
_LEARNING_READING = (
    _OWN_CONTROLLERS,
    "Amplitudes are the furthest sensed bends to the left (+) and to the right (-) in the periods of each "
    "chamber, counted from its first fill. They have converged from the first period on from which all stay "
    "within 5 % of their targets. What is said of the path without 'before' is of the last five periods; "
    "curvature is positive to the left. The box is how far the body reaches to the left (negative) and right "
    "of the circle or line through the path of the centre of mass.",
    *_GAIT_READING[1:],
)
_PLAN_READING = (
    _OWN_CONTROLLERS,
    "Cross-track is the distance of the centre of mass from the plan in force. Inside: the share of time at "
    "which the whole body is between the edges of the footprint that was planned with; of the 50 mm box, the "
    "text's. Clearance is the least distance between body and obstacles.",
    *_GAIT_READING[1:],
)
_FOLLOWING_READING = (
    _OWN_CONTROLLERS,
    "Of a step: rise from 10 to 90 % of it, overshoot as a share of it, settled from when on the bend stays "
    "within so much of it. At rest: over the second half of the time since the reference last changed. Of a "
    "sine: amplitude over the reference's and lag, by least squares over whole periods after a warm-up. An "
    "opening is one of a valve, mean of both chambers. Bends are positive to the left.",
    *_ALWAYS_READING,
)


def write_report(
    path: str | Path,
    *,
    scenario_title: str,
    spec: RobotSpec,
    trajectories: Mapping[str, Trajectory],
    metrics: Mapping[str, Any],
    comparison: Comparison | None = None,
    attribution: Attribution | None = None,
    measured: Mapping[str, MeasuredDifference] | None = None,
) -> None:
    """Write the report of one run; it needs nothing from outside itself.

    Args:
        path: file to write; an existing one is replaced.
        scenario_title: one line for people.
        spec: the robot that ran.
        trajectories: plant → what it did.
        metrics: what stands in metrics.json.
        comparison: adds the plot of differences over time.
        attribution: adds why the plants differ.
        measured: plant → how far it is from the measured robot; adds the plot of it.

    Raises:
        InputError: there is no trajectory, or one of them is empty.
    """
    check_drawable(trajectories)
    duration = max(float(run.time[-1]) for run in trajectories.values())
    plants = " and ".join(trajectories)
    parts = [
        element("h1", scenario_title),
        element("p", f"{spec.title}, {duration:g} s simulated, {plants}", cls="sub"),
        element("h2", "Results"),
        result_table(metrics),
        *_expectations(metrics.get("expectations") or ()),
        *(why_section(attribution) if attribution is not None else []),
        element("h2", "Plots"),
        *_measured(measured),
        *_pictures(trajectories, spec, comparison),
        element("h2", "How to read this"),
        *(element("p", sentence) for sentence in _reading(trajectories)),
        element("h2", "Settings"),
        *_settings(spec, trajectories, metrics.get("versions") or {}),
    ]
    Path(path).write_text(page(scenario_title, *parts), encoding="utf-8")


def _reading(trajectories: Mapping[str, Trajectory]) -> Sequence[str]:
    """Return how to read the report of such runs."""
    if all(run.has("reference_1") for run in trajectories.values()):
        return _FOLLOWING_READING
    if all(following(run) is not None for run in trajectories.values()):
        return _PLAN_READING
    if all(map(is_learning, trajectories.values())):
        return _LEARNING_READING
    return _GAIT_READING


def result_table(metrics: Mapping[str, Any]) -> Markup:
    """Return the table of metrics: one column a plant, the difference, and what was published."""
    plants: Mapping[str, Mapping[str, Any]] = metrics["plants"]
    stated = {
        name: f"{_text(value)} ({source})"
        for name, (value, source) in published(metrics.get("expectations") or ()).items()
    }
    both = {"analytical", "twin"} <= plants.keys()
    headings = [
        "metric",
        "unit",
        *plants,
        *(["difference"] if both else []),
        *(["published"] if stated else []),
    ]
    rows = []
    for name, unit in (METRIC_UNITS | LIST_METRIC_UNITS).items():
        values = [measured.get(name) for measured in plants.values()]
        if any(value is not None for value in values):
            apart = [difference(metrics, name)] if both else []
            rows.append([_words(name), unit, *map(_text, values), *apart, *_said(stated, name)])
    for name, unit in COMPARISON_UNITS.items():
        value = (metrics.get("comparison") or {}).get(name)
        if value is not None:
            blank = [""] * len(plants)
            rows.append([_words(name), unit, *blank, *([_text(value)] if both else []), *_said(stated, name)])
    return table(headings, rows, numbers=range(2, len(headings)))


def _said(stated: Mapping[str, str], name: str) -> list[str]:
    """Return the cell of what was published; there is no such column where nothing was."""
    return [stated.get(name, "")] if stated else []


def _expectations(expectations: Sequence[Mapping[str, Any]]) -> list[Markup]:
    if not expectations:
        return []
    verdicts = [verdict(each) for each in expectations]
    keys = ["allowed", "source", *(["known"] if {"known", "holds"} & set(verdicts) else [])]
    rows = []
    for word, each in zip(verdicts, expectations, strict=True):
        mark = element("span", word, cls="missed" if word == "missed" else "met" if each["met"] else "sub")
        texts = [each.get(key) or "" for key in keys]
        rows.append([mark, each["metric"], each.get("of") or "", _text(each.get("value")), *texts])
    headings = ["", "metric", "of", "value", *keys]
    return [element("h2", f"Expectations: {tally(Counter(verdicts))}"), table(headings, rows, numbers=[3])]


def _pictures(
    trajectories: Mapping[str, Trajectory], spec: RobotSpec, comparison: Comparison | None
) -> list[Markup]:
    made = [
        picture(plan_view(trajectories, spec), "Paths and bodies from above. Forward is from tail to head."),
        picture(bend_plot(trajectories), "Bend of each segment; positive bends the head end to the left."),
        picture(pressure_plot(trajectories), "Pressure of the + chamber less that of the − chamber."),
    ]
    if all(run.has("reference_1") for run in trajectories.values()):
        made.insert(0, picture(tracking_plot(trajectories), "How the first segment follows its reference."))
    else:
        made.append(picture(speed_plot(trajectories), "Speed of the centre of mass."))
    if all(map(is_learning, trajectories.values())):
        text = "What was learnt: amplitudes and duties of each module, by period."
        made.insert(0, picture(learning_plot(trajectories), text))
    if (read := reading_plot(trajectories)) is not None:
        made.append(picture(read, "What the first segment's sensor reads over what it is bent by."))
    if (followed := following_plot(trajectories, spec)) is not None:
        text = "The plan, the floor planned for the body (blue), obstacles, goal, and what came of it."
        made.insert(0, picture(followed, text))
    if comparison is not None and len(comparison.time):
        made.append(picture(error_plot(comparison, spec), "How far the twin is from the analytical model."))
    return made


def _measured(differences: Mapping[str, MeasuredDifference] | None) -> list[Markup]:
    """Return the plot of how far the plants are from the measured robot, where one was."""
    if not differences:
        return []
    return [picture(measured_plot(differences), "How far each plant is from what was measured, over time.")]


def _settings(
    spec: RobotSpec, trajectories: Mapping[str, Trajectory], versions: Mapping[str, Any]
) -> list[Markup]:
    about = {plant: run.metadata for plant, run in trajectories.items()}
    keys = dict.fromkeys(key for metadata in about.values() for key in metadata)
    runs = [[key, *(_text(metadata.get(key)) for metadata in about.values())] for key in keys]
    robot = [[name, _text(value)] for name, value in _leaves(asdict(spec))]
    used = [[name, str(version)] for name, version in versions.items()]
    return [
        folded("Plants and controller", table(["setting", *about], runs)),
        folded(f"Robot {spec.name} (SI units)", table(["parameter", "value"], robot)),
        folded("Versions", table(["package", "version"], used)),
    ]


def _leaves(tree: Mapping[str, Any], above: str = "") -> list[tuple[str, Any]]:
    """Return ('geometry.width', 0.03)… of nested mappings."""
    found: list[tuple[str, Any]] = []
    for name, value in tree.items():
        found += _leaves(value, f"{above}{name}.") if isinstance(value, Mapping) else [(above + name, value)]
    return found


def _words(name: str) -> str:
    """Return 'CoM speed' for com_speed_m_s: the unit has a column of its own."""
    for ending, words in _ENDINGS.items():
        if name.endswith(ending):
            name = name.removesuffix(ending) + words
            break
    return {"wall": "time to compute"}.get(name, name.replace("com_", "CoM ").replace("_", " "))


def _text(value: Any) -> str:
    """Return a JSON value for people; a dash where there is none."""
    if value is None:
        return "–"
    if isinstance(value, bool | str):
        return str(value)
    if isinstance(value, int | float):
        return f"{value:.4g}" if isinstance(value, float) else str(value)
    if isinstance(value, list | tuple):
        return ", ".join(
            f"[{_text(each)}]" if isinstance(each, list | tuple) else _text(each) for each in value
        )
    return json.dumps(value, ensure_ascii=False)
