"""Shipped scenarios run on both plants and miss only their known expectations."""

from __future__ import annotations

import json
import math

import pytest
from conftest import ROOT

from srs_twin.experiment import load_run
from srs_twin.io.files import shipped_names
from srs_twin.scenario.expectation import verdict
from srs_twin.scenario.loading import load_scenario

DOCUMENTED = json.loads((ROOT / "docs/module.json").read_text("utf-8"))


# By default one of each kind that is quickly run; ILC: test_learning_scenarios.py.
BRIEF = {
    "gen2_straight",
    "module_step_direct",
    "sensor_far",
}
SHIPPED = [
    pytest.param(name, marks=[] if name in BRIEF else [pytest.mark.slow])
    for name in sorted(shipped_names("scenario"))
]


def test_default_runs_are_shipped_scenarios():
    assert set(shipped_names("scenario")) >= BRIEF


@pytest.mark.parametrize("name", SHIPPED)
def test_shipped_scenarios_miss_only_known_expectations(name, shipped_run):
    folder = shipped_run(name)
    plants = load_scenario(name).plants
    assert {path.name for path in folder.iterdir()} == {
        *(f"{plant}.parquet" for plant in plants),
        "scenario.resolved.yaml",
        "report.html",
        "recording.rrd",
        "metrics.json",
    }
    metrics = json.loads((folder / "metrics.json").read_text("utf-8"))
    surprising = [
        each
        for each in metrics["expectations"]
        if verdict(each) not in ("met", "expected_failure")
        and each.get("verdict") != "undecided"
    ]
    assert surprising == [], (
        "missed, or marked `known` and met: change the mark on purpose"
    )
    assert "body_overlap_m" not in metrics, "the body passes through itself"
    as_documented(name, metrics["plants"])
    if len(plants) == 1:
        return
    both = load_run(folder).trajectories
    if any(
        both["twin"].has(name)
        for name in ("reference", "duty_plus", "offset_commanded")
    ):
        return  # feedback: the commands depend on the plant
    # Equal valve commands give equal pressures, regardless of the motion.
    assert (
        both["twin"].metadata["valve_switches"]
        == both["analytical"].metadata["valve_switches"]
    )
    robot = load_scenario(name).robot
    for chamber in (
        range(1, robot.chambers + 1) if robot.is_spatial else ("plus", "minus")
    ):
        valve = f"valve_{chamber}"
        pressure = f"pressure_{chamber}"
        assert (both["twin"].stack(valve) == both["analytical"].stack(valve)).all()
        assert both["twin"].stack(pressure) == pytest.approx(
            both["analytical"].stack(pressure), abs=1e-6
        )


def as_documented(name, plants):
    """Compare the metrics of a scenario with those in docs/module.md, stored in docs/module.json."""
    documented = DOCUMENTED["scenarios"].get(name)
    if documented is None:
        return
    for plant, metrics in plants.items():
        numbers = {
            metric: value
            for metric, value in metrics.items()
            if isinstance(value, int | float)
            and metric not in ("wall_s", "realtime_factor")
        }
        assert numbers.keys() == documented[plant].keys()
        if "leak" not in name:
            again = "uv run python benchmarks/module_table.py writes them again"
            assert numbers == pytest.approx(documented[plant], rel=0.02, abs=2e-4), (
                again
            )
            continue
        # At the edge of the dead zone rounding acts like noise: compare with the
        # documented distribution.
        drawn = DOCUMENTED["leak"]["of"][name.rpartition("_")[2]][plant]
        for metric, unit in (("inlet_openings", 1), ("steady_rms_rad", 180 / math.pi)):
            mean = drawn[metric]["mean"]
            deviation = drawn[metric]["deviation"]
            assert unit * numbers[metric] == pytest.approx(mean, abs=4 * deviation)
