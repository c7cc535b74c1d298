"""rollouts: many runs at once, each as `rollout` alone would have made it.

`run_many` runs jobs that do not know of each other, on any plants; `run_batch` lets one policy look at all
twins of a batch and command them, tick by tick.

Kernels and engine free the interpreter's lock while they step, so runs overlap on threads; bytes do not
depend on how many there are.

>>> from functools import partial
>>> from srs_twin import AnalyticalSnake, Gait, Job, load_robot, run_many
>>> snake = partial(AnalyticalSnake, load_robot("gen2"))
>>> runs = run_many([Job(snake, Gait(2.0, offset), 1.0) for offset in (-0.2, 0.0, 0.2)])
>>> [round(float(run["heading"][-1]), 1) for run in runs]
[-0.7, -0.3, 0.3]
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from srs_twin.control.base import Controller
from srs_twin.errors import DivergedError, InputError, whole_steps
from srs_twin.plants.base import Plant, Pose, SnakeState
from srs_twin.rollout import Recorder, rollout, sampling
from srs_twin.spec import RobotSpec
from srs_twin.threads import Stopped, Workers
from srs_twin.trajectory import Trajectory

if TYPE_CHECKING:
    from srs_twin.plants.batch import TwinBatch

Policy = Callable[[SnakeState], np.ndarray]


@dataclass(frozen=True)
class Job:
    """One run of `run_many`; the fields are the arguments of `rollout`.

    Attributes:
        plant: what moves, or what makes it. Jobs with the same maker, one after the other, share the plants
            that it made, one a thread.
        controller: what commands its valves, or what makes it.
        duration: s.
        pose: where the snake lies at first: centre of mass x, y (m), mean heading (rad).
        seed: for plant and controller.
        record_hz: samples a second.
    """

    plant: Plant | Callable[[], Plant]
    controller: Controller | Callable[[], Controller]
    duration: float
    pose: Pose = (0.0, 0.0, 0.0)
    seed: int = 0
    record_hz: float = 100


def run_many(
    jobs: Iterable[Job], *, threads: int | None = None, progress: Callable[[int], None] | None = None
) -> list[Trajectory | DivergedError]:
    """Run jobs over threads; each gives what `rollout` would have given, bit for bit.

    Args:
        jobs: in any order; none shares its plant or controller with another.
        threads: how many; default one a processor.
        progress: called on the calling thread with how many jobs are done.

    Returns:
        A trajectory a job, in order; in place of one that diverged its error, whose `trajectory` holds what
        was recorded until then.

    Raises:
        InputError: two jobs share a plant or a controller, or the first job, by order, that cannot be run,
            with its number.
    """
    jobs = list(jobs)
    _refuse_sharing(jobs)
    here = threading.local()

    def run(k: int, stopped: Stopped) -> Trajectory | DivergedError:
        def go_on(time: float) -> None:
            if stopped():
                raise _StoppedError

        job = jobs[k]
        try:
            controller = job.controller if isinstance(job.controller, Controller) else job.controller()
            return rollout(
                _plant(job, here), controller, job.duration,
                pose=job.pose, seed=job.seed, record_hz=job.record_hz, progress=go_on,
            )  # fmt: skip
        except DivergedError as error:
            return error.with_traceback(None)  # its frames hold the plant
        except InputError as error:
            raise InputError(f"job {k + 1} of {len(jobs)}: {error}") from error

    return Workers(threads).each(len(jobs), run, progress)


def run_batch(
    batch: TwinBatch,
    policy: Policy,
    duration: float,
    *,
    poses: Sequence[Pose] | None = None,
    seed: int = 0,
    record_hz: float = 100,
    progress: Callable[[float], None] | None = None,
) -> list[Trajectory | DivergedError]:
    """Let one policy command all twins of a batch, every tick.

    Args:
        batch: the twins.
        policy: maps the twins' states, which have a leading axis of runs, to valves of shape
            (runs, segments, 2) or (runs, slots, segments, 2).
        duration: s, a multiple of the tick.
        poses: one a twin, as in `rollout`; default all at the origin.
        seed: for the twins.
        record_hz: samples a second, as in `rollout`.
        progress: called with the simulated time after every tick, s.

    Returns:
        A trajectory a twin, in order; in place of one that diverged its error, whose `trajectory` holds what
        was recorded until then. The others go on.

    Raises:
        InputError: times that do not fit together, or valves that are not possible.
    """
    ticks = whole_steps("duration", duration, "tick", batch.tick)
    samples, stride = sampling(batch.tick, record_hz)
    told = _Told()
    recorders = [Recorder(twin, told, record_hz, duration) for twin in batch.twins]
    resting = batch.reset(poses=poses, seed=seed)
    for k, recorder in enumerate(recorders):
        recorder.add(resting.at(k))
    for tick in range(1, ticks + 1):
        histories = batch.advance(policy(batch.state), samples)
        for recorder, history, error in zip(recorders, histories, batch.errors, strict=True):
            if history is not None and (tick % stride == 0 or error is not None):
                recorder.add(history)
        if progress is not None:
            progress(tick * batch.tick)
        if all(batch.errors):
            break
    return [_outcome(recorder, error) for recorder, error in zip(recorders, batch.errors, strict=True)]


def _outcome(recorder: Recorder, error: DivergedError | None) -> Trajectory | DivergedError:
    if error is None:
        return recorder.trajectory()
    error.trajectory = recorder.trajectory()
    return error


def _refuse_sharing(jobs: Sequence[Job]) -> None:
    """Refuse plants and controllers that two jobs would use at the same time."""
    seen: dict[int, int] = {}
    for k, job in enumerate(jobs, start=1):
        for kind, thing in (("plant", job.plant), ("controller", job.controller)):
            if not isinstance(thing, Plant | Controller):
                continue
            first = seen.setdefault(id(thing), k)
            if first != k:
                raise InputError(
                    f"jobs {first} and {k} share one {kind}, a {type(thing).__name__}; "
                    f"give each its own, or what makes one"
                )


def _plant(job: Job, here: threading.local) -> Plant:
    """Return the job's plant; one that this thread has made last serves again."""
    if isinstance(job.plant, Plant):
        return job.plant
    if getattr(here, "maker", None) is not job.plant:
        here.plant, here.maker = job.plant(), job.plant
    plant: Plant = here.plant
    return plant


class _StoppedError(Exception):
    """Nobody waits for this run any more."""


class _Told(Controller):
    """Stands in a recording for a policy that commands many snakes: it has no signals of its own."""

    kind = "policy"

    def reset(self, spec: RobotSpec, tick: float, *, seed: int = 0) -> None:
        """Nothing to prepare."""

    def step(self, state: SnakeState) -> np.ndarray:
        """Hold what there is: the policy commands the batch itself."""
        return state.valves
