"""Run plants under controllers and record them: `rollout` one, `run_many` many at once, `run_batch` a batch.

Jobs of `run_many` do not know of each other, on any plants, and each gives what `rollout` alone would have
given; with `run_batch` one policy looks at all twins of a batch and commands them, tick by tick. Kernels and
engine free the interpreter's lock while they step, so runs overlap on threads; bytes do not depend on how
many there are.

>>> from functools import partial
>>> from srs_twin import AnalyticalSnake, Gait, Job, load_robot, run_many
>>> snake = partial(AnalyticalSnake, load_robot("gen2"))
>>> runs = run_many([Job(snake, Gait(2.0, offset), 1.0) for offset in (-0.2, 0.0, 0.2)])
>>> [round(float(run["heading"][-1]), 1) for run in runs]
[-0.7, -0.3, 0.3]
"""

from __future__ import annotations

import math
import threading
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType
from typing import TYPE_CHECKING

import numpy as np

from srs_twin.compute.workers import Stopped, Workers
from srs_twin.control.base import Controller
from srs_twin.errors import Clock, DivergedError, InputError, decimal, exact, nearest_rate, whole_steps
from srs_twin.io.saved_state import SavedState
from srs_twin.plants.base import Plant, PlantState, Pose, SnakeState, check_commands, check_plausible
from srs_twin.pneumatics.valves import Schedule
from srs_twin.robot.spec import RobotSpec
from srs_twin.trajectory import Event, Trajectory

if TYPE_CHECKING:
    from srs_twin.plants.twin.batch import TwinBatch


Observer = Callable[[SnakeState], None]
Begin = Callable[[Plant, int], SnakeState]


def rollout(
    plant: Plant,
    controller: Controller,
    duration: float,
    *,
    pose: Pose = (0.0, 0.0, 0.0),
    begin: Begin | None = None,
    resume: tuple[PlantState, SavedState] | None = None,
    seed: int = 0,
    record_hz: float = 100,
    until: Callable[[SnakeState], bool] | None = None,
    observers: Iterable[Observer] = (),
    progress: Callable[[float], None] | None = None,
) -> Trajectory:
    """Run a plant under a controller, from rest unless told otherwise.

    Where nothing looks on (`until`, `observers`), a controller that does not sense runs its whole script on
    a plant that can follow one; otherwise they meet every tick.

    Args:
        plant: what moves.
        controller: what commands its valves.
        duration: s, a multiple of the plant's tick.
        pose: where the snake lies at first: centre of mass x, y (m), mean heading (rad).
        begin: brings the plant into another first state, from plant and seed, as `Plant.place` does.
        resume: saved states of plant and controller, from which both go on; the clock goes on, too.
        seed: for plant and controller.
        record_hz: samples a second. Above the tick rate a whole number a tick, else every whole-numbered
            tick.
        until: ends the run after the tick in which it returns True.
        observers: called with the state at the start and after every tick.
        progress: called now and then with the simulated time, s.

    Returns:
        The samples from the first state on; where `until` or a controller that has finished ends the run
        between two, its last state as well. Its metadata say which of them did (``ended_by``, None at the
        full duration), and what the controller says of itself (``control``).

    Raises:
        InputError: duration, tick, time step and record_hz do not fit together, or the controller cannot
            drive these valves, or a state that does not belong to them.
        DivergedError: the plant or the controller diverged; the error's `trajectory` holds what was recorded
            until then.
    """
    ticks = whole_steps("duration", duration, "tick", plant.tick)
    recorder = Recorder(plant, controller, record_hz, duration)
    if plant.layout not in controller.layouts:
        raise InputError(
            f"controller '{controller.kind}' drives valves of layout {', '.join(controller.layouts)}; "
            f"the {plant.name} plant has {plant.layout} (layout in_out can hold, 3/2 cannot)"
        )
    state = plant.reset(pose=pose, seed=seed) if begin is None else begin(plant, seed)
    controller.reset(plant.spec, plant.tick, seed=seed)
    if resume is not None:
        state = plant.restore(resume[0])
        controller.restore(resume[1])
    recorder.add(state)
    watchers, passed = tuple(observers), float(state.time)
    script = None if until is not None or watchers else controller.script(passed + ticks * plant.tick)
    if script is not None and passed:
        script = script.part(passed, passed + ticks * plant.tick)
    try:
        if script is None or not _play_script(recorder, script, ticks, progress):
            _step_ticks(recorder, state, ticks, until, watchers, progress)
    except DivergedError as error:
        if error.history is not None and len(error.history.time):
            recorder.add(error.history)
        error.trajectory = recorder.trajectory()
        raise
    return recorder.trajectory()


def _play_script(
    recorder: Recorder, script: Schedule, ticks: int, progress: Callable[[float], None] | None
) -> bool:
    """Let a plant follow a script; return whether it can.

    Stretches are whole numbers of recorded ticks, the last one apart, whose unrecorded rest is only played.
    """
    plant, stride, controller = recorder.plant, recorder.stride, _described(recorder.controller)
    stretch = max(1, round(plant.stretch / plant.tick / stride)) * stride
    recorded = ticks - ticks % stride
    begun = 0
    while begun < ticks:
        now = min(stretch, (recorded if begun < recorded else ticks) - begun)
        part = script.part(begun * plant.tick, (begun + now) * plant.tick)
        check_commands(controller, begun * plant.tick, part.states)
        history = plant.play(part, now * recorder.samples // stride if begun < recorded else 1)
        if history is None:
            return False
        check_plausible(plant.name, history)
        if begun < recorded:
            recorder.add(history)
        begun += now
        if progress is not None:
            progress(begun * plant.tick)
    return True


def _step_ticks(
    recorder: Recorder,
    state: SnakeState,
    ticks: int,
    until: Callable[[SnakeState], bool] | None,
    watchers: tuple[Observer, ...],
    progress: Callable[[float], None] | None,
) -> None:
    """Let the controller sense and command every tick."""
    plant, controller = recorder.plant, recorder.controller
    for watch in watchers:
        watch(state)
    for k in range(1, ticks + 1):
        valves = controller.step(state)
        check_commands(_described(controller), (k - 1) * plant.tick, valves)
        states = plant.advance(valves, recorder.samples)
        for sample in states:
            check_plausible(plant.name, sample)
        state = states[-1]
        if controller.finished:
            recorder.ended_by = "controller"
        elif until is not None and until(state):
            recorder.ended_by = "until"
        ends = recorder.ended_by is not None
        if k % recorder.stride == 0 or ends:
            for sample in states:
                recorder.add(sample)
        recorder.events.extend(controller.events())
        for watch in watchers:
            watch(state)
        if progress is not None:
            progress(k * plant.tick)
        if ends:
            break


def _described(controller: Controller) -> str:
    return f"controller '{controller.kind}'"


def sampling(tick: float, record_hz: float, step: float | None = None) -> tuple[int, int]:
    """Return samples per tick and ticks per recorded tick; one of them is 1.

    Args:
        tick: of the plant, s.
        record_hz: recording rate, Hz.
        step: `Plant.sample_step`, s.

    Raises:
        InputError: the rate does not fit; the message names the nearest one that does.
    """
    if not 0 < record_hz < math.inf:
        raise InputError(f"record_hz {record_hz:g} is not allowed; it must be finite and above 0")
    clock = Clock(tick, step)
    if not clock.fits(record_hz):
        whole = decimal(1 / tick, lambda rate: clock.fits(rate, 1e-10))
        whole += " Hz" if step is None else f" Hz with an interval that is a multiple of {exact(step)} s"
        raise InputError(
            f"record_hz {exact(record_hz)} does not fit the tick {exact(tick)} s; "
            f"{nearest_rate(record_hz, [clock])} Hz or any whole multiple or fraction of {whole} would"
        )
    return max(1, round(tick * record_hz)), max(1, round(1 / (tick * record_hz)))


class Recorder:
    """Collects states and signals, and turns them into columns.

    Attributes:
        plant: what is recorded.
        controller: whose signals are recorded.
        samples: a tick.
        stride: ticks a recorded tick.
        events: of the controller.
        ended_by: what ended the run before its time, "until" or "controller".
    """

    def __init__(self, plant: Plant, controller: Controller, record_hz: float, duration: float) -> None:
        self.plant, self.controller = plant, controller
        self.samples, self.stride = sampling(plant.tick, record_hz, plant.sample_step)
        self._about = {"record_hz": record_hz, "duration_s": duration}
        self._parts: list[SnakeState] = []
        self._signals: list[tuple[int, dict[str, float]]] = []
        self.events: list[Event] = []
        self.ended_by: str | None = None

    def add(self, state: SnakeState) -> None:
        """Add a moment or a history, with the controller's signals of now."""
        self._parts.append(state)
        self._signals.append((np.size(state.time), _numbered(self.controller.signals())))

    def trajectory(self, more: Mapping[str, object] = MappingProxyType({})) -> Trajectory:
        """Return what was added, with more to say of it."""
        self._states = SnakeState.history(self._parts)
        columns = {"time": self._column("time")}
        columns |= _spread("com_", self._column("com"), "xy")
        columns["heading"] = self._column("heading")
        position = self._column("position")
        columns |= _spread("x_", position[..., 0]) | _spread("y_", position[..., 1])
        for name in ("theta", "bend", "sensed", "torque"):
            columns |= _spread(f"{name}_", self._column(name))
        for name, quantity in (("pressure", "pressure"), ("valve", "valves")):
            values = self._column(quantity)
            columns |= _spread(f"{name}_plus_", values[..., 0]) | _spread(f"{name}_minus_", values[..., 1])
        columns["work"] = self._column("work")
        if self.plant.has_internal_loss:
            columns["internal_loss"] = self._column("internal_loss")
        if self.plant.metered:
            columns["air"] = self._column("air")
        if self.plant.touches:
            force = self._column("obstacle_force")
            columns |= _spread("obstacle_force_x_", force[..., 0])
            columns |= _spread("obstacle_force_y_", force[..., 1])
        counts = [count for count, _ in self._signals]
        for name in self._signals[0][1]:
            columns[name] = np.repeat([signals[name] for _, signals in self._signals], counts)
        columns |= _spread("qpos_", self._column("qpos"))
        return Trajectory(columns, events=tuple(self.events), metadata={**self._metadata(), **more})

    def _column(self, name: str) -> np.ndarray:
        return np.asarray(getattr(self._states, name), dtype=float)

    def _metadata(self) -> dict[str, object]:
        plant, geometry = self.plant, self.plant.spec.geometry
        return {
            **plant.describe(),
            **self._about,
            "body_length_m": geometry.body_length,
            "body_width_m": geometry.width,
            "segment_length_m": geometry.segment_length,
            "rigid_gap_m": geometry.rigid_gap,
            "mass_kg": plant.spec.mass.total,
            "controller": self.controller.kind,
            "gait_frequency_hz": self.controller.frequency,
            "control": self.controller.describe(),
            "ended_by": self.ended_by,
            "valve_switches": plant.openings().tolist() if plant.metered else None,
        }


def _numbered(signals: dict[str, float | np.ndarray]) -> dict[str, float]:
    """Give the elements of array signals names of their own, numbered from 1."""
    flat: dict[str, float] = {}
    for name, value in signals.items():
        if np.ndim(value) == 0:
            flat[name] = float(value)
        else:
            flat |= {f"{name}_{i}": float(v) for i, v in enumerate(np.ravel(value), start=1)}
    return flat


def _spread(prefix: str, values: np.ndarray, names: str | None = None) -> dict[str, np.ndarray]:
    """Return the columns of a (samples, n) array under prefix + 1…n, or prefix + each of `names`."""
    suffixes = names or [str(i) for i in range(1, values.shape[1] + 1)]
    return {f"{prefix}{suffix}": values[:, i] for i, suffix in enumerate(suffixes)}


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
        begin: brings the plant into another first state.
    """

    plant: Plant | Callable[[], Plant]
    controller: Controller | Callable[[], Controller]
    duration: float
    pose: Pose = (0.0, 0.0, 0.0)
    seed: int = 0
    record_hz: float = 100
    begin: Begin | None = None


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
                pose=job.pose, begin=job.begin, seed=job.seed, record_hz=job.record_hz, progress=go_on,
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
    samples, stride = sampling(batch.tick, record_hz, batch.twins[0].sample_step)
    recorders = [Recorder(twin, _PolicyController(), record_hz, duration) for twin in batch.twins]
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
    return _ended(batch, recorders)


def _ended(batch: TwinBatch, recorders: Sequence[Recorder]) -> list[Trajectory | DivergedError]:
    """Return what came of the runs of a batch; an error holds the trajectory up to it."""
    found: list[Trajectory | DivergedError] = []
    for recorder, opened, error in zip(recorders, batch.openings(), batch.errors, strict=True):
        counted = opened.tolist() if recorder.plant.metered else None
        trajectory = recorder.trajectory(batch.describe() | {"valve_switches": counted})
        if error is not None:
            error.trajectory = trajectory
        found.append(error or trajectory)
    return found


def run_scripts(
    batch: TwinBatch,
    controllers: Sequence[Controller],
    duration: float,
    *,
    poses: Sequence[Pose] | None = None,
    seed: int = 0,
    record_hz: float = 100,
    progress: Callable[[float], None] | None = None,
) -> list[Trajectory | DivergedError]:
    """Let each twin of a batch follow a controller that does not sense.

    Args:
        batch: the twins.
        controllers: one a twin.
        duration: s, a multiple of the tick.
        poses: one a twin, as in `rollout`; default all at the origin.
        seed: for twins and controllers.
        record_hz: samples a second, as in `rollout`.
        progress: called now and then with the simulated time, s.

    Returns:
        As `run_batch`.

    Raises:
        InputError: a controller that senses, not one a twin, or as in `run_batch`.
    """
    ticks = whole_steps("duration", duration, "tick", batch.tick)
    samples, stride = sampling(batch.tick, record_hz, batch.twins[0].sample_step)
    if len(controllers) != len(batch.twins):
        raise InputError(f"controllers: {len(controllers)} were given for {len(batch.twins)} runs")
    scripts = []
    for twin, controller in zip(batch.twins, controllers, strict=True):
        controller.reset(twin.spec, twin.tick, seed=seed)
        script = controller.script(duration)
        if script is None:
            raise InputError(f"controller '{controller.kind}' senses; a batch of scripts cannot run it")
        scripts.append(script)
    pairs = zip(batch.twins, controllers, strict=True)
    recorders = [Recorder(twin, controller, record_hz, duration) for twin, controller in pairs]
    resting = batch.reset(poses=poses, seed=seed)
    for k, recorder in enumerate(recorders):
        recorder.add(resting.at(k))
    whole = ticks - ticks % stride
    stretch = max(1, round(batch.twins[0].stretch / batch.tick / stride)) * stride
    for begun in range(0, whole, stretch):
        now = min(stretch, whole - begun)
        parts = [script.part(begun * batch.tick, (begun + now) * batch.tick) for script in scripts]
        for recorder, history in zip(recorders, batch.play(parts, now * samples // stride), strict=True):
            if history is not None:
                recorder.add(history)
        if progress is not None:
            progress((begun + now) * batch.tick)
    return _ended(batch, recorders)


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


class _PolicyController(Controller):
    """Stands in a recording for a policy that commands many snakes: it has no signals of its own."""

    kind = "policy"

    def reset(self, spec: RobotSpec, tick: float, *, seed: int = 0) -> None:
        """Nothing to prepare."""

    def step(self, state: SnakeState) -> np.ndarray:
        """Hold what there is: the policy commands the batch itself."""
        return state.valves
