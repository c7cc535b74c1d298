"""Wrong types and units given to the Python interface are named where they were given."""

from __future__ import annotations

import pickle
import sys

import numpy as np
import pytest

import srs_twin as srs
from srs_twin.errors import InputError
from srs_twin.io.arguments import checked
from srs_twin.io.validation import describe_schema
from srs_twin.robot.world import Goal, Pose, World

pytestmark = pytest.mark.fast


@pytest.fixture(scope="module")
def spec():
    return srs.load_robot("gen2")


@pytest.fixture(scope="module")
def snake(spec):
    return srs.AnalyticalSnake(spec)


@pytest.fixture(scope="module")
def run(snake):
    return srs.rollout(snake, srs.Gait(2.0), 0.2)


@pytest.mark.parametrize("plant", [srs.AnalyticalSnake, srs.TwinSnake])
@pytest.mark.parametrize("given", ["gen2", None])
def test_plants_need_a_loaded_robot(plant, given):
    with pytest.raises(
        InputError, match=rf"{plant.__name__}: spec .*load_robot\('gen2'\)"
    ):
        plant(given)


@pytest.mark.parametrize("plant", [srs.AnalyticalSnake, srs.TwinSnake])
@pytest.mark.parametrize(
    ("supply_pa", "unit"),
    [(np.float64(48.3), "kPa"), (0.483, "bar"), (7.0, "psi")],
)
def test_a_supply_pressure_in_another_unit_is_refused(spec, plant, supply_pa, unit):
    with pytest.raises(
        InputError, match=rf"supply_pa.* did you mean 48\d\d\d.* {unit}\)"
    ):
        plant(spec, supply_pa=supply_pa)


@pytest.mark.parametrize("supply_pa", [-48e3, float("nan"), float("inf")])
def test_impossible_supply_pressures_are_refused(spec, supply_pa):
    with pytest.raises(
        InputError, match="supply_pa.* a finite pressure of at least 0 Pa"
    ):
        srs.TwinSnake(spec, supply_pa=supply_pa)


@pytest.mark.parametrize(
    ("wrong", "words"),
    [
        ({"plant": "gen2"}, r"plant 'gen2' .* TwinSnake\(load_robot\('gen2'\)\)"),
        ({"plant": srs.TwinSnake}, "plant the class TwinSnake"),
        ({"controller": "gait"}, r"controller 'gait' .* Gait\(2.0\)"),
        ({"controller": srs.Gait}, "controller the class Gait"),
        ({"duration": "3"}, "duration '3' .* a number"),
        ({"record_hz": None}, "record_hz None .* a number"),
        ({"pose": (0, 0)}, r"pose \(0, 0\) .* 3 numbers"),
        ({"seed": 0.5}, "seed 0.5 .* a whole number"),
        ({"until": 3}, "until 3 .* a function or None"),
        ({"observers": print}, "observers .* a list"),
    ],
)
def test_rollout_names_the_wrong_argument(snake, wrong, words):
    right = {"plant": snake, "controller": srs.Gait(2.0), "duration": 0.2}
    with pytest.raises(InputError, match=f"rollout: {words}"):
        srs.rollout(**right | wrong)


def test_rollout_of_a_robot_says_how_to_build_a_plant(spec):
    with pytest.raises(InputError, match="plant of type RobotSpec .* TwinSnake"):
        srs.rollout(spec, srs.Gait(2.0), 0.2)


@pytest.mark.parametrize(
    ("call", "words"),
    [
        (lambda: srs.Gait("2.0"), "Gait: frequency '2.0' .* a number"),
        (lambda: srs.Gait(2.0, "left"), "Gait: offset 'left'"),
        (lambda: srs.load_robot(2), "load_robot: .* a text or a path"),
        (lambda: srs.load_scenario(None), "load_scenario: .* a text or a path"),
        (
            lambda: srs.compare("gen2_straight", "gen2_turn"),
            "compare: candidate 'gen2_turn'",
        ),
        (
            lambda: srs.compare("gen2_straight", set="duration_s=2"),
            "compare: set .* a mapping",
        ),
        (lambda: srs.compare(3), "compare: reference 3"),
        (lambda: srs.plan("follow_fig57"), "plan: problem .* plan_scenario"),
        (
            lambda: srs.Problem((0, 0), Goal(1, 0, None, 0.1), World(), "gen2_gait"),
            r"Problem: start \(0, 0\) .* a Pose, such as Pose\(0, 0, 0\)",
        ),
        (
            lambda: srs.Problem(
                Pose(0, 0, 0), Goal(1, 0, None, 0.1), World(), "gen2_gait"
            ),
            r"Problem: footprint 'gen2_gait' .* load_footprint\('gen2_gait'\)",
        ),
        (lambda: srs.Job("gen2", srs.Gait(2.0), 1.0), "Job: plant 'gen2'"),
        (lambda: srs.run_many([("gen2", 1)]), "run_many: jobs .* each a Job"),
        (
            lambda: srs.run_scripts(None, srs.Gait(2.0), 1.0),
            "run_scripts: controllers of type Gait .* a list, each a Controller",
        ),
        (
            lambda: srs.run_batch(None, srs.Gait(2.0), 1.0),
            "run_batch: policy .* a func",
        ),
        (lambda: srs.TwinBatch(["gen2"]), "TwinBatch: specs .* each a RobotSpec"),
        (
            lambda: srs.TwinSnake(srs.load_robot("gen2"), world={}),
            "TwinSnake: world {} .* a World",
        ),
    ],
)
def test_the_wrong_argument_is_named(call, words):
    with pytest.raises(InputError, match=words):
        call()


@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("com", "did you mean com_x or com_y"),
        ("bends", "did you mean"),
        (0, "unknown column '0'"),
    ],
)
def test_an_unknown_column_suggests_similar_ones(run, name, words):
    for kind in (InputError, KeyError):  # a trajectory is a mapping, too
        with pytest.raises(kind) as error:
            run[name]
        assert words in str(error.value) and '"' not in str(error.value)
    copy = pickle.loads(pickle.dumps(error.value))
    assert str(copy) == str(error.value)


def test_numpy_numbers_and_arrays_are_numbers(snake):
    gait = srs.Gait(np.int64(2))
    duration = np.float32(0.5)
    run = srs.rollout(snake, gait, duration, pose=np.zeros(3), seed=np.int64(1))
    assert run.time == pytest.approx(np.arange(51) / 100)


def test_missing_and_unknown_arguments_are_reported_by_python():
    @checked
    def function(number: float) -> float:
        return number

    assert function(2) == 2
    with pytest.raises(
        TypeError, match="missing 1 required positional argument: 'number'"
    ):
        function()
    with pytest.raises(TypeError, match="unexpected keyword argument 'size'"):
        function(1.0, size=2)


def test_a_data_frame_has_time_as_its_index_and_all_units(run):
    frame = run.to_pandas()
    assert frame.index.name == "time" and (frame.index == run.time).all()
    assert set(frame.columns) == set(run.columns) - {"time"}
    assert all((frame[name] == run[name]).all() for name in frame.columns)
    units = frame.attrs["units"]
    assert (units["time"], units["com_x"], units["pressure_plus_1"]) == ("s", "m", "Pa")
    assert units == {name: run.unit(name) for name in run.columns}


def test_a_data_frame_without_pandas_names_the_package(run, monkeypatch):
    monkeypatch.setitem(sys.modules, "pandas", None)
    with pytest.raises(
        InputError, match="needs the optional package pandas; .*`pip install pandas`"
    ):
        run.to_pandas()


def test_three_kinds_of_blocks_are_described_as_one():
    def block(key):
        return {"type": "object", "properties": {key: {"type": "number"}}}

    two = {"anyOf": [block("a"), block("b")]}
    assert describe_schema(two, {}) == "a block of keys (a) or a block of keys (b)"
    three = {"anyOf": [block("a"), {"type": "boolean"}, block("b"), block("c")]}
    assert describe_schema(three, {}) == "a block of keys or true or false"
