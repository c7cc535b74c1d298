"""Twins stepped together in `mujoco.batch`, one of the methods that sweeps.py compares.

    uv run python benchmarks/common/twin_batch.py [--threads 2]

All twins advance by one second at a time: first the chambers of each twin, then all
engine steps of all twins in one call on several threads, then the records of each twin.
The script compares every column of three runs with runs of single twins and exits with
1 unless they agree to the bit.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence

import mujoco
import numpy as np
from mujoco.batch import Batch

from srs_twin import PreloadedContact
from srs_twin.rollout import Recorder, rollout
from srs_twin.scenario.loading import load_scenario, parse_scenario
from srs_twin.scenario.scenario import Scenario
from srs_twin.trajectory import Trajectory

_WHOLE = mujoco.mjtState.mjSTATE_INTEGRATION
_SEEN = int(mujoco.mjtState.mjSTATE_FULLPHYSICS)


def run_together(scenarios: Sequence[Scenario], threads: int) -> list[Trajectory]:
    """Run the preloaded twins of scenarios that differ in gait and supply only, without other engine steps.

    Args:
        scenarios: scenarios with the same `record_hz` and the same duration, in whole
            seconds.
        threads: number of threads of the engine.
    """
    first = scenarios[0]
    twins = [
        scenario.build_plant("twin", contact=PreloadedContact())
        for scenario in scenarios
    ]
    models = [twin.physics.model for twin in twins]
    engine = Batch(models[0], len(twins), threads)
    engine.set_models(models)
    scripts = []
    recorders = []
    for k, (scenario, twin) in enumerate(zip(scenarios, twins, strict=True)):
        controller = scenario.build_controller()
        state = twin.reset(pose=scenario.pose, seed=scenario.seed)
        controller.reset(twin.spec, twin.tick, seed=scenario.seed)
        recorders.append(
            Recorder(twin, controller, scenario.record_hz, scenario.duration)
        )
        recorders[-1].add(state)
        scripts.append(controller.script(scenario.duration))
        mujoco.mj_getState(models[k], twin.physics.data, engine.state[k], _WHOLE)
    steps = round(1 / twins[0].timestep)
    samples = round(first.record_hz)
    times = 1.0 / samples * np.arange(1, samples + 1)
    for second in range(round(first.duration)):
        traces = [
            twin.physics.advance_chambers(script.slice(second, second + 1), steps)
            for twin, script in zip(twins, scripts, strict=True)
        ]
        controls = np.zeros((len(twins), steps, models[0].nu))
        for k, trace in enumerate(traces):
            flat = twins[k].physics.controls(trace)[:-1]
            controls[k, :, : flat.shape[1]] = flat
        out = engine.rollout(steps, controls, record=(_SEEN, "sensordata"))
        for k, twin in enumerate(twins):
            mujoco.mj_setState(models[k], twin.physics.data, engine.state[k], _WHOLE)
            rates = traces[k].bend_rate[1:]
            batch = twin.physics.evaluate(rates, out[_SEEN][k], out["sensordata"][k])
            trace = traces[k].at(np.arange(1, steps + 1))
            recorders[k].add(
                twin._chunk_history(second + times, trace, batch, steps // samples)
            )
    return [recorder.trajectory() for recorder in recorders]


def main() -> None:
    """Compare twins stepped together with single twins."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument(
        "--threads", type=int, default=2, help="number of threads of the engine"
    )
    document = load_scenario("gen2_straight").document
    scenarios = [
        parse_scenario(
            {**document, "duration_s": 2.0, "supply": {"pressure_kpa": pressure}}
        )
        for pressure in (42.0, 48.0, 54.0)
    ]
    different: set[str] = set()
    for scenario, run in zip(
        scenarios, run_together(scenarios, parser.parse_args().threads), strict=True
    ):
        twin = scenario.build_plant("twin", contact=PreloadedContact())
        single = rollout(twin, scenario.build_controller(), scenario.duration)
        different |= run.columns.keys() ^ single.columns.keys()
        shared = run.columns.keys() & single.columns.keys()
        different |= {
            name for name in shared if run[name].tobytes() != single[name].tobytes()
        }
    print(
        "columns that differ from those of single twins:"
        f" {', '.join(sorted(different)) or 'none'}"
    )
    sys.exit(bool(different))


if __name__ == "__main__":
    main()
