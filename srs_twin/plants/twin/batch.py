"""`TwinBatch` steps many twins with individual parameters in parallel threads.

Each run has its own `TwinSnake`. The results are bit-identical to those of twins that
run alone. Each distinct robot is compiled once, and the compiled model is copied for
equal robots.

A thread simulates whole twins, including chambers and observation. Every call to the
engine releases the global interpreter lock. The class `mujoco.batch.Batch` is not used,
because its threads wait while Python runs. The class `mujoco.rollout.Rollout` does not
return the solver's warm start, so a run divided into chunks would not be bit-identical.

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

from collections.abc import Mapping, Sequence, Sized
from typing import Any

import numpy as np

from srs_twin import extensions
from srs_twin.compute.claims import Claimable
from srs_twin.compute.workers import Workers
from srs_twin.errors import DivergedError, InputError, check_choice
from srs_twin.io.arguments import checked
from srs_twin.plants.base import Pose, SnakeState, check_commands
from srs_twin.plants.twin.snake import TwinSnake
from srs_twin.pneumatics import Pneumatics, Schedule
from srs_twin.robot.spec import RobotSpec

ENGINES = ("cpu", "warp")


class TwinBatch(Claimable):
    """Twins with equal numbers of connectors and equal ticks, stepped in parallel.

    Attributes:
        twins: twin of each run, a `TwinSnake` that can also be used alone.
        tick: control tick, s.
        state: latest state of every run, with a leading axis of runs on every field.
            For a diverged run, the state is the last plausible state.
        errors: error that ended each run, or None for runs that have not diverged.
            Ended runs are not advanced until `reset`.
    """

    twins: tuple[TwinSnake, ...]
    state: SnakeState
    errors: list[DivergedError | None]

    def __new__(
        cls,
        *arguments: Any,
        engine: str = "cpu",
        device: str | None = None,
        **settings: Any,
    ) -> Any:
        """Return a batch for the chosen engine.

        Args:
            *arguments: positional arguments of `__init__`.
            engine: "cpu" for MuJoCo, or "warp" for MuJoCo Warp.
            device: device of Warp, such as "cuda:0" or "cpu". The default is Warp's
                default device.
            **settings: keyword arguments of `__init__`. With `deterministic=True`, Warp
                computes sums in a fixed order.

        Raises:
            InputError: MuJoCo Warp is not installed, or does not support the settings.
            UnknownNameError: the engine is unknown.
        """
        check_choice("engine", engine, ENGINES)
        if engine == "cpu":
            return super().__new__(cls)
        return on_warp(*arguments, device=device, **settings)

    @checked
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
            specs: robot of each run. The robots must have equal numbers of connectors.
            supply_pa: supply pressure of all runs or of each run, Pa. The default is
                the nominal pressure of each robot.
            threads: number of threads. The default is one thread per processor.
            engine: engine, "cpu" or "warp". See `__new__`.
            **settings: further arguments of `TwinSnake`, which apply to all runs.

        Raises:
            InputError: there is no run, the robots differ in the number of connectors,
                the number of pressures is wrong, `pneumatics` is an object, or
                `TwinSnake` rejects an argument.
        """
        self._workers = Workers(threads)
        self.twins = _twins(self._workers, specs, supply_pa, settings)
        self.tick = self.twins[0].tick
        self.reset()

    def __len__(self) -> int:
        """Return the number of runs."""
        return len(self.twins)

    def reset(
        self, *, poses: Sequence[Pose] | None = None, seed: int = 0
    ) -> SnakeState:
        """Reset all snakes to a straight shape at rest with empty chambers.

        Args:
            poses: centre of mass x, y (m) and mean heading (rad) of each run. The
                default is the origin.
            seed: random seed of the twins.

        Returns:
            The states of all runs, which are also stored in the attribute `state`.

        Raises:
            InputError: the number of poses differs from the number of runs.
        """
        if poses is None:
            places = [(0.0, 0.0, 0.0)] * len(self)
        else:
            places = list(poses)
        check_one_per_run("poses", places, len(self))
        self.errors = [None] * len(self)
        resting = self._workers.run(
            len(self), lambda k, _: self.twins[k].reset(pose=places[k], seed=seed)
        )
        self.state = SnakeState.history(resting)
        return self.state

    def step(self, valves: np.ndarray) -> SnakeState:
        """Advance all runs by one tick and return their states.

        Args:
            valves: valve commands as in `Plant.step`, with a leading axis of runs,
                shape (runs, segments, 2) or (runs, slots, segments, 2).

        Raises:
            InputError: the shape is wrong, or the valve layout does not allow a
                commanded state. No run is advanced in this case.
        """
        self.advance(valves, 1)
        return self.state

    def advance(self, valves: np.ndarray, samples: int) -> list[SnakeState | None]:
        """Advance all runs by one tick. A run ends if its commands have diverged.

        Args:
            valves: valve commands as in `step`.
            samples: number of equally spaced samples. The last sample is at the end of
                the tick.

        Returns:
            The history of each run, as returned by `play`.

        Raises:
            InputError: `step` would reject the valve commands.
        """
        check_one_per_run("valves", valves, len(self))
        errors = [
            self.errors[k] or self._command_error(k, commands)
            for k, commands in enumerate(valves)
        ]
        schedules = [
            None if error else twin.pneumatics.schedule(commands, self.tick)
            for twin, commands, error in zip(self.twins, valves, errors, strict=True)
        ]
        self.errors = errors
        return self.play(schedules, samples)

    def play(
        self, schedules: Sequence[Schedule | None], samples: int
    ) -> list[SnakeState | None]:
        """Execute schedules of valve commands without feedback.

        Args:
            schedules: valve schedule for each run, which lasts a whole number of ticks.
                Runs whose schedule is None are not advanced.
            samples: number of equally spaced samples of each run. The last sample is at
                the end of the schedule.

        Returns:
            The history of each run. If a run diverges, its history ends at the
            divergence. The history of a run without samples is None.

        Raises:
            InputError: the number of schedules differs from the number of runs, or
                `Plant.play` rejects a schedule.
        """
        check_one_per_run("schedules", schedules, len(self))
        histories = self._workers.run(
            len(self), lambda k, _: self._play(k, schedules[k], samples)
        )
        last = [
            self.state.at(k) if history is None else history.at(-1)
            for k, history in enumerate(histories)
        ]
        self.state = SnakeState.history(last)
        return histories

    def openings(self) -> np.ndarray:
        """Return the number of openings of each inlet, shape (runs, segments, 2)."""
        return np.array([twin.openings() for twin in self.twins])

    def describe(self) -> dict[str, object]:
        """Return the batch settings that a recording stores, as JSON values."""
        return {}

    def _command_error(self, k: int, valves: np.ndarray) -> DivergedError | None:
        try:
            check_commands("policy", float(np.asarray(self.state.time)[k]), valves)
        except DivergedError as error:
            return error.with_traceback(None)
        return None

    def _play(
        self, k: int, schedule: Schedule | None, samples: int
    ) -> SnakeState | None:
        if schedule is None or self.errors[k] is not None:
            return None
        try:
            return self.twins[k].play(schedule, samples)
        except DivergedError as error:
            # The traceback would keep the engine's records in memory.
            self.errors[k] = error.with_traceback(None)
            history: SnakeState | None = error.history
            return history


def check_one_per_run(name: str, given: Sized, runs: int) -> None:
    """Check that a sequence has one item per run.

    Raises:
        InputError: the number of items differs from the number of runs.
    """
    if len(given) != runs:
        raise InputError(
            f"{name}: {len(given)} values are given for {runs} runs; give one value"
            " per run"
        )


def on_warp(
    specs: Sequence[RobotSpec],
    *,
    supply_pa: float | Sequence[float] | None = None,
    threads: int | None = None,
    device: str | None = None,
    deterministic: bool = False,
    **settings: Any,
) -> Any:
    """Build a `WarpBatch` with the arguments of `TwinBatch`."""
    return warp_batch()(
        _twins(Workers(threads), specs, supply_pa, settings, once=True),
        device=device,
        deterministic=deterministic,
    )


def warp_batch() -> Any:
    """Import and return the class `WarpBatch`.

    Raises:
        InputError: MuJoCo Warp is not installed.
    """
    try:
        return extensions.load(extensions.ENGINES["warp"])
    except ImportError as error:
        raise InputError(
            "engine 'warp' needs MuJoCo Warp; install it with: pip install"
            " 'srs-twin[gpu]'"
        ) from error


def _twins(
    workers: Workers,
    specs: Sequence[RobotSpec],
    supply_pa: float | Sequence[float] | None,
    settings: Mapping[str, Any],
    *,
    once: bool = False,
) -> tuple[TwinSnake, ...]:
    supplies = _one_per_run("supply_pa", supply_pa, len(specs))
    counts = sorted({spec.geometry.connectors for spec in specs})
    if len(counts) != 1:
        numbers = ", ".join(map(str, counts)) or "no robot"
        raise InputError(
            "the robots of a batch must have the same number of connectors, but they"
            f" have {numbers}"
        )
    if isinstance(settings.get("pneumatics"), Pneumatics):
        raise InputError(
            "the twins of a batch cannot share one pneumatics object; give the name"
            " of the pneumatic model instead, such as 'lag'"
        )
    keys = [
        repr(pair) if once else str(k)
        for k, pair in enumerate(zip(specs, supplies, strict=True))
    ]
    first_run = {key: k for k, key in reversed(list(enumerate(keys)))}
    distinct = sorted(first_run.values())
    built = workers.run(
        len(distinct),
        lambda n, _: TwinSnake(
            specs[distinct[n]], supply_pa=supplies[distinct[n]], **settings
        ),
    )
    twin_of_run = dict(zip(distinct, built, strict=True))
    return tuple(twin_of_run[first_run[key]] for key in keys)


def _one_per_run(
    name: str, values: float | Sequence[float] | None, runs: int
) -> list[float | None]:
    if values is None or isinstance(values, int | float):
        return [values] * runs
    if len(values) != runs:
        raise InputError(
            f"{name}: {len(values)} values are given for {runs} runs; give one value,"
            " or one per run"
        )
    return list(values)
