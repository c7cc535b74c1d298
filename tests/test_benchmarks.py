"""The benchmarks: each compares the same problem, and its timing helpers compute what they document."""

from __future__ import annotations

import getpass
import json
import re
import socket
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import pytest
from benchmark_runs import run_benchmark
from conftest import ROOT
from lsoda import CompleteModel, bend_intervals, solve, trajectory
from processes import python

from srs_twin import AnalyticalSnake, Gait, load_robot, rollout

SPEC = load_robot("gen2")
SUPPLY = 48.3e3


@pytest.mark.slow
@pytest.mark.parametrize("friction_law", ["axis", "wheel"])
@pytest.mark.parametrize(("frequency", "offset"), [(2.0, 0.0), (1.7, 0.3)])
def test_lsoda_and_the_compiled_model_solve_the_same_equations(
    friction_law, frequency, offset
):
    """Two programs that share only the valve slots: paths agree within 0.1 % of their length."""
    fine = AnalyticalSnake(
        SPEC, friction=friction_law, supply_pa=SUPPLY, timestep=0.00002
    )
    compiled = rollout(fine, Gait(frequency, offset), 0.6)
    gait = Gait(frequency, offset)
    bends = bend_intervals(SPEC, gait, 0.6, SUPPLY)
    model = CompleteModel(
        SPEC, friction=friction_law, slip=fine.describe()["slip_speed_m_s"]
    )
    lsoda = trajectory(SPEC, gait, solve(model, bends, rtol=1e-6, atol=1e-9), bends)
    length = np.hypot(*np.diff(compiled.com, axis=0).T).sum()
    assert length > 0.05
    assert lsoda.time == pytest.approx(compiled.time, abs=1e-12)
    assert lsoda.stack("bend") == pytest.approx(compiled.stack("bend"), abs=1e-9)
    assert lsoda.com == pytest.approx(compiled.com, abs=1e-3 * length)
    assert lsoda["heading"] == pytest.approx(
        compiled["heading"], abs=1e-3 * np.ptp(compiled["heading"])
    )


@pytest.mark.slow
@pytest.mark.parametrize("script", ["timing", "scaling"])
def test_doctests_of_the_timing_helpers(script):
    python("-m", "doctest", f"common/{script}.py", cwd=ROOT / "benchmarks")


@pytest.mark.slow
def test_speed_benchmark_compares_equal_motions_and_hides_private_names(tmp_path):
    """The bare `mj_step` loop ends where the rollout ends; a missing PyElastica is reported."""
    out = tmp_path / "speed.json"
    done = run_benchmark("speed.py", "--quick", "--only", "b", "c", "--json", str(out))
    assert done.returncode == 0, done.stderr
    text = out.read_text("utf-8")
    values = json.loads(text)
    assert values["b"]["final_qpos_error"] < 1e-9
    assert set(values["b"]["ratios"]) == {"preloaded", "default"}
    assert "| program | simulated s per wall s |" in done.stdout
    assert values["quick"] is True and values["machine"]["cpus"] >= 1
    assert values["machine"]["versions"]["mujoco"].startswith("3.")
    for private in (
        socket.gethostname(),
        str(Path.home()),
        str(ROOT),
        f"/{getpass.getuser()}/",
    ):
        assert private not in text
    if not find_spec("elastica"):
        assert (
            "(c) left out: PyElastica is not installed: `uv run --group benchmarks"
            in done.stderr
        )
        assert "c" not in values


@pytest.mark.slow
@pytest.mark.parametrize("threads", [1, 2])
def test_twins_stepped_together_equal_single_twins_to_the_bit(threads):
    done = run_benchmark("common/twin_batch.py", "--threads", str(threads))
    assert done.returncode == 0, done.stdout + done.stderr


@pytest.mark.slow
def test_environments_and_batched_rollouts_travel_the_same_distance():
    done = run_benchmark("environments.py", "--check")
    assert done.returncode == 0, done.stderr


@pytest.mark.fast
def test_readme_lists_every_tool():
    text = (ROOT / "tools/README.md").read_text("utf-8")
    listed = re.findall(r"^\| `(\w+\.py)` \|", text, re.M)
    assert sorted(listed) == sorted(path.name for path in (ROOT / "tools").glob("*.py"))
