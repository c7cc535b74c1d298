"""Scenarios of iterative learning: their files, the command line, reports, and runs that a fault ends."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from srs_twin import InputError, Trajectory, load_scenario
from srs_twin.comparison.compare import compare
from srs_twin.experiment import prepare
from srs_twin.scenario.loading import parse_scenario
from srs_twin.sensing import Sensor

FILE = """\
title: Learning to turn
robot: gen4
duration_s: 6
supply: {pressure_kpa: 131}
controller: {kind: ilc, frequency_hz: 2.0, offset: -0.1, target_rad: 0.7}
plants:
  analytical: {model: compliant}
expect:
  - {metric: periods_to_converge, plant: analytical, below: 12}
  - {metric: path_radius_m, plant: analytical, below: 0}
"""


def scenario(**controller: Any) -> Any:
    return parse_scenario(
        {
            "robot": "gen4",
            "duration_s": 8,
            "supply": {"pressure_kpa": 131},
            "controller": {"kind": "ilc", "frequency_hz": 1.0} | controller,
            "plants": {"analytical": {"model": "compliant"}, "twin": {}},
        }
    )


@pytest.mark.slow
def test_the_command_line_runs_a_file(tmp_path, srs_twin):
    (tmp_path / "turn.yaml").write_text(FILE, "utf-8")
    done = srs_twin("run", "turn.yaml", "--check", "--out", "out", cwd=tmp_path)
    assert done.returncode == 0, done.stdout + done.stderr
    assert "periods to converge" in done.stdout
    assert "curvature at the end" in done.stdout
    metrics = json.loads((tmp_path / "out/metrics.json").read_text("utf-8"))
    found = metrics["plants"]["analytical"]
    assert found["periods_to_converge"] <= 12
    assert min(found["extent_left_m"], found["extent_right_m"]) > 0
    assert len(found["duty"]) == len(found["amplitude_error_rad"]) == 11
    page = (tmp_path / "out/report.html").read_text("utf-8")
    assert "Learning: amplitudes and duties of each module per period." in page
    assert "same valve commands" not in page
    run = Trajectory.from_parquet(tmp_path / "out/analytical.parquet")
    assert {"ilc_update", "converged"} <= {event.kind for event in run.events}


def test_settings_reach_the_controller():
    def described(given):
        controller = given.build_controller()
        snake = given.build_plant("analytical")
        controller.reset(snake.spec, snake.tick)
        return controller.describe()

    settings = {
        "k_per_rad": 0.4,
        "free_periods": 3,
        "carrier_hz": 100,
        "on_fault": "stop",
        "steering": "targets_and_wave",
    }
    given = scenario(offset=0.2, target_rad=0.5, phase_rad=1.0, **settings)
    about = described(given)
    assert about | settings | {"target": 0.5} == about
    controller = given.build_controller()
    assert (controller.offset, controller.frequency) == (0.2, 1.0)
    assert given.layout == "3/2"
    defaults = {
        "k_per_rad": 0.3,
        "free_periods": 2,
        "carrier_hz": 60,
        "target": "smallest",
        "steering": "targets",
    }
    about = described(scenario())
    assert about | defaults == about


def test_a_target_out_of_reach_is_warned_of():
    given = scenario(target_rad=1.5)
    assert given.warnings == ()
    weak = parse_scenario(dict(given.document) | {"supply": {"pressure_kpa": 30}})
    (warning,) = weak.warnings
    assert warning.startswith(
        "controller.target_rad: 1.5 rad is above 0.455 rad, the maximum bend"
    )


@pytest.mark.parametrize("name", ["ilc_straight", "ilc_curve"])
def test_the_shipped_pairs_differ_in_nothing_but_the_learning(name):
    def shared(scenario):
        controller = scenario.controller
        gait = (controller.offset, controller.frequency_hz)
        air = (scenario.supply_pa, scenario.file.pneumatics)
        return scenario.robot, scenario.duration, *gait, *air

    learning, without = (load_scenario(each) for each in (name, f"{name}_without"))
    assert shared(learning) == shared(without)


class Silent(Sensor):
    """Loses every reading of the first segment."""

    kind = "silent"

    def read(self, bend: np.ndarray, time: np.ndarray | float, seed: int) -> np.ndarray:
        said = np.array(bend, dtype=float)
        said[..., 0] = np.nan
        return said


@pytest.fixture(scope="module")
def stopped(tmp_path_factory) -> Any:
    """Return a run of both plants that a silent sensor ends on one of them."""
    given = scenario(on_fault="stop", target_rad=0.7)
    run = prepare(given, tmp_path_factory.mktemp("stopped"))
    broken = given.build_plant("analytical", sensor=Silent())
    return replace(
        run, pairs=dict(run.pairs) | {"analytical": (broken, given.build_controller())}
    ).execute()


@pytest.mark.slow
def test_a_run_that_a_fault_ends_still_gives_everything(stopped):
    ended = stopped.trajectories["analytical"]
    whole = stopped.trajectories["twin"]
    assert ended.time[-1] < 4.0 and whole.time[-1] == pytest.approx(8.0)
    assert ended.metadata["control"]["faults"] == [
        "segment 1: sensor dead, all readings of a period are lost"
    ]
    assert (
        whole.metadata["ended_by"] is None and whole.metadata["control"]["faults"] == []
    )
    assert stopped.metrics["plants"]["analytical"]["periods_to_converge"] is None
    names = {path.name for path in Path(stopped.folder).iterdir()}
    assert {"report.html", "recording.rrd", "metrics.json", "twin.parquet"} <= names
    assert compare(ended, whole).time[-1] == ended.time[-1]
    again = Trajectory.from_parquet(Path(stopped.folder) / "analytical.parquet")
    assert np.isnan(again["measured_bend_1"]).all() and again.events[-1].kind == "fault"


def test_a_carrier_as_slow_as_the_gait_is_refused():
    with pytest.raises(
        InputError,
        match="`carrier_hz` is too low for this gait frequency; it must be at least 8",
    ):
        scenario(carrier_hz=7)
