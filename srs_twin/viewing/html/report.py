"""HTML report of a run, with metrics, expectations, attribution, plots and settings."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING

from srs_twin.comparison.compare import MEASURES
from srs_twin.comparison.metrics import (
    COMPARISON_UNITS,
    RunMetrics,
    all_units,
    chosen,
    headline,
    plant_metrics,
    published,
    result_rows,
    tidy,
)
from srs_twin.robot.file import RobotFile, section_units
from srs_twin.robot.sourced import si_unit, split_unit
from srs_twin.robot.spec import RobotSpec
from srs_twin.scenario.expectation import allowed_text, tally, verdict
from srs_twin.scenario.modified import Changes, left_out_line, text_of
from srs_twin.trajectory import Trajectory
from srs_twin.viewing.additions import RunPictures, added_to
from srs_twin.viewing.content import RunContent, events_of
from srs_twin.viewing.html import (
    Picture,
    Table,
    cell,
    colored,
    notebook_output,
    picture,
    render,
)
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
from srs_twin.viewing.plots.signals import kind_of

if TYPE_CHECKING:
    from srs_twin.comparison.compare import Attribution, Comparison
    from srs_twin.scenario.expectation import ExpectationRow

_ZERO = 5e-6
"""Threshold below which a difference is printed as 0, in m, m/s, rad or rad/s."""


def write_report(
    path: str | Path,
    content: RunContent,
    *,
    scenario_title: str,
    metrics: RunMetrics,
    attribution: Attribution | None = None,
) -> None:
    """Write the report of one run as a self-contained HTML file.

    Without an `attribution`, the report has no section on the causes of differences.
    """
    trajectories = content.trajectories
    spec = content.spec
    duration = max(float(run.time[-1]) for run in trajectories.values())
    expectations = metrics.get("expectations") or ()
    verdicts = [verdict(row) for row in expectations]
    tracked = all(run.has("reference_1") for run in trajectories.values())
    plants = " and ".join(trajectories)
    page = render(
        "viewing/html/report.html",
        title=scenario_title,
        subtitle=f"{spec.title}, {duration:g} s simulated, {plants}",
        headline=headline(metrics),
        changes=_changes(metrics.get("changes") or ()),
        results=_results(metrics, chosen(metrics["plants"])),
        all_metrics=_results(metrics, all_units()),
        tally=tally(Counter(verdicts)),
        expectations=_expectations(expectations, verdicts),
        left_out=left_out_line(metrics.get("left_out") or ()),
        **_attribution(attribution),
        plots=_plots(content, tracked=tracked),
        events=_events(trajectories),
        kind="tracking" if tracked else kind_of(trajectories),
        settings=_settings(spec, trajectories, metrics.get("versions") or {}),
    )
    Path(path).write_text(page, encoding="utf-8")


def notebook_run(
    title: str,
    metrics: RunMetrics,
    trajectories: Mapping[str, Trajectory],
    spec: RobotSpec,
) -> str:
    """Return the headline, metrics and plan view of a run as HTML for a notebook."""
    view = picture(plan_view(trajectories, spec), "Paths and bodies from above.")
    return notebook_output(
        f"{title}: {headline(metrics)}",
        _results(metrics, chosen(metrics["plants"])),
        view,
    )


def page_of_run(trajectory: Trajectory) -> str:
    """Return the metrics and the path of a trajectory as HTML for a notebook."""
    plant = str(trajectory.metadata.get("plant", "run"))
    metrics: RunMetrics = {"plants": {plant: plant_metrics(trajectory)}}
    lines = {
        "centre of mass": trajectory.com,
        "body at the end": trajectory.position[-1],
    }
    path = picture(
        lines_plot(lines), "Path of the centre of mass, and the body at the end."
    )
    summary = f"{plant}, {trajectory.time[-1]:g} s, {len(trajectory)} samples"
    return notebook_output(summary, _results(metrics, chosen(metrics["plants"])), path)


def page_of_comparison(comparison: Comparison) -> str:
    """Return the metrics of a comparison as HTML for a notebook."""
    rows = [
        [metric_title(name), COMPARISON_UNITS[name], cell(value)]
        for name, value in comparison.metrics.items()
    ]
    return notebook_output(
        "Twin − analytical model", Table(["metric", "unit", "value"], rows, [2])
    )


def _results(metrics: RunMetrics, names: Iterable[str]) -> Table:
    plants = metrics["plants"]
    published_values = published(metrics.get("expectations") or ())
    both = {"analytical", "twin"} <= plants.keys()
    headings = ["metric", "unit", *plants, *["difference", "%"] * both]
    headings += ["published"] * bool(published_values)
    rows = []
    for name, unit, values, *differences in result_rows(metrics, names, cell):
        row = [metric_title(name), unit, *values, *differences * both]
        if name in published_values:
            value, source = published_values[name]
            row.append(f"{cell(tidy(name, value))} ({source})")
        elif published_values:
            row.append("")
        rows.append(row)
    return Table(headings, rows, range(2, len(headings)))


def _changes(changes: Changes) -> Table:
    rows = [
        [change["field"], text_of(change["from"]), text_of(change["to"])]
        for change in changes
    ]
    return Table(["changed field", "in the scenario", "in this run"], rows)


def _expectations(
    expectations: Sequence[ExpectationRow], verdicts: Sequence[str]
) -> Table:
    keys = ["source"]
    if not {"expected_failure", "holds"}.isdisjoint(verdicts):
        keys.append("expected_failure")
    if "not_judged" in verdicts:
        keys.append("reason")
    rows = []
    for state, row in zip(verdicts, expectations, strict=True):
        color = "met" if row["met"] else "sub"
        if state == "missed":
            color = "missed"
        rows.append(
            [
                colored(state.replace("_", " "), color),
                metric_title(row["metric"]),
                row["of"],
                cell(tidy(row["metric"], row.get("value"))),
                allowed_text(row),
                *(str(row.get(key) or "") for key in keys),
            ]
        )
    headings = ["", "metric", "of", "value", "allowed", *keys]
    return Table(headings, rows, numbers=[3])


def _attribution(attribution: Attribution | None) -> dict[str, object]:
    if attribution is None:
        return {"attribution": None}
    measures = [f"{title}, {unit}" for title, unit in MEASURES.values()]
    headings = ["assumption", "description", "method", *measures]
    rows = [
        [
            share.name,
            share.title,
            share.how,
            *map(_contribution, share.value, share.low, share.high),
        ]
        for share in attribution.shares
    ]
    matched = "remaining difference with stiff bends and equal friction in both plants"
    for name, description, values in (
        ("not explained", "", attribution.remainder),
        ("difference", "", attribution.gap),
        ("matched (stiff bends)", matched, attribution.matched),
    ):
        rows.append([name, description, "", *map(_signed, values)])
    changes = "change of the difference if the bends of the twin have this damping time"
    for name, change in attribution.damping.items():
        rows.append([name, changes, "", *map(_signed, change)])
    caption = (
        "Contributions to twin − analytical; thin lines: minimum and maximum over all"
        " orders."
    )
    if attribution.extent:
        caption = f"{attribution.extent.capitalize()}. {caption}"
    return {
        "attribution": Table(headings, rows, range(3, len(headings))),
        "shares": picture(attribution_plot(attribution), caption),
        "same": ", ".join(attribution.same),
        "extent": attribution.extent,
    }


def _contribution(value: float, low: float, high: float) -> str:
    if low == high:
        return _signed(value)
    return f"{_signed(value)} [{_signed(low)}, {_signed(high)}]"


def _signed(value: float) -> str:
    if abs(value) >= _ZERO:
        return f"{value:+.3g}"
    return "0"


def _plots(content: RunContent, *, tracked: bool) -> list[Picture]:
    runs = content.trajectories
    spec = content.spec
    added = next(filter(None, map(added_to, runs.values())), RunPictures())
    figures = {
        "Difference of each plant from the measured robot over time.": measured_plot(
            content.measured
        ),
        **added.figures(runs, spec),
        "Learning: amplitudes and duties of each module per period.": learning_plot(
            runs
        ),
    }
    if tracked:
        title = "Bend of the first segment and its reference."
        figures[title] = tracking_plot(runs)
    if spec.segments > 1:
        title = "Paths and bodies from above. Forward is from tail to head."
        figures[title] = plan_view(runs, spec, content.world)
    if not tracked:
        figures["Speed of the centre of mass."] = speed_plot(runs)
    figures |= {
        "Bend of each segment; positive bends the head end to the left.": bend_plot(
            runs
        ),
        "Pressure difference between the + chamber and the − chamber.": pressure_plot(
            runs
        ),
        "Sensor reading of the first segment against the bend.": reading_plot(runs),
    }
    if content.comparison is not None and len(content.comparison.time):
        title = "Distance between the twin and the analytical model."
        figures[title] = error_plot(content.comparison, spec)
    return [picture(figure, title) for title, figure in figures.items() if figure]


def _settings(
    spec: RobotSpec, trajectories: Mapping[str, Trajectory], versions: Mapping[str, str]
) -> dict[str, Table]:
    settings = {plant: run.metadata for plant, run in trajectories.items()}
    keys = dict.fromkeys(key for metadata in settings.values() for key in metadata)
    rows = [
        [key, *(cell(metadata.get(key)) for metadata in settings.values())]
        for key in keys
    ]
    return {
        "Plants and controller": Table(["setting", *settings], rows),
        f"Robot {spec.name}": robot_table(spec),
        "Versions": Table(["package", "version"], list(versions.items())),
    }


def _events(trajectories: Mapping[str, Trajectory]) -> Table:
    rows = [
        (event.time, plant, event.kind.replace("_", " "), event.text)
        for plant, run in trajectories.items()
        for event in events_of(run)
    ]
    ordered = [[f"{time:.2f}", *rest] for time, *rest in sorted(rows)]
    return Table(["time, s", "plant", "event", "details"], ordered, [0])


def robot_table(spec: RobotSpec) -> Table:
    """Return a table of all robot parameters with their units."""
    units = _robot_units()
    rows = [
        [name, units.get(name, ""), cell(value)]
        for name, value in _leaves(asdict(spec))
    ]
    return Table(["parameter", "unit", "value"], rows)


def _robot_units() -> dict[str, str]:
    units = {
        "actuator.gain": "rad/Pa",
        "chamber.displacement": "m³/rad",
        "friction.mu_back": "1",
    }
    for section in RobotFile.model_fields:
        prefix = {"modules": "variation.", "gait": ""}.get(section, f"{section}.")
        units |= {
            f"{prefix}{split_unit(key)[0]}": si_unit(key)
            for key in section_units(section)
        }
    return {name: unit.replace("*", "·") for name, unit in units.items()}


def _leaves(tree: Mapping[str, object], prefix: str = "") -> list[tuple[str, object]]:
    leaves: list[tuple[str, object]] = []
    for name, value in tree.items():
        if isinstance(value, Mapping):
            leaves += _leaves(value, f"{prefix}{name}.")
        else:
            leaves.append((prefix + name, value))
    return leaves
