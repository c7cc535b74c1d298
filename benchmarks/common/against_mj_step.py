"""(b) Rollouts of the twin compared with a bare loop of `mj_step` under the same controls.

The bare loop can only use the friction of MuJoCo, so it steps the model with the
preloaded contact. Its final positions must agree with the rollout of that twin. The
default twin computes friction with its own solver.
"""

from __future__ import annotations

import copy
from collections.abc import Callable

import mujoco
import numpy as np
from common.timing import Ratio, Result, Task, interleaved

from srs_twin import Gait, TwinSnake, load_robot, rollout

DURATION = 2.0  # s
OFFSET = 0.2


def run(quick: bool) -> Result:
    """Time generation 2 in a turn.

    Args:
        quick: simulate a quarter of the duration.
    """
    duration = DURATION / 4 if quick else DURATION
    spec = load_robot("gen2")
    pressed = TwinSnake(spec, contact="preloaded")
    default = TwinSnake(spec)
    bare, data = bare_loop(pressed, duration)
    last = rollout(pressed, Gait(2.0, OFFSET), duration).stack("qpos")[-1]
    rollout(default, Gait(2.0, OFFSET), duration)  # compiles
    bare()
    bare()  # repeats from the same start
    error = float(np.abs(data.qpos - last).max())
    if error > 1e-6:
        raise RuntimeError(
            f"the bare loop ends {error:.2g} m or rad from the rollout: different"
            " controls"
        )
    times = interleaved(
        {
            "mj_step": Task(bare, duration),
            "preloaded": Task(
                lambda: rollout(pressed, Gait(2.0, OFFSET), duration), duration
            ),
            "default": Task(
                lambda: rollout(default, Gait(2.0, OFFSET), duration), duration
            ),
        }
    )
    ratios = {
        name: Ratio.between(times[name], times["mj_step"])
        for name in ("preloaded", "default")
    }
    rates = {name: 1 / timing.median for name, timing in times.items()}
    return Result(
        f"(b) twin rollouts compared with a bare mj_step loop, gen2, {duration:g} s",
        ["program", "simulated s per wall s", "time relative to the bare loop"],
        [
            ["mj_step loop, preloaded model", f"{rates['mj_step']:.3g}", "1"],
            *(
                [f"rollout, {name}", f"{rates[name]:.3g}", str(ratio)]
                for name, ratio in ratios.items()
            ),
        ],
        {
            "ratios": {name: ratio.json() for name, ratio in ratios.items()},
            "times": {name: timing.json() for name, timing in times.items()},
            "simulated_s_per_wall_s": rates,
            "final_qpos_error": error,
        },
        [f"Final positions of the first two differ by at most {error:.1g} m or rad."],
    )


def bare_loop(
    plant: TwinSnake, duration: float
) -> tuple[Callable[[], None], mujoco.MjData]:
    """Return a loop over the controls of a rollout, and the MuJoCo data that it advances."""
    model = plant.physics.model
    controls = step_controls(plant, duration)
    plant.reset()
    kind = mujoco.mjtState.mjSTATE_INTEGRATION
    start = np.empty(mujoco.mj_stateSize(model, kind))
    mujoco.mj_getState(model, plant.physics.data, start, kind)
    data = mujoco.MjData(model)
    chambers = data.ctrl[: controls.shape[1]]

    def loop() -> None:
        mujoco.mj_setState(model, data, start, kind)
        for row in controls:
            chambers[:] = row
            mujoco.mj_step(model, data)

    return loop, data


def step_controls(
    plant: TwinSnake, duration: float, *, frequency: float = 2.0, offset: float = OFFSET
) -> np.ndarray:
    """Return the chamber pressures at the beginning of each time step, shape (steps, 2 · segments), Pa."""
    gait = Gait(frequency, offset)
    chambers = copy.deepcopy(plant.pneumatics)
    gait.reset(plant.spec, plant.tick)
    chambers.reset()
    times = plant.timestep * np.arange(round(duration / plant.timestep))
    pressure = chambers.advance(gait.script(duration), times).pressure
    return pressure.reshape(len(times), -1)
