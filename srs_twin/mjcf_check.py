"""Check MJCF that may come from anybody: in a child process, with limits on time and memory.

A file of a hundred bytes can keep MuJoCo's compiler busy for minutes, and MuJoCo itself accepts paths that
lead out of the model's folder, time steps of NaN and negative friction. What passes here opens in any
MuJoCo program and stands a second of random control without a warning.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
import xml.etree.ElementTree as ElementTree
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from srs_twin.errors import InputError

TIME_LIMIT_S = 30
MEMORY_LIMIT_BYTES = 4 << 30
SIZE_LIMIT_BYTES = 20 << 20
CONTROL_S = 1.0
_REDRAW_S = 0.02
_PATHS = ("file", "assetdir", "meshdir", "texturedir")


@dataclass(frozen=True)
class ModelReport:
    """What a check found.

    Attributes:
        faults: one line each; empty where the model is fit for use.
        sizes: what the compiled model has: bodies, joints, actuators, mass_kg, timestep_s.
    """

    faults: tuple[str, ...]
    sizes: dict[str, float] = field(default_factory=dict)


def check_mjcf(path: Path, *, time_limit_s: int = TIME_LIMIT_S) -> ModelReport:
    """Compile a model in a child process and give it a second of random control.

    Args:
        path: the MJCF file.
        time_limit_s: most that the child may take, s.

    Raises:
        InputError: there is no such file.
    """
    if not path.is_file():
        raise InputError(f"{path}: no such file; give an MJCF file or the name of a shipped robot")
    if path.stat().st_size > SIZE_LIMIT_BYTES:
        return ModelReport((f"over {SIZE_LIMIT_BYTES >> 20} MB of XML",))
    command = [sys.executable, "-m", "srs_twin.mjcf_check", str(path.resolve()), str(time_limit_s)]
    # No window system is needed, and threads of numpy's would count as memory.
    env = {**os.environ, "MUJOCO_GL": "disabled", "OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1"}
    with tempfile.TemporaryDirectory() as room:  # MuJoCo leaves its log file where it runs
        try:
            child = subprocess.run(
                command, cwd=room, env=env, capture_output=True, text=True, timeout=time_limit_s
            )
        except subprocess.TimeoutExpired:
            return ModelReport((f"did not finish within {time_limit_s} s",))
    try:
        found = json.loads(child.stdout)
    except ValueError:
        said = child.stderr.strip().splitlines()
        reason = said[-1] if said else f"exit status {child.returncode}"
        return ModelReport(
            (f"broke MuJoCo or a limit ({MEMORY_LIMIT_BYTES >> 30} GB, {time_limit_s} s): {reason}",)
        )
    return ModelReport(tuple(found["faults"]), found["sizes"])


def _stray_paths(path: Path, folder: Path, seen: set[Path]) -> list[str]:
    """Return a fault for each path in a file, and in what it includes, that leads out of the folder."""
    seen.add(path)
    try:
        tree = ElementTree.parse(path)
    except (ElementTree.ParseError, UnicodeDecodeError, OSError) as error:
        return [f"{path.name}: not readable as XML ({error})"]
    faults = []
    for element in tree.iter():
        for given in filter(None, (element.get(name) for name in _PATHS)):
            target = (folder / given).resolve()
            if not target.is_relative_to(folder):
                faults.append(f"{path.name}: <{element.tag}> names '{given}', outside the model's folder")
            elif element.tag == "include" and target not in seen and target.is_file():
                faults += _stray_paths(target, folder, seen)
    return faults


def _bad_numbers(model: Any) -> list[str]:
    """Return a fault for each number that MuJoCo compiles but no body can have."""
    faults = []
    if not (np.isfinite(model.opt.timestep) and model.opt.timestep > 0):
        faults.append(f"timestep {model.opt.timestep} is not allowed; it must be finite and above 0")
    for name in ("geom_friction", "pair_friction", "dof_damping", "dof_frictionloss", "body_mass"):
        if (getattr(model, name) < 0).any():
            faults.append(f"{name} has a negative value")
    for name in dir(model):
        value = None if name.startswith("_") else getattr(model, name)
        if isinstance(value, np.ndarray) and value.dtype.kind == "f" and not np.isfinite(value).all():
            faults.append(f"{name} has a value that is not finite")
    return faults


def _shake(model: Any) -> list[str]:
    """Simulate `CONTROL_S` under random control; return what MuJoCo warned of."""
    import mujoco

    data = mujoco.MjData(model)
    if model.nkey:
        mujoco.mj_resetDataKeyframe(model, data, 0)
    rng = np.random.default_rng(0)
    low, high = np.where(model.actuator_ctrllimited[:, None], model.actuator_ctrlrange, [-1.0, 1.0]).T
    redraw = max(1, round(_REDRAW_S / model.opt.timestep))
    for step in range(max(1, round(CONTROL_S / model.opt.timestep))):
        if step % redraw == 0:
            data.ctrl[:] = rng.uniform(low, high)
        mujoco.mj_step(model, data)
    faults = [
        f"{CONTROL_S:g} s of random control raised the warning {name.removeprefix('mjWARN_')}"
        for name, kind in mujoco.mjtWarning.__members__.items()
        if name.startswith("mjWARN_") and data.warning[kind].number
    ]
    if not np.isfinite(data.qpos).all():
        faults.append(f"{CONTROL_S:g} s of random control ended in a state that is not finite")
    return faults


def _examine(path: Path) -> dict[str, Any]:
    import mujoco

    faults = _stray_paths(path, path.parent, set())
    if faults:
        return {"faults": faults, "sizes": {}}
    try:
        model = mujoco.MjModel.from_xml_path(str(path))
    except ValueError as error:
        return {"faults": [f"does not compile: {' '.join(str(error).split())}"], "sizes": {}}
    faults = _bad_numbers(model) or _shake(model)
    sizes = {
        "bodies": model.nbody - 1,
        "joints": model.njnt,
        "actuators": model.nu,
        "mass_kg": float(model.body_mass.sum()),
        "timestep_s": model.opt.timestep,
    }
    return {"faults": faults, "sizes": sizes}


def _child(path: str, time_limit_s: str) -> None:
    import resource

    resource.setrlimit(resource.RLIMIT_AS, (MEMORY_LIMIT_BYTES, MEMORY_LIMIT_BYTES))
    resource.setrlimit(resource.RLIMIT_CPU, (int(time_limit_s), int(time_limit_s)))
    json.dump(_examine(Path(path)), sys.stdout)


if __name__ == "__main__":
    _child(*sys.argv[1:])
