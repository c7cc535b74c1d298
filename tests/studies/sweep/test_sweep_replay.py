"""Sweep over a replay: deviations of each robot from the measurement, one column per metric."""

from __future__ import annotations

import numpy as np
import pyarrow.parquet as pq
import pytest
from conftest import ROOT
from small import execute, write

from srs_twin import rollout
from srs_twin.comparison.compare import MeasuredDifference
from srs_twin.comparison.metrics import MEASURED_UNITS
from srs_twin.errors import InputFileError
from srs_twin.scenario.loading import parse_scenario
from srs_twin.studies.sweep.loading import load_sweep

WALK = ROOT / "calibration/examples/my_snake/walk_check.csv"
SCENARIO = f"""\
robot: {{base: gen2, friction: {{mu_t: 0.055, mu_n: 0.48}}}}
duration_s: 2.0
supply: {{pressure_kpa: 48.3}}
controller: {{kind: replay}}
recording: {{motion: {WALK}, longest_gap_s: 0.3}}
plants: {{analytical: {{friction: wheel}}}}
"""
SWEEP = """\
scenario: replay.yaml
plants: [analytical]
vary:
  robot.geometry.rigid_gap_m: [0.018, 0.021, 0.026]
"""


@pytest.fixture(autouse=True)
def at_home(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)


@pytest.mark.slow
def test_each_row_has_the_deviations_of_its_run(tmp_path):
    """The recorded robot has gaps of 21 mm, which body shapes identify."""
    (tmp_path / "replay.yaml").write_text(SCENARIO)
    sweep = load_sweep(write(tmp_path, SWEEP))
    execute(sweep, tmp_path / "out")
    table = pq.read_table(tmp_path / "out/results.parquet").to_pydict()
    gaps = table["robot.geometry.rigid_gap_m"]
    shapes = dict(zip(gaps, table["analytical.measured_shape_rms_m"], strict=True))
    assert min(shapes, key=shapes.__getitem__) == 0.021
    assert shapes[0.021] < 0.8 * shapes[0.026]
    row = gaps.index(0.026)
    (point,) = (point for point in sweep.points if point.key == table["key"][row])
    scenario = parse_scenario(sweep.experiment.document(point.changes))
    run = rollout(
        scenario.build_plant("analytical"),
        scenario.build_controller(),
        scenario.duration,
        pose=scenario.pose,
        record_hz=scenario.record_hz,
    )
    printed = MeasuredDifference.between(scenario.measured, run).metrics
    for name in MEASURED_UNITS:
        assert table[f"analytical.{name}"][row] == printed[name]
    # By hand: the bends at the recording's times, sampled at 100 Hz.
    measured = scenario.measured
    bends = np.stack(
        [np.interp(measured.time, run.time, run[f"bend_{j}"]) for j in range(1, 5)], 1
    )
    rms = float(np.sqrt(np.mean((bends - measured.stack("bend")) ** 2)))
    assert table["analytical.measured_bend_rms_rad"][row] == pytest.approx(
        rms, rel=0.02
    )


def test_a_missing_recording_is_reported_before_any_run(tmp_path):
    (tmp_path / "replay.yaml").write_text(SCENARIO.replace("walk_check", "walk_away"))
    with pytest.raises(
        InputFileError,
        match=r"replay.yaml:5:21: recording.motion: .*walk_away.csv: no such",
    ):
        load_sweep(write(tmp_path, SWEEP))
