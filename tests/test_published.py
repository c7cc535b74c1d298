"""Tables 1 to 10 as data: they load, and agree with whatever else states the same number."""

from __future__ import annotations

import math
import re

import pytest
from conftest import ROOT
from published_tables import TABLES, claim, load_table, published_runs

from srs_twin.io.documents import load_yaml
from srs_twin.io.files import data_root
from srs_twin.planning.footprint_file import load_footprint_file
from srs_twin.robot.file import load_robot, load_robot_file
from srs_twin.robot.sourced import split_unit
from srs_twin.studies.sweep.loading import load_sweep

pytestmark = pytest.mark.fast


def by_offset():
    return {run.offset: run for run in published_runs()}


def values_of(name):
    """Return the values of a table of parameters by their keys."""
    return {key: each["value"] for key, each in load_table(name)["values"].items()}


def test_tables_are_named_and_ordered_as_in_the_dissertation():
    folder = data_root() / "calibration/published"
    stems = {path.stem for path in folder.glob("*.yaml")}
    assert stems == {*TABLES, "claims", "figures"}
    tables = [load_table(name) for name in TABLES]
    assert [table["name"] for table in tables] == list(TABLES)
    pages = [table["page"] for table in tables]
    assert pages == sorted(pages)
    for table in tables:
        if "robot" in table:
            load_robot_file(table["robot"])


def test_every_erratum_is_one_that_the_page_explains():
    page = (ROOT / "docs/reproduction.md").read_text("utf-8")
    explained = set(re.findall(r"^\| (E\d+) \|", page, flags=re.MULTILINE))
    for name in TABLES:
        table = load_table(name)
        errata = set(table["errata"])
        assert errata <= explained
        for entry in table.get("values", {}).values():
            assert set(entry.get("errata", ())) <= errata


def printed_number(text):
    """Return the number at the head of what is printed, None where it is a formula."""
    match = re.fullmatch(r"(-?[0-9.]+)(?: ?[a-zμ°/]*)?", text)
    return match and float(match[1])


@pytest.mark.parametrize("name", ["table2", "table5", "table6", "table9"])
def test_values_are_the_printed_numbers_in_the_unit_of_their_key(name):
    formulas = 0
    for key, entry in load_table(name)["values"].items():
        number = printed_number(entry["printed"])
        formulas += number is None
        assert number is None or number == entry["value"]
        assert entry["unit"] == split_unit(key)[1]
    assert formulas <= 1


def test_the_formulas_of_tables_2_5_and_6():
    third = 2 * math.pi / 3
    assert values_of("table2")["angular_frequency_rad_per_s"] == pytest.approx(third)
    for name in ("table5", "table6"):
        table = values_of(name)
        step = 2 * math.pi / (table["connectors"] - 1)
        assert table["phase_step_rad"] == pytest.approx(step)


def test_generation_1_is_that_of_table_2():
    table = values_of("table2")
    robot = load_robot("gen1")
    assert robot.geometry.connectors == table["connectors"]
    assert (robot.friction.mu_t, robot.friction.mu_n) == (table["mu_t"], table["mu_n"])
    segments = table["connectors"] - 1
    assert robot.mass.total == pytest.approx(segments * table["segment_mass_kg"])
    bend = table["amplitude_rad_per_m"] * robot.geometry.segment_length
    recorded = load_robot_file("gen1").records()["actuator.bend_rad"]
    assert recorded.value == pytest.approx(bend)
    scenario = load_yaml(data_root() / "scenarios/gen1_straight.yaml").data
    frequency = table["angular_frequency_rad_per_s"] / (2 * math.pi)
    assert scenario["controller"]["frequency_hz"] == pytest.approx(frequency, rel=0.02)


@pytest.mark.parametrize(("name", "table"), [("gen2", "table5"), ("gen3", "table6")])
def test_generations_2_and_3_are_those_of_tables_5_and_6(name, table):
    table = values_of(table)
    robot = load_robot(name)
    masses = [table["connector_mass_kg"]] * int(table["connectors"])
    masses[-1] = table.get("tail_mass_kg", masses[-1])
    assert list(robot.mass.connectors) == masses
    assert robot.geometry.segment_length == table["segment_length_m"]
    assert (robot.friction.mu_t, robot.friction.mu_n) == (table["mu_t"], table["mu_n"])
    step = load_robot_file(name).records()["gait.phase_step_rad"]
    assert step.value == pytest.approx(table["phase_step_rad"])


def test_table_8_is_that_of_the_claims():
    rows = claim("table8")["rows"]
    stated = {
        row["offset"]: (row["speed"], -row["left"], row["right"], row["radius"])
        for row in rows
    }
    runs = published_runs()
    assert len(runs) == len(rows) == 7
    assert stated == {
        run.offset: (run.speed_m_s, run.left_m, run.right_m, run.radius_m)
        for run in runs
    }
    assert all(run.left_m < 0 < run.right_m for run in runs)


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
    offsets = [point.changes["controller.offset"] for point in sweep.points]
    assert offsets == sorted(by_offset())
    document = sweep.experiment.document(sweep.points[0].changes)
    assert (
        document["controller"]["frequency_hz"] == load_table("table8")["frequency_hz"]
    )
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
    table = values_of("table9")
    weaker = by_offset()[0.3]
    turn_rate = math.radians(table["turn_rate_deg_per_s"])
    assert weaker.speed_m_s / weaker.radius_m == pytest.approx(turn_rate, rel=0.02)
    widest = max(run.right_m - run.left_m for run in published_runs())
    assert table["box_m"] > widest
    file = load_footprint_file("gen4_table9")
    assert set(file.speed_m_s.value) == {table["speed_m_s"]}
    most = max(abs(curvature) for curvature in file.curvature_per_m.value)
    assert most * table["speed_m_s"] == pytest.approx(turn_rate, rel=1e-3)
    for left, right in zip(file.left_m.value, file.right_m.value, strict=True):
        assert left + right == pytest.approx(table["box_m"])


def test_table_10_is_that_of_the_claims():
    generations = load_table("table10")["generations"]
    speeds = {each["robot"]: each.get("top_speed_mm_s") for each in generations}
    for name, robot in (
        ("gen1-forward", "gen1"),
        ("gen2-top-speed", "gen2"),
        ("gen3-speed", "gen3"),
    ):
        assert 1000 * claim(name)["value"] == pytest.approx(speeds[robot])
    for each in generations:
        said = " ".join(each["advantages"] + each["disadvantages"])
        found = re.search(r"Max (\d+) mm/s", said)
        assert (found and float(found[1])) == each.get("top_speed_mm_s")
