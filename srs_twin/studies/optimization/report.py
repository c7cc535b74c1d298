"""Files of a study's answer: document, evaluations, best designs, pictures, report.html."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pyarrow as pa

from srs_twin.io.documents import dump_yaml
from srs_twin.io.file_sets import replaced
from srs_twin.io.files import write_text
from srs_twin.studies.optimization.answer import EVALUATIONS, PRODUCTS, RESULT, Answer
from srs_twin.studies.optimization.plots import draw_convergence, draw_front, draw_parallel
from srs_twin.studies.optimization.search import costs, excesses
from srs_twin.studies.sweep.store import write
from srs_twin.viewing.html.page import Table, image, render
from srs_twin.viewing.plots.labels import field_label, metric_label
from srs_twin.viewing.plots.picture_file import save

BOUND_MARK = "†"
"""Mark of a variable's value that lies on a bound."""


def write_answer(answer: Answer, folder: Path) -> tuple[str, ...]:
    """Write document, evaluations, best designs, pictures and report into a folder; return their names.

    Raises:
        InputError: a file cannot be written; those of an earlier search are as they were.
    """
    with replaced(folder, PRODUCTS) as fresh:
        return _write(answer, fresh)


def _write(answer: Answer, folder: Path) -> tuple[str, ...]:
    columns = {name: pa.array(values, from_pandas=True) for name, values in answer.table.items()}
    write(folder / EVALUATIONS, pa.table(columns))
    written = [EVALUATIONS]
    study, scenario = answer.study, answer.study.scenario.document
    for k, run in enumerate(answer.optimum.best, start=1):
        whole = study.experiments["twin"].document(study.space.changes(run.shares))
        whole |= {"plants": scenario["plants"], "title": f"{study.title}: best {k}"[:200]}
        (folder / "best").mkdir(parents=True, exist_ok=True)
        (folder / f"best/{k}.yaml").write_text(dump_yaml(whole), "utf-8")
        (folder / f"best/{k}.robot.yaml").write_text(dump_yaml(whole["robot"]), "utf-8")
        written += [f"best/{k}.yaml", f"best/{k}.robot.yaml"]
    written += write_report(folder, answer)
    (folder / RESULT).write_text(json.dumps(answer.document(), indent=2) + "\n", "utf-8")
    return (*written, RESULT)


def write_report(folder: Path, answer: Answer) -> list[str]:
    """Write pictures and page; return their names.

    Raises:
        InputError: a file cannot be written.
    """
    study = answer.study
    goals, begun = study.file.objectives, answer.document()["begun"]
    twin = [run for run in answer.optimum.runs if run.part == "twin"]
    values = np.array([[run.metric(each.metric) for each in goals] for run in twin])
    labels = [metric_label(each.metric) for each in goals]
    start = [begun[each.metric] for each in goals]
    missed = np.maximum(excesses(study, twin), 0.0).sum(axis=1)
    kept, figures = missed <= missed.min(), {}
    if len(goals) == 1:
        best = goals[0].goal == "maximize"
        figures["convergence"] = draw_convergence(values[:, 0], kept, labels[0], start[0], maximize=best)
    else:
        front = np.array([[run.metric(each.metric) for each in goals] for run in answer.optimum.best])
        figures["front"] = draw_front(values, front, labels, start)
    shares = np.array([run.shares for run in twin])
    ranks = np.argsort(np.lexsort((costs(study, twin)[:, 0], missed)))  # what misses constraints comes last
    ends = [(each.low, each.high) for each in study.file.variables.values()]
    bounds = [study.space.bounds(run.shares) for run in answer.optimum.best]
    marks = [[each.get(name) for each in bounds] for name in study.space.variables]
    figures["parallel"] = draw_parallel(
        shares, ranks, list(map(field_label, study.space.variables)), ends, marks
    )
    pictures = []
    for name, (figure, caption) in figures.items():
        save(figure, folder / f"{name}.png")
        pictures.append(image((folder / f"{name}.png").read_bytes(), "png", caption))
    made = [(name, str(value)) for name, value in answer.document()["versions"].items()]
    write_text(
        folder / "report.html",
        render(
            "studies/optimization/report.html",
            title=study.title,
            subtitle=", ".join(f"{n} runs of {part}" for part, n in answer.document()["evaluations"].items()),
            best=_best(answer),
            plots=pictures,
            likeness=_likeness(answer),
            made_with=Table(["", ""], made),
        ),
    )
    return [*(f"{name}.png" for name in figures), "report.html"]


def _best(answer: Answer) -> Table:
    study, told = answer.study, answer.document()
    headings = ["", *map(field_label, study.space.variables), *map(metric_label, answer.metrics)]
    headings += [f"{metric_label(each.metric)}, gain" for each in study.file.objectives] + ["refined"]
    rows = [
        ["as it stands", *[""] * study.space.size, *(_text(told["begun"][name]) for name in answer.metrics)]
    ]
    rows[0] += [""] * (len(headings) - len(rows[0]))
    for each in told["best"]:
        variables = each["variables"].items()
        row = [each["scenario"], *(marked(value, name in each["on_bound"]) for name, value in variables)]
        for name in answer.metrics:
            ends = (each["intervals"] or {}).get(name)
            row.append(
                _text(each["metrics"][name]) + (f" ({_text(ends[0])} to {_text(ends[1])})" if ends else "")
            )
        for gain in each["gains"].values():
            ends = gain["interval_95"]
            row.append(
                share_text(gain["share"])
                + (f" ({share_text(ends[0])} to {share_text(ends[1])})" if ends else "")
            )
        row.append(f"changes by {share_text(max(filter(None, each['refined'].values()), default=0.0))}")
        rows.append(row)
    notes = ["In brackets: 95 % under what is uncertain of the robot."] if answer.samples else []
    notes += bound_lines(answer)
    return Table(headings, rows, range(1, len(headings)), " ".join(notes))


def bound_lines(answer: Answer) -> list[str]:
    """Return a sentence for each bound on which a best design lies, and one that says what a bound means."""
    found: dict[tuple[str, str], list[str]] = {}
    sources: dict[tuple[str, str], str] = {}
    for design in answer.document()["best"]:
        for name, row in design["on_bound"].items():
            key = name, f"{row['bound']} bound {row['value']:g}"
            found.setdefault(key, []).append(design["scenario"].removesuffix(".yaml"))
            sources[key] = f" ({row['source']})" if row["source"] else ""
    lines = [
        f"{BOUND_MARK} {', '.join(designs)}: {field_label(name)} is on its {bound}{sources[name, bound]}."
        for (name, bound), designs in found.items()
    ]
    return [*lines, "The optimum over a wider range may lie beyond a bound."] if lines else []


def marked(value: float, on_bound: bool) -> str:
    """Return the value of a variable, marked where it lies on a bound."""
    return f"{value:.4g}{BOUND_MARK if on_bound else ''}"


def _likeness(answer: Answer) -> str:
    said = []
    for name, found in answer.document()["fidelities"].items():
        if found is not None:
            label = metric_label(name)
            every, near = _text(found["all"]), _text(found["near"])
            said.append(f"{label}: {every} over all designs, {near} over the better half")
    return "; ".join(said)


def _text(value: float | None) -> str:
    return "–" if value is None else f"{value:.4g}"


def share_text(value: float | None) -> str:
    """Return a share in per cent, with its sign."""
    return "–" if value is None else f"{100 * value:+.1f} %"
