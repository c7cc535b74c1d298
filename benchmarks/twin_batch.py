"""A grid of twins stepped together in `mujoco.batch`: what sweeps.py holds against processes and threads.

All twins advance a second at a time: chambers one after the other, then every engine step of all of them in
one call over threads, then what was to be seen, one after the other. It gives the bits of single twins.
"""

from __future__ import annotations

from collections.abc import Sequence

import mujoco
import numpy as np
from mujoco.batch import Batch

from srs_twin import PreloadedContact
from srs_twin.rollout import Recorder
from srs_twin.scenario.scenario import Scenario
from srs_twin.trajectory import Trajectory

_WHOLE = mujoco.mjtState.mjSTATE_INTEGRATION
_SEEN = int(mujoco.mjtState.mjSTATE_FULLPHYSICS)


def run_together(scenarios: Sequence[Scenario], threads: int) -> list[Trajectory]:
    """Run the preloaded twins of scenarios that differ in gait and supply only; MuJoCo steps them alone.

    Args:
        scenarios: with one duration of whole seconds and one record_hz.
        threads: of the engine.
    """
    first = scenarios[0]
    twins = [scenario.build_plant("twin", contact=PreloadedContact()) for scenario in scenarios]
    models = [twin.physics.model.ptr for twin in twins]
    engine = Batch(models[0], len(twins), threads)
    engine.set_models(models)
    scripts, recorders = [], []
    for k, (scenario, twin) in enumerate(zip(scenarios, twins, strict=True)):
        controller = scenario.build_controller()
        state = twin.reset(pose=scenario.pose, seed=scenario.seed)
        controller.reset(twin.spec, twin.tick, seed=scenario.seed)
        recorders.append(Recorder(twin, controller, scenario.record_hz, scenario.duration))
        recorders[-1].add(state)
        scripts.append(controller.script(scenario.duration))
        mujoco.mj_getState(models[k], twin.physics.data.ptr, engine.state[k], _WHOLE)
    steps, samples = round(1 / twins[0].timestep), round(first.record_hz)
    times = 1.0 / samples * np.arange(1, samples + 1)
    for second in range(round(first.duration)):
        traces = [
            twin.physics.fill(script.part(second, second + 1), steps)
            for twin, script in zip(twins, scripts, strict=True)
        ]
        controls = np.zeros((len(twins), steps, models[0].nu))
        for k, trace in enumerate(traces):
            flat = trace.pressure[:-1].reshape(steps, -1)
            controls[k, :, : flat.shape[1]] = flat
        out = engine.rollout(steps, controls, record=(_SEEN, "sensordata"))
        for k, twin in enumerate(twins):
            mujoco.mj_setState(models[k], twin.physics.data.ptr, engine.state[k], _WHOLE)
            stretch = twin.physics.recorded(out[_SEEN][k], out["sensordata"][k])
            trace = traces[k].at(np.arange(1, steps + 1))
            recorders[k].add(twin._history(second + times, trace, stretch, steps // samples))
    return [recorder.trajectory() for recorder in recorders]
