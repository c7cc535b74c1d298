"""report.html of a run: what ran, what came out, how far the plants lie apart and why, and plots of it."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

from srs_twin.comparison.compare import MEASURES
from srs_twin.comparison.learning import is_learning
from srs_twin.comparison.metrics import (
    COMPARISON_UNITS,
    LIST_METRIC_UNITS,
    METRIC_UNITS,
    chosen,
    headline,
    plant_metrics,
    published,
    result_rows,
    tidy,
)
from srs_twin.robot.file import RobotFile, units_of
from srs_twin.robot.sourced import si_unit, split_unit
from srs_twin.robot.spec import RobotSpec
from srs_twin.scenario.expectation import tally, verdict
from srs_twin.scenario.modified import Changes, left_out_line, text_of
from srs_twin.trajectory import Trajectory
from srs_twin.viewing.additions import added_to
from srs_twin.viewing.html.page import Picture, Table, cell, colored, picture, piece, render
from srs_twin.viewing.plots.from_above import lines_plot, plan_view
from srs_twin.viewing.plots.labels import metric_title
from srs_twin.viewing.plots.runs import (
    attribution_plot,
    bend_plot,
    error_plot,
    learning_plot,
    measured_plot,
    pressure_plot,
    reading_plot,
    speed_plot,
    tracking_plot,
)
from srs_twin.viewing.plots.signals import check_drawable, kind_of

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from srs_twin.comparison.compare import Attribution, Comparison, MeasuredDifference

_NOTHING = 5e-6  # in m, m/s, rad and rad/s alike: below what any two of these runs mean


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
    expectations = metrics.get("expectations") or ()
    verdicts = [verdict(each) for each in expectations]
    tracked = all(run.has("reference_1") for run in trajectories.values())
    page = render(
        "viewing/html/report.html",
        title=scenario_title,
        subtitle=f"{spec.title}, {duration:g} s simulated, {' and '.join(trajectories)}",
        headline=headline(metrics),
        changes=_changes(metrics.get("changes") or ()),
        results=_results(metrics, chosen(metrics["plants"])),
        every=_results(metrics, METRIC_UNITS | LIST_METRIC_UNITS | COMPARISON_UNITS),
        tally=tally(Counter(verdicts)),
        expectations=_expectations(expectations, verdicts),
        left_out=left_out_line(metrics.get("left_out") or ()),
        **_why(attribution),
        plots=_plots(trajectories, spec, comparison, measured, tracked=tracked),
        kind="tracking" if tracked else kind_of(trajectories),
        settings=_settings(spec, trajectories, metrics.get("versions") or {}),
    )
    Path(path).write_text(page, encoding="utf-8")


def shown_run(
    title: str, metrics: Mapping[str, Any], trajectories: Mapping[str, Trajectory], spec: RobotSpec
) -> str:
    """Return what a notebook shows of a run: the sentence, the table, the bodies from above."""
    above = picture(plan_view(trajectories, spec), "Paths and bodies from above.")
    return piece(f"{title}: {headline(metrics)}", _results(metrics, chosen(metrics["plants"])), above)


def page_of_run(trajectory: Trajectory) -> str:
    """Return a trajectory as HTML for a notebook."""
    plant = str(trajectory.metadata.get("plant", "run"))
    metrics = {"plants": {plant: plant_metrics(trajectory)}}
    lines = {"centre of mass": trajectory.com, "body at the end": trajectory.position[-1]}
    path = picture(lines_plot(lines), "The centre of mass, and the body at the end.")
    words = f"{plant}, {trajectory.time[-1]:g} s, {len(trajectory)} samples"
    return piece(words, _results(metrics, chosen(metrics["plants"])), path)


def page_of_comparison(comparison: Comparison) -> str:
    """Return a comparison as HTML for a notebook."""
    rows = [
        [metric_title(name), COMPARISON_UNITS[name], cell(value)]
        for name, value in comparison.metrics.items()
    ]
    return piece("Twin less analytical model", Table(["metric", "unit", "value"], rows, [2]))


def _results(metrics: Mapping[str, Any], names: Iterable[str]) -> Table:
    """Return a table of these metrics: one column a plant, the difference, and what was published."""
    plants, stated = metrics["plants"], published(metrics.get("expectations") or ())
    both = {"analytical", "twin"} <= plants.keys()
    headings = ["metric", "unit", *plants, *["difference"] * both, *["published"] * bool(stated)]
    rows = []
    for name, unit, values, apart in result_rows(metrics, names, cell):
        said = f"{cell(stated[name][0])} ({stated[name][1]})" if name in stated else ""
        rows.append([metric_title(name), unit, *values, *[apart] * both, *[said] * bool(stated)])
    return Table(headings, rows, range(2, len(headings)))


def _changes(changes: Changes) -> Table:
    """Return the table of the fields that differ from the scenario's file."""
    rows = [[each["field"], text_of(each["from"]), text_of(each["to"])] for each in changes]
    return Table(["changed field", "in the scenario", "in this run"], rows)


def _expectations(expectations: Sequence[Mapping[str, Any]], verdicts: Sequence[str]) -> Table:
    keys = ["allowed", "source", *["known"] * bool({"known", "holds"} & set(verdicts))]
    keys += ["reason"] * ("not_judged" in verdicts)
    rows = []
    for word, each in zip(verdicts, expectations, strict=True):
        color = "missed" if word == "missed" else "met" if each["met"] else "sub"
        texts = [each.get(key) or "" for key in ("of", *keys)]
        title, value = metric_title(each["metric"]), cell(tidy(each["metric"], each.get("value")))
        rows.append([colored(word.replace("_", " "), color), title, texts[0], value, *texts[1:]])
    return Table(["", "metric", "of", "value", *keys], rows, numbers=[3])


def _why(attribution: Attribution | None) -> dict[str, Any]:
    """Return the part of the page that says why the plants differ: picture, table, what they share."""
    if attribution is None:
        return {"why": None}
    headings = ["assumption", "what it is", "how", *(f"{t}, {u}" for t, u in MEASURES.values())]
    rows = [
        [share.name, share.title, share.how, *map(_share, share.value, share.low, share.high)]
        for share in attribution.shares
    ]
    matched = "stiff bends and the same friction on both sides: what is left"
    for name, what, values in (
        ("not explained", "", attribution.remainder),
        ("gap", "", attribution.gap),
        ("matched (stiff bends)", matched, attribution.matched),
    ):
        rows.append([name, what, "", *map(_signed, values)])
    caption = "Contributions to twin − analytical; thin lines: least and most over the orders of switching."
    return {
        "why": Table(headings, rows, range(3, len(headings))),
        "shares": picture(attribution_plot(attribution), caption),
        "same": ", ".join(attribution.same),
    }


def _share(value: float, low: float, high: float) -> str:
    return _signed(value) + ("" if low == high else f" [{_signed(low)}, {_signed(high)}]")


def _signed(value: float) -> str:
    return f"{value:+.3g}" if abs(value) >= _NOTHING else "0"


def _plots(
    runs: Mapping[str, Trajectory],
    spec: RobotSpec,
    comparison: Comparison | None,
    measured: Mapping[str, MeasuredDifference] | None,
    *,
    tracked: bool,
) -> list[Picture]:
    """Return the plots that there is something to draw in, those of what was asked of the robot first."""
    learnt = all(map(is_learning, runs.values()))
    compared = comparison if comparison is not None and len(comparison.time) else None
    added = next(filter(None, map(added_to, runs.values())), None)
    learning = "What was learnt: amplitudes and duties of each module, by period."
    made: dict[str, Figure | None] = {
        "How far each plant is from what was measured, over time.": measured_plot(measured or {}),
        **(added.figures(runs, spec) if added else {}),
        learning: learning_plot(runs) if learnt else None,
        "How the first segment follows its reference.": tracking_plot(runs) if tracked else None,
        "Paths and bodies from above. Forward is from tail to head.": plan_view(runs, spec),
        "Speed of the centre of mass.": None if tracked else speed_plot(runs),
        "Bend of each segment; positive bends the head end to the left.": bend_plot(runs),
        "Pressure of the + chamber less that of the − chamber.": pressure_plot(runs),
        "What the first segment's sensor reads over what it is bent by.": reading_plot(runs),
        "How far the twin is from the analytical model.": error_plot(compared, spec) if compared else None,
    }
    return [picture(figure, caption) for caption, figure in made.items() if figure is not None]


def _settings(
    spec: RobotSpec, trajectories: Mapping[str, Trajectory], versions: Mapping[str, Any]
) -> dict[str, Table]:
    about = {plant: run.metadata for plant, run in trajectories.items()}
    keys = dict.fromkeys(key for metadata in about.values() for key in metadata)
    runs = [[key, *(cell(metadata.get(key)) for metadata in about.values())] for key in keys]
    return {
        "Plants and controller": Table(["setting", *about], runs),
        f"Robot {spec.name}": robot_table(spec),
        "Versions": Table(["package", "version"], list(versions.items())),
    }


def robot_table(spec: RobotSpec) -> Table:
    """Return the table of a robot's parameters with their units."""
    units = _robot_units()
    rows = [[name, units.get(name, ""), cell(value)] for name, value in _leaves(asdict(spec))]
    return Table(["parameter", "unit", "value"], rows)


def _robot_units() -> dict[str, str]:
    """Return parameter of a `RobotSpec` → unit: those of robot files in SI, and of numbers made from them."""
    found = {"actuator.gain": "rad/Pa", "chamber.displacement": "m³/rad"}
    for section in RobotFile.model_fields:
        inside = {"modules": "variation.", "gait": ""}.get(section, f"{section}.")
        found |= {f"{inside}{split_unit(key)[0]}": si_unit(key) for key in units_of(section)}
    return {name: unit.replace("*", "·") for name, unit in found.items()}


def _leaves(tree: Mapping[str, Any], above: str = "") -> list[tuple[str, Any]]:
    """Return ('geometry.width', 0.03)… of nested mappings."""
    found: list[tuple[str, Any]] = []
    for name, value in tree.items():
        found += _leaves(value, f"{above}{name}.") if isinstance(value, Mapping) else [(above + name, value)]
    return found
