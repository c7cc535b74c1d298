"""Exported models: what a robot file states reaches the MJCF, is named as missing, or stops the export."""

from __future__ import annotations

import copy
import math
import os
from pathlib import Path

import mujoco
import numpy as np
import pytest
from conftest import ROOT
from pages import Page

from srs_twin import Gait, InputError, TwinSnake, load_robot, load_scenario, rollout
from srs_twin.io.documents import dump_yaml
from srs_twin.io.files import shipped_names
from srs_twin.plants.twin.mjcf.export import (
    SCENE,
    SCENE_MJX,
    describe_departures,
    robot_files,
    write_files,
)
from srs_twin.pneumatics.chambers import equivalent_linear_pressure
from srs_twin.robot.file import RobotFile, load_robot_file, section_units
from srs_twin.studies.sweep.loading import load_sweep

ROBOTS = ("gen1", "gen2", "gen3", "gen4")
DEAD_ZONE = {
    "onset_fraction": 1.0,
    "dead_zone_rad": 0.3,
    "dead_zone_transition_rad": 0.1,
}
BEND_LIMIT = {"bend_limit_rad": 1.571}


def changed(base: str, **sections: dict[str, object]) -> RobotFile:
    """Return a shipped robot with other numbers."""
    data = load_robot_file(base).model_dump()
    for section, numbers in sections.items():
        units = section_units(section)
        records = {
            key: {
                "value": value,
                "unit": units[key],
                "status": "estimated",
                "source": "test",
            }
            for key, value in numbers.items()
        }
        data[section] = (data[section] or {}) | records
    return RobotFile.model_validate(data)


def save(path: Path, robot: RobotFile) -> None:
    """Write a robot file; the name of the robot becomes the stem of the path."""
    path.write_text(
        dump_yaml(robot.model_dump(exclude_none=True) | {"name": path.stem}), "utf-8"
    )


def exported(tmp_path, robot: RobotFile, scene: str = SCENE) -> mujoco.MjModel:
    write_files(robot_files(robot.spec(), linear=True), tmp_path)
    return mujoco.MjModel.from_xml_path(str(tmp_path / scene))


def at_home(model: mujoco.MjModel) -> mujoco.MjData:
    data = mujoco.MjData(model)
    mujoco.mj_resetDataKeyframe(model, data, model.key("home").id)
    return data


def step_pressures(twin: TwinSnake, frequency: float, duration: float) -> np.ndarray:
    """Return the pressures of a gait at the beginning of each time step, shape (steps, segments, 2), Pa."""
    gait = Gait(frequency)
    chambers = copy.deepcopy(twin.pneumatics)
    gait.reset(twin.spec, twin.tick)
    chambers.reset()
    times = twin.timestep * np.arange(round(duration / twin.timestep))
    return chambers.advance(gait.script(duration), times).pressure


def distance(model: mujoco.MjModel, data: mujoco.MjData) -> float:
    """Return the distance of the centre of mass from its place at home, m."""
    home = at_home(model)
    mujoco.mj_forward(model, home)
    return float(np.linalg.norm(data.subtree_com[1] - home.subtree_com[1]))


def driven(
    model: mujoco.MjModel, controls: np.ndarray, pose: np.ndarray | None = None
) -> mujoco.MjData:
    """Return the state of a model after it has followed chamber controls, one row per time step.

    Args:
        model: the model.
        controls: chamber controls of each step, Pa.
        pose: initial position and quaternion of its root, shape (7,); None for those of
            `home`.
    """
    data = at_home(model)
    if pose is not None:
        data.qpos[:7] = pose
    for row in controls.reshape(len(controls), -1):
        data.ctrl[: len(row)] = row
        mujoco.mj_step(model, data)
    return data


CASES = {
    "gen2": (load_robot_file("gen2"), 48.3, 1e-9),
    "gen3": (load_robot_file("gen3"), 48.3, 1e-9),
    "gen4": (load_robot_file("gen4"), 131.0, 1e-9),
    "bias": (changed("gen4", modules={"bias_rad": [0.2, 0.0, -0.1, 0.0]}), 51.0, 1e-9),
    "drag": (changed("gen2", friction={"drag_n": 0.05}), 48.3, 1e-9),
    # The file applies the bend law before the lag, the twin after it.
    "bend law": (changed("gen4", actuator=DEAD_ZONE | BEND_LIMIT), 131.0, 1e-3),
    # MuJoCo's filter holds its control over a step.
    "damped": (changed("gen2", bending={"damping_time_s": 0.008}), 48.3, 1e-3),
    "gen1": (load_robot_file("gen1"), 25.9, 1e-3),
}


@pytest.mark.default_cases(at=[0, 4, 5, 6])
@pytest.mark.parametrize(("robot", "supply_kpa", "largest"), CASES.values(), ids=CASES)
def test_exported_model_follows_the_preloaded_twin(
    tmp_path, robot, supply_kpa, largest
):
    """Nominal models agree to rounding, although the file knows neither the valves nor the package."""
    spec = robot.spec()
    twin = TwinSnake(spec, contact="preloaded", supply_pa=1e3 * supply_kpa)
    controls = equivalent_linear_pressure(spec, step_pressures(twin, 1.5, 1.0))
    qpos = rollout(twin, Gait(1.5), 1.0).stack("qpos")
    model = exported(tmp_path, robot)
    if robot.bending.damping_time_s.value != robot.actuator.tau_mode_s.value:
        assert model.actuator(model.nu - 1).name == "minus_4_lag"
        controls = controls.reshape(len(controls), -1)
        constant = np.zeros((len(controls), model.nu - 2 * controls.shape[1]))
        mean = (controls + np.vstack([controls[1:], controls[-1:]])) / 2
        controls = np.hstack([controls, constant, mean])
    data = driven(model, controls, pose=qpos[0, :7])
    assert np.abs(qpos[-1, 7:]).max() > 0.1
    joints = [
        j for j in range(model.njnt) if not model.joint(j).name.startswith("axle")
    ]
    places = model.jnt_qposadr[joints[1:]]
    assert data.qpos[places] == pytest.approx(qpos[-1, places], abs=largest)
    assert data.qpos[:3] == pytest.approx(qpos[-1, :3], abs=largest)


@pytest.mark.slow
def test_shipped_model_gets_the_supply_of_every_shipped_scenario(root):
    """No supply of a scenario or sweep exceeds the range of the controls."""
    limits = {}
    for name in (*ROBOTS, "gen4_module"):
        model = mujoco.MjModel.from_xml_path(str(root / f"models/{name}/{SCENE}"))
        limits[name] = model.actuator("plus_1").ctrlrange[1]
    supplies = [
        (scenario.robot.name, scenario.supply_pa)
        for scenario in map(load_scenario, shipped_names("scenario"))
    ]
    for name in shipped_names("sweep"):
        swept = load_sweep(name)
        pressures = (
            point.changes.get("supply.pressure_kpa", 0.0) for point in swept.points
        )
        robot = swept.experiment.base["robot"]["name"]
        supplies += [(robot, 1e3 * pressure) for pressure in pressures]
    assert {robot for robot, _ in supplies} >= set(limits)
    assert [
        (robot, supply)
        for robot, supply in supplies
        if supply > limits.get(robot, math.inf)
    ] == []


def complete_robot() -> RobotFile:
    """Return a robot on wheels with every optional number that such a robot may have."""
    rows = [[1.0, 1.1]] * 2
    return changed(
        "gen4",
        geometry={"connectors": 3},
        mass={"connector_gyration_m": 0.02},
        friction={"drag_n": 0.05},
        actuator=DEAD_ZONE | BEND_LIMIT | {"onset_fraction": 0.5},
        modules={
            "gain": rows,
            "tau_fill": rows,
            "tau_vent": rows,
            "bias_rad": [0.1] * 2,
            "sensor_gain": [1.1] * 2,
            "sensor_bias_rad": [0.1] * 2,
            "gain_spread": 0.1,
            "tau_spread": 0.1,
            "bias_spread_rad": 0.1,
            "sensor_gain_spread": 0.1,
            "sensor_bias_spread_rad": 0.1,
        },
    )


def larger(value):
    """Return a number, or all numbers of a list, larger by a thousandth or by one; 0 increases, too."""
    if isinstance(value, list):
        return [larger(entry) for entry in value]
    return value + 1 if isinstance(value, int) else 1.001 * value + 1e-6


NOT_OF_THE_BODY = {
    "supply.nominal_kpa",
    "supply.continuous_limit_kpa",
    "gait.phase_step_rad",
}
"""Numbers for valves and gaits; of two limits, the files have the larger one."""

FREE_BEND_ONLY = {"actuator.tau_mode_s"}
"""Numbers that the twin does not use: the bodies lag by their own damping."""


@pytest.mark.slow
def test_every_number_reaches_the_files_or_is_named_as_missing():
    robot = complete_robot()
    before = robot_files(robot.spec(), linear=True)
    lines = {line.partition(" = ")[0]: line for line in describe_departures(robot)}
    silent = []
    untrue = []
    for path, record in robot.records().items():
        section, key = path.split(".")
        if path == "geometry.connectors":  # the lists of the modules would not fit
            continue
        data = robot.model_dump()
        data[section][key]["value"] = larger(record.value)
        reached = (
            robot_files(RobotFile.model_validate(data).spec(), linear=True) != before
        )
        left_out = "is left out" in lines.get(path, "")
        if (
            not reached
            and not left_out
            and path not in NOT_OF_THE_BODY | FREE_BEND_ONLY
        ):
            silent.append(path)
        if reached and left_out:
            untrue.append(path)
    assert (silent, untrue) == ([], [])


def test_lines_state_the_field_the_value_and_the_consequence(tmp_path, srs_twin):
    sensors = {"sensor_gain": [1.0, 1.1, 1.0, 1.0]}
    save(
        tmp_path / "limited.yaml", changed("gen4", actuator=BEND_LIMIT, modules=sensors)
    )
    done = srs_twin("models", "export", "limited.yaml", "--out", "here", cwd=tmp_path)
    assert (done.returncode, done.stdout) == (
        0,
        "here/limited/scene.xml\n",
    ), done.stderr
    assert {
        (
            "limited: actuator.bend_limit_rad = 1.571 rad is approximate, because"
            " bends near it are up to 19 % too large; convert pressures with"
            " equivalent_linear_pressure (models/README.md)"
        ),
        (
            "limited: modules.sensor_gain = [1.0, 1.1, 1.0, 1.0] is left out, because"
            " the tendon lengths are the exact bends"
        ),
        (
            "limited: friction.mu_n = 0.57 is approximate, because it acts on the"
            " static loads and no wheel lifts"
        ),
    } <= set(done.stderr.splitlines())


def test_dead_zone_is_refused_before_anything_is_written(tmp_path, srs_twin):
    save(tmp_path / "stiff.yaml", changed("gen4", actuator={"dead_zone_rad": 0.3}))
    words = "models", "export", "gen2", "stiff.yaml", "--out", "here"
    done = srs_twin(*words, cwd=tmp_path)
    assert (done.returncode, done.stdout) == (2, "")
    assert (
        "stiff has a dead zone (`actuator.onset_fraction` 1, `dead_zone_rad` 0.3 rad)"
        in done.stderr
    )
    assert (
        "Export it with --linear if you convert its controls (models/README.md)"
        in done.stderr
    )
    assert not (tmp_path / "here").exists()
    done = srs_twin(*words, "--linear", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert (
        "stiff: actuator.dead_zone_rad = 0.3 rad is left out; convert pressures with"
        in done.stderr
    )


def test_pressure_option_raises_the_limit_of_the_controls(tmp_path, srs_twin):
    for option, limit in (
        ((), 68.94757),
        (("--pressure", "10"), 68.94757),
        (("--pressure", "77"), 77.0),
    ):
        done = srs_twin(
            "models", "export", "gen2", *option, "--out", "here", cwd=tmp_path
        )
        assert done.returncode == 0, done.stderr
        model = mujoco.MjModel.from_xml_path(str(tmp_path / "here/gen2/scene.xml"))
        assert model.actuator("plus_1").ctrlrange == pytest.approx([0.0, 1e3 * limit])


def test_moment_of_the_air_ends_at_the_bend_limit(tmp_path):
    robot = changed("gen4", actuator=BEND_LIMIT)
    model = exported(tmp_path, robot)
    spec = robot.spec()
    data = at_home(model)
    for pressure in (30e3, 131e3):
        data.actuator("minus_2").ctrl = pressure
        mujoco.mj_forward(model, data)
        moment = data.qfrc_actuator[model.joint("hinge_2_1").dofadr[0]]
        free_bend = min(spec.actuator.gain * pressure, spec.actuator.bend_limit)
        assert moment == pytest.approx(-spec.bending.stiffness * free_bend)


def test_home_has_the_rest_bends_of_unequal_modules(tmp_path):
    bias = [0.2, 0.0, -0.1, 0.05]
    model = exported(tmp_path, changed("gen4", modules={"bias_rad": bias}))
    data = at_home(model)
    mujoco.mj_forward(model, data)
    assert data.ten_length == pytest.approx(bias, abs=1e-15)
    assert np.abs(data.qfrc_spring).max() < 1e-15


@pytest.mark.default_cases(1)
@pytest.mark.parametrize("name", ROBOTS)
def test_mjx_scene_moves_as_the_scene(root, name):
    """It lacks what MJX and MuJoCo Warp refuse; its integrator changes the distance by up to 2 %."""
    spec = load_robot(name)
    pressure = step_pressures(TwinSnake(spec, contact="preloaded"), 1.5, 2.0)
    files = [str(root / f"models/{name}/{scene}") for scene in (SCENE, SCENE_MJX)]
    exact, model = map(mujoco.MjModel.from_xml_path, files)
    assert (model.nsensor, model.opt.disableflags) == (0, 0)
    assert model.opt.integrator == mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    expected = distance(exact, driven(exact, pressure))
    assert expected > 0.02
    assert distance(model, driven(model, pressure)) == pytest.approx(expected, rel=0.02)


@pytest.mark.parametrize("name", ["skin_example", "spatial_example"])
def test_robot_without_wheels_is_refused(name):
    with pytest.raises(InputError, match=f"{name} cannot be exported"):
        robot_files(load_robot(name))


def test_tail_on_two_axles_is_refused():
    tail = {"axle_m": 0.05, "com_m": 0.02, "com_height_m": 0.02, "gyration_m": 0.02}
    with pytest.raises(InputError, match="a tail on two axles; use contact 'loaded'"):
        robot_files(changed("gen2", tail=tail).spec())


DM_CONTROL = [
    block.text
    for block in Page(ROOT / "models/README.md").blocks
    if block.language == "py"
]


@pytest.mark.parametrize("block", DM_CONTROL, ids=["arena", "attached"])
def test_dm_control_lines_of_the_readme_move_as_the_scene(root, monkeypatch, block):
    """dm_control writes seven digits, so paths agree to that accuracy."""
    pytest.importorskip("dm_control")
    monkeypatch.chdir(root)
    monkeypatch.setitem(os.environ, "MUJOCO_GL", "disable")
    found: dict[str, object] = {}
    exec(block, found)
    model = found["physics"].model.ptr
    scene = mujoco.MjModel.from_xml_path(f"models/gen2/{SCENE}")
    pressure = step_pressures(
        TwinSnake(load_robot("gen2"), contact="preloaded"), 2.0, 1.0
    )
    expected = driven(scene, pressure).ten_length
    data = mujoco.MjData(model)
    for row in pressure.reshape(len(pressure), -1):
        data.ctrl[: len(row)] = row
        mujoco.mj_step(model, data)
    assert data.ncon == 10
    assert data.ten_length == pytest.approx(expected, abs=1e-3)
