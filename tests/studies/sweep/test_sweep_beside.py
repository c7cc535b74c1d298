"""Published values in a sweep (`beside`): parsing, tables, plots; they do not change the rows."""

from __future__ import annotations

import re

import pytest
import yaml
from conftest import ROOT
from small import SMALL, execute, table_of, write

from srs_twin.io.documents import parse_yaml
from srs_twin.studies.sweep.loading import load_sweep
from srs_twin.studies.sweep.plots import draw as draw_results
from srs_twin.studies.sweep.points import Plot, Published
from srs_twin.studies.sweep.table import published_table

P = "supply.pressure_kpa"
F = "controller.frequency_hz"
SPEED = "com_speed_m_s"
GIVEN = (
    "beside: {source: Table 10, at: {supply.pressure_kpa: [41, 55]}, metrics:"
    " {com_speed_m_s: [0.2, null]}}\n"
)
LINE = "plots: [{kind: line, x: supply.pressure_kpa, metric: com_speed_m_s}]\n"
TABLE = {
    "key": list("abcdef"),
    P: [20.0, 20.0, 30.0, 30.0, 40.0, 40.0],
    F: [1.0, 2.0, 1.0, 2.0, 1.0, 2.0],
    "status": ["done", "done", "done", "failed", "done", "done"],
    f"analytical.{SPEED}": [0.1, 0.3, 0.4, None, -0.1, -0.1],
    f"twin.{SPEED}": [0.2, 0.2, 0.5, None, None, None],
}


def draw(plot, columns, beside):
    """Return the figure of a plot of columns."""
    return draw_results(plot, table_of(columns), beside)


def published(source, at, metrics):
    return Published(source=source, at=at, metrics=metrics)


def claims():
    result = yaml.safe_load(
        (ROOT / "calibration/published/claims.yaml").read_text("utf-8")
    )
    return {claim["id"]: claim for claim in result}


def test_published_values_are_read_with_their_settings(tmp_path):
    sweep = load_sweep(write(tmp_path, SMALL + GIVEN))
    assert sweep.beside.settings == [{P: 41}, {P: 55}] and sweep.beside.metrics == {
        SPEED: [0.2, None]
    }
    assert sweep.warnings == ()
    assert load_sweep(write(tmp_path)).beside is None


def test_settings_without_a_run_give_a_warning(tmp_path):
    sweep = load_sweep(
        write(tmp_path, SMALL + GIVEN.replace("[41, 55]", "[41.0000000000001, 54]"))
    )
    assert sweep.warnings == ("beside: no run has supply.pressure_kpa 54",)


@pytest.mark.slow
def test_published_values_do_not_change_the_rows(tmp_path):
    """Values are added, edited and removed; the rows stay the same, and no run is repeated."""
    plain = SMALL + LINE
    edited = SMALL + LINE + GIVEN.replace("0.2", "0.3")
    keys = None
    for ran, text in ((8, plain), (0, plain + GIVEN), (0, edited), (0, plain)):
        sweep = load_sweep(write(tmp_path, text))
        keys = keys or [point.key for point in sweep.points]
        assert [point.key for point in sweep.points] == keys
        done, summary = execute(sweep, tmp_path / "out")
        assert done == ran
        report = (tmp_path / "out" / "report.html").read_text("utf-8")
        assert (
            (summary.published is not None)
            == ("Table 10" in report)
            == ("beside" in text)
        )
    assert "<td>0.3</td>" not in report


def test_the_table_has_means_over_seeds_and_differences():
    seeds = table_of(
        {"seed" if name == F else name: column for name, column in TABLE.items()}
    )
    result = published_table(
        published(
            "here", {P: [20.0, 30.0, 40.0, 50.0]}, {SPEED: [0.1, 0.5, 0.1, None]}
        ),
        seeds,
    )
    assert result.headings == (
        "metric",
        "supply pressure (kPa)",
        "published",
        "analytical",
        "difference",
        "twin",
        "difference",
        "runs",
    )
    assert result.rows == (
        ("CoM speed (m/s)", "20", "0.1", "0.2", "+100.0 %", "0.2", "+100.0 %", "2"),
        ("CoM speed (m/s)", "30", "0.5", "0.4", "-20.0 %", "0.5", "0 %", "1"),
        # Values of opposite sign are compared by difference, not by ratio.
        ("CoM speed (m/s)", "40", "0.1", "-0.1", "-0.2", "–", "–", "2"),
        ("CoM speed (m/s)", "50", "–", "–", "–", "–", "–", "0"),
    )


def test_the_table_has_a_row_for_each_combination_of_other_settings():
    result = published_table(
        published("here", {P: [20.0, 30.0, 50.0]}, {SPEED: [0.1, 0.5, 0.2]}), rows()
    )
    assert result.headings[1:4] == (
        "supply pressure (kPa)",
        "gait frequency (Hz)",
        "published",
    )
    assert "runs" not in result.headings
    assert [row[1:6] for row in result.rows] == [
        ("20", "1", "0.1", "0.1", "0 %"),
        ("20", "2", "0.1", "0.3", "+200.0 %"),
        ("30", "1", "0.5", "0.4", "-20.0 %"),
        ("50", "–", "0.2", "–", "–"),
    ]


def test_several_fields_make_one_setting():
    result = published_table(
        published("here", {F: [2, 1], P: [20, 40]}, {SPEED: [0.3, -0.1]}), rows()
    )
    assert [row[1:5] for row in result.rows] == [
        ("2", "20", "0.3", "0.3"),
        ("1", "40", "-0.1", "-0.1"),
    ]
    assert "runs" not in result.headings


def test_text_and_boolean_settings_are_matched():
    values = {
        "key": list("ab"),
        "a.kind": ["x", "y"],
        "a.on": [True, False],
        "status": ["done"] * 2,
    }
    values[f"twin.{SPEED}"] = [1.0, 2.0]
    for field, first in (("a.kind", "y"), ("a.on", False)):
        result = published_table(
            published("here", {field: [first]}, {SPEED: [1.0]}), table_of(values)
        )
        assert result.rows[0][2:] == ("1", "2", "+100.0 %")


def test_a_table_without_runs_has_published_values_only():
    nothing = {name: [] for name in ("key", P, "status")}
    result = published_table(
        published("here", {P: [20, 30]}, {SPEED: [0.1, None]}), table_of(nothing)
    )
    assert [row[1:] for row in result.rows] == [("20", "0.1"), ("30", "–")]


def rows():
    return table_of(TABLE)


def stars(axes):
    return {
        (*map(tuple, line.get_xydata()), line.get_color())
        for line in axes.lines
        if line.get_marker() == "*"
    }


def legends(axes):
    return [
        text.get_text()
        for artist in axes.findobj(match=lambda a: hasattr(a, "get_texts"))
        for text in artist.get_texts()
    ]


def test_line_plots_show_published_values_as_stars():
    beside = published("Table $8$", {P: [20, 25, 40]}, {SPEED: [0.15, 0.2, None]})
    (axes,) = draw(Plot(kind="line", x=P, metric=SPEED), TABLE, beside).axes
    assert stars(axes) == {((20.0, 0.15), "#000000"), ((25.0, 0.2), "#000000")}
    others = {line.get_marker() for line in axes.lines} - {"*"}
    assert {"s", "o"} <= others
    assert r"published, Table \$8\$" in legends(axes)


@pytest.mark.parametrize(
    ("request_", "at"),
    [
        (Plot(kind="line", x=F, metric=SPEED), {P: [20]}),
        (Plot(kind="line", x=P, metric="yaw_rate_rad_s"), {P: [20]}),
        (Plot(kind="scatter", x=P, metric=SPEED), {P: [20]}),
    ],
)
def test_other_plots_show_no_published_values(request_, at):
    values = TABLE | {"twin.yaw_rate_rad_s": [0.0] * 6}
    (axes,) = draw(request_, values, published("here", at, {SPEED: [0.15]})).axes
    assert stars(axes) == set() and not any(
        "published" in text for text in legends(axes)
    )


def test_published_values_have_the_colour_of_their_line():
    beside = published("here", {P: [20, 20], F: [1, 3]}, {SPEED: [0.1, 0.2]})
    (axes,) = draw(Plot(kind="line", x=P, metric=SPEED, by=F), TABLE, beside).axes
    colors = {place: color for place, color in stars(axes)}
    lines = [line.get_color() for line in axes.lines if line.get_marker() == "s"]
    assert colors == {(20.0, 0.1): lines[0], (20.0, 0.2): "#000000"}


def test_a_source_with_an_invalid_formula_can_be_drawn():
    figure = draw(
        Plot(kind="line", x=P, metric=SPEED),
        TABLE,
        published(r"$\frac", {P: [20]}, {SPEED: [0.15]}),
    )
    figure.canvas.draw()


def test_table_8_has_the_published_values_with_signed_radii():
    printed = {row["offset"]: row for row in claims()["table8"]["rows"]}
    sweep = load_sweep("table8")
    assert len(sweep.points) == 7 and sweep.experiment.plants == ("analytical", "twin")
    beside = sweep.beside
    offsets = beside.at["controller.offset"]
    assert sorted(offsets) == sorted(printed)
    for metric, key in (
        ("path_speed_m_s", "speed"),
        ("box_left_m", "left"),
        ("box_right_m", "right"),
    ):
        assert dict(zip(offsets, beside.metrics[metric], strict=True)) == {
            o: printed[o][key] for o in offsets
        }
    for offset, radius in zip(offsets, beside.metrics["path_radius_m"], strict=True):
        assert radius == printed[offset]["radius"] * (-1 if offset < 0 else 1)
    document = sweep.experiment.document(sweep.points[0].changes)
    assert (
        document["controller"]["frequency_hz"] == 1.5
        and document["controller"]["target_rad"] == 0.7
    )
    assert document["supply"]["pressure_kpa"] == 131 and document["duration_s"] == 16


def test_docs_learning_shows_table_8_and_its_deviations():
    """The published columns equal the file, and the text states the deviations of the predicted rows."""
    page = (ROOT / "docs/learning.md").read_text("utf-8")
    section = page.partition("## Table 8")[2].partition("\n## ")[0]
    lines = [
        re.split(r"\s*\|\s*", line.strip("| "))
        for line in section.splitlines()
        if re.match(r"\| (−|0)", line)
    ]
    assert [line[1] for line in lines] == [
        "fit",
        "predicted",
        "predicted",
        "fit",
        "predicted",
        "predicted",
        "fit",
    ]
    numbers = [[float(c.replace("−", "-")) for c in line[2:]] for line in lines]
    beside = load_sweep("table8").beside
    difference = {"analytical": {}, "twin": {}}
    for i, metric in enumerate(beside.metrics):
        assert [line[3 * i] for line in numbers] == list(beside.metrics[metric]), metric
        for k, plant in enumerate(difference, start=1):
            for name, line in zip(lines, numbers, strict=True):
                if name[1] == "predicted":
                    difference[plant][metric, name[0]] = (
                        line[3 * i + k] / line[3 * i] - 1
                    )
    for plant, speed, radius in (("analytical", 0.38, 0.79), ("twin", 0.21, 0.72)):
        missed = {
            place: value
            for place, value in difference[plant].items()
            if abs(value) > 0.2
        }
        assert len(difference[plant]) == 16
        assert missed == {
            ("path_speed_m_s", "0.2"): pytest.approx(speed, abs=0.01),
            ("path_radius_m", "0.1"): pytest.approx(radius, abs=0.02),
        }
    assert (
        "fourteen" in section
        and "(+38 % and +21 %)" in section
        and "(+79 % and +72 %)" in section
    )


def test_docs_sweeps_shows_the_shipped_file():
    page = (ROOT / "docs/sweeps.md").read_text("utf-8")
    printed = parse_yaml(
        re.findall(r"^```yaml[^\n]*\n(beside:.*?)^```$", page, re.M | re.S)[0], "page"
    ).data["beside"]
    shipped = dict(load_sweep("fig41").document["beside"])
    assert printed == {key: value for key, value in shipped.items() if key in printed}
    assert {"source", "at", "metrics"} <= printed.keys()
