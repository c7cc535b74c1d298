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
import time
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from srs_twin.files import existing
from srs_twin.mjcf_scan import scan_mjcf

TIME_LIMIT_S = 30
MEMORY_LIMIT_BYTES = 4 << 30
CONTROL_S = 1.0
TIMESTEPS_S = (1e-5, 0.1)
MAX_ITERATIONS = 10_000
_REDRAW_S = 0.02
_PATIENCE_S = 0.5  # of random control, until it is judged how long it will take
_ITERATIONS = ("iterations", "ls_iterations", "noslip_iterations", "ccd_iterations", "sdf_iterations")
_NOT_NEGATIVE = ("geom_friction", "pair_friction", "dof_damping", "dof_frictionloss", "body_mass")


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
    remedy = "; give an MJCF file or the name of a shipped robot"
    model = existing(path, suffix=".xml", remedy=remedy).resolve()
    faults = scan_mjcf(model)
    if faults:
        return ModelReport(tuple(faults))
    command = [sys.executable, "-m", "srs_twin.mjcf_check", str(model), str(time_limit_s)]
    # No window system is needed, and threads of numpy's would count as memory.
    env = {**os.environ, "MUJOCO_GL": "disabled", "OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1"}
    with tempfile.TemporaryDirectory() as room:  # MuJoCo leaves its log file where it runs
        try:
            child = subprocess.run(
                command, cwd=room, env=env, capture_output=True, text=True, timeout=time_limit_s
            )
        except subprocess.TimeoutExpired:
            return ModelReport((f"did not finish within {time_limit_s} s",))
    said = child.stderr.strip().splitlines()
    return verdict(child.stdout, said[-1] if said else f"exit status {child.returncode}", time_limit_s)


def verdict(found: str, ending: str, time_limit_s: int) -> ModelReport:
    """Return what a child found, or that it broke.

    Args:
        found: what it wrote.
        ending: its last words, or how it ended.
        time_limit_s: most that it might take, s.
    """
    try:
        report = json.loads(found)
    except ValueError:
        limits = f"{MEMORY_LIMIT_BYTES >> 30} GB, {time_limit_s} s"
        return ModelReport((f"broke MuJoCo or a limit ({limits}): {ending}",))
    return ModelReport(tuple(report["faults"]), report["sizes"])


def _bad_numbers(model: Any) -> list[str]:
    """Return a fault for each number that MuJoCo compiles but no body can have."""
    faults = []
    low, high = TIMESTEPS_S
    if not low <= model.opt.timestep <= high:
        faults.append(f"timestep {model.opt.timestep:g} s is not allowed; it must be {low:g} to {high:g} s")
    for name in _ITERATIONS:
        if getattr(model.opt, name) > MAX_ITERATIONS:
            faults.append(f"{name} {getattr(model.opt, name)} are not allowed; at most {MAX_ITERATIONS}")
    for name in _NOT_NEGATIVE:
        values = getattr(model, name)
        if (values < 0).any():
            faults.append(f"{name}{_first(values < 0)} has a negative value")
    for name in dir(model):
        value = None if name.startswith("_") else getattr(model, name)
        if isinstance(value, np.ndarray) and value.dtype.kind == "f" and not np.isfinite(value).all():
            faults.append(f"{name}{_first(~np.isfinite(value))} has a value that is not finite")
    return faults


def _first(wrong: np.ndarray) -> str:
    """Return the row of the first True, as it is indexed."""
    return f"[{np.argwhere(np.atleast_1d(wrong))[0][0]}]"


def _shake(model: Any, time_limit_s: float, control_s: float) -> list[str]:
    """Simulate some seconds under random control; return what MuJoCo warned of."""
    import mujoco

    data = mujoco.MjData(model)
    if model.nkey:
        mujoco.mj_resetDataKeyframe(model, data, 0)
    rng = np.random.default_rng(0)
    low, high = np.where(model.actuator_ctrllimited[:, None], model.actuator_ctrlrange, [-1.0, 1.0]).T
    redraw = max(1, round(_REDRAW_S / model.opt.timestep))
    steps = max(1, round(control_s / model.opt.timestep))
    begun = time.monotonic()
    for step in range(steps):
        if step % redraw == 0:
            data.ctrl[:] = rng.uniform(low, high)
        mujoco.mj_step(model, data)
        spent = time.monotonic() - begun
        if spent > _PATIENCE_S and spent / (step + 1) * steps > time_limit_s:
            ahead = spent / (step + 1) * steps
            return [f"{control_s:g} s of random control would take {ahead:.0f} s; at most {time_limit_s} s"]
    faults = [
        f"{control_s:g} s of random control raised the warning {name.removeprefix('mjWARN_')}"
        for name, kind in mujoco.mjtWarning.__members__.items()
        if name.startswith("mjWARN_") and data.warning[kind].number
    ]
    if not np.isfinite(data.qpos).all():
        faults.append(f"{control_s:g} s of random control ended in a state that is not finite")
    return faults


def examine(path: Path, time_limit_s: int, control_s: float = CONTROL_S) -> dict[str, Any]:
    """Compile a model and shake it, in this process; return faults and sizes, as in `ModelReport`.

    Args:
        path: the MJCF file.
        time_limit_s: a model that would take longer to shake is a fault, s.
        control_s: simulated time under random control, s.
    """
    import mujoco

    try:
        model = mujoco.MjModel.from_xml_path(str(path))
    except (ValueError, MemoryError) as error:
        return {"faults": [f"does not compile: {' '.join(str(error).split())}"], "sizes": {}}
    faults = _bad_numbers(model) or _shake(model, time_limit_s, control_s)
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
    json.dump(examine(Path(path), int(time_limit_s)), sys.stdout)


if __name__ == "__main__":
    _child(*sys.argv[1:])
