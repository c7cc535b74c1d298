"""Output files of a study: JSON document, evaluations, best designs, plots, report.html."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from textwrap import fill

import numpy as np
import pyarrow as pa
from matplotlib.figure import Figure

from srs_twin.io.documents import dump_yaml
from srs_twin.io.file_sets import replace_files
from srs_twin.io.files import write_text
from srs_twin.studies.optimization.result import (
    EVALUATIONS,
    PRODUCTS,
    RESULT,
    StudyResult,
)
from srs_twin.studies.optimization.search import costs, excesses
from srs_twin.studies.sweep.table import write_table
from srs_twin.viewing.html import Table, cell, image, render
from srs_twin.viewing.plots.labels import field_label, metric_label
from srs_twin.viewing.plots.style import drawing, save

CaptionedFigure = tuple[Figure, str]
"""Figure and its caption."""


@drawing
def draw_convergence(
    values: np.ndarray,
    feasible: np.ndarray,
    label: str,
    initial: float | None,
    *,
    maximize: bool,
) -> CaptionedFigure:
    """Draw the objective of the twin's runs and the best feasible value so far.

    Args:
        values: objective of each run, shape (runs,).
        feasible: whether a run satisfies the constraints, shape (runs,).
        label: axis label of the objective.
        initial: value of the unmodified scenario.
        maximize: direction of the optimisation.
    """
    figure = Figure(figsize=(6.5, 3.4), layout="constrained")
    axes = figure.subplots()
    number = np.arange(1, len(values) + 1)
    best = (np.fmax if maximize else np.fmin).accumulate(
        np.where(feasible, values, np.nan)
    )
    marks = [
        (feasible, "o", "#9aa5b1", "each run"),
        (~feasible, "x", "#d5dae0", "misses constraints"),
    ]
    for which, marker, color, name in marks[: 1 if feasible.all() else 2]:
        axes.plot(
            number[which], values[which], marker, color=color, markersize=4, label=name
        )
    axes.step(number, best, where="post", color="#1f6f8b", label="best so far")
    if initial is not None:
        axes.axhline(
            initial,
            color="#b5651d",
            linestyle="--",
            linewidth=1,
            label="initial scenario",
        )
    axes.set(xlabel="runs of the twin", ylabel=label)
    axes.legend()
    return (
        figure,
        "Convergence of the search: runs of the twin in order, and the best so far.",
    )


@drawing
def draw_front(
    values: np.ndarray,
    front: np.ndarray,
    labels: Sequence[str],
    initial: Sequence[float | None],
) -> CaptionedFigure:
    """Draw the two objectives of all runs, shape (runs, 2), and the Pareto front."""
    figure = Figure(figsize=(6.5, 4.2), layout="constrained")
    axes = figure.subplots()
    axes.plot(*values.T, "o", color="#9aa5b1", markersize=4, label="runs of the twin")
    axes.plot(*front.T, "o-", color="#1f6f8b", markersize=5, label="Pareto front")
    known = [value for value in initial if value is not None]
    if len(known) == 2:
        (start,) = axes.plot(
            known[:1], known[1:], "x", color="#b5651d", label="initial scenario"
        )
        start.set(markersize=9, markeredgewidth=2)
    if (
        values.size
        and np.nanmax(values[:, 1]) > 20 * np.nanmin(np.abs(values[:, 1])) > 0
    ):
        axes.set_yscale("log")
    axes.set(xlabel=labels[0], ylabel=labels[1])
    axes.legend()
    return (
        figure,
        "Both objectives. No design is better in both than a design of the front.",
    )


@drawing
def draw_parallel(
    shares: np.ndarray,
    ranks: np.ndarray,
    labels: Sequence[str],
    ends: Sequence[tuple[float, float]],
    bounds: Sequence[Sequence[str | None]],
) -> CaptionedFigure:
    """Draw designs as parallel coordinates, the better ones more prominently.

    Args:
        shares: variables as fractions of their ranges, shape (runs, d).
        ranks: rank of each run, shape (runs,).
        labels: labels of the variables.
        ends: (low, high) of each variable.
        bounds: for each variable, the bound ("low", "high" or None) of each best
            design.
    """
    count = len(shares)
    places = np.arange(shares.shape[1])
    figure = Figure(figsize=(max(6.5, 1.1 * len(places)), 3.6), layout="constrained")
    axes = figure.subplots()
    for k in np.argsort(-ranks):
        good = 1 - ranks[k] / max(count - 1, 1)
        if ranks[k] < max(count // 10, 1):
            color = "#1f6f8b"
        else:
            color = "#9aa5b1"
        axes.plot(
            places,
            shares[k],
            "o-",
            color=color,
            alpha=0.15 + 0.85 * good,
            linewidth=1,
            markersize=3,
        )
    marked = [
        (i, bound == "high")
        for i, names in enumerate(bounds)
        for bound in {*names} - {None}
    ]
    if marked:
        axes.plot(
            *zip(*marked, strict=True),
            "D",
            color="#b03030",
            markersize=7,
            zorder=3,
            clip_on=False,
        )
    named = zip(labels, ends, strict=True)
    axes.set_xticks(
        places,
        [f"{fill(label, 13)}\n{low:g} to {high:g}" for label, (low, high) in named],
    )
    axes.set(
        yticks=[0, 1],
        yticklabels=["low", "high"],
        xlim=(-0.2, max(len(places) - 1, 0) + 0.2),
    )
    caption = (
        "Designs run by the twin; better ones are more opaque, the best tenth is blue."
    )
    return figure, caption + (
        " Red: bounds on which a best design is." if marked else ""
    )


BOUND_MARK = "†"
"""Mark of a variable that is on a bound."""


def write_result(result: StudyResult, folder: Path) -> tuple[str, ...]:
    """Write all output files into a folder atomically; return their names.

    Raises:
        InputError: a file cannot be written; earlier files are left unchanged.
    """
    with replace_files(folder, PRODUCTS) as fresh:
        return _write(result, fresh)


def _write(result: StudyResult, folder: Path) -> tuple[str, ...]:
    columns = {
        name: pa.array(values, from_pandas=True)
        for name, values in result.table.items()
    }
    write_table(folder / EVALUATIONS, pa.table(columns))
    written = [EVALUATIONS]
    study = result.study
    scenario = result.study.scenario.document
    for k, design in enumerate(result.designs, start=1):
        document = study.experiments["twin"].document(
            study.space.changes(design.run.shares)
        )
        document |= {
            "plants": scenario["plants"],
            "title": f"{study.title}: best {k}"[:200],
        }
        (folder / "best").mkdir(parents=True, exist_ok=True)
        (folder / f"best/{k}.yaml").write_text(dump_yaml(document), "utf-8")
        (folder / f"best/{k}.robot.yaml").write_text(
            dump_yaml(document["robot"]), "utf-8"
        )
        written += [f"best/{k}.yaml", f"best/{k}.robot.yaml"]
    written += write_report(folder, result)
    (folder / RESULT).write_text(
        json.dumps(result.document(), indent=2) + "\n", "utf-8"
    )
    return (*written, RESULT)


def write_report(folder: Path, result: StudyResult) -> list[str]:
    """Write plots and HTML page; return their names.

    Raises:
        InputError: a file cannot be written.
    """
    study = result.study
    goals = study.file.objectives
    initial = result.document()["begun"]
    twin = [run for run in result.runs if run.part == "twin"]
    best = [entry.run for entry in result.designs]
    values = np.array([[run.metric(goal.metric) for goal in goals] for run in twin])
    labels = [metric_label(goal.metric) for goal in goals]
    start = [initial[goal.metric] for goal in goals]
    violation = np.maximum(excesses(study, twin), 0.0).sum(axis=1)
    feasible = violation <= violation.min()
    figures = {}
    if len(goals) == 1:
        maximize = goals[0].goal == "maximize"
        figures["convergence"] = draw_convergence(
            values[:, 0], feasible, labels[0], start[0], maximize=maximize
        )
    else:
        front = np.array([[run.metric(goal.metric) for goal in goals] for run in best])
        figures["front"] = draw_front(values, front, labels, start)
    shares = np.array([run.shares for run in twin])
    ranks = np.argsort(
        np.lexsort((costs(study, twin)[:, 0], violation))
    )  # infeasible runs rank last
    ends = [(variable.low, variable.high) for variable in study.file.variables.values()]
    bounds = [study.space.bounds(run.shares) for run in best]
    marks = [[bound.get(name) for bound in bounds] for name in study.space.variables]
    figures["parallel"] = draw_parallel(
        shares, ranks, list(map(field_label, study.space.variables)), ends, marks
    )
    pictures = []
    for name, (figure, caption) in figures.items():
        save(figure, folder / f"{name}.png")
        pictures.append(image((folder / f"{name}.png").read_bytes(), "png", caption))
    versions = [
        (name, str(value)) for name, value in result.document()["versions"].items()
    ]
    write_text(
        folder / "report.html",
        render(
            "studies/optimization/report.html",
            title=study.title,
            subtitle=", ".join(
                f"{n} runs of {part}"
                for part, n in result.document()["evaluations"].items()
            ),
            best=_best_table(result),
            plots=pictures,
            fidelities=_fidelity_text(result),
            improvement=percentage(result.improvement),
            warning=result.warning,
            made_with=Table(["", ""], versions),
        ),
    )
    return [*(f"{name}.png" for name in figures), "report.html"]


def _best_table(result: StudyResult) -> Table:
    """Return a row per best design, after one for the initial scenario."""
    study = result.study
    document = result.document()
    headings = [
        "",
        *map(field_label, study.space.variables),
        *map(metric_label, result.metrics),
    ]
    headings += [
        f"{metric_label(objective.metric)}, gain" for objective in study.file.objectives
    ]
    headings += ["refined"]
    initial = [cell(document["begun"][name]) for name in result.metrics]
    rows = [["initial scenario", *[""] * study.space.size, *initial]]
    rows[0] += [""] * (len(headings) - len(rows[0]))
    for design in document["best"]:
        variables = design["variables"].items()
        row = [
            design["scenario"],
            *(
                mark_bound(value, name in design["on_bound"])
                for name, value in variables
            ),
        ]
        for name in result.metrics:
            ends = (design["intervals"] or {}).get(name)
            if ends:
                interval = f" ({cell(ends[0])} to {cell(ends[1])})"
            else:
                interval = ""
            row.append(cell(design["metrics"][name]) + interval)
        for gain in design["gains"].values():
            ends = gain["interval_95"]
            if ends:
                interval = f" ({percentage(ends[0])} to {percentage(ends[1])})"
            else:
                interval = ""
            row.append(percentage(gain["share"]) + interval)
        row.append(
            "changes by"
            f" {percentage(max(filter(None, design['refined'].values()), default=0.0))}"
        )
        rows.append(row)
    notes = bound_lines(result)
    if result.initial.samples:
        notes.insert(
            0, "In brackets: 95 % interval over the robot's uncertain parameters."
        )
    return Table(headings, rows, range(1, len(headings)), " ".join(notes))


def bound_lines(result: StudyResult) -> list[str]:
    """Return a sentence for each bound on which a best design is, and one on the meaning of bounds."""
    designs_on_bound: dict[tuple[str, str], list[str]] = {}
    sources: dict[tuple[str, str], str] = {}
    for design in result.document()["best"]:
        for name, row in design["on_bound"].items():
            key = name, f"{row['bound']} bound {row['value']:g}"
            designs_on_bound.setdefault(key, []).append(
                design["scenario"].removesuffix(".yaml")
            )
            sources[key] = f" ({row['source']})" if row["source"] else ""
    lines = [
        f"{BOUND_MARK} {', '.join(designs)}: {field_label(name)} is on its"
        f" {bound}{sources[name, bound]}."
        for (name, bound), designs in designs_on_bound.items()
    ]
    if lines:
        return [*lines, "With a wider range the optimum may be beyond such a bound."]
    return []


def mark_bound(value: float, on_bound: bool) -> str:
    """Return the value of a variable as text, with a mark if it is on a bound."""
    return f"{value:.4g}{BOUND_MARK if on_bound else ''}"


def _fidelity_text(result: StudyResult) -> str:
    texts = []
    for name, correlation in result.document()["fidelities"].items():
        if correlation is not None:
            label = metric_label(name)
            total = cell(correlation["all"])
            near = cell(correlation["near"])
            texts.append(
                f"{label}: {total} over all designs, {near} over the better half"
            )
    return "; ".join(texts)


def percentage(value: float | None) -> str:
    """Return a fraction in per cent, with its sign."""
    if value is None:
        return "–"
    return f"{100 * value:+.1f} %"
