"""Exported models in other programs: whether they load and step, and their speed against the preloaded twin.

    uv run python benchmarks/exported_models.py                       # programs installed here
    uv run python benchmarks/exported_models.py --python mjx=/tmp/mjx/bin/python --robots gen2

Each program runs in a process of its own, which needs the program and NumPy only. It
gets an exported scene and the chamber pressures of the twin at the beginning of each
time step, and prints the mean speed.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import tempfile
from collections.abc import Callable
from dataclasses import replace
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np

FREQUENCY_HZ = 1.5
PERIODS = 3  # the speed is the mean over all periods but the first

SUPPLY_KPA = {
    "gen1": 25.9,
    "gen2": 48.3,
    "gen3": 48.3,
    "gen4": 51.0,
    "dead_zone": 51.0,
    "limited": 131.0,
    "limited_raw": 131.0,
}
"""Robot → supply pressure.

The last three are generation 4 with a dead zone and with a limit of the bends.
"""

CHANGES = {
    "dead_zone": {"onset_fraction": 1.0, "onset": 0.3, "onset_width": 0.1},
    "limited": {"bend_limit": 1.571},
    "limited_raw": {"bend_limit": 1.571},
}

Path2 = list[list[float]]
"""x and y of the centre of mass after each time step, m."""


def run_mujoco(folder: Path, controls: np.ndarray) -> Path2:
    """Step `scene.xml` in MuJoCo."""
    import mujoco

    model = mujoco.MjModel.from_xml_path(str(folder / "scene.xml"))
    return _stepped(model, controls)


def run_dm_control(folder: Path, controls: np.ndarray) -> Path2:
    """Step `scene.xml` as an arena of dm_control."""
    from dm_control import mjcf

    return _stepped(
        mjcf.Physics.from_mjcf_model(
            mjcf.from_path(str(folder / "scene.xml"))
        ).model.ptr,
        controls,
    )


def run_mjx(folder: Path, controls: np.ndarray) -> Path2:
    """Step `scene_mjx.xml` in MJX on JAX."""
    import jax
    import mujoco
    from mujoco import mjx

    model = mujoco.MjModel.from_xml_path(str(folder / "scene_mjx.xml"))
    device_model = mjx.put_model(model, impl="jax")

    @jax.jit
    def run(data: Any, rows: Any) -> Any:
        def step(data: Any, row: Any) -> tuple[Any, Any]:
            data = mjx.step(device_model, data.replace(ctrl=row))
            return data, data.subtree_com[1][:2]

        return jax.lax.scan(step, data, rows)[1]

    start = mjx.put_data(model, _at_home(model), impl="jax")
    return np.asarray(run(start, _all_controls(model, controls))).tolist()


def run_mujoco_warp(folder: Path, controls: np.ndarray) -> Path2:
    """Step `scene_mjx.xml` in MuJoCo Warp on the processor."""
    import mujoco
    import mujoco_warp as mjw

    model = mujoco.MjModel.from_xml_path(str(folder / "scene_mjx.xml"))
    device_model = mjw.put_model(model)
    data = mjw.put_data(model, _at_home(model), nconmax=64, njmax=256)
    path = []
    for row in _all_controls(model, controls):
        data.ctrl.assign(row[None].astype(np.float32))
        mjw.step(device_model, data)
        path.append(data.subtree_com.numpy()[0, 1, :2].tolist())
    return path


def run_newton(folder: Path, controls: np.ndarray) -> Path2:
    """Step `scene_mjx.xml` in Newton with its MuJoCo solver; controls go to the actuators of MuJoCo."""
    import mujoco
    import newton

    rows = _all_controls(
        mujoco.MjModel.from_xml_path(str(folder / "scene_mjx.xml")), controls
    )
    builder = newton.ModelBuilder()
    newton.solvers.SolverMuJoCo.register_custom_attributes(builder)
    builder.add_mjcf(str(folder / "scene_mjx.xml"))
    model = builder.finalize(device="cpu")
    solver = newton.solvers.SolverMuJoCo(model, use_mujoco_cpu=True)
    before = model.state()
    after = model.state()
    control = model.control()
    masses = model.body_mass.numpy()
    path = []
    for row in rows:
        control.mujoco.ctrl.assign(row.astype(np.float32))
        solver.step(before, after, control, None, 0.001)
        before, after = after, before
        path.append((masses @ before.body_q.numpy()[:, :2] / masses.sum()).tolist())
    return path


def run_drake(folder: Path, controls: np.ndarray) -> Path2:
    """Load `scene.xml` in Drake, which ignores the actuators, and let it go."""
    from pydrake.multibody.parsing import Parser
    from pydrake.multibody.plant import AddMultibodyPlantSceneGraph
    from pydrake.systems.analysis import Simulator
    from pydrake.systems.framework import DiagramBuilder

    builder = DiagramBuilder()
    plant, _ = AddMultibodyPlantSceneGraph(builder, 0.001)
    Parser(plant).AddModels(str(folder / "scene.xml"))
    plant.Finalize()
    simulator = Simulator(builder.Build())
    context = plant.GetMyContextFromRoot(simulator.get_mutable_context())
    path = []
    for k in range(len(controls)):
        simulator.AdvanceTo(0.001 * (k + 1))
        path.append(plant.CalcCenterOfMassPositionInWorld(context)[:2].tolist())
    height = plant.CalcCenterOfMassPositionInWorld(context)[2]
    if height < 0:
        raise RuntimeError(
            f"{plant.num_actuators()} actuators, no floor: falls to {height:.1f} m"
        )
    return path


def run_usd(folder: Path, controls: np.ndarray) -> Path2:
    """Convert `scene.xml` to USD, which has no contact pairs."""
    import mujoco_usd_converter

    with tempfile.TemporaryDirectory() as out:
        mujoco_usd_converter.Converter().convert(str(folder / "scene.xml"), out)
        size = sum(path.stat().st_size for path in Path(out).rglob("*.usd*"))
    raise RuntimeError(
        f"converts to {size / 1000:.0f} kB; not simulated: pairs, sensors, keys are"
        " ignored"
    )


PROGRAMS: dict[str, tuple[str, Callable[[Path, np.ndarray], Path2]]] = {
    "mujoco": ("mujoco", run_mujoco),
    "dm_control": ("dm-control", run_dm_control),
    "mjx": ("mujoco-mjx", run_mjx),
    "mujoco_warp": ("mujoco-warp", run_mujoco_warp),
    "newton": ("newton", run_newton),
    "drake": ("drake", run_drake),
    "usd": ("mujoco-usd-converter", run_usd),
}
"""Name → distribution on PyPI, and the function that runs it."""


def _at_home(model: Any) -> Any:
    import mujoco

    data = mujoco.MjData(model)
    mujoco.mj_resetDataKeyframe(model, data, 0)
    mujoco.mj_forward(model, data)
    return data


def _all_controls(model: Any, controls: np.ndarray) -> np.ndarray:
    """Return the controls of all actuators: of the chambers, of their lags if there are any, otherwise 0."""
    values = np.zeros((len(controls), model.nu))
    values[:, : controls.shape[1]] = controls
    lags = [k for k in range(model.nu) if model.actuator(k).name.endswith("_lag")]
    if lags:
        after = np.vstack([controls[1:], controls[-1]])
        values[:, lags] = (controls + after) / 2
    return values


def _stepped(model: Any, controls: np.ndarray) -> Path2:
    import mujoco

    data = _at_home(model)
    path = []
    for row in _all_controls(model, controls):
        data.ctrl[:] = row
        mujoco.mj_step(model, data)
        path.append(data.subtree_com[1][:2].tolist())
    return path


def mean_speed(path: np.ndarray) -> float:
    """Return the mean speed after the first period, m/s, of positions at equal steps of 1 ms."""
    period = round(1000 / FREQUENCY_HZ)
    start = path[-1 - (PERIODS - 1) * period]
    return float(np.linalg.norm(path[-1] - start)) / ((PERIODS - 1) * period * 0.001)


def export(name: str, folder: Path) -> tuple[np.ndarray, float]:
    """Write the files of a robot; return its controls and the speed of the twin.

    Returns:
        Shape (steps, chambers), Pa, and m/s.
    """
    from against_mj_step import step_controls

    from srs_twin import Gait, TwinSnake, load_robot, rollout
    from srs_twin.plants.twin.mjcf.export import robot_files, write_files
    from srs_twin.pneumatics.chambers import equivalent_linear_pressure

    spec = load_robot("gen4" if name in CHANGES else name)
    spec = replace(spec, actuator=replace(spec.actuator, **CHANGES.get(name, {})))
    write_files(robot_files(spec, linear=True), folder)
    twin = TwinSnake(spec, contact="preloaded", supply_pa=1e3 * SUPPLY_KPA[name])
    pressure = step_controls(
        twin, PERIODS / FREQUENCY_HZ, frequency=FREQUENCY_HZ, offset=0.0
    )
    converted = equivalent_linear_pressure(spec, pressure.reshape(len(pressure), -1, 2))
    converted = converted.reshape(len(pressure), -1)
    path = rollout(
        twin, Gait(FREQUENCY_HZ), PERIODS / FREQUENCY_HZ, record_hz=1 / twin.timestep
    ).com[1:]
    return pressure if name == "limited_raw" else converted, mean_speed(path)


def run_elsewhere(python: str, program: str, folder: Path, controls: Path) -> str:
    """Run a program in its own process; return its version and speed, or the reason why there is none."""
    words = [python, __file__, "--child", program, str(folder), str(controls)]
    done = subprocess.run(words, capture_output=True, text=True, check=False)
    lines = done.stdout.splitlines()
    if lines:
        return lines[-1]
    return json.dumps({"reason": done.stderr.strip().splitlines()[-1]})


def child(program: str, folder: str, controls: str) -> None:
    """Run one program and print a JSON line."""
    distribution, run = PROGRAMS[program]
    found: dict[str, Any] = {}
    try:
        found["version"] = version(distribution)
        found["speed"] = mean_speed(np.array(run(Path(folder), np.load(controls))))
    except Exception as error:
        found["reason"] = f"{type(error).__name__}: {error}".splitlines()[0][:200]
    print(json.dumps(found))


def main() -> None:
    """Print a row per program and robot."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument(
        "--programs", nargs="+", default=list(PROGRAMS), choices=PROGRAMS
    )
    parser.add_argument(
        "--robots", nargs="+", default=list(SUPPLY_KPA), choices=SUPPLY_KPA
    )
    parser.add_argument(
        "--python",
        action="append",
        default=[],
        metavar="PROGRAM=PATH",
        help="interpreter that has a program",
    )
    parser.add_argument("--child", nargs=3, help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.child:
        child(*options.child)
        return
    pythons = dict(item.split("=", 1) for item in options.python)
    print(
        "| program | version | robot | speed, m/s | twin, m/s | difference"
        " |\n|---|---|---|---|---|---|"
    )
    for name in options.robots:
        with tempfile.TemporaryDirectory() as temporary:
            folder = Path(temporary)
            file = Path(temporary) / "controls.npy"
            controls, expected = export(name, folder)
            np.save(file, controls)
            for program in options.programs:
                python = pythons.get(program, sys.executable)
                found = json.loads(run_elsewhere(python, program, folder, file))
                result = found.get("reason", "")
                if "speed" in found:
                    result = (
                        f"{found['speed']:.5f} | {expected:.5f} |"
                        f" {found['speed'] / expected - 1:+.2%}"
                    )
                print(
                    f"| {program} | {found.get('version', '')} | {name} | {result} |",
                    flush=True,
                )


if __name__ == "__main__":
    main()
