"""Batches of runs: the same bits as single runs, in order, for any number of threads."""

from __future__ import annotations

import doctest
import importlib
import io
import os
import signal
import threading
import time
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
import pytest
from snakes import robot, vented

from srs_twin import (
    AnalyticalSnake,
    Controller,
    DivergedError,
    Gait,
    InputError,
    Job,
    LoadedContact,
    Plant,
    RobotSpec,
    SnakeState,
    Trajectory,
    TwinBatch,
    TwinSnake,
    rollout,
    run_batch,
    run_many,
)
from srs_twin.compute.workers import Workers
from srs_twin.pneumatics import make_pneumatics

SPEC = robot()
POSES = ((0.0, 0.0, 0.0), (0.3, -0.2, 1.1), (-1.0, 2.0, -2.5), (0.1, 0.1, 3.0))


def variants() -> list[RobotSpec]:
    """Return a robot, and copies with other friction, compliance and masses."""
    heavier = tuple(
        mass * factor
        for mass, factor in zip(SPEC.mass.connectors, (1, 1.3, 1, 1.1, 2), strict=True)
    )
    return [
        SPEC,
        robot(mu_t=0.06, mu_n=0.4),
        replace(
            SPEC,
            bending=replace(
                SPEC.bending, stiffness=1.5, damping_time=0.004, roll_stiffness=0.2
            ),
        ),
        replace(SPEC, mass=replace(SPEC.mass, connectors=heavier)),
    ]


def written(run: Trajectory | DivergedError) -> bytes:
    """Return a trajectory, or the history and message of an error, as the bytes of a file."""
    output = b""
    if isinstance(run, DivergedError):
        output = str(run).encode()
        run = run.trajectory
    assert run is not None
    file = io.BytesIO()
    run.to_parquet(file)
    return output + file.getvalue()


def alone(job: Job) -> bytes:
    """Return the result of `rollout` for a job."""
    assert isinstance(job.controller, Controller)
    plant = job.plant if isinstance(job.plant, Plant) else job.plant()
    try:
        return written(
            rollout(
                plant,
                job.controller,
                job.duration,
                pose=job.pose,
                seed=job.seed,
                record_hz=job.record_hz,
            )
        )
    except DivergedError as error:
        return written(error)


class Reflex(Controller):
    """Controller that switches the chambers of a segment when the sensed bend exceeds a threshold."""

    kind = "reflex"

    def reset(self, spec: RobotSpec, tick: float, *, seed: int = 0) -> None:
        self._sign = (
            np.random.default_rng(seed).choice([-1, 1], spec.segments).astype(np.int8)
        )

    def step(self, state: SnakeState) -> np.ndarray:
        self._sign[state.measured_bend > 0.5] = -1
        self._sign[state.measured_bend < -0.5] = 1
        return np.stack([self._sign, -self._sign], axis=-1)

    def signals(self) -> dict[str, Any]:
        return {"sign": self._sign.copy()}


class Fuse(Plant):
    """Plant that does not move, and diverges, raises or waits on request."""

    name = "fuse"
    tick = 0.02

    def __init__(self, act: Callable[[float], None] = lambda time: None) -> None:
        self.spec = SPEC
        self._act = act

    def reset(self, *, pose: Any = (0.0, 0.0, 0.0), seed: int = 0) -> SnakeState:
        self._still = AnalyticalSnake(self.spec).reset(pose=pose)
        self._ticks = 0
        return self._still

    def step(self, valves: np.ndarray) -> SnakeState:
        self._ticks += 1
        self._act(self._ticks * self.tick)
        return replace(self._still, time=self._ticks * self.tick)


def fused(plant: Fuse, duration: float) -> Job:
    """Return a job for a plant that advances tick by tick only."""
    return Job(plant, Gait(2.0), duration, record_hz=50)


def diverges(time: float) -> None:
    if time > 0.1:
        raise DivergedError("fuse", time, "it was told to")


def refuses(time: float) -> None:
    if time > 0.1:
        raise InputError(f"not after {time:.2g} s")


def breaks(time: float) -> None:
    raise ZeroDivisionError("a fault of the program")


def mixed_jobs() -> list[Job]:
    """Return jobs on all plants, with scripts and with feedback."""
    return [
        Job(partial(AnalyticalSnake, SPEC), Gait(2.0, 0.2), 3.0, POSES[1], 3),
        Job(AnalyticalSnake(variants()[1], model="compliant"), Reflex(), 0.4, seed=5),
        Job(TwinSnake(variants()[2]), Gait(1.0, -0.1), 0.3, POSES[2], record_hz=50),
        Job(
            partial(TwinSnake, variants()[3], contact=LoadedContact("ellipse")),
            Reflex(),
            0.2,
            POSES[3],
            7,
        ),
        Job(
            partial(AnalyticalSnake, SPEC, friction="wheel"),
            Gait(1.5),
            0.2,
            record_hz=25,
        ),
        Job(partial(AnalyticalSnake, SPEC, pneumatics="orifice"), Gait(2.0, 0.4), 0.5),
    ]


@pytest.mark.parametrize("threads", [1, 2, None])
def test_parallel_runs_equal_serial_runs_in_order_bit_for_bit(threads):
    expected = [alone(job) for job in mixed_jobs()]
    assert len(set(expected)) == len(expected)
    assert [written(run) for run in run_many(mixed_jobs(), threads=threads)] == expected


def _snake() -> AnalyticalSnake:
    return AnalyticalSnake(SPEC, friction="wheel")


def test_jobs_of_one_factory_use_a_plant_without_interference():
    made: list[int] = []

    def make() -> TwinSnake:
        made.append(threading.get_ident())
        return TwinSnake(SPEC)

    jobs = [Job(make, Gait(2.0, 0.1 * k), 0.2, POSES[k]) for k in range(4)]
    runs = run_many(jobs, threads=2)
    assert 1 <= len(made) == len(set(made)) <= 2
    assert [written(run) for run in runs] == [
        alone(Job(TwinSnake(SPEC), Gait(2.0, 0.1 * k), 0.2, POSES[k])) for k in range(4)
    ]


def test_controllers_may_be_factories():
    (run,) = run_many([Job(_snake, partial(Gait, 2.0, 0.3), 0.2)])
    assert written(run) == alone(Job(_snake, Gait(2.0, 0.3), 0.2))


@pytest.mark.parametrize("threads", [1, 2])
def test_diverged_run_returns_its_error_and_others_continue(threads):
    plants = [Fuse(), Fuse(diverges), Fuse()]
    runs = run_many([fused(plant, 0.4) for plant in plants], threads=threads)
    first, error, last = runs
    assert isinstance(error, DivergedError)
    assert str(error) == "fuse diverged at t = 0.12 s: it was told to"
    assert error.trajectory is not None and error.trajectory.time[-1] == pytest.approx(
        0.1
    )
    assert isinstance(first, Trajectory) and isinstance(last, Trajectory)
    assert len(first) == len(last) == 21


def wild() -> TwinSnake:
    """Return a twin that diverges: it gets a large velocity into the floor on reset."""

    class Thrown(TwinSnake):
        def reset(self, **about: Any) -> SnakeState:
            state = super().reset(**about)
            self.physics.data.qvel[2] = -1e9
            return state

    return Thrown(SPEC)


@pytest.mark.parametrize("threads", [1, 2])
def test_diverged_twin_has_the_same_error_as_alone(threads):
    """The message contains the engine's warnings, which come from all threads."""
    expected = alone(Job(wild, Gait(2.0), 0.1))
    assert b"twin diverged at t = 0.001 s" in expected
    jobs = [
        Job(partial(TwinSnake, SPEC) if k % 2 else wild, Gait(2.0), 0.1)
        for k in range(6)
    ]
    runs = run_many(jobs, threads=threads)
    assert [written(run) == expected for run in runs] == [True, False] * 3
    assert all(isinstance(run, Trajectory) for run in runs[1::2])


def test_plants_without_samples_within_a_tick_name_the_allowed_rates():
    with pytest.raises(InputError, match="2 are requested; `record_hz` must be 50 div"):
        Fuse().advance(vented(SPEC), 2)


def test_no_jobs_return_no_runs():
    assert run_many([]) == [] == run_many(iter([]), threads=2)


@pytest.mark.parametrize("threads", [1, 3])
def test_first_invalid_job_is_reported(threads):
    def slowly_refuses(time_: float) -> None:
        time.sleep(0.01)
        refuses(time_)

    plants = [Fuse(), Fuse(slowly_refuses), Fuse(refuses), Fuse()]
    with pytest.raises(InputError, match=r"^job 2 of 4: .*: not after 0.12 s$"):
        run_many([fused(plant, 0.4) for plant in plants], threads=threads)


@pytest.mark.parametrize("threads", [1, 2])
def test_programming_errors_propagate_unchanged(threads):
    with pytest.raises(ZeroDivisionError, match="a fault of the program"):
        run_many([fused(Fuse(breaks), 0.4), fused(Fuse(), 0.4)], threads=threads)


def test_jobs_after_a_failed_one_end_early():
    reached: list[float] = []

    def slow(time_: float) -> None:
        time.sleep(0.01)
        reached.append(time_)

    with pytest.raises(InputError, match="job 1 of 2"):
        run_many([fused(Fuse(refuses), 10.0), fused(Fuse(slow), 10.0)], threads=2)
    assert len(reached) < 400


def test_shared_plants_and_controllers_are_refused():
    gait = Gait(2.0)
    snake = AnalyticalSnake(SPEC)
    with pytest.raises(
        InputError,
        match=(
            "jobs 1 and 3 share one controller, a Gait; give each job its own"
            " controller, or a function"
        ),
    ):
        run_many(
            [
                Job(_snake, gait, 1.0),
                Job(_snake, Gait(2.0), 1.0),
                Job(_snake, gait, 1.0),
            ]
        )
    with pytest.raises(
        InputError,
        match="jobs 1 and 2 share one plant, a AnalyticalSnake; give each job its own",
    ):
        run_many([Job(snake, Gait(2.0), 1.0), Job(snake, Gait(2.0), 1.0)])


def test_fewer_than_one_thread_is_refused():
    with pytest.raises(
        InputError, match="`threads` 0 is not allowed; it must be 1 or more"
    ):
        run_many([], threads=0)


@pytest.mark.parametrize(
    ("job", "words"),
    [
        (
            Job(_snake, Gait(2.0), 0.03),
            "job 2 of 2: duration 0.03 s is not a multiple of tick 0.02 s",
        ),
        (
            Job(_snake, Gait(2.0), 1.0, record_hz=70),
            "job 2 of 2: `record_hz` 70 does not fit the tick of 0.02 s",
        ),
    ],
)
def test_rollout_errors_name_the_job(job, words):
    with pytest.raises(InputError, match=f"^{words}"):
        run_many([Job(_snake, Gait(2.0), 0.1), job], threads=2)


@pytest.mark.parametrize("threads", [1, 2])
def test_progress_is_reported_on_the_calling_thread(threads):
    reported: list[tuple[int, int]] = []
    jobs = [Job(_snake, Gait(2.0), 0.1) for _ in range(5)]
    run_many(
        jobs,
        threads=threads,
        progress=lambda done: reported.append((done, threading.get_ident())),
    )
    assert reported == [(k, threading.get_ident()) for k in range(1, 6)]


@pytest.mark.usefixtures("interruptible")
@pytest.mark.parametrize("threads", [1, 2])
def test_interrupt_ends_all_runs(threads):
    lived: list[float] = []

    def naps(time_: float) -> None:
        time.sleep(0.01)
        lived.append(time_)

    def interrupt(time_: float) -> None:
        naps(time_)
        if 0.1 < time_ < 0.13:
            os.kill(os.getpid(), signal.SIGINT)

    jobs = [fused(Fuse(act), 100.0) for act in (naps, interrupt, naps, naps)]
    if threads == 1:
        jobs = jobs[1:]
    with pytest.raises(KeyboardInterrupt):
        run_many(jobs, threads=threads)
    assert max(lived) < 50.0, "all of them had 100 s to simulate"
    ticks = len(lived)
    time.sleep(0.05)
    assert len(lived) == ticks


def test_no_thread_outlives_the_batch():
    before = threading.active_count()
    for _ in range(3):
        run_many([Job(_snake, Gait(2.0), 0.1) for _ in range(4)], threads=3)
    deadline = time.monotonic() + 60.0
    while threading.active_count() > before and time.monotonic() < deadline:
        time.sleep(0.01)
    assert threading.active_count() <= before


def test_lowest_error_is_raised_and_later_jobs_do_not_start():
    begun: list[int] = []

    def task(k: int, stopped: Callable[[], bool]) -> int:
        begun.append(k)
        if k in (3, 5):
            raise ValueError(f"task {k}")
        time.sleep(0.01)
        return k

    with pytest.raises(ValueError, match="task 3"):
        Workers(2).run(50, task)
    assert len(begun) < 20


# TwinBatch


def scripts(batch: TwinBatch, duration: float) -> list[Any]:
    """Return the script of a different gait for each run."""
    gaits = [Gait(1.0 + 0.5 * k, 0.1 * k) for k in range(len(batch))]
    for gait, twin in zip(gaits, batch.twins, strict=True):
        gait.reset(twin.spec, twin.tick)
    return [gait.script(duration) for gait in gaits]


def same(one: SnakeState, other: SnakeState) -> bool:
    return all(
        np.array_equal(getattr(one, name), getattr(other, name))
        for name in one.__dataclass_fields__
    )


@pytest.mark.parametrize("threads", [1, 2])
def test_runs_of_a_batch_are_those_of_single_twins(threads):
    supplies = [45e3, 50e3, 41e3, 60e3]
    batch = TwinBatch(variants(), supply_pa=supplies, threads=threads, tick=0.01)
    batch.reset(poses=POSES)
    histories = batch.play(scripts(batch, 0.3), 30)
    for k, spec in enumerate(variants()):
        twin = TwinSnake(spec, supply_pa=supplies[k], tick=0.01)
        twin.reset(pose=POSES[k])
        history = histories[k]
        assert history is not None
        assert same(history, twin.play(scripts(batch, 0.3)[k], 30))
        assert same(batch.state.at(k), history.at(-1))
    bends = [history.bend for history in histories if history is not None]
    assert all(np.abs(bends[0] - other).max() > 0.01 for other in bends[1:])


def test_reset_batch_repeats_the_run():
    batch = TwinBatch(variants()[:2], threads=1)
    first = batch.play(scripts(batch, 0.1), 5)
    batch.reset()
    again = batch.play(scripts(batch, 0.1), 5)
    assert None not in first and None not in again
    assert all(same(a, b) for a, b in zip(first, again, strict=True))


def test_changing_the_model_of_one_twin_does_not_affect_others():
    one, other = TwinBatch([SPEC, SPEC], threads=1).twins
    one.physics.model.opt.gravity[2] = 0.0
    assert (
        other.physics.model.opt.gravity[2]
        == TwinSnake(SPEC).physics.model.opt.gravity[2]
        < -9
    )


@pytest.mark.default_cases(2)
@pytest.mark.parametrize("threads", [1, 2])
@pytest.mark.parametrize("record_hz", [25, 100])
def test_batch_policy_equals_one_controller_per_twin(threads, record_hz):
    batch = TwinBatch(variants()[:3], threads=threads)
    reflexes = [Reflex() for _ in batch.twins]
    for reflex, twin in zip(reflexes, batch.twins, strict=True):
        reflex.reset(twin.spec, twin.tick)
    seen: list[float] = []

    def policy(state: SnakeState) -> np.ndarray:
        assert state.position.shape == (3, 5, 2)
        return np.stack([reflex.step(state.at(k)) for k, reflex in enumerate(reflexes)])

    runs = run_batch(
        batch, policy, 0.2, poses=POSES[:3], record_hz=record_hz, progress=seen.append
    )
    assert seen == pytest.approx(0.02 * np.arange(1, 11))
    for k, run in enumerate(runs):
        expected = rollout(
            TwinSnake(variants()[k]), Reflex(), 0.2, pose=POSES[k], record_hz=record_hz
        )
        assert isinstance(run, Trajectory)
        assert run.columns.keys() == {
            name for name in expected.columns if not name.startswith("sign_")
        }
        assert all(np.array_equal(run[name], expected[name]) for name in run.columns)
        assert run.metadata == {**expected.metadata, "controller": "policy"}


def test_batch_ends_when_all_runs_have_diverged():
    batch = TwinBatch([SPEC], threads=1)
    requested: list[float] = []

    def policy(state: SnakeState) -> np.ndarray:
        requested.extend(state.time)
        batch.twins[0].physics.data.qvel[2] = -1e9
        return vented(SPEC)[None]

    (error,) = run_batch(batch, policy, 10.0)
    assert isinstance(error, DivergedError)
    assert requested == [0.0]


def test_batch_rejects_invalid_robots_and_settings():
    longer = replace(
        SPEC,
        geometry=replace(SPEC.geometry, connectors=3),
        mass=replace(SPEC.mass, connectors=SPEC.mass.connectors[:3]),
    )
    for specs, words in (([], "no robot"), ([SPEC, longer], "3, 5")):
        with pytest.raises(
            InputError, match=f"the same number of connectors, but they have {words}$"
        ):
            TwinBatch(specs)
    with pytest.raises(
        InputError,
        match=r"supply_pa: 3 values are given for 2 runs; give one value, or one per run",
    ):
        TwinBatch([SPEC, SPEC], supply_pa=[1e4, 2e4, 3e4])
    own = make_pneumatics("lag", SPEC, supply_pa=48e3, layout="3/2")
    with pytest.raises(
        InputError,
        match="the twins of a batch cannot share one pneumatics object; give the name",
    ):
        TwinBatch([SPEC, SPEC], pneumatics=own)
    with pytest.raises(
        InputError, match="contact 'lose' is unknown; allowed: loaded, preloaded"
    ):
        TwinBatch([SPEC, SPEC], contact="lose", threads=2)


def test_batch_rejects_wrong_numbers_of_arguments():
    batch = TwinBatch([SPEC, SPEC], threads=1)
    with pytest.raises(
        InputError, match="poses: 1 values are given for 2 runs; give one value per run"
    ):
        batch.reset(poses=POSES[:1])
    with pytest.raises(
        InputError,
        match="valves: 3 values are given for 2 runs; give one value per run",
    ):
        batch.step(np.stack([vented(SPEC)] * 3))
    with pytest.raises(
        InputError,
        match="schedules: 0 values are given for 2 runs; give one value per run",
    ):
        batch.play([], 1)
    impossible = np.stack([np.nan * vented(SPEC), 0 * vented(SPEC)])
    with pytest.raises(
        InputError, match="valve state 0.0 is not supported by layout 3/2"
    ):
        batch.step(impossible)
    assert batch.errors == [None, None]
    assert batch.twins[0].physics.data.time == 0.0
    assert np.array_equal(batch.step(np.stack([vented(SPEC)] * 2)).time, [0.02, 0.02])


@pytest.mark.parametrize("name", ["srs_twin.rollout", "srs_twin.plants.twin.batch"])
def test_docstring_examples_are_correct(name):
    outcome = doctest.testmod(importlib.import_module(name))
    assert (outcome.failed, outcome.attempted > 4) == (0, True)
