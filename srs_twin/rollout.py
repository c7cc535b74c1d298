"""Functions that simulate plants under controllers.

The function `rollout` simulates one run, and `run_many` simulates independent runs on
several threads. The function `run_batch` simulates a batch of twins under one policy,
which computes the valve commands of all twins at every tick.

>>> from functools import partial
>>> from srs_twin import AnalyticalSnake, Gait, Job, load_robot, run_many
>>> snake = partial(AnalyticalSnake, load_robot("gen2"))
>>> runs = run_many([Job(snake, Gait(2.0, offset), 1.0) for offset in (-0.2, 0.0, 0.2)])
>>> [round(float(run["heading"][-1]), 1) for run in runs]
[-0.7, -0.3, 0.3]
"""

from __future__ import annotations

import math
import reprlib
import threading
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from types import MappingProxyType
from typing import TYPE_CHECKING, Any

import numpy as np

from srs_twin.compute.claims import claim
from srs_twin.compute.workers import IsCancelled, Workers
from srs_twin.control.base import Controller
from srs_twin.errors import (
    DivergedError,
    InputError,
    SamplingGrid,
    count_steps,
    format_exact,
    named_in_errors,
    nearest_rate,
    shortest_decimal,
)
from srs_twin.io.arguments import check_types, checked
from srs_twin.io.saved_state import SavedState
from srs_twin.plants.base import (
    Plant,
    PlantState,
    PneumaticPlant,
    Pose,
    SnakeState,
    SpatialState,
    check_commands,
    check_plausible,
)
from srs_twin.plants.clearance import PENETRATION_M, TOUCHING_M, check_start, clearance
from srs_twin.pneumatics.valves import Schedule
from srs_twin.robot.spec import RobotSpec
from srs_twin.trajectory import Event, Trajectory

if TYPE_CHECKING:
    from srs_twin.plants.twin.batch import TwinBatch
else:
    TwinBatch = Any  # a batch on another engine has another class


Observer = Callable[[SnakeState], None]
PlaceFunction = Callable[[Plant, int], SnakeState]
"""Function that takes a plant and a seed, sets the initial state and returns it."""

Policy = Callable[[SnakeState], np.ndarray]
"""Function that maps the states of all twins in a batch to valve commands."""


def rollout(
    plant: Plant,
    controller: Controller,
    duration: float,
    *,
    pose: Pose | None = None,
    initial_state: PlaceFunction | None = None,
    resume: tuple[PlantState, SavedState] | None = None,
    seed: int = 0,
    record_hz: float = 100,
    until: Callable[[SnakeState], bool] | None = None,
    observers: Iterable[Observer] = (),
    progress: Callable[[float], None] | None = None,
) -> Trajectory:
    """Simulate a plant under a controller and record the trajectory.

    The snake starts at rest at `pose`, unless `initial_state` or `resume` is given. A
    controller without sensor input provides a script of valve commands, which the plant
    executes in chunks of many ticks. A controller with sensor input is called at every
    tick, as is any controller if `until` or `observers` is given.

    Args:
        plant: simulated robot.
        controller: controller that computes the valve states.
        duration: simulated time, a multiple of the plant's tick, s.
        pose: initial centre of mass x, y (m) and mean heading (rad), zero by default.
        initial_state: function that takes the plant and the seed, sets another initial
            state (see `Plant.set_state`) and returns it.
        resume: saved states of plant and controller from which the run continues,
            including the simulated time. Settings of a controller that can change
            during a run, such as the frequency of a gait, are those of the saved state.
        seed: random seed of plant and controller.
        record_hz: sampling rate, Hz. Either the number of samples per tick or the
            number of ticks per sample must be an integer.
        until: function of the state that ends the run after the first tick at which it
            returns True.
        observers: functions called with the initial state and with the state after
            every tick. The arrays in the states are read-only.
        progress: function called at intervals with the time simulated so far, s.

    Returns:
        Trajectory that begins with the initial state. If `until` or the controller ends
        the run between two samples, the last state is recorded as well. The metadata
        contain the reason for an early end (``ended_by``) and the description of the
        controller (``control``).

    Raises:
        InputError: the duration or the sampling period is not a multiple of the tick,
            or several of pose, initial_state and resume are given. The error is also
            raised if the controller does not support the robot, the valves or the
            saved state or returns invalid valve states or signals, if an obstacle
            overlaps the body at the start, or if another thread uses the plant or the
            controller.
        DivergedError: the plant or the controller diverged. The attribute `trajectory`
            of the error contains the samples before the divergence.
    """
    check_types("rollout", rollout, locals())
    if sum(start is not None for start in (pose, initial_state, resume)) > 1:
        raise InputError(
            "rollout: the arguments `pose`, `initial_state` and `resume` each set the"
            " initial state; give only one of them"
        )
    ticks = count_steps("duration", duration, "tick", plant.tick)
    recorder = Recorder(plant, controller, record_hz, duration)
    _check_drives(controller, plant)
    with claim(plant), claim(controller):
        if resume is None:
            state = _initial_state(plant, pose, initial_state, seed)
            controller.reset(plant.spec, plant.tick, seed=seed)
        else:
            plant.reset(seed=seed)
            controller.reset(plant.spec, plant.tick, seed=seed)
            state = plant.restore(resume[0])
            controller.restore(resume[1])
        recorder.add(state)
        observers = tuple(observers)
        script = None
        if until is None and not observers:
            begun = float(state.time)
            script = _script(controller, begun, ticks * plant.tick)
        try:
            if script is None or not _play_script(recorder, script, ticks, progress):
                _step_ticks(recorder, state, ticks, until, observers, progress)
        except DivergedError as error:
            if error.history is not None and len(error.history.time):
                with suppress(InputError):
                    recorder.add(error.history)
            error.trajectory = recorder.trajectory()
            if excess := _excessive_air_work(plant, error.trajectory):
                raise excess from error
            raise
        trajectory = recorder.trajectory()
        if excess := _excessive_air_work(plant, trajectory):
            raise excess
        return trajectory


def _excessive_air_work(plant: Plant, run: Trajectory) -> DivergedError | None:
    if not isinstance(plant, PneumaticPlant) or not plant.measures_air:
        return None
    if not plant.has_coupled_air:
        return None
    from srs_twin.plants.air_work import excessive_air_work

    return excessive_air_work(plant, run)


def _initial_state(
    plant: Plant, pose: Pose | None, initial_state: PlaceFunction | None, seed: int
) -> SnakeState:
    if initial_state is None:
        state = plant.reset(pose=(0.0, 0.0, 0.0) if pose is None else pose, seed=seed)
        check_start(plant, state, TOUCHING_M)
    else:
        state = initial_state(plant, seed)
        if not isinstance(state, SnakeState):
            raise InputError(
                f"rollout: initial_state returned {state!r}, but must return the state"
                " that it sets, as `plant.set_state` does"
            )
        # The body may already touch an obstacle in a state from another run.
        check_start(plant, state, PENETRATION_M * plant.spec.scale.length)
    return state


def _check_drives(controller: Controller, plant: Plant) -> None:
    if plant.layout not in controller.layouts:
        raise InputError(
            f"controller '{controller.kind}' needs valves of layout"
            f" {', '.join(controller.layouts)}, but the {plant.name} plant has the"
            f" layout {plant.layout} (valves of layout in_out can hold the air, 3/2"
            " valves cannot)"
        )
    if not controller.spatial:
        plant.spec.require_planar(f"controller '{controller.kind}'")


def _script(controller: Controller, start: float, span: float) -> Schedule | None:
    script = controller.script(start + span)
    if script is not None and start:
        script = script.slice(start, start + span)
    return script


def _play_script(
    recorder: Recorder,
    script: Schedule,
    ticks: int,
    progress: Callable[[float], None] | None,
) -> bool:
    """Simulate a script in chunks, or return False if the plant cannot run scripts."""
    plant = recorder.plant
    stride = recorder.stride
    controller = _describe_controller(recorder.controller)
    chunk = max(1, round(plant.max_chunk_s / plant.tick / stride)) * stride
    recorded = ticks - ticks % stride
    done = 0
    while done < ticks:
        is_recorded = done < recorded
        end = recorded if is_recorded else ticks
        count = min(chunk, end - done)
        commands = script.slice(done * plant.tick, (done + count) * plant.tick)
        samples = 1
        if is_recorded:
            samples = count * recorder.samples // stride
        with named_in_errors(controller):
            check_commands(controller, done * plant.tick, commands.states)
            history = plant.play(commands, samples)
        if history is None:
            return False
        check_plausible(plant.name, history)
        if is_recorded:
            recorder.add(history)
        done += count
        if progress is not None:
            progress(done * plant.tick)
    return True


def _step_ticks(
    recorder: Recorder,
    state: SnakeState,
    ticks: int,
    until: Callable[[SnakeState], bool] | None,
    observers: tuple[Observer, ...],
    progress: Callable[[float], None] | None,
) -> None:
    plant = recorder.plant
    controller = recorder.controller
    name = _describe_controller(controller)
    state.make_read_only()
    for observe in observers:
        observe(state)
    for k in range(1, ticks + 1):
        valves = controller.step(state)
        with named_in_errors(name):
            check_commands(name, (k - 1) * plant.tick, valves)
            states = plant.advance(valves, recorder.samples)
        for sample in states:
            check_plausible(plant.name, sample)
        state = states[-1]
        state.make_read_only()
        recorder.ended_by = _end_of_run(controller, until, state)
        ends = recorder.ended_by is not None
        if k % recorder.stride == 0 or ends:
            for sample in states:
                recorder.add(sample)
        recorder.events.extend(controller.events())
        for observe in observers:
            observe(state)
        if progress is not None:
            progress(k * plant.tick)
        if ends:
            break


def _end_of_run(
    controller: Controller,
    until: Callable[[SnakeState], bool] | None,
    state: SnakeState,
) -> str | None:
    if controller.finished:
        return "controller"
    if until is not None and until(state):
        return "until"
    return None


def _describe_controller(controller: Controller) -> str:
    return f"controller '{controller.kind}'"


def sample_counts(
    tick: float, record_hz: float, step: float | None = None
) -> tuple[int, int]:
    """Return the number of samples per tick and the number of ticks per sample.

    At least one of the two numbers is 1.

    Args:
        tick: control tick of the plant, s.
        record_hz: sampling rate, Hz.
        step: time step of which the sampling interval must be a multiple, s, or None.

    Raises:
        InputError: the rate is not compatible with the tick. The message suggests the
            nearest allowed rate.
    """
    if not 0 < record_hz < math.inf:
        raise InputError(
            f"`record_hz` {record_hz:g} is not allowed; it must be finite and above 0"
        )
    grid = SamplingGrid(tick, step)
    if not grid.fits(record_hz):
        base = shortest_decimal(1 / tick, lambda rate: grid.fits(rate, 1e-10)) + " Hz"
        if step is not None:
            base += f" with an interval that is a multiple of {format_exact(step)} s"
        raise InputError(
            f"`record_hz` {format_exact(record_hz)} does not fit the tick of"
            f" {format_exact(tick)} s; use {nearest_rate(record_hz, [grid])} Hz, or"
            f" any integer multiple or integer fraction of {base}"
        )
    return max(1, round(tick * record_hz)), max(1, round(1 / (tick * record_hz)))


class Recorder:
    """Recorder that builds a trajectory from plant states and controller signals.

    Attributes:
        plant: recorded plant.
        controller: controller whose signals are recorded.
        samples: number of samples per tick.
        stride: number of ticks per sample, or 1 if there are several samples per tick.
        events: events reported by the controller.
        ended_by: reason for an early end, "until" or "controller", or None if the run
            did not end early.
    """

    def __init__(
        self, plant: Plant, controller: Controller, record_hz: float, duration: float
    ) -> None:
        self.plant = plant
        self.controller = controller
        self.samples, self.stride = sample_counts(
            plant.tick, record_hz, plant.sample_step
        )
        self._settings = {"record_hz": record_hz, "duration_s": duration}
        self._states: list[SnakeState] = []
        self._signals: list[tuple[int, dict[str, float]]] = []
        self.events: list[Event] = []
        self.ended_by: str | None = None

    def add(self, state: SnakeState) -> None:
        """Append one or several states, with the current signals of the controller.

        Raises:
            InputError: the signals are invalid.
        """
        with named_in_errors(_describe_controller(self.controller)):
            signals = _flatten_signals(self.controller.signals())
            if self._signals:
                wrong = signals.keys() ^ self._signals[0][1].keys()
            else:
                columns = self._columns(SnakeState.history([state]), {})
                wrong = signals.keys() & columns.keys()
            if wrong:
                raise _signal_error(f"signal '{min(wrong, key=str)}'")
        self._states.append(state)
        self._signals.append((np.size(state.time), signals))

    def trajectory(
        self, metadata: Mapping[str, object] = MappingProxyType({})
    ) -> Trajectory:
        """Return the trajectory recorded so far, with additional metadata."""
        counts = [count for count, _ in self._signals]
        signals = {
            name: np.repeat([values[name] for _, values in self._signals], counts)
            for name in self._signals[0][1]
        }
        return Trajectory(
            self._columns(SnakeState.history(self._states), signals),
            events=tuple(self.events),
            metadata={**self._metadata(), **metadata},
        )

    def _columns(
        self, states: SnakeState, signals: Mapping[str, np.ndarray]
    ) -> dict[str, np.ndarray]:
        def values_of(name: str) -> np.ndarray:
            return np.asarray(getattr(states, name), dtype=float)

        columns = {"time": values_of("time")}
        columns |= _numbered_columns("com_", values_of("com"), "xy")
        columns["heading"] = values_of("heading")
        for axis, name in enumerate("xy"):
            columns |= _numbered_columns(f"{name}_", values_of("position")[..., axis])
        if isinstance(states, SpatialState):
            columns |= _spatial_columns(states)
        else:
            columns |= _planar_columns(states)
        has_energy = {
            "work": True,
            "internal_loss": self.plant.has_internal_loss,
            "pneumatic_energy": self.plant.measures_air,
        }
        columns |= {name: values_of(name) for name, has in has_energy.items() if has}
        if self.plant.has_contact:
            force = values_of("obstacle_force")
            for axis, name in enumerate("xy"):
                columns |= _numbered_columns(
                    f"obstacle_force_{name}_", force[..., axis]
                )
        for k in range(self.plant.objects):
            first = 3 * (k - self.plant.objects)
            for axis, name in enumerate(("x", "y", "heading")):
                columns[f"object_{name}_{k + 1}"] = values_of("qpos")[:, first + axis]
        if self.plant.world is not None and self.plant.world.is_solid:
            columns["clearance"] = clearance(self.plant, states)
        columns |= signals
        return columns | _numbered_columns("qpos_", values_of("qpos"))

    def _metadata(self) -> dict[str, object]:
        plant = self.plant
        geometry = self.plant.spec.geometry
        metadata: dict[str, object] = {
            **plant.describe(),
            **self._settings,
            "body_length_m": geometry.body_length,
            "body_width_m": geometry.width,
        }
        if plant.spec.is_spatial:
            metadata["spatial"] = True
        return metadata | {
            "segment_length_m": geometry.segment_length,
            "rigid_gap_m": geometry.rigid_gap,
            "mass_kg": plant.spec.mass.total,
            "controller": self.controller.kind,
            "gait_frequency_hz": self.controller.frequency,
            "control": self.controller.describe(),
            "ended_by": self.ended_by,
            "valve_switches": plant.openings().tolist() if plant.measures_air else None,
        }


def _planar_columns(states: SnakeState) -> dict[str, np.ndarray]:
    columns: dict[str, np.ndarray] = {}
    for name in ("connector_heading", "bend", "measured_bend", "torque"):
        columns |= _numbered_columns(f"{name}_", getattr(states, name))
    for name, values in (("pressure", states.pressure), ("valve", states.valves)):
        chambers = np.asarray(values, dtype=float)
        columns |= _numbered_columns(f"{name}_plus_", chambers[..., 0])
        columns |= _numbered_columns(f"{name}_minus_", chambers[..., 1])
    return columns


def _spatial_columns(states: SpatialState) -> dict[str, np.ndarray]:
    columns = _numbered_columns(
        "connector_heading_", states.connector_heading
    ) | _numbered_columns("z_", states.height)
    for k, axis in enumerate("wxyz"):
        columns |= _numbered_columns(f"quaternion_{axis}_", states.orientation[..., k])
    columns |= _numbered_columns("load_", states.load)
    pairs = {
        "bend": "pitch",
        "measured_bend": "measured_pitch",
        "torque": "torque_pitch",
    }
    for left, up in pairs.items():
        values = getattr(states, left)
        columns |= _numbered_columns(f"{left}_", values[..., 0]) | _numbered_columns(
            f"{up}_", values[..., 1]
        )
    for name, values in (("pressure", states.pressure), ("valve", states.valves)):
        for k in range(values.shape[-1]):
            columns |= _numbered_columns(
                f"{name}_{k + 1}_", np.asarray(values[..., k], dtype=float)
            )
    return columns


def _flatten_signals(signals: Mapping[str, float | np.ndarray]) -> dict[str, float]:
    flat: dict[str, float] = {}
    wrong = reprlib.repr(signals)
    try:
        for name, value in signals.items():
            wrong = f"signal '{name}'"
            if np.ndim(value) == 0:
                flat[name] = float(value)
            else:
                flat |= {
                    f"{name}_{i}": float(v)
                    for i, v in enumerate(np.ravel(value), start=1)
                }
    except (AttributeError, OverflowError, TypeError, ValueError) as error:
        raise _signal_error(wrong) from error
    return flat


def _signal_error(wrong: str) -> InputError:
    return InputError(
        f"{wrong} is not allowed; `signals` must return a mapping to numbers or arrays"
        " of numbers. Its names must be the same at every tick and differ from the"
        " columns of the plant"
    )


def _numbered_columns(
    prefix: str, values: np.ndarray, names: str | None = None
) -> dict[str, np.ndarray]:
    """Split an array (samples, n) into columns with the suffixes 1…n or `names`."""
    suffixes = names or [str(i) for i in range(1, values.shape[1] + 1)]
    return {f"{prefix}{suffix}": values[:, i] for i, suffix in enumerate(suffixes)}


@dataclass(frozen=True)
class Job:
    """Arguments of one `rollout` call in `run_many`.

    Attributes:
        plant: simulated robot, or a function that builds it. A thread reuses the plant
            for consecutive jobs with the same function.
        controller: controller that computes the valve states, or a function that builds
            a controller for every job.
        duration: simulated time, s.
        pose: initial centre of mass x, y (m) and mean heading (rad), zero by default.
        seed: random seed of plant and controller.
        record_hz: sampling rate, Hz.
        initial_state: function that sets another initial state, as in `rollout`.
    """

    plant: Plant | Callable[[], Plant]
    controller: Controller | Callable[[], Controller]
    duration: float
    pose: Pose | None = None
    seed: int = 0
    record_hz: float = 100
    initial_state: PlaceFunction | None = None

    def __post_init__(self) -> None:
        check_types("Job", Job, vars(self))


@checked
def run_many(
    jobs: Iterable[Job],
    *,
    threads: int | None = None,
    progress: Callable[[int], None] | None = None,
) -> list[Trajectory | DivergedError]:
    """Run jobs on several threads.

    The trajectories are bit-identical to those of `rollout`.

    Args:
        jobs: jobs to run. Two jobs must not share a plant or controller object.
        threads: number of threads, by default one per processor.
        progress: function called in the calling thread with the number of finished
            jobs.

    Returns:
        Trajectory of each job, in the order of the jobs. For a diverged job, the list
        contains the error, whose attribute `trajectory` has the samples before the
        divergence.

    Raises:
        InputError: two jobs share a plant or a controller, or a job cannot be run. The
            message contains the job number.
    """
    jobs = list(jobs)
    _check_not_shared(jobs)
    thread_data = threading.local()

    def run(k: int, is_cancelled: IsCancelled) -> Trajectory | DivergedError:
        def check_cancelled(time: float) -> None:
            if is_cancelled():
                raise _CancelledError

        job = jobs[k]
        try:
            with named_in_errors(f"job {k + 1} of {len(jobs)}"):
                controller = job.controller
                if not isinstance(controller, Controller):
                    controller = controller()
                plant = _build_plant(job, thread_data)
                parts = {"plant": plant, "controller": controller}
                return rollout(**vars(job) | parts, progress=check_cancelled)
        except DivergedError as error:
            # The frames of the traceback would keep the plant in memory.
            return error.with_traceback(None)

    return Workers(threads).run(len(jobs), run, progress)


@checked
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
    """Simulate a batch of twins under one policy, which is evaluated at every tick.

    Args:
        batch: batch of twins, one per run.
        policy: function that maps the states of all twins (leading axis: runs) to valve
            commands of shape (runs, segments, 2) or (runs, slots, segments, 2).
        duration: simulated time, a multiple of the tick, s.
        poses: initial pose of each twin, as in `rollout`.
        seed: random seed of the twins.
        record_hz: sampling rate, as in `rollout`, Hz.
        progress: function called after every tick with the simulated time, s.

    Returns:
        Trajectory of each twin, in the order of the batch. For a diverged twin, the
        list contains the error, whose attribute `trajectory` has the samples before the
        divergence. The simulation of the remaining twins continues.

    Raises:
        InputError: the duration or the sampling rate does not fit the tick, or a valve
            command is invalid.
    """
    ticks = count_steps("duration", duration, "tick", batch.tick)
    with claim(batch):
        controllers = [_PolicyController() for _ in batch.twins]
        recorders = _record_start(
            batch, controllers, duration, record_hz, poses=poses, seed=seed
        )
        samples = recorders[0].samples
        stride = recorders[0].stride
        for tick in range(1, ticks + 1):
            histories = batch.advance(policy(batch.state), samples)
            for recorder, history, error in zip(
                recorders, histories, batch.errors, strict=True
            ):
                if history is not None and (tick % stride == 0 or error is not None):
                    recorder.add(history)
            if progress is not None:
                progress(tick * batch.tick)
            if all(batch.errors):
                break
        return _finish_batch(batch, recorders)


def _record_start(
    batch: TwinBatch,
    controllers: Sequence[Controller],
    duration: float,
    record_hz: float,
    poses: Sequence[Pose] | None,
    seed: int,
) -> list[Recorder]:
    pairs = zip(batch.twins, controllers, strict=True)
    recorders = [
        Recorder(twin, controller, record_hz, duration) for twin, controller in pairs
    ]
    resting = batch.reset(poses=poses, seed=seed)
    for k, recorder in enumerate(recorders):
        check_start(recorder.plant, resting.at(k))
        recorder.add(resting.at(k))
    return recorders


def _finish_batch(
    batch: TwinBatch, recorders: Sequence[Recorder]
) -> list[Trajectory | DivergedError]:
    results: list[Trajectory | DivergedError] = []
    for recorder, openings, error in zip(
        recorders, batch.openings(), batch.errors, strict=True
    ):
        switches = openings.tolist() if recorder.plant.measures_air else None
        trajectory = recorder.trajectory(
            batch.describe() | {"valve_switches": switches}
        )
        if error is not None:
            error.trajectory = trajectory
        excess = _excessive_air_work(recorder.plant, trajectory)
        results.append(error or excess or trajectory)
    return results


@checked
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
    """Simulate a batch of twins, each under its own controller without sensor input.

    Args:
        batch: batch of twins, one per run.
        controllers: controllers without sensor input, one per twin.
        duration: simulated time, a multiple of the tick, s.
        poses: initial pose of each twin, as in `rollout`.
        seed: random seed of twins and controllers.
        record_hz: sampling rate, as in `rollout`, Hz.
        progress: function called at intervals with the simulated time, s.

    Returns:
        Trajectory or error of each twin, as in `run_batch`.

    Raises:
        InputError: a controller uses sensor readings, the numbers of controllers and
            twins differ, or an argument is invalid as in `run_batch`.
    """
    ticks = count_steps("duration", duration, "tick", batch.tick)
    if len(controllers) != len(batch.twins):
        raise InputError(
            f"{len(controllers)} controllers are given for {len(batch.twins)} runs;"
            " give one controller per run"
        )
    with claim(batch):
        scripts = []
        for twin, controller in zip(batch.twins, controllers, strict=True):
            controller.reset(twin.spec, twin.tick, seed=seed)
            script = controller.script(duration)
            if script is None:
                raise InputError(
                    f"controller '{controller.kind}' uses sensor readings, but"
                    " `run_scripts` needs a controller whose commands are known in"
                    " advance, such as Gait"
                )
            scripts.append(script)
        recorders = _record_start(
            batch, controllers, duration, record_hz, poses=poses, seed=seed
        )
        samples = recorders[0].samples
        stride = recorders[0].stride
        recorded = ticks - ticks % stride
        chunk = max(1, round(batch.twins[0].max_chunk_s / batch.tick / stride)) * stride
        for done in range(0, recorded, chunk):
            count = min(chunk, recorded - done)
            commands = [
                script.slice(done * batch.tick, (done + count) * batch.tick)
                for script in scripts
            ]
            for recorder, history in zip(
                recorders, batch.play(commands, count * samples // stride), strict=True
            ):
                if history is not None:
                    recorder.add(history)
            if progress is not None:
                progress((done + count) * batch.tick)
        return _finish_batch(batch, recorders)


def _check_not_shared(jobs: Sequence[Job]) -> None:
    first_user: dict[int, int] = {}
    for k, job in enumerate(jobs, start=1):
        for kind, shared in (("plant", job.plant), ("controller", job.controller)):
            if not isinstance(shared, Plant | Controller):
                continue
            first = first_user.setdefault(id(shared), k)
            if first != k:
                raise InputError(
                    f"jobs {first} and {k} share one {kind}, a"
                    f" {type(shared).__name__}; give each job its own {kind}, or a"
                    " function that builds one"
                )


def _build_plant(job: Job, thread_data: threading.local) -> Plant:
    if isinstance(job.plant, Plant):
        return job.plant
    if getattr(thread_data, "builder", None) is not job.plant:
        thread_data.plant = job.plant()
        thread_data.builder = job.plant
    plant: Plant = thread_data.plant
    return plant


class _CancelledError(Exception):
    """Exception that stops a simulation whose result is no longer needed."""


class _PolicyController(Controller):
    """Placeholder controller for a batch whose commands come from a policy."""

    kind = "policy"

    def reset(self, spec: RobotSpec, tick: float, *, seed: int = 0) -> None:
        """Do nothing, because the policy commands the valves."""

    def step(self, state: SnakeState) -> np.ndarray:
        return state.valves
