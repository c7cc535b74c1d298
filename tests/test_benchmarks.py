"""The benchmarks: what the plants are timed against is the same problem, and the times are what they say."""

from __future__ import annotations

import getpass
import json
import socket
import time
from pathlib import Path

import against_mj_step
import numpy as np
import pytest
import speed
from environments import Plain, Vector
from lsoda import CompleteModel, solve, stretches, trajectory
from scaling import ThreadCost, chain
from timing import Ratio, Result, Task, Timing, interleaved, machine
from twin_batch import run_together

from srs_twin import AnalyticalSnake, Gait, PreloadedContact, TwinSnake, load_robot, rollout
from srs_twin.scenario.loading import load_scenario, parse_scenario

SPEC = load_robot("gen2")
SUPPLY = 48.3e3


@pytest.mark.slow
@pytest.mark.parametrize("law", ["axis", "wheel"])
@pytest.mark.parametrize(("frequency", "offset"), [(2.0, 0.0), (1.7, 0.3)])
def test_lsoda_and_the_compiled_model_solve_the_same_equations(law, frequency, offset):
    """Two codes that share no formula but the valves' raster: paths within 0.1 % of their length."""
    fine = AnalyticalSnake(SPEC, friction=law, supply_pa=SUPPLY, timestep=0.00002)
    ours = rollout(fine, Gait(frequency, offset), 0.6)
    gait = Gait(frequency, offset)
    bends = stretches(SPEC, gait, 0.6, SUPPLY)
    model = CompleteModel(SPEC, friction=law, slip=fine.describe()["slip_speed_m_s"])
    theirs = trajectory(SPEC, gait, solve(model, bends, rtol=1e-6, atol=1e-9), bends)
    length = np.hypot(*np.diff(ours.com, axis=0).T).sum()
    assert length > 0.05
    assert theirs.time == pytest.approx(ours.time, abs=1e-12)
    assert theirs.stack("bend") == pytest.approx(ours.stack("bend"), abs=1e-9)
    assert theirs.com == pytest.approx(ours.com, abs=1e-3 * length)
    assert theirs["heading"] == pytest.approx(ours["heading"], abs=1e-3 * np.ptp(ours["heading"]))


def test_lsoda_gets_closer_as_its_tolerance_shrinks():
    gait = Gait(2.0, 0.2)
    bends = stretches(SPEC, gait, 0.3, SUPPLY)
    model = CompleteModel(SPEC, friction="wheel", slip=0.0005)
    ways = [solve(model, bends, rtol=t, atol=1e-3 * t)[:, :2] for t in (1e-2, 1e-5, 1e-8)]
    rough, good = (np.abs(way - ways[-1]).max() for way in ways[:2])
    assert good < 0.1 * rough < 1e-3


def test_bare_loop_moves_the_twin_as_its_rollout_does():
    plant = TwinSnake(SPEC, contact="preloaded")
    loop, data = against_mj_step.bare_loop(plant, 0.1)
    loop()
    loop()  # begins anew each time
    way = rollout(plant, Gait(2.0, against_mj_step.OFFSET), 0.1)
    assert data.qpos == pytest.approx(way.stack("qpos")[-1], abs=1e-9)
    assert data.time == pytest.approx(0.1)


@pytest.mark.parametrize("segments", [2, 16])
def test_chains_of_any_length_keep_the_robots_own_segments(segments):
    spec = chain(segments)
    assert spec.segments == segments
    assert spec.geometry.pitch == SPEC.geometry.pitch
    assert spec.mass.total == pytest.approx(SPEC.mass.total / 5 * (segments + 1))
    assert spec.phase_step == SPEC.phase_step


def test_tasks_take_turns_and_the_order_turns_as_well():
    called: list[str] = []
    tasks = {name: Task(lambda name=name: called.append(name)) for name in "abc"}
    times = interleaved(tasks, rounds=3)
    assert "".join(called) == "abccbaabc"
    assert {name: len(timing.seconds) for name, timing in times.items()} == {"a": 3, "b": 3, "c": 3}


def test_efficiency_of_threads_is_that_of_the_rounds_nothing_disturbed():
    wall = {1: Timing((4.0, 9.0, 4.4)), 2: Timing((7.0, 2.5, 8.0))}
    cost = ThreadCost(wall, processor={1: Timing((4.0, 4.2, 4.1)), 2: Timing((4.6, 4.4, 5.0))})
    assert (cost.efficiency, cost.overhead) == (0.8, 1.1)
    assert cost.speedup.value == pytest.approx(4.4 / 7.0)
    assert json.loads(json.dumps(cost.json()))["wall"]["2"]["median_s"] == 7.0


def test_times_are_per_simulated_second():
    times = interleaved({"nap": Task(lambda: time.sleep(0.02), simulated=0.1)}, rounds=1)
    assert times["nap"].median >= 0.2


def test_ratio_is_that_of_the_medians_with_the_rounds_as_its_spread():
    ratio = Ratio.of(Timing((2.0, 30.0, 4.0, 5.0, 6.0)), Timing((1.0, 1.0, 1.0, 2.0, 1.0)))
    assert (ratio.value, ratio.least, ratio.most) == (5.0, 2.0, 30.0)
    assert str(ratio) == "5 (2 to 30)"


def test_what_is_written_of_the_machine_names_neither_host_nor_user_nor_folder(root):
    written = json.dumps(machine())
    for private in (socket.gethostname(), str(Path.home()), str(root), f"/{getpass.getuser()}/"):
        assert private not in written
    assert machine()["versions"]["mujoco"].startswith("3.")


def test_command_prints_tables_writes_json_and_says_what_it_leaves_out(monkeypatch, capsys, tmp_path):
    def missing(quick: bool) -> Result:
        raise ModuleNotFoundError("No module named 'elastica'", name="elastica")

    result = Result("(a) one against another", ["what", "ratio"], [["one", "2"]], {"ratio": 2.0}, ["Remark."])
    monkeypatch.setattr(speed, "BENCHMARKS", {"a": lambda quick: result, "c": missing})
    monkeypatch.setattr("sys.argv", ["speed.py", "--quick", "--json", str(tmp_path / "speed.json")])
    speed.main()
    out, err = capsys.readouterr()
    assert "(a) one against another\n\n| what | ratio |\n| --- | --- |\n| one | 2 |\n\nRemark.\n" in out
    assert "(c) left out: PyElastica is not installed: `uv run --group benchmarks" in err
    found = json.loads((tmp_path / "speed.json").read_text("utf-8"))
    assert found["a"] == {"title": "(a) one against another", "ratio": 2.0}
    assert found["quick"] is True and "c" not in found and found["machine"]["cpus"] >= 1


@pytest.mark.slow
@pytest.mark.parametrize("threads", [1, 2])
def test_twins_stepped_together_are_single_twins_to_the_bit(threads):
    document = load_scenario("gen2_straight").document
    scenarios = [
        parse_scenario({**document, "duration_s": 2.0, "supply": {"pressure_kpa": pressure}})
        for pressure in (42.0, 48.0, 54.0)
    ]
    for scenario, run in zip(scenarios, run_together(scenarios, threads), strict=True):
        twin = scenario.build_plant("twin", contact=PreloadedContact())
        alone = rollout(twin, scenario.build_controller(), scenario.duration)
        assert run.columns.keys() == alone.columns.keys()
        for name in alone.columns:
            assert run[name].tobytes() == alone[name].tobytes(), name


def test_the_vector_of_environments_is_timed_against_the_same_crawling():
    """Where each snake gets to, whatever its heading at the start."""
    vector, plain = Vector(2, 1), Plain(2, 1, 0.1)
    whole = Plain(2, 1, 1.0)
    for each in (vector, plain, whole):
        each.run(1.0)
    way = np.hypot(*plain._batch.state.com.T)
    assert way.min() > 0.1
    assert np.hypot(*whole._batch.state.com.T) == pytest.approx(way, abs=1e-9)
    for env, made in zip(vector._envs.envs, way, strict=True):
        assert np.hypot(*env.episode.state.com) == pytest.approx(made, abs=1e-5)
        assert not env.episode.ending
