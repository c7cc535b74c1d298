"""TwinBatch: many twins of one robot, with parameters of their own, stepped together over threads.

Every run is a `TwinSnake` of its own spec, so a batch gives bit for bit what that twin alone gives, and no
law stands here a second time. Each distinct spec is compiled once (24 ms for gen2; a copy takes 2 ms).

Threads share out whole twins, chambers and observation included, and every engine call frees the
interpreter's lock. `mujoco.batch.Batch`, one call for the steps of all runs, is as fast in the engine and
gives the same bits, but all Python would then run while its threads wait: 5 % of a run that is played, a
third of one that is commanded tick by tick. (A `mujoco.rollout.Rollout` with threads hands no warm start
back, so a run in pieces would change its bits.) Expanding parameters instead of compiling would save those
24 ms, against one second for ten simulated ones, and write every formula of the model twice.

>>> from dataclasses import replace
>>> from srs_twin import Gait, Job, TwinBatch, load_robot, run_many
>>> robot = load_robot("gen2")
>>> rough = replace(robot, friction=replace(robot.friction, mu_t=0.2))
>>> batch = TwinBatch([robot, rough], supply_pa=48e3)
>>> runs = run_many([Job(twin, Gait(2.0), 2.0) for twin in batch.twins])
>>> [round(float(run["com_x"][-1]), 1) for run in runs]
[0.3, 0.2]
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from srs_twin import extensions
from srs_twin.compute.workers import Workers
from srs_twin.errors import DivergedError, InputError, one_of
from srs_twin.io.saved_state import CopiedWhole
from srs_twin.plants.base import Pose, SnakeState, check_commands
from srs_twin.plants.twin.snake import TwinSnake
from srs_twin.pneumatics import Pneumatics, Schedule
from srs_twin.robot.spec import RobotSpec

ENGINES = ("cpu", "warp")


class TwinBatch(CopiedWhole):
    """Many twins with one number of connectors and one tick, stepped together over threads.

    Each gives bit for bit what a `TwinSnake` of its spec alone gives.

    Attributes:
        twins: the runs, each a `TwinSnake` that may also be used alone.
        tick: control tick, s.
        state: the last state of every run, with a leading axis of runs on every field; of a run that
            diverged the last plausible one.
        errors: of each run, None or what ended it; runs that ended take no further part until `reset`.
    """

    twins: tuple[TwinSnake, ...]
    state: SnakeState
    errors: list[DivergedError | None]

    def __new__(cls, *given: Any, engine: str = "cpu", device: str | None = None, **settings: Any) -> Any:
        """Return a batch of another engine where that is asked for (`plants.device.batch.WarpBatch`).

        Args:
            *given: see `__init__`.
            engine: "cpu", or "warp": MuJoCo Warp.
            device: of Warp, such as "cuda:0" or "cpu"; None: its preferred one.
            **settings: see `__init__`; `deterministic=True` lets Warp sum in one order.

        Raises:
            InputError: MuJoCo Warp is not installed, or cannot do this.
            UnknownNameError: another engine.
        """
        one_of("engine", engine, ENGINES)
        return super().__new__(cls) if engine == "cpu" else on_warp(*given, device=device, **settings)

    def __init__(
        self,
        specs: Sequence[RobotSpec],
        *,
        supply_pa: float | Sequence[float] | None = None,
        threads: int | None = None,
        engine: str = "cpu",
        **settings: Any,
    ) -> None:
        """Build the twins.

        Args:
            specs: the robot of each run: friction, stiffness, damping, masses, lengths may all differ.
            supply_pa: supply pressure, Pa, of all runs or one each; default each robot's nominal one.
            threads: how many; default one a processor.
            engine: see `__new__`.
            **settings: of all runs, as `TwinSnake` takes them.

        Raises:
            InputError: no run at all, robots that differ in their number of connectors, pressures that are
                not one a run, chambers made beforehand, or as `TwinSnake` raises it.
        """
        self._workers = Workers(threads)
        self.twins = _twins(self._workers, specs, supply_pa, settings)
        self.tick = self.twins[0].tick
        self.reset()

    def __len__(self) -> int:
        """Return the number of runs."""
        return len(self.twins)

    def reset(self, *, poses: Sequence[Pose] | None = None, seed: int = 0) -> SnakeState:
        """Lay all snakes straight, at rest, chambers empty.

        Args:
            poses: centre of mass x, y (m) and mean heading (rad), one a run; default all at the origin.
            seed: for whatever is random in the twins.

        Returns:
            `state`.

        Raises:
            InputError: not one pose a run.
        """
        places = [(0.0, 0.0, 0.0)] * len(self) if poses is None else list(poses)
        if len(places) != len(self):
            raise InputError(f"poses: {len(places)} were given for {len(self)} runs; give one a run")
        self.errors = [None] * len(self)
        resting = self._workers.each(len(self), lambda k, _: self.twins[k].reset(pose=places[k], seed=seed))
        self.state = SnakeState.history(resting)
        return self.state

    def step(self, valves: np.ndarray) -> SnakeState:
        """Advance all runs by one tick and return `state`.

        Args:
            valves: (runs, segments, 2) or (runs, slots, segments, 2), otherwise as in `Plant.step`.

        Raises:
            InputError: a wrong shape, or a state that the valves cannot take; nothing has moved then.
        """
        self.advance(valves, 1)
        return self.state

    def advance(self, valves: np.ndarray, samples: int) -> list[SnakeState | None]:
        """Advance all runs by one tick; a run whose commands have diverged ends.

        Args:
            valves: see `step`.
            samples: how many equally spaced samples to return, the last at the tick's end.

        Returns:
            Their history, run by run, as in `play`.

        Raises:
            InputError: as in `step`.
        """
        if len(valves) != len(self):
            raise InputError(f"valves: {len(valves)} were given for {len(self)} runs; give one array a run")
        errors = [self.errors[k] or self._wild(k, own) for k, own in enumerate(valves)]
        schedules = [
            None if error else twin.pneumatics.schedule(own, self.tick)
            for twin, own, error in zip(self.twins, valves, errors, strict=True)
        ]
        self.errors = errors
        return self.play(schedules, samples)

    def play(self, schedules: Sequence[Schedule | None], samples: int) -> list[SnakeState | None]:
        """Follow schedules that no feedback changes.

        Args:
            schedules: of each run, over a whole number of ticks; None for one that has ended.
            samples: how many equally spaced samples to return of each run, the last at its end.

        Returns:
            Their history, run by run: a run that diverges stops there; None from one without samples.

        Raises:
            InputError: not one schedule a run, or as in `Plant.play`.
        """
        if len(schedules) != len(self):
            raise InputError(f"schedules: {len(schedules)} were given for {len(self)} runs; give one a run")
        histories = self._workers.each(len(self), lambda k, _: self._play(k, schedules[k], samples))
        last = [
            self.state.at(k) if history is None else history.at(-1) for k, history in enumerate(histories)
        ]
        self.state = SnakeState.history(last)
        return histories

    def openings(self) -> np.ndarray:
        """Return how often inlets have opened, shape (runs, segments, 2)."""
        return np.array([twin.openings() for twin in self.twins])

    def describe(self) -> dict[str, Any]:
        """Return what is worth recording besides what the twins say."""
        return {}

    def _wild(self, k: int, valves: np.ndarray) -> DivergedError | None:
        """Return what ends a run whose commands have diverged."""
        try:
            check_commands("policy", float(np.asarray(self.state.time)[k]), valves)
        except DivergedError as error:
            return error.with_traceback(None)
        return None

    def _play(self, k: int, schedule: Schedule | None, samples: int) -> SnakeState | None:
        if schedule is None or self.errors[k] is not None:
            return None
        try:
            return self.twins[k].play(schedule, samples)
        except DivergedError as error:
            self.errors[k] = error.with_traceback(None)  # its frames hold what the engine recorded
            history: SnakeState | None = error.history
            return history


def on_warp(
    specs: Sequence[RobotSpec],
    *,
    supply_pa: float | Sequence[float] | None = None,
    threads: int | None = None,
    device: str | None = None,
    deterministic: bool = False,
    **settings: Any,
) -> Any:
    """Return a `WarpBatch`; arguments as `TwinBatch` takes them."""
    return warp_batch()(
        _twins(Workers(threads), specs, supply_pa, settings, once=True),
        device=device, deterministic=deterministic,
    )  # fmt: skip


def warp_batch() -> Any:
    """Return the class `WarpBatch`.

    Raises:
        InputError: MuJoCo Warp is not installed.
    """
    try:
        return extensions.load(extensions.ENGINES["warp"])
    except ImportError as error:
        raise InputError(
            "engine 'warp' needs MuJoCo Warp; install it with: pip install 'srs-twin[gpu]'"
        ) from error


def _twins(
    workers: Workers,
    specs: Sequence[RobotSpec],
    supply_pa: float | Sequence[float] | None,
    settings: Mapping[str, Any],
    *,
    once: bool = False,
) -> tuple[TwinSnake, ...]:
    """Return a twin of each spec; `once`: runs of one robot and supply share theirs."""
    supplies = _one_each("supply_pa", supply_pa, len(specs))
    lengths = sorted({spec.geometry.connectors for spec in specs})
    if len(lengths) != 1:
        found = ", ".join(map(str, lengths)) or "no robot at all"
        raise InputError(f"a batch needs robots with one number of connectors; found {found}")
    if isinstance(settings.get("pneumatics"), Pneumatics):
        raise InputError("pneumatics: one object cannot be the chambers of every twin; give its kind")
    keys = [repr(each) if once else str(k) for k, each in enumerate(zip(specs, supplies, strict=True))]
    first = {key: k for k, key in reversed(list(enumerate(keys)))}
    needed = sorted(first.values())
    made = workers.each(
        len(needed), lambda n, _: TwinSnake(specs[needed[n]], supply_pa=supplies[needed[n]], **settings)
    )
    of = dict(zip(needed, made, strict=True))
    return tuple(of[first[key]] for key in keys)


def _one_each(name: str, given: float | Sequence[float] | None, runs: int) -> list[float | None]:
    if given is None or isinstance(given, int | float):
        return [given] * runs
    if len(given) != runs:
        raise InputError(f"{name}: {len(given)} were given for {runs} runs; give one, or one a run")
    return list(given)
