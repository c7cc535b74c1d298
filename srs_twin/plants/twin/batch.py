"""Parallel simulation of many twins with individual parameters (`TwinBatch`).

Each run has its own `TwinSnake`, and the results are bit-identical to those of separate
simulations. Each distinct robot is compiled once, and equal robots receive copies of
the compiled model.

A thread simulates complete twins, including chambers and sensors. Every call to the
engine releases the global interpreter lock.

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

from collections.abc import Sequence, Sized
from typing import Any, Unpack

import numpy as np

from srs_twin import extensions
from srs_twin.compute.claims import Claimable
from srs_twin.compute.workers import Workers
from srs_twin.errors import DivergedError, InputError, check_choice
from srs_twin.io.arguments import checked
from srs_twin.plants.base import Pose, SnakeState, check_commands
from srs_twin.plants.twin.snake import TwinKeywords, TwinSnake
from srs_twin.pneumatics import Pneumatics, Schedule
from srs_twin.robot.spec import RobotSpec

ENGINES = ("cpu", "warp")


class TwinBatch(Claimable):
    """Twins with equal numbers of connectors and equal ticks, which run in parallel.

    Attributes:
        twins: `TwinSnake` of each run, which can also be used alone.
        tick: control tick, s.
        state: latest states of all runs, with a leading axis of runs in every field.
            For a diverged run, the state is the last plausible state.
        errors: error that ended each run, or None if the run has not diverged. Diverged
            runs are not advanced until `reset`.
    """

    twins: tuple[TwinSnake, ...]
    state: SnakeState
    errors: list[DivergedError | None]

    def __new__(
        cls,
        *arguments: Sequence[RobotSpec],
        engine: str = "cpu",
        device: str | None = None,
        **settings: Any,
    ) -> Any:
        """Return a batch for the chosen engine.

        Args:
            *arguments: positional arguments of `__init__`.
            engine: "cpu" for MuJoCo, or "warp" for MuJoCo Warp.
            device: Warp device, such as "cuda:0" or "cpu". The default is Warp's
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
        **settings: Unpack[TwinKeywords],
    ) -> None:
        """Build the twins of all runs.

        Args:
            specs: robot of each run. The robots must have equal numbers of connectors.
            supply_pa: supply pressure, either one value for all runs or one value per
                run, Pa. The default is the nominal pressure of each robot.
            threads: number of threads. The default is one thread per processor.
            engine: simulation engine, "cpu" or "warp" (see `__new__`).
            **settings: further arguments of `TwinSnake`, which apply to all runs.

        Raises:
            InputError: `specs` is empty, the numbers of connectors differ, the number
                of pressures is wrong, `pneumatics` is not a name, or `TwinSnake`
                rejects an argument.
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
            poses: x and y coordinates of the centre of mass (m) and mean heading (rad)
                for each run. By default, all coordinates and headings are 0.
            seed: random seed of the sensor noise in all twins.

        Returns:
            Initial states of all runs, which are also stored in the attribute `state`.

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
        """Advance all runs by one control tick and return their states.

        Args:
            valves: valve commands as in `Plant.step`, with a leading axis of runs,
                shape (runs, segments, 2) or (runs, slots, segments, 2).

        Raises:
            InputError: the shape is wrong, or the valve layout does not allow a
                commanded state. No run is advanced after this error.
        """
        self.advance(valves, 1)
        return self.state

    def advance(self, valves: np.ndarray, samples: int) -> list[SnakeState | None]:
        """Advance all runs by one control tick.

        A run ends if its valve commands have diverged.

        Args:
            valves: valve commands as in `step`.
            samples: number of equally spaced samples. The last sample is at the end of
                the tick.

        Returns:
            History of each run, as returned by `play`.

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
        """Run a schedule of valve commands in each twin without feedback.

        Args:
            schedules: schedule of valve states for each run, with a duration of a whole
                number of control ticks. A run whose schedule is None is not advanced.
            samples: number of equally spaced samples of each run. The last sample is at
                the end of the schedule.

        Returns:
            History of each run, which ends before a divergence. The history of a run
            without samples is None.

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
        """Return how often each inlet valve has opened since `reset`.

        The array has the shape (runs, segments, chambers per segment).
        """
        return np.array([twin.openings() for twin in self.twins])

    def describe(self) -> dict[str, object]:
        """Return an empty mapping, because recordings store no batch settings."""
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


def check_one_per_run(
    name: str, given: Sized, runs: int, allowed: str = "one value per run"
) -> None:
    """Check that a sequence has one item per run.

    The error message names the sequence and what is allowed.

    Raises:
        InputError: the number of items differs from the number of runs.
    """
    if len(given) != runs:
        raise InputError(
            f"{name}: {len(given)} values are given for {runs} runs; give {allowed}"
        )


def on_warp(
    specs: Sequence[RobotSpec],
    *,
    supply_pa: float | Sequence[float] | None = None,
    threads: int | None = None,
    device: str | None = None,
    deterministic: bool = False,
    **settings: Unpack[TwinKeywords],
) -> Any:
    """Build a `WarpBatch` from the arguments of `TwinBatch`."""
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
    settings: TwinKeywords,
    *,
    once: bool = False,
) -> tuple[TwinSnake, ...]:
    supplies = _supplies(supply_pa, len(specs))
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
    run_of_key = {key: k for k, key in enumerate(keys)}
    distinct = list(run_of_key.values())
    built = workers.run(
        len(distinct),
        lambda n, _: TwinSnake(
            specs[distinct[n]], supply_pa=supplies[distinct[n]], **settings
        ),
    )
    twin_of_key = dict(zip(run_of_key, built, strict=True))
    return tuple(twin_of_key[key] for key in keys)


def _supplies(
    supply_pa: float | Sequence[float] | None, runs: int
) -> list[float | None]:
    if supply_pa is None or isinstance(supply_pa, int | float):
        return [supply_pa] * runs
    check_one_per_run("supply_pa", supply_pa, runs, "one value, or one per run")
    return list(supply_pa)
