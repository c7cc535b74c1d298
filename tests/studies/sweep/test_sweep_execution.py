"""Execution of sweeps: missing points run once, and failures become rows."""

from __future__ import annotations

import json

import numpy as np
import pyarrow.parquet as pq
import pytest
from small import SMALL, diverges, execute, here, write

from srs_twin import Trajectory, rollout
from srs_twin.comparison.metrics import plant_metrics
from srs_twin.compute.workers import TaskResult
from srs_twin.errors import InputError, WorkerDiedError
from srs_twin.scenario.loading import parse_scenario
from srs_twin.studies.sweep.execution import open_sweep
from srs_twin.studies.sweep.loading import load_sweep
from srs_twin.studies.sweep.store import rows_digest
from srs_twin.studies.sweep.table import _of_one_type
from srs_twin.studies.sweep.task import Row, flat_metrics


@pytest.fixture
def sweep(tmp_path):
    return load_sweep(write(tmp_path))


def test_every_point_has_a_row_with_the_metrics_of_its_run(sweep, tmp_path):
    _, summary = execute(sweep, tmp_path / "out")
    assert (summary.points, summary.done, summary.failed, summary.exit_code) == (
        8,
        8,
        0,
        0,
    )
    table = pq.read_table(tmp_path / "out" / "results.parquet")
    assert table["key"].to_pylist() == sorted(point.key for point in sweep.points)
    assert table["exit_code"].to_pylist() == [0] * 8
    row = table.slice(3, 1).to_pydict()
    point = next(point for point in sweep.points if point.key == row["key"][0])
    assert {name: row[name][0] for name in sweep.fields} == point.changes
    scenario = parse_scenario(sweep.experiment.document(point.changes))
    run = rollout(
        scenario.build_plant("analytical"),
        scenario.build_controller(),
        scenario.duration,
    )
    metrics = plant_metrics(run)
    assert row["analytical.com_speed_m_s"][0] == metrics["com_speed_m_s"]
    assert row["analytical.bend_amplitude_rad_2"][0] == metrics["bend_amplitude_rad"][1]
    assert (
        row["analytical.valve_switches_minus_1"][0] == metrics["valve_switches"][0][1]
    )
    assert (
        json.loads((tmp_path / "out" / "sweep.json").read_text())["results_sha256"]
        == summary.sha256
    )


def test_only_requested_metrics_are_columns(tmp_path):
    text = SMALL + "metrics: [com_speed_m_s, bend_bias_rad, valve_switches]\n"
    execute(load_sweep(write(tmp_path, text)), tmp_path / "out")
    names = pq.read_schema(tmp_path / "out" / "results.parquet").names
    assert {name for name in names if name.startswith("analytical.")} == {
        "analytical.com_speed_m_s",
        *(f"analytical.bend_bias_rad_{j}" for j in range(1, 5)),
        *(
            f"analytical.valve_switches_{side}_{j}"
            for side in ("plus", "minus")
            for j in range(1, 5)
        ),
    }


def test_only_missing_points_run(sweep, tmp_path):
    def stops_after_three(experiment, points):
        yield from (done for done in here(experiment, points[:3]))
        raise KeyboardInterrupt

    with (
        open_sweep(sweep, tmp_path / "out") as opened,
        pytest.raises(KeyboardInterrupt),
    ):
        opened.run(stops_after_three, opened.missing())
    ran, summary = execute(sweep, tmp_path / "out")
    assert (ran, summary.done) == (5, 8)
    assert summary.sha256 == execute(sweep, tmp_path / "whole")[1].sha256
    assert execute(sweep, tmp_path / "out")[0] == 0


def test_failed_runs_are_rows_with_a_reason(sweep, tmp_path):
    _, summary = execute(sweep, tmp_path / "out", diverges)
    assert (summary.done, summary.failed, summary.exit_code) == (4, 4, 3)
    assert summary.reasons == {"twin diverged at t = 1 s: boom": 4}
    table = pq.read_table(tmp_path / "out" / "results.parquet").to_pydict()
    assert [reason for reason in table["reason"] if reason] == [
        "twin diverged at t = 1 s: boom"
    ] * 4
    assert table["analytical.com_speed_m_s"].count(None) == 4
    assert execute(sweep, tmp_path / "out")[0] == 0
    ran, summary = execute(sweep, tmp_path / "out", retry_failed=True)
    assert (ran, summary.done, summary.failed) == (4, 8, 0)


def test_a_dead_worker_fails_only_its_point(sweep, tmp_path):
    def dies(experiment, points):
        for done in here(experiment, points):
            yield (
                TaskResult(done.number, None, WorkerDiedError(-9, 3))
                if done.number == 5
                else done
            )

    _, summary = execute(sweep, tmp_path / "out", dies)
    ((reason, count),) = summary.reasons.items()
    assert count == 1 and "SIGKILL" in reason and summary.exit_code == 4


def test_an_invalid_point_is_a_failed_row(tmp_path):
    text = SMALL.replace(
        "supply.pressure_kpa: {from: 41, to: 55, count: 4}",
        "plants.analytical.tick_s: [0.02, 0.08]",
    )
    text = text.replace(
        "controller.frequency_hz: [2, 2.5]", "duration_s: [2.0, 2.02]"
    ).replace("fixed: {duration_s: 2}\n", "")
    sweep = load_sweep(write(tmp_path, text))
    _, summary = execute(sweep, tmp_path / "out")
    assert (summary.done, summary.failed, summary.exit_code) == (3, 1, 2)
    assert "is not a multiple of" in next(iter(summary.reasons))


def test_an_edited_sweep_is_refused_without_changed(tmp_path):
    before = load_sweep(write(tmp_path))
    execute(before, tmp_path / "out")
    after = load_sweep(write(tmp_path, SMALL.replace("count: 4", "count: 7")))
    refusal = r"another study or to another version of it \(points changed\)\. Use"
    with pytest.raises(InputError, match=refusal), open_sweep(after, tmp_path / "out"):
        pass
    # 41 to 55 kPa in six steps has every other pressure of three steps.
    ran, summary = execute(after, tmp_path / "out", changed=True)
    assert (ran, summary.done) == (6, 14)
    edited = load_sweep(
        write(tmp_path, SMALL.replace("duration_s: 2", "duration_s: 3"))
    )
    refusal = r"scenario\.duration_s 3(\.0)?, was 2"
    with pytest.raises(InputError, match=refusal), open_sweep(edited, tmp_path / "out"):
        pass
    ran, summary = execute(edited, tmp_path / "out", changed=True)
    assert (ran, summary.done) == (8, 8)


def test_a_renamed_sweep_keeps_its_rows(tmp_path):
    execute(load_sweep(write(tmp_path)), tmp_path / "out")
    renamed = load_sweep(write(tmp_path, "title: Another\n" + SMALL, "other.yaml"))
    assert execute(renamed, tmp_path / "out")[0] == 0


def test_stored_trajectories_equal_those_of_the_runs(tmp_path):
    sweep = load_sweep(write(tmp_path, SMALL + "trajectories: true\n"))
    execute(sweep, tmp_path / "out")
    files = sorted((tmp_path / "out" / "trajectories").iterdir())
    assert [file.name for file in files] == sorted(
        f"{point.key}.analytical.parquet" for point in sweep.points
    )
    table = pq.read_table(tmp_path / "out" / "results.parquet").to_pydict()
    run = Trajectory.from_parquet(files[0])
    assert plant_metrics(run)["com_speed_m_s"] == table["analytical.com_speed_m_s"][0]


def test_both_plants_are_compared(tmp_path):
    text = (
        SMALL.replace("plants: [analytical]\n", "")
        .replace("[2, 2.5]", "[2]")
        .replace("count: 4", "count: 2")
    )
    execute(load_sweep(write(tmp_path, text)), tmp_path / "out")
    table = pq.read_table(tmp_path / "out" / "results.parquet").to_pydict()
    analytical, twin = (
        np.array(table[f"{plant}.com_speed_m_s"]) for plant in ("analytical", "twin")
    )
    assert np.array(table["comparison.com_speed_rel"]) == pytest.approx(
        twin / analytical - 1
    )


def test_the_digest_does_not_depend_on_order_or_wall_times():
    rows = [
        Row("a", "done", {"x": 1.0, "y": None}, 0.1),
        Row("b", "failed", {}, 0.2, "boom", 3),
    ]
    slower = [
        Row("b", "failed", {}, 9.0, "boom", 3),
        Row("a", "done", {"y": None, "x": 1.0}, 9.0),
    ]
    assert rows_digest(rows) == rows_digest(slower)
    for other in (
        Row("a", "done", {"x": 1.0000000000000002, "y": None}),
        Row("a", "done", {"x": 1.0}),
    ):
        assert rows_digest([other, rows[1]]) != rows_digest(rows)


def test_columns_of_several_types_become_numbers_or_texts():
    assert list(map(repr, _of_one_type([1, 2]))) == ["1", "2"]
    assert list(map(repr, _of_one_type([1, 2.5]))) == ["1.0", "2.5"]
    assert _of_one_type([True, "a", 2]) == ["true", "a", "2"]


def test_list_metrics_have_a_column_for_each_element():
    """Elements are numbered by segment and period; wall times are no metrics."""
    metrics = {
        "wall_s": 1.0,
        "speed": True,
        "bend": [0.5, None],
        "switches": [[1, 2], [3, 4]],
        "spatial": [[5, 6, 7]],
        "learned": [[[8, 9]], [[10, 11]]],
    }
    assert flat_metrics("twin", metrics) == {
        "twin.speed": 1.0,
        "twin.bend_1": 0.5,
        "twin.bend_2": None,
        "twin.switches_plus_1": 1.0,
        "twin.switches_minus_1": 2.0,
        "twin.switches_plus_2": 3.0,
        "twin.switches_minus_2": 4.0,
        "twin.spatial_1_1": 5.0,
        "twin.spatial_2_1": 6.0,
        "twin.spatial_3_1": 7.0,
        "twin.learned_plus_1_period_1": 8.0,
        "twin.learned_minus_1_period_1": 9.0,
        "twin.learned_plus_1_period_2": 10.0,
        "twin.learned_minus_1_period_2": 11.0,
    }
