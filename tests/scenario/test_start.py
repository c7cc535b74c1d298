"""Initial states of runs: bends, motion and pressures from keys or from an earlier run."""

from __future__ import annotations

import math

import numpy as np
import pytest

from srs_twin import InputError
from srs_twin.rollout import rollout
from srs_twin.scenario.loading import parse_scenario
from srs_twin.scenario.scenario import Scenario
from srs_twin.trajectory import Trajectory

SEGMENTS = 4
MOVING = {
    "x_m": 0.5,
    "y_m": -0.2,
    "heading_rad": 0.3,
    "velocity_m_s": [0.1, 0.02],
    "yaw_rate_rad_s": 0.5,
    "bend_rad": [0.3, 0.0, -0.2, 0.1],
    "bend_rate_rad_s": [0.0, 1.0, 0.0, 0.0],
    "pressure_kpa": [[20.0, 0.0], [0.0, 0.0], [0.0, 10.0], [0.0, 0.0]],
}
PLANTS = {
    "analytical": {"model": "compliant", "friction": "wheel"},
    "twin": {"contact": "loaded"},
}


def scenario(start: dict, **more: object) -> Scenario:
    gait = {"kind": "gait", "frequency_hz": 2.0}
    return parse_scenario(
        {
            "robot": "gen2",
            "duration_s": 1.0,
            "start": start,
            "controller": gait,
            "plants": PLANTS,
        }
        | more
    )


def run(asked: Scenario, plant: str) -> Trajectory:
    return rollout(asked.build_plant(plant), asked.build_controller(), **asked.timing)


@pytest.mark.parametrize("plant", PLANTS)
def test_first_sample_equals_the_keys(plant):
    asked = scenario(MOVING)
    state = asked.initial_state(asked.build_plant(plant), 0)
    assert state.com_velocity == pytest.approx(MOVING["velocity_m_s"], abs=1e-9)
    assert state.bend_rate == pytest.approx(MOVING["bend_rate_rad_s"], abs=1e-9)
    way = run(asked, plant)
    assert way.com[0] == pytest.approx([0.5, -0.2], abs=1e-9)
    assert way["heading"][0] == pytest.approx(0.3, abs=1e-9)
    assert way.stack("bend")[0] == pytest.approx(MOVING["bend_rad"], abs=1e-9)
    assert way.stack("pressure_plus")[0] == pytest.approx([20e3, 0, 0, 0], abs=1e-6)
    assert way.stack("pressure_minus")[0] == pytest.approx([0, 0, 10e3, 0], abs=1e-6)


def test_one_key_suffices_and_none_means_at_rest():
    bent = run(scenario({"bend_rad": [0.1] * SEGMENTS}), "analytical")
    assert bent.stack("bend")[0] == pytest.approx([0.1] * SEGMENTS)
    assert scenario({"x_m": 1.0}).initial_state is None


@pytest.mark.parametrize("plant", PLANTS)
def test_run_from_a_trajectory_continues_it(plant, tmp_path):
    """Rates and wheel speeds, which a trajectory does not contain, are recovered within this tolerance."""
    whole = run(scenario({}, duration_s=2.0), plant)
    whole.to_parquet(tmp_path / f"{plant}.parquet")
    at = 1.3
    asked = scenario(
        {"from": str(tmp_path), "time_s": at},
        plants={plant: PLANTS[plant]},
        duration_s=0.6,
        controller={
            "kind": "gait",
            "frequency_hz": 2.0,
            "phase_rad": math.remainder(4 * math.pi * at, 2 * math.pi),
        },
    )
    found = run(asked, plant)
    begun = int(np.searchsorted(whole.time, at - 1e-9))
    later = slice(begun, begun + len(found.time))
    assert np.abs(found.com - whole.com[later]).max() < 0.0006
    assert np.abs(found.stack("bend") - whole.stack("bend")[later]).max() < 0.01
    assert np.abs(found["heading"] - whole["heading"][later]).max() < 0.02


@pytest.mark.parametrize(
    ("start", "told"),
    [
        (
            {"bend_rad": [0.1]},
            "start: `bend_rad` has 1 entries, but the robot has 4 segments",
        ),
        (
            {"pressure_kpa": [[900.0, 0.0]] * SEGMENTS},
            "start: `pressure_kpa` 900 is above the supply pressure",
        ),
        (
            {"from": "nowhere", "time_s": 1.0},
            "start: nowhere: the folder contains no trajectory of the analytical plant",
        ),
        (
            {"from": "nowhere"},
            "start.from: the time in the earlier run is missing; set `time_s`",
        ),
        ({"time_s": 1.0}, "start.time_s: this key needs an earlier run; set `from`"),
        (
            {"from": "nowhere", "time_s": 1.0, "x_m": 0.0},
            "start.x_m: the earlier run given by `from` already sets this value",
        ),
        ({"bends_rad": [0.1] * SEGMENTS}, "did you mean"),
    ],
)
def test_invalid_starts_are_rejected(start, told):
    with pytest.raises(InputError) as error:
        scenario(start)
    assert told in str(error.value)


@pytest.fixture(scope="module")
def records(tmp_path_factory):
    """Return the folder of an earlier run of both plants, and its analytical trajectory."""
    folder = tmp_path_factory.mktemp("earlier")
    ways = {plant: run(scenario({}), plant) for plant in PLANTS}
    for plant, way in ways.items():
        way.to_parquet(folder / f"{plant}.parquet")
    return folder, ways["analytical"]


def test_time_outside_the_trajectory_is_rejected(records):
    folder, _ = records
    with pytest.raises(
        InputError,
        match=r"`time_s` 3 is outside .*analytical.parquet, which covers 0 to 1 s",
    ):
        scenario({"from": str(folder), "time_s": 3.0})


def test_run_starts_from_the_first_and_last_sample_of_a_trajectory(
    records, monkeypatch
):
    folder, analytical = records
    monkeypatch.chdir(folder.parent)
    for row in (0, -1):
        start = {"from": folder.name, "time_s": float(analytical.time[row])}
        asked = scenario(start, duration_s=0.02)
        assert asked.document["start"]["from"] == str(folder)
        way = run(asked, "analytical")
        assert way.com[0] == pytest.approx(analytical.com[row], abs=1e-9)
