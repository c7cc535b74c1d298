"""Tables 1 to 10 as data: they load, and agree with whatever else states the same number."""

from __future__ import annotations

import doctest
import math
import re
from pathlib import Path

import published_tables
import pytest
from published_tables import (
    TABLES,
    ParameterTable,
    RunTable,
    load_table,
    published_runs,
)

from srs_twin.errors import InputFileError, UnknownNameError
from srs_twin.io.documents import load_yaml
from srs_twin.io.files import data_root
from srs_twin.planning.footprint_file import load_footprint_file
from srs_twin.reproduction.claims import CLAIMS_BYTES, claims_file
from srs_twin.robot.file import load_robot, load_robot_file
from srs_twin.studies.sweep.loading import load_sweep

pytestmark = pytest.mark.fast


def claim(name):
    claims = load_yaml(claims_file(), limit=CLAIMS_BYTES).data
    return next(each for each in claims if each["id"] == name)


def by_offset():
    return {run.offset: run for run in published_runs()}


@pytest.mark.default_cases(at=[0, 1, 5, 9])
@pytest.mark.parametrize("name", TABLES)
def test_every_table_loads_under_its_own_name(name):
    table = load_table(name)
    assert table.name == name
    if table.robot:
        load_robot_file(table.robot)


def test_the_folder_holds_no_other_table():
    folder = data_root() / "calibration/published"
    assert {path.stem for path in folder.glob("*.yaml")} == {
        *TABLES,
        "claims",
        "figures",
    }


def test_pages_and_tables_run_alike():
    pages = [load_table(name).page for name in TABLES]
    assert pages == sorted(pages)


def test_every_erratum_is_one_that_the_page_explains():
    page = (Path(__file__).parents[1] / "docs/reproduction.md").read_text("utf-8")
    explained = set(re.findall(r"^\| (E\d+) \|", page, flags=re.MULTILINE))
    assert {each for name in TABLES for each in load_table(name).errata} <= explained


def printed_number(text):
    """Return the number at the head of what is printed, None where it is a formula."""
    match = re.fullmatch(r"(-?[0-9.]+)(?: ?[a-zμ°/]*)?", text)
    return match and float(match[1])


@pytest.mark.default_cases(2)
@pytest.mark.parametrize("name", ["table2", "table5", "table6", "table9"])
def test_values_are_the_printed_numbers(name):
    table = load_table(name)
    assert isinstance(table, ParameterTable)
    formulas = 0
    for entry in table.values.values():
        number = printed_number(entry.printed)
        formulas += number is None
        assert number is None or number == entry.value
    assert formulas <= 1


def test_the_formulas_of_tables_2_5_and_6():
    assert load_table("table2")["angular_frequency_rad_per_s"] == pytest.approx(
        2 * math.pi / 3
    )
    for name in ("table5", "table6"):
        table = load_table(name)
        assert table["phase_step_rad"] == pytest.approx(
            2 * math.pi / (table["connectors"] - 1)
        )


def test_generation_1_is_that_of_table_2():
    table = load_table("table2")
    robot = load_robot("gen1")
    assert robot.geometry.connectors == table["connectors"]
    assert (robot.friction.mu_t, robot.friction.mu_n) == (table["mu_t"], table["mu_n"])
    segments = table["connectors"] - 1
    assert robot.mass.total == pytest.approx(segments * table["segment_mass_kg"])
    bend = table["amplitude_rad_per_m"] * robot.geometry.segment_length
    assert load_robot_file("gen1").records()[
        "actuator.bend_rad"
    ].value == pytest.approx(bend)
    scenario = load_yaml(data_root() / "scenarios/gen1_straight.yaml").data
    frequency = table["angular_frequency_rad_per_s"] / (2 * math.pi)
    assert scenario["controller"]["frequency_hz"] == pytest.approx(frequency, rel=0.02)


@pytest.mark.parametrize(("name", "table"), [("gen2", "table5"), ("gen3", "table6")])
def test_generations_2_and_3_are_those_of_tables_5_and_6(name, table):
    table = load_table(table)
    robot = load_robot(name)
    masses = [table["connector_mass_kg"]] * int(table["connectors"])
    if "tail_mass_kg" in table.values:
        masses[-1] = table["tail_mass_kg"]
    assert list(robot.mass.connectors) == masses
    assert robot.geometry.segment_length == table["segment_length_m"]
    assert (robot.friction.mu_t, robot.friction.mu_n) == (table["mu_t"], table["mu_n"])
    assert load_robot_file(name).records()[
        "gait.phase_step_rad"
    ].value == pytest.approx(table["phase_step_rad"])


def test_table_8_is_that_of_the_claims():
    rows = claim("table8")["rows"]
    assert {row["offset"] for row in rows} == set(by_offset())
    for row in rows:
        run = by_offset()[row["offset"]]
        assert (row["speed"], -row["left"], row["right"], row["radius"]) == (
            run.speed_m_s,
            run.left_m,
            run.right_m,
            run.radius_m,
        )


def test_table_8_is_that_of_the_footprint():
    file = load_footprint_file("gen4_table8")
    runs = [by_offset()[offset] for offset in file.offset.value]
    assert file.speed_m_s.value == [run.speed_m_s for run in runs]
    assert file.left_m.value == [-run.left_m for run in runs]
    assert file.right_m.value == [run.right_m for run in runs]
    for curvature, run in zip(file.curvature_per_m.value, runs, strict=True):
        assert abs(curvature) == pytest.approx(1 / run.radius_m, abs=1e-5)


def test_table_8_is_that_of_the_sweep():
    sweep = load_sweep("table8")
    assert sweep.experiment.plants == ("analytical", "twin")
    assert [point.changes["controller.offset"] for point in sweep.points] == sorted(
        by_offset()
    )
    document = sweep.experiment.document(sweep.points[0].changes)
    table = load_table("table8")
    assert isinstance(table, RunTable)
    assert document["controller"]["frequency_hz"] == table.frequency_hz
    assert document["controller"]["target_rad"] == 0.7
    assert document["supply"]["pressure_kpa"] == 131
    assert document["duration_s"] == 16


def test_docs_learning_shows_table_8_and_its_deviations():
    """The published columns equal the table, and the text states the deviations of the predicted rows."""
    page = (data_root() / "docs/module.md").read_text("utf-8")
    section = page.partition("## Table 8")[2].partition("\n## ")[0]
    lines = [
        re.split(r"\s*\|\s*", line.replace("−", "-").strip("| "))
        for line in section.splitlines()
        if re.match(r"\| (−|0)", line)
    ]
    fitted = {-0.3, 0.0, 0.3}
    deviations = {}
    for offset, row, *cells in lines:
        run = by_offset()[float(offset)]
        assert row == ("fit" if run.offset in fitted else "predicted")
        numbers = list(map(float, cells))
        radius = math.copysign(run.radius_m, run.offset)
        assert numbers[::3] == [run.speed_m_s, radius, run.left_m, run.right_m]
        if row == "predicted":
            for k, plant in ((1, "analytical"), (2, "twin")):
                for j, quantity in enumerate(("speed", "radius", "left", "right")):
                    fraction = numbers[3 * j + k] / numbers[3 * j] - 1
                    deviations[plant, quantity, run.offset] = fraction
    assert len(lines) == 7
    assert len(deviations) == 32
    missed = {
        place: fraction for place, fraction in deviations.items() if abs(fraction) > 0.2
    }
    assert missed == {
        ("analytical", "speed", 0.2): pytest.approx(0.38, abs=0.01),
        ("twin", "speed", 0.2): pytest.approx(0.21, abs=0.01),
        ("analytical", "radius", 0.1): pytest.approx(0.79, abs=0.02),
        ("twin", "radius", 0.1): pytest.approx(0.72, abs=0.02),
    }
    assert "fourteen" in section
    assert "(+38 % and +21 %)" in section
    assert "(+79 % and +72 %)" in section


def test_table_9_follows_from_table_8_and_is_that_of_the_footprint():
    table = load_table("table9")
    weaker = by_offset()[0.3]
    assert math.degrees(weaker.speed_m_s / weaker.radius_m) == pytest.approx(
        table["turn_rate_deg_per_s"], rel=0.02
    )
    widest = max(run.right_m - run.left_m for run in published_runs())
    assert table["box_m"] > widest
    file = load_footprint_file("gen4_table9")
    assert set(file.speed_m_s.value) == {table["speed_m_s"]}
    most = max(abs(curvature) for curvature in file.curvature_per_m.value)
    assert most * table["speed_m_s"] == pytest.approx(
        math.radians(table["turn_rate_deg_per_s"]), rel=1e-3
    )
    for left, right in zip(file.left_m.value, file.right_m.value, strict=True):
        assert left + right == pytest.approx(table["box_m"])


def test_table_10_is_that_of_the_claims():
    table = load_table("table10")
    speeds = {each.robot: each.top_speed_mm_s for each in table.generations}
    for name, robot in (
        ("gen1-forward", "gen1"),
        ("gen2-top-speed", "gen2"),
        ("gen3-speed", "gen3"),
    ):
        assert 1000 * claim(name)["value"] == pytest.approx(speeds[robot])
    for each in table.generations:
        said = " ".join(each.advantages + each.disadvantages)
        assert (each.top_speed_mm_s is None) == ("Max" not in said)
        assert (
            each.top_speed_mm_s is None or f"Max {each.top_speed_mm_s:g} mm/s" in said
        )


REFUSED = [
    (
        "unit: kg,",
        "unit: g,",
        "values.segment_mass_kg.unit: must be kg as in the key, not g",
    ),
    (
        "errata: [E14]}",
        "errata: [E4]}",
        "per_s.errata: E4 is not among the table's errata",
    ),
    (
        "value: 0.68",
        "value: about 0.68",
        "mu_n.value: must be a number from -1000000 to 1000000, not text",
    ),
    (
        "kind: parameters",
        "kind: parameter",
        "kind: must be one of .* did you mean parameters",
    ),
    ("page: 53", "pages: 53", "pages: unknown key; did you mean page"),
    ("E24, E25]", "E24, E31]", "errata"),
]


@pytest.mark.default_cases(at=[0, 2, 3, 4, 5])
@pytest.mark.parametrize(("old", "new", "words"), REFUSED)
def test_what_a_table_is_refused_for(tmp_path, old, new, words):
    text = (data_root() / "calibration/published/table2.yaml").read_text("utf-8")
    assert old in text
    path = tmp_path / "mine.yaml"
    path.write_text(text.replace(old, new), "utf-8")
    with pytest.raises(InputFileError, match=words):
        load_table(path)


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("offset: -0.3", "offset: -0.2", "offset -0.2 stands here 2 times"),
        ("left_m: -0.1,", "left_m: 0.1,", "left edge"),
    ],
)
def test_what_runs_are_refused_for(tmp_path, old, new, words):
    text = (data_root() / "calibration/published/table8.yaml").read_text("utf-8")
    path = tmp_path / "mine.yaml"
    path.write_text(text.replace(old, new), "utf-8")
    with pytest.raises(InputFileError, match=words):
        load_table(path)


def test_an_unknown_table_names_the_nearest():
    with pytest.raises(UnknownNameError, match="table8"):
        load_table("tabel8")


def test_the_example_in_the_docstring():
    outcome = doctest.testmod(published_tables)
    assert outcome.attempted and not outcome.failed
