"""(b) The twin's rollout against a bare loop of `mj_step`: the same compiled model, the same controls."""

from __future__ import annotations

import copy
from collections.abc import Callable

import mujoco
import numpy as np
from timing import Ratio, Result, Task, interleaved

from srs_twin import Gait, TwinSnake, load_robot, rollout

DURATION = 2.0  # s
OFFSET = 0.2


def run(quick: bool) -> Result:
    """Time generation 2 in a turn.

    Args:
        quick: a quarter of the run.
    """
    duration = DURATION / 4 if quick else DURATION
    plant = TwinSnake(load_robot("gen2"))
    bare, data = bare_loop(plant, duration)
    last = rollout(plant, Gait(2.0, OFFSET), duration).stack("qpos")[-1]
    bare()
    apart = float(np.abs(data.qpos - last).max())
    if apart > 1e-6:
        raise RuntimeError(f"the bare loop ends {apart:.2g} m or rad from the rollout: not the same controls")
    times = interleaved(
        {
            "rollout": Task(lambda: rollout(plant, Gait(2.0, OFFSET), duration), duration),
            "mj_step": Task(bare, duration),
        }
    )
    ratio = Ratio.of(times["rollout"], times["mj_step"])
    rates = {name: 1 / timing.median for name, timing in times.items()}
    return Result(
        f"(b) twin rollout against a bare mj_step loop, gen2, {duration:g} s",
        ["what", "simulated s per wall s", "rollout over bare loop"],
        [
            ["mj_step loop", f"{rates['mj_step']:.3g}", "1"],
            ["rollout", f"{rates['rollout']:.3g}", str(ratio)],
        ],
        {
            "ratio": ratio.json(),
            "times": {name: timing.json() for name, timing in times.items()},
            "simulated_s_per_wall_s": rates,
            "final_qpos_apart": apart,
        },
        [f"Final positions of the two differ by at most {apart:.1g} m or rad."],
    )


def bare_loop(plant: TwinSnake, duration: float) -> tuple[Callable[[], None], mujoco.MjData]:
    """Return a loop over the controls that a rollout would give, and the data it leaves them in."""
    model = plant.physics.model.ptr
    controls = step_controls(plant, duration)
    plant.reset()
    kind = mujoco.mjtState.mjSTATE_INTEGRATION
    start = np.empty(mujoco.mj_stateSize(model, kind))
    mujoco.mj_getState(model, plant.physics.data.ptr, start, kind)
    data = mujoco.MjData(model)
    chambers = data.ctrl[: controls.shape[1]]

    def loop() -> None:
        mujoco.mj_setState(model, data, start, kind)
        for row in controls:
            chambers[:] = row
            mujoco.mj_step(model, data)

    return loop, data


def step_controls(plant: TwinSnake, duration: float) -> np.ndarray:
    """Return the chamber pressures at the beginning of each time step, shape (steps, 2 · segments), Pa."""
    gait, chambers = Gait(2.0, OFFSET), copy.deepcopy(plant.pneumatics)
    gait.reset(plant.spec, plant.tick)
    chambers.reset()
    times = plant.timestep * np.arange(round(duration / plant.timestep))
    pressure = chambers.advance(gait.script(duration), times).pressure
    return pressure.reshape(len(times), -1)
