"""Sweeps without plants: plans in the same worlds, with their metrics as columns of one table."""

from __future__ import annotations

from dataclasses import replace

import pyarrow.parquet as pq
import pytest
from small import execute, here, write

from srs_twin.errors import InputFileError
from srs_twin.planning.footprint_file import load_footprint
from srs_twin.planning.planner import plan
from srs_twin.planning.problem import Problem, Settings
from srs_twin.robot.world import FIG54_GOAL, FIG54_START, fig54_world
from srs_twin.studies.sweep.execution import open_sweep
from srs_twin.studies.sweep.loading import load_sweep
from srs_twin.studies.sweep.store import rows_digest

WORLDS = """\
scenario: plan_fig54_8
plants: []
fixed: {world.goal.radius_m: 0.02}
vary:
  planner.weight: [1, 2]
  world.random.count: [3, 12]
  seed: [0, 1, 2]
"""
PICTURE = (
    "plots: [{kind: line, x: world.random.count, metric: plan_found, by:"
    " planner.weight}]\n"
)


def table(text, folder):
    execute(load_sweep(write(folder, text)), folder / "out")
    return pq.read_table(folder / "out/results.parquet").to_pylist()


def test_rows_equal_direct_calls_of_the_planner(tmp_path):
    rows = table(WORLDS + PICTURE, tmp_path)
    assert len(rows) == 12 and {row["status"] for row in rows} == {"done"}
    body = load_footprint("gen2_section52")
    for row in rows:
        world = fig54_world(row["world.random.count"], row["seed"])
        problem = Problem(FIG54_START, FIG54_GOAL, world, body)
        answer = plan(problem, Settings(weight=row["planner.weight"]))
        assert (
            row["plan.plan_found"] == answer.found
            and row["plan.plan_nodes"] == answer.expanded
        )
        if answer.found:
            # The file's angles have six decimals.
            assert row["plan.plan_length_m"] == pytest.approx(answer.length, abs=1e-4)
        assert 0 < row["plan.plan_s"] < row["wall_s"]
    assert not [
        name
        for name in rows[0]
        if name.startswith(("analytical.", "twin.", "comparison."))
    ]
    assert (
        (tmp_path / "out/plots/1_line_plan_found.png")
        .read_bytes()
        .startswith(b"\x89PNG")
    )
    assert "plan found" in (tmp_path / "out/report.html").read_text("utf-8")


def test_the_digest_does_not_depend_on_planning_time(tmp_path):
    with open_sweep(load_sweep(write(tmp_path, WORLDS)), tmp_path / "out") as opened:
        rows = [
            done.result for done in here(opened.sweep.experiment, opened.missing()[:4])
        ]
    slower = [replace(row, values={**row.values, "plan.plan_s": 9.0}) for row in rows]
    longer = [
        replace(row, values={**row.values, "plan.plan_nodes": 9.0}) for row in rows
    ]
    assert rows_digest(rows) == rows_digest(slower) != rows_digest(longer)


@pytest.mark.parametrize(
    ("exclude", "says"),
    [
        (
            "planner.weigh=1",
            "unknown varied field 'planner.weigh'; did you mean planner.weight?",
        ),
        (
            "planner.weight=3",
            "unknown value of planner.weight '3'",
        ),
    ],
)
def test_invalid_exclusions_are_refused(exclude, says, tmp_path, srs_twin):
    write(tmp_path, WORLDS)
    done = srs_twin("sweep", "small.yaml", "--exclude", exclude, cwd=tmp_path)
    assert (
        done.returncode == 2 and says in done.stderr and "Traceback" not in done.stderr
    )


@pytest.mark.default_cases(at=[0, 3, 5])
@pytest.mark.parametrize(
    ("text", "says"),
    [
        (
            "scenario: gen2_straight\nplants: []\nvary: {seed: [0, 1]}\n",
            "plants: no plant is named and the scenario has no planner",
        ),
        (WORLDS + "metrics: [com_speed_m_s]\n", "unknown metric 'com_speed_m_s'"),
        (WORLDS + "metrics: [path_rms_m]\n", "unknown metric 'path_rms_m'"),
        (
            WORLDS + "periods: 5\n",
            "periods: this key has no effect, because no plant runs with `plants: []`",
        ),
        (
            WORLDS + "trajectories: true\n",
            "trajectories: this key has no effect, because no plant runs with `plants: []`",
        ),
        (WORLDS.replace("planner.weight", "planner.wait"), "planner.wait"),
    ],
)
def test_keys_that_need_a_plant_are_refused(text, says, tmp_path):
    with pytest.raises(InputFileError) as caught:
        load_sweep(write(tmp_path, text))
    assert says in str(caught.value)
