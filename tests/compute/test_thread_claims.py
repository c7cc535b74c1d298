"""A second thread that uses a plant, a controller, a batch or an environment gets an error."""

# ruff: noqa: SLF001 - claims and steps have no public names
from __future__ import annotations

import copy
import os
import pickle
import signal
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor, ThreadPoolExecutor
from contextlib import contextmanager, suppress
from multiprocessing import get_context
from typing import Any

import numpy as np
import pytest
from dm_environments import dm_environments
from snakes import robot
from test_rollout import Clock, Scripted

from srs_twin import (
    AnalyticalSnake,
    Controller,
    DivergedError,
    Gait,
    InputError,
    Job,
    Plant,
    SnakeState,
    TwinBatch,
    TwinSnake,
    rollout,
    run_batch,
    run_many,
)
from srs_twin.compute import claims
from srs_twin.envs.gymnasium import SnakeEnv, SnakeVectorEnv
from srs_twin.rollout import run_scripts

SPEC = robot()
GAIT = Gait(2.0)
GAIT.reset(SPEC, 0.02)
VALVES = np.tile(np.array([1, -1], dtype=np.int8), (4, 1))
IN_USE = (
    r"this \w+ is in use by another thread; create a separate object for this thread\."
    r" `run_many` runs"
)


@pytest.fixture(autouse=True)
def nothing_stays_claimed() -> Iterator[None]:
    yield
    assert claims._HOLDERS == {}


def elsewhere(act: Callable[[], Any]) -> Any:
    """Return the result of a call in another thread, or raise its exception."""
    with ThreadPoolExecutor(1) as pool:
        return pool.submit(act).result(60)


class Pause:
    """Place in a program where another thread waits until a test continues."""

    def __init__(self) -> None:
        self.reached = threading.Event()
        self.left = threading.Event()

    def __call__(self, *_: Any) -> None:
        if not self.reached.is_set():
            self.reached.set()
            assert self.left.wait(60)

    @contextmanager
    def during(self, act: Callable[[], Any]) -> Iterator[list[Any]]:
        """Run a function up to this place in another thread; it returns after the block, into the list."""
        results: list[Any] = []
        with ThreadPoolExecutor(1) as pool:
            future = pool.submit(act)
            try:
                assert self.reached.wait(60)
                yield results
            finally:
                self.left.set()
            results.append(future.result(60))


USES: dict[str, Callable[[Plant], Any]] = {
    "step": lambda plant: plant.step(VALVES),
    "advance": lambda plant: plant.advance(VALVES, 1),
    "play": lambda plant: plant.play(GAIT.script(0.1), 1),
    "reset": lambda plant: plant.reset(),
    "place": lambda plant: plant.set_state(plant.state),
    "save": lambda plant: plant.save(),
    "restore": lambda plant: plant.restore(AnalyticalSnake(SPEC).save()),
    "rollout": lambda plant: rollout(plant, Gait(2.0), 0.2),
    "run_many": lambda plant: run_many([Job(plant, Gait(2.0), 0.2)]),
    "pickle": pickle.dumps,
    "copy": copy.copy,
}


@pytest.mark.default_cases(at=[0, 2, 4, 6, 7, 9])
@pytest.mark.parametrize("use", USES)
def test_rollout_claims_its_plant_until_it_ends(use):
    plant = AnalyticalSnake(SPEC)
    pause = Pause()
    with (
        pause.during(lambda: rollout(plant, Gait(2.0), 0.4, observers=[pause])) as runs,
        pytest.raises(InputError, match=IN_USE),
    ):
        USES[use](plant)
    alone = rollout(
        AnalyticalSnake(SPEC), Gait(2.0), 0.4, observers=[lambda state: None]
    )
    assert all((runs[0][name] == alone[name]).all() for name in alone.columns)
    USES[use](plant)


class Slow(AnalyticalSnake):
    """A user's plant that waits within the methods it overrides."""

    pause: Pause | None = None

    def wait(self) -> None:
        if self.pause is not None:
            self.pause()

    def advance(self, valves: np.ndarray, samples: int) -> list[SnakeState]:
        self.wait()
        return super().advance(valves, samples)

    def reset(self, **start: Any) -> SnakeState:
        self.wait()
        return super().reset(**start)

    def identity(self) -> dict[str, Any]:
        self.wait()
        return super().identity()


@pytest.mark.default_cases(at=[0, 3, 4])
@pytest.mark.parametrize("use", ["step", "advance", "reset", "place", "save"])
def test_methods_claim_the_plant_while_they_run(use):
    plant = Slow(SPEC)
    pause = Pause()
    plant.pause = pause
    with (
        pause.during(lambda: USES[use](plant)),
        pytest.raises(InputError, match="this Slow is in use by another thread"),
    ):
        AnalyticalSnake.step(plant, VALVES)
    elsewhere(lambda: plant.step(VALVES))


def test_observers_and_controllers_may_use_the_plant_of_their_own_rollout():
    class Reader(Gait):
        def step(self, state):
            saved.append(plant.save())
            return super().step(plant.state)

    plant = AnalyticalSnake(SPEC)
    saved = []
    copied = []
    run = rollout(
        plant,
        Reader(2.0),
        0.2,
        observers=[lambda state: copied.append(copy.copy(plant))],
    )
    alone = rollout(
        AnalyticalSnake(SPEC), Gait(2.0), 0.2, observers=[lambda state: None]
    )
    assert len(saved) == 10 and (run["com_x"] == alone["com_x"]).all()
    assert (copied[-1].state.com == plant.state.com).all()


class Paused(Scripted):
    """Controller that waits in its first step."""

    def __init__(self, pause: Pause) -> None:
        super().__init__()
        self.pause = pause

    def step(self, state: SnakeState) -> np.ndarray:
        self.pause()
        return super().step(state)


def test_controller_serves_one_rollout_at_a_time():
    pause = Pause()
    controller = Paused(pause)
    with pause.during(lambda: rollout(Clock(), controller, 0.2)) as runs:
        for use in (
            lambda: rollout(Clock(), controller, 0.2),
            lambda: controller.step(None),
        ):
            with pytest.raises(
                InputError, match="this Paused is in use by another thread"
            ):
                use()
    assert list(runs[0]["count"][::2]) == list(range(11))
    rollout(Clock(), controller, 0.2)


def test_plant_from_a_function_of_two_jobs_is_refused_in_the_second():
    plant = Clock()
    pause = Pause()
    released = threading.Timer(0.5, pause.left.set)
    released.start()
    jobs = [Job(lambda: plant, Paused(pause), 0.1, record_hz=50) for _ in range(2)]
    with pytest.raises(InputError, match=f"job [12] of 2: {IN_USE}"):
        run_many(jobs, threads=2)
    released.join()


def raise_(error: BaseException) -> None:
    raise error


@pytest.mark.parametrize(
    "error", [RuntimeError(), KeyboardInterrupt(), SystemExit()], ids=repr
)
def test_claims_end_with_an_exception(error):
    plant = AnalyticalSnake(SPEC)
    controller = Gait(2.0)
    with pytest.raises(type(error)):
        rollout(plant, controller, 0.2, observers=[lambda state: raise_(error)])
    with pytest.raises(InputError, match="valve"):
        plant.step(np.full((4, 2), 7))
    assert elsewhere(lambda: rollout(plant, controller, 0.2)).time[-1] == 0.2


def test_claims_end_with_a_divergence_and_with_a_refused_second_claim():
    plant = Clock(breaks_at=0.1)
    with pytest.raises(DivergedError):
        rollout(plant, Scripted(), 0.2)
    elsewhere(plant.reset)
    pause = Pause()
    controller = Scripted()
    with pause.during(lambda: rollout(Clock(), Paused(pause), 0.2, record_hz=50)):
        rollout(Clock(), controller, 0.2)
    busy = Clock()
    pause = Pause()
    with pause.during(lambda: rollout(busy, Paused(pause), 0.2, record_hz=50)):
        with pytest.raises(InputError, match="this Clock"):
            rollout(busy, controller, 0.2)
        rollout(
            Clock(), controller, 0.2
        )  # the refused rollout holds no claim of the controller


@pytest.mark.parametrize(
    "use",
    [lambda plant: plant.step(VALVES), lambda plant: rollout(plant, Scripted(), 0.04)],
)
def test_interrupts_at_any_time_leave_no_claim(use):
    class Alarm(Exception):
        pass

    def interrupt(*_):
        raise Alarm

    plant = Clock()
    draw = np.random.default_rng(0)
    plant.reset()
    handler = signal.signal(signal.SIGALRM, interrupt)
    try:
        for _ in range(2000):
            # An interrupted comparison of numpy may raise a TypeError instead.
            with suppress(Alarm, TypeError):
                signal.setitimer(signal.ITIMER_REAL, draw.uniform(1e-6, 3e-4))
                while True:
                    use(plant)
            assert claims._HOLDERS == {}
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0.0)
        signal.signal(signal.SIGALRM, handler)


def test_copies_of_a_claimed_plant_are_free():
    plant = AnalyticalSnake(SPEC)
    pause = Pause()
    others = []

    def copy_and_wait(state: SnakeState) -> None:
        if not others:
            others.extend(
                [
                    pickle.loads(pickle.dumps(plant)),
                    copy.deepcopy(plant),
                    copy.copy(plant),
                ]
            )
        pause()

    with pause.during(
        lambda: rollout(plant, Gait(2.0), 0.2, observers=[copy_and_wait])
    ):
        for other in others:
            rollout(other, Gait(2.0), 0.2)


def batch_of_two() -> TwinBatch:
    return TwinBatch([SPEC, SPEC], threads=2)


BATCH_USES: dict[str, Callable[[TwinBatch], Any]] = {
    "step": lambda batch: batch.step(np.stack([VALVES] * 2)),
    "advance": lambda batch: batch.advance(np.stack([VALVES] * 2), 1),
    "play": lambda batch: batch.play([GAIT.script(0.1)] * 2, 1),
    "reset": lambda batch: batch.reset(),
    "run_batch": lambda batch: run_batch(batch, lambda state: state.valves, 0.04),
    "run_scripts": lambda batch: run_scripts(batch, [Gait(2.0), Gait(2.0)], 0.04),
}


@pytest.mark.default_cases(2)
@pytest.mark.parametrize("use", BATCH_USES)
@pytest.mark.parametrize("run", ["run_batch", "run_scripts"])
def test_runs_of_a_batch_claim_it_until_they_end(run, use):
    batch = batch_of_two()
    pause = Pause()

    def simulate(batch: TwinBatch, pause: Callable[..., None]) -> list[Any]:
        if run == "run_batch":
            return run_batch(batch, lambda state: state.valves, 0.08, progress=pause)
        return run_scripts(batch, [Gait(1.0), Gait(2.0)], 1.04, progress=pause)

    with (
        pause.during(lambda: simulate(batch, pause)) as results,
        pytest.raises(InputError, match=IN_USE),
    ):
        BATCH_USES[use](batch)
    alone = simulate(batch_of_two(), lambda time: None)
    assert all(
        (a["com_x"] == b["com_x"]).all() for a, b in zip(results[0], alone, strict=True)
    )
    BATCH_USES[use](batch)


@pytest.mark.parametrize("use", ["step", "play", "reset"])
def test_methods_of_a_batch_claim_it_while_they_run(use, monkeypatch):
    batch = batch_of_two()
    pause = Pause()
    simulate = TwinSnake._simulate
    monkeypatch.setattr(
        TwinSnake, "_simulate", lambda *args: [pause(), simulate(*args)][1]
    )
    with (
        pause.during(lambda: batch.step(np.stack([VALVES] * 2))),
        pytest.raises(InputError, match=IN_USE),
    ):
        BATCH_USES[use](batch)
    elsewhere(lambda: BATCH_USES[use](batch))


def gymnasium_env() -> Any:
    env = SnakeEnv("GoTo", render_mode="rgb_array")
    env.reset(seed=1)
    return env


def vector_env() -> Any:
    env = SnakeVectorEnv("GoTo", 2, threads=2)
    env.reset(seed=1)
    return env


def dm_env() -> Any:
    env = dm_environments().load("GoTo", seed=1)
    env.reset()
    return env


ENVIRONMENTS = {"gymnasium": gymnasium_env, "vector": vector_env, "dm_env": dm_env}
ENVIRONMENT_USES = {
    "step": lambda env, action: env.step(action),
    "reset": lambda env, action: env.reset(),
    "render": lambda env, action: env.render(),
}


@pytest.mark.default_cases(at=[0, 2, 4, 6])
@pytest.mark.parametrize("kind", ENVIRONMENTS)
@pytest.mark.parametrize("use", ENVIRONMENT_USES)
def test_steps_of_an_environment_claim_it(kind, use, monkeypatch):
    if (kind, use) == ("dm_env", "render"):
        pytest.skip("dm_env has no render")
    env = ENVIRONMENTS[kind]()
    pause = Pause()
    simulate = TwinSnake._simulate
    action = (
        env.action_spec().minimum if kind == "dm_env" else env.action_space.low
    ).copy()
    monkeypatch.setattr(
        TwinSnake, "_simulate", lambda *args: [pause(), simulate(*args)][1]
    )
    with (
        pause.during(lambda: env.step(action)) as results,
        pytest.raises(InputError, match=IN_USE),
    ):
        ENVIRONMENT_USES[use](env, action)
    other = ENVIRONMENTS[kind]()
    copied = pickle.loads(pickle.dumps(env))
    assert np.array_equal(results[0][1], other.step(action)[1])  # the rewards
    assert np.array_equal(copied.step(action)[1], other.step(action)[1])
    elsewhere(lambda: env.step(action))


def test_child_of_a_fork_during_a_rollout_may_use_the_plant():
    plant = Clock()
    pause = Pause()
    with pause.during(lambda: rollout(plant, Paused(pause), 0.2, record_hz=50)):
        child = os.fork()
        if child == 0:
            try:
                plant.reset()
            except InputError:
                os._exit(1)
            os._exit(0)
        assert os.waitpid(child, 0)[1] == 0


def run_in_worker(plant: Plant, controller: Controller) -> bytes:
    return rollout(plant, controller, 0.2)["com_x"].tobytes()


@pytest.mark.default_cases(1)
@pytest.mark.parametrize("method", ["fork", "spawn", "forkserver"])
def test_process_pools_give_the_bits_of_this_process(method):
    """The kernels are loaded, the engine has run, and a thread exists when the workers are forked."""
    plants = [
        AnalyticalSnake(SPEC),
        AnalyticalSnake(SPEC, model="compliant"),
        TwinSnake(SPEC),
    ]
    here = run_many([Job(plant, Gait(2.0, 0.1), 0.2) for plant in plants], threads=2)
    with ProcessPoolExecutor(2, mp_context=get_context(method)) as pool:
        futures = [
            pool.submit(run_in_worker, plant, Gait(2.0, 0.1)) for plant in plants
        ]
        assert [future.result(300) for future in futures] == [
            run["com_x"].tobytes() for run in here
        ]
