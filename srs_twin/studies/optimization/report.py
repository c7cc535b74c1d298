"""Output files of an optimisation: JSON document, report, tables and plots."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from pathlib import Path
from textwrap import fill

import numpy as np
from matplotlib.figure import Figure

from srs_twin.io.documents import dump_yaml
from srs_twin.io.file_sets import replace_files
from srs_twin.io.files import STUDY_RESULT, write_text
from srs_twin.studies.optimization.loading import DesignSpace
from srs_twin.studies.optimization.result import (
    EVALUATIONS,
    PICTURES,
    PRODUCTS,
    REPORT,
    StudyDocument,
    StudyResult,
)
from srs_twin.studies.optimization.runs import Run
from srs_twin.studies.optimization.search import costs, excesses
from srs_twin.studies.sweep.table import write_columns
from srs_twin.viewing.html import Table, cell, image, render
from srs_twin.viewing.plots.labels import field_label, metric_label
from srs_twin.viewing.plots.style import drawing, save

_RUN_COLOR = "#9aa5b1"
_BEST_COLOR = "#1f6f8b"
_INITIAL_COLOR = "#b5651d"
CaptionedFigure = tuple[Figure, str]


@drawing
def draw_convergence(
    values: np.ndarray,
    feasible: np.ndarray,
    label: str,
    initial: float | None,
    *,
    maximize: bool,
) -> CaptionedFigure:
    """Plot the objective of each twin run and the best feasible result so far."""
    figure = Figure(figsize=(6.5, 3.4), layout="constrained")
    axes = figure.subplots()
    number = np.arange(1, len(values) + 1)
    better = np.fmax if maximize else np.fmin
    best = better.accumulate(np.where(feasible, values, np.nan))
    for which, marker, color, name in (
        (feasible, "o", _RUN_COLOR, "each run"),
        (~feasible, "x", "#d5dae0", "misses constraints"),
    ):
        if which.any():
            axes.plot(
                number[which],
                values[which],
                marker,
                color=color,
                markersize=4,
                label=name,
            )
    axes.step(number, best, where="post", color=_BEST_COLOR, label="best so far")
    if initial is not None:
        axes.axhline(
            initial,
            linestyle="--",
            linewidth=1,
            color=_INITIAL_COLOR,
            label="initial scenario",
        )
    axes.set(xlabel="runs of the twin", ylabel=label)
    axes.legend()
    return (
        figure,
        "Convergence of the search: twin runs in order, and the best result so far.",
    )


@drawing
def draw_front(
    values: np.ndarray,
    front: np.ndarray,
    labels: Sequence[str],
    initial: Sequence[float | None],
) -> CaptionedFigure:
    """Plot the values of two objectives, shape (runs, 2), and their Pareto front."""
    figure = Figure(figsize=(6.5, 4.2), layout="constrained")
    axes = figure.subplots()
    axes.plot(*values.T, "o", color=_RUN_COLOR, markersize=4, label="runs of the twin")
    axes.plot(*front.T, "o-", color=_BEST_COLOR, markersize=5, label="Pareto front")
    known = [value for value in initial if value is not None]
    if len(known) == 2:
        axes.plot(
            *known,
            "x",
            markersize=9,
            markeredgewidth=2,
            color=_INITIAL_COLOR,
            label="initial scenario",
        )
    if np.nanmax(values[:, 1]) > 20 * np.nanmin(np.abs(values[:, 1])) > 0:
        axes.set_yscale("log")
    axes.set(xlabel=labels[0], ylabel=labels[1])
    axes.legend()
    return (
        figure,
        "Both objectives. No design beats a design on the front in both objectives.",
    )


@drawing
def draw_parallel(
    space: DesignSpace, runs: Sequence[Run], ranks: np.ndarray, best: Sequence[Run]
) -> CaptionedFigure:
    """Plot designs in parallel coordinates, and emphasise the better designs."""
    places = np.arange(space.size)
    figure = Figure(figsize=(max(6.5, 1.1 * space.size), 3.6), layout="constrained")
    axes = figure.subplots()
    for k in np.argsort(-ranks):
        is_good = ranks[k] < max(len(runs) // 10, 1)
        axes.plot(
            places,
            runs[k].fractions,
            "o-",
            color=_BEST_COLOR if is_good else _RUN_COLOR,
            alpha=1.0 - 0.85 * ranks[k] / max(len(runs) - 1, 1),
            linewidth=1,
            markersize=3,
        )
    caption = (
        "Designs that the twin simulated. Better designs are more opaque, and the best"
        " tenth is blue."
    )
    bounds = [space.bounds(run.fractions) for run in best]
    marked = [
        (place, bound == "high")
        for place, name in enumerate(space.variables)
        for bound in ("low", "high")
        if bound in [own.get(name) for own in bounds]
    ]
    if marked:
        caption += " Red: bounds on which a best design lies."
        axes.plot(
            *zip(*marked, strict=True),
            "D",
            clip_on=False,
            color="#b03030",
            markersize=7,
            zorder=3,
        )
    labels = [
        f"{fill(field_label(name), 13)}\n{variable.low:g} to {variable.high:g}"
        for name, variable in space.variables.items()
    ]
    axes.set_xticks(places, labels)
    axes.set(
        yticks=[0, 1], yticklabels=["low", "high"], xlim=(-0.2, space.size - 1 + 0.2)
    )
    return figure, caption


BOUND_MARK = "†"
"""Mark for variables that lie on a bound of their range."""


def write_result(result: StudyResult, folder: Path) -> tuple[str, ...]:
    """Write all output files of a study to a folder, and return their names."""
    with replace_files(folder, PRODUCTS) as fresh:
        return _write(result, fresh)


def _write(result: StudyResult, folder: Path) -> tuple[str, ...]:
    write_columns(folder / EVALUATIONS, result.table)
    written = [EVALUATIONS]
    study = result.study
    for k, design in enumerate(result.designs, start=1):
        changes = study.space.changes(design.run.fractions)
        document = study.experiments["twin"].document(changes)
        document |= {
            "plants": study.scenario.document["plants"],
            "title": f"{study.title}: best {k}"[:200],
        }
        files = {f"best/{k}.yaml": document, f"best/{k}.robot.yaml": document["robot"]}
        for name, content in files.items():
            write_text(folder / name, dump_yaml(content))
        written += files
    written += write_report(folder, result)
    write_text(folder / STUDY_RESULT, json.dumps(result.document(), indent=2) + "\n")
    return (*written, STUDY_RESULT)


def write_report(folder: Path, result: StudyResult) -> list[str]:
    """Write the plots and the HTML report of a study, and return the file names."""
    document = result.document()
    figures = _figures(result, document)
    pictures = []
    for name, (figure, caption) in figures.items():
        save(figure, folder / name)
        pictures.append(image((folder / name).read_bytes(), "png", caption))
    content = render(
        "studies/optimization/report.html",
        title=result.study.title,
        subtitle=run_counts(document),
        best=_best_table(result, document),
        plots=pictures,
        fidelities=_fidelity_text(document),
        improvement=percentage(result.improvement),
        warning=result.warning,
        made_with=Table(["", ""], list(document["versions"].items())),
    )
    write_text(folder / REPORT, content)
    return [*figures, REPORT]


def _figures(
    result: StudyResult, document: StudyDocument
) -> dict[str, CaptionedFigure]:
    study = result.study
    goals = study.file.objectives
    twin = [run for run in result.runs if run.part == "twin"]
    best = [design.run for design in result.designs]
    values = np.array([[run.metric(goal.metric) for goal in goals] for run in twin])
    labels = [metric_label(goal.metric) for goal in goals]
    start = [document["begun"][goal.metric] for goal in goals]
    violation = np.maximum(excesses(study, twin), 0.0).sum(axis=1)
    convergence, front, parallel = PICTURES
    figures = {}
    if len(goals) == 1:
        figures[convergence] = draw_convergence(
            values[:, 0],
            violation <= violation.min(),
            labels[0],
            start[0],
            maximize=goals[0].goal == "maximize",
        )
    else:
        members = [[run.metric(goal.metric) for goal in goals] for run in best]
        figures[front] = draw_front(values, np.array(members), labels, start)
    # Infeasible runs rank behind all feasible runs.
    ranks = np.argsort(np.lexsort((costs(study, twin)[:, 0], violation)))
    figures[parallel] = draw_parallel(study.space, twin, ranks, best)
    return figures


def _best_table(result: StudyResult, document: StudyDocument) -> Table:
    study = result.study
    objectives = [objective.metric for objective in study.file.objectives]
    headings = [
        "",
        *map(field_label, study.space.variables),
        *map(metric_label, result.metrics),
        *(f"{metric_label(metric)}, gain" for metric in objectives),
        "refined",
    ]
    rows = [
        [
            "initial scenario",
            *[""] * study.space.size,
            *(cell(document["begun"][name]) for name in result.metrics),
            *[""] * (len(objectives) + 1),
        ]
    ]
    for design in document["best"]:
        row = [design["scenario"]]
        for name, value in design["variables"].items():
            row.append(mark_bound(value, name in design["on_bound"]))
        intervals = design["intervals"] or {}
        for name in result.metrics:
            interval = _interval_text(intervals.get(name), cell)
            row.append(cell(design["metrics"][name]) + interval)
        for gain in design["gains"].values():
            interval = _interval_text(gain["interval_95"], percentage)
            row.append(percentage(gain["fraction"]) + interval)
        change = max(filter(None, design["refined"].values()), default=0.0)
        rows.append([*row, f"changes by {percentage(change)}"])
    notes = bound_lines(document)
    if result.initial.samples:
        notes.insert(
            0, "In brackets: 95 % interval over the robot's uncertain parameters."
        )
    return Table(headings, rows, range(1, len(headings)), " ".join(notes))


def _interval_text(
    ends: list[float | None] | None, text: Callable[[float | None], str]
) -> str:
    return f" ({' to '.join(map(text, ends))})" if ends else ""


def bound_lines(document: StudyDocument) -> list[str]:
    """Return a sentence for each bound that a best design reaches, and a final note."""
    designs: dict[str, list[str]] = {}
    for design in document["best"]:
        for name, bound in design["on_bound"].items():
            text = f"{field_label(name)} is on its {bound['bound']} bound"
            text += f" {bound['value']:g}"
            if bound["source"]:
                text += f" ({bound['source']})"
            named = design["scenario"].removesuffix(".yaml")
            designs.setdefault(text, []).append(named)
    lines = [
        f"{BOUND_MARK} {', '.join(names)}: {text}." for text, names in designs.items()
    ]
    if lines:
        lines.append("With a wider range, the optimum may lie beyond such a bound.")
    return lines


def run_counts(document: StudyDocument) -> str:
    """Return the number of runs of each fidelity as text."""
    texts = []
    for part, count in document["evaluations"].items():
        text = f"{count} runs of {part}"
        if missing := document["without_value"][part]:
            text += f" ({missing} without a value of an objective or constraint)"
        texts.append(text)
    return ", ".join(texts)


def mark_bound(value: float, on_bound: bool) -> str:
    """Format a value, and append a mark if the variable is on a bound."""
    text = f"{value:.4g}"
    if on_bound:
        return text + BOUND_MARK
    return text


def _fidelity_text(document: StudyDocument) -> str:
    return "; ".join(
        f"{metric_label(name)}: {cell(correlation['all'])} over all designs,"
        f" {cell(correlation['near'])} over the better half"
        for name, correlation in document["fidelities"].items()
        if correlation is not None
    )


def percentage(value: float | None) -> str:
    """Format a fraction as a signed percentage, or None as a dash."""
    if value is None:
        return "–"
    return f"{100 * value:+.1f} %"
