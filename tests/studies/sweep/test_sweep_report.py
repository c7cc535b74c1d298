"""report.html of a sweep, read back by a parser: its tables show the results."""

from __future__ import annotations

import base64
from html.parser import HTMLParser
from itertools import product
from types import SimpleNamespace

import numpy as np
import pyarrow.parquet as pq
import pytest
from small import SMALL, diverges, execute, here, table_of, write

from srs_twin.compute.workers import TaskResult
from srs_twin.errors import DivergedError
from srs_twin.studies.sweep import report
from srs_twin.studies.sweep.loading import load_sweep
from srs_twin.studies.sweep.report import MAX_RUNS, mean_tables, run_tables
from srs_twin.studies.sweep.table import SweepTable

PICTURE = (
    "plots: [{kind: line, x: supply.pressure_kpa, metric: com_speed_m_s, by:"
    " controller.frequency_hz}]\n"
)
SPEED = "com_speed_m_s"


class Page(HTMLParser):
    """Parser of the tables, headings, pictures and references of a page."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.tables = []
        self.texts = {}
        self.images = []
        self.tags = set()
        self._open = []
        self.feed(text)
        self.close()

    def handle_starttag(self, tag, attrs):
        self.tags.add(tag)
        if tag in ("meta", "img"):
            self.images += [dict(attrs)["src"]] if tag == "img" else []
            return
        self._open.append(tag)
        if tag == "table":
            self.tables.append([])
        elif tag == "tr":
            self.tables[-1].append([])
        elif tag in ("td", "th"):
            self.tables[-1][-1].append("")

    def handle_endtag(self, tag):
        assert self._open.pop() == tag

    def handle_data(self, data):
        if self._open and self._open[-1] in ("td", "th"):
            self.tables[-1][-1][-1] += data
        elif self._open:
            self.texts.setdefault(self._open[-1], []).append(data)


def left(tmp_path, text, engine=here, points=None):
    """Run a sweep and return its page, its table and the summary."""
    out = tmp_path / "out"
    _, summary = execute(load_sweep(write(tmp_path, text)), out, engine, points=points)
    return (
        Page((out / "report.html").read_text("utf-8")),
        pq.read_table(out / "results.parquet"),
        summary,
    )


def test_the_page_shows_the_results(tmp_path):
    title = "title: Speed <b> & more\n"
    page, results, summary = left(tmp_path, title + SMALL + PICTURE)
    assert page.texts["title"] == page.texts["h1"] == ["Speed <b> & more"]
    assert "8 of 8 runs done, 0 failed" in page.texts["p"]
    varied, runs, made_with = page.tables
    assert [
        "supply pressure (kPa)",
        "supply.pressure_kpa",
        "41, 45.6667, 50.3333, 55",
    ] in varied
    assert ["simulated duration (s)", "duration_s", "2 (fixed)"] in varied
    columns = results.to_pydict()
    assert runs[0][:3] == [
        "gait frequency (Hz)",
        "supply pressure (kPa)",
        "CoM speed (m/s), analytical",
    ]
    places = zip(
        columns["controller.frequency_hz"], columns["supply.pressure_kpa"], strict=True
    )
    speeds = dict(zip(places, columns[f"analytical.{SPEED}"], strict=True))
    for (f, p), line in zip(sorted(speeds), runs[1:], strict=True):
        assert [float(cell) for cell in line[:3]] == pytest.approx(
            [f, p, speeds[f, p]], rel=1e-3
        )
    assert ["results sha256", summary.sha256] in made_with
    assert any(line[0] == "mujoco" for line in made_with)


def test_the_page_has_no_external_references(tmp_path):
    page, _, _ = left(tmp_path, SMALL + PICTURE)
    text = (tmp_path / "out" / "report.html").read_text("utf-8")
    assert (
        page.tags.isdisjoint({"script", "link", "iframe", "object", "a"})
        and "http://" not in text
    )
    (picture,) = (tmp_path / "out" / "plots").iterdir()
    assert [
        base64.b64decode(src.removeprefix("data:image/png;base64,"))
        for src in page.images
    ] == [picture.read_bytes()]
    assert "default-src 'none'" in text.replace("&#x27;", "'")


def test_failed_and_missing_runs_are_listed(tmp_path):
    page, _, _ = left(tmp_path, SMALL + PICTURE, diverges, points=6)
    assert "3 of 8 runs done, 3 failed, 2 not run yet" in page.texts["p"]
    assert page.tables[0][1:] == [["twin diverged at t = 1 s: boom", "3"]]
    assert page.tables[2][0][2] == "status" and {
        line[2] for line in page.tables[2][1:]
    } == {"done", "failed"}


def test_a_sweep_with_only_failed_runs_writes_its_files(tmp_path):
    def fails(experiment, points):
        yield from (
            TaskResult(i, None, DivergedError("twin", 1.0, "boom"))
            for i, _ in enumerate(points)
        )

    page, _, summary = left(tmp_path, SMALL + PICTURE, fails)
    assert (summary.failed, len(page.images)) == (8, 1) and (
        tmp_path / "out" / "sweep.json"
    ).exists()
    assert "0 of 8 runs done, 8 failed" in page.texts["p"]


def test_equal_rows_give_equal_pages(tmp_path):
    def backwards(experiment, points):
        yield from reversed(list(here(experiment, points)))

    for name, engine in (("a", here), ("b", backwards)):
        (tmp_path / name).mkdir()
        left(tmp_path / name, SMALL + PICTURE, engine)
    first, second = (
        (tmp_path / name / "out" / "report.html").read_bytes() for name in "ab"
    )
    assert first == second


def table(x, value, failed=()):
    status = ["failed" if i in failed else "done" for i in range(len(x))]
    return table_of(
        {
            "key": list(map(str, range(len(x)))),
            "seed": x,
            "status": status,
            f"twin.{SPEED}": value,
        }
    )


def test_means_are_only_over_seeds():
    """One row per combination of varied fields, with mean, standard deviation and number of runs."""
    rng = np.random.default_rng(2)
    names = "controller.offset", "controller.frequency_hz", "seed"
    columns = dict(
        zip(
            names,
            zip(*product((0.1, 0.2), (1.0, 1.5, 2.0), range(50)), strict=True),
            strict=True,
        )
    )
    value = rng.normal(5, 2, 300)
    status = ["failed" if i == 7 else "done" for i in range(300)]
    rows = table_of(
        {"key": range(300), **columns, "status": status, f"twin.{SPEED}": value}
    )
    assert [result.rows for result in run_tables(rows, [SPEED])] == [()]
    (result,) = mean_tables(rows, [SPEED])
    assert result.headings[:3] == ("steering offset", "gait frequency (Hz)", "runs")
    assert [line[:2] for line in result.rows] == list(
        product(("0.1", "0.2"), ("1", "1.5", "2"))
    )
    for k, line in enumerate(result.rows):
        own = np.delete(value[50 * k : 50 * k + 50], [7] if k == 0 else [])
        assert line[2:] == (str(len(own)), f"{own.mean():.4g} ± {own.std(ddof=1):.2g}")
    many = table_of(
        {
            "key": range(402),
            "seed": [0, 1] * 201,
            "a.b": np.repeat(range(201), 2),
            "status": ["done"] * 402,
        }
    )
    assert [
        (result.rows, result.note[:16]) for result in mean_tables(many, [SPEED])
    ] == [((), "201 combinations")]


def test_long_lists_of_values_and_reasons_are_shortened():
    assert report._values_text([0.5 * k for k in range(13)]) == "0 to 6, 13 values"
    words = list("abcdefghijklm")
    assert report._values_text(words) == f"{', '.join(words[:12])} and 1 more"
    assert report._values_text(words[:12]) == ", ".join(words[:12])
    for count, note in ((20, ""), (21, "And 1 other reasons: see results.parquet.")):
        reasons = {f"reason {k}": k for k in range(count)}
        found = report._failures(SimpleNamespace(reasons=reasons))
        assert (len(found.rows), found.note) == (20, note)


def test_the_number_of_listed_runs_is_limited():
    rows = table(list(range(MAX_RUNS))[::-1], [float(i) for i in range(MAX_RUNS)])
    (result,) = run_tables(rows, [SPEED])
    assert [int(line[0]) for line in result.rows] == list(range(MAX_RUNS))
    alone = table_of(
        {name: column for name, column in rows.columns.items() if name != "seed"}
        | {"controller.offset": list(range(MAX_RUNS))}
    )
    assert mean_tables(alone, [SPEED]) == []  # each has one run, and that is shown


def test_runs_without_the_metric_are_counted():
    values = table([1, 2, 3, 1, 2], [1.0, None, 3.0, None, None]).columns
    rows = SweepTable({**values, "a.b": [1, 1, 1, 2, 2]})
    (result,) = mean_tables(rows, [SPEED, "path_radius_m"])
    assert list(result.rows) == [("1", "3", "2 ± 1.4 (2)"), ("2", "2", "–")]


def test_large_integers_have_all_digits_and_columns_one_decimal_place():
    speeds = [-0.00001, 12.3456, None]
    (result,) = run_tables(table([4294967295, 4294967294, 2], speeds), [SPEED])
    assert list(result.rows) == [
        ("2", "–"),
        ("4294967294", "12.35"),
        ("4294967295", "0.00"),
    ]


def test_wide_tables_are_truncated():
    metrics = [SPEED, "path_length_m", "yaw_rate_rad_s", "path_speed_m_s"]
    values = {"key": ["a"], "seed": [1], "status": ["done"]}
    values |= {
        f"{plant}.{metric}": [1.0]
        for metric in metrics
        for plant in ("analytical", "twin")
    }
    tables = run_tables(table_of(values), metrics)
    assert [len(result.headings) for result in tables] == [7, 3]
    assert (
        sorted(h for result in tables for h in result.headings[1:])[0]
        == "CoM speed (m/s), analytical"
    )
    note = "24 of 25 columns are shown; results.parquet has all."
    for count, expected in ((24, ""), (25, note)):
        names = [f"bend_{k}" for k in range(count)]
        columns = values | {f"twin.{name}": [1.0] for name in names}
        tables = run_tables(table_of(columns), names)
        assert [len(result.headings) for result in tables] == [7] * 4
        assert {result.note for result in tables} == {expected}
