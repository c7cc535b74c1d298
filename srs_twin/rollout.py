"""rollout: drive a plant with a controller and record what happens."""

from __future__ import annotations

from collections.abc import Callable, Iterable

import numpy as np

from srs_twin.control.base import Controller
from srs_twin.errors import DivergedError, InputError, whole_steps
from srs_twin.plants.base import Plant, Pose, SnakeState
from srs_twin.trajectory import Event, Trajectory

Observer = Callable[[SnakeState], None]


def rollout(
    plant: Plant,
    controller: Controller,
    duration: float,
    *,
    pose: Pose = (0.0, 0.0, 0.0),
    seed: int = 0,
    record_hz: float = 100,
    until: Callable[[SnakeState], bool] | None = None,
    observers: Iterable[Observer] = (),
) -> Trajectory:
    """Run a plant under a controller from rest.

    Args:
        plant: what moves.
        controller: what commands its valves.
        duration: s, a multiple of the plant's tick.
        pose: where the snake lies at first: centre of mass x, y (m), mean heading (rad).
        seed: for plant and controller.
        record_hz: samples a second. Above the tick rate a whole number a tick, else every whole-numbered
            tick.
        until: ends the run after the tick in which it returns True.
        observers: called with the state at the start and after every tick.

    Returns:
        The samples from t = 0 on; where `until` ends the run between two, its last state as well.

    Raises:
        InputError: duration, tick, time step and record_hz do not fit together.
        DivergedError: the plant diverged; its `trajectory` holds what was recorded until then.
    """
    ticks = whole_steps("duration", duration, "tick", plant.tick)
    samples, stride = _sampling(plant.tick, record_hz)
    watchers = tuple(observers)
    state = plant.reset(pose=pose, seed=seed)
    controller.reset(plant.spec, plant.tick, seed=seed)
    recorder = _Recorder(plant, controller, record_hz, duration)
    recorder.add(state)
    for watch in watchers:
        watch(state)
    for k in range(1, ticks + 1):
        try:
            states = plant.advance(controller.step(state), samples)
        except DivergedError as error:
            error.trajectory = recorder.trajectory()
            raise
        state = states[-1]
        ends = until is not None and until(state)
        if k % stride == 0 or ends:
            for sample in states:
                recorder.add(sample)
        recorder.events.extend(controller.events())
        for watch in watchers:
            watch(state)
        if ends:
            break
    return recorder.trajectory()


def _sampling(tick: float, record_hz: float) -> tuple[int, int]:
    """Return samples a tick and ticks a recorded tick; one of them is 1."""
    per_tick = tick * record_hz
    samples, stride = max(1, round(per_tick)), max(1, round(1 / per_tick))
    if abs(samples / stride - per_tick) > 1e-9 * per_tick:
        raise InputError(
            f"record_hz {record_hz:g} does not fit the tick {tick:g} s; "
            f"{samples / stride / tick:g} Hz or any whole multiple or fraction of {1 / tick:g} Hz would"
        )
    return samples, stride


class _Recorder:
    """Collects states and signals, and turns them into columns."""

    def __init__(self, plant: Plant, controller: Controller, record_hz: float, duration: float) -> None:
        self._plant, self._controller = plant, controller
        self._about = {"record_hz": record_hz, "duration_s": duration}
        self._states: list[SnakeState] = []
        self._signals: list[dict[str, float]] = []
        self.events: list[Event] = []

    def add(self, state: SnakeState) -> None:
        self._states.append(state)
        self._signals.append(_numbered(self._controller.signals()))

    def trajectory(self) -> Trajectory:
        columns = {"time": self._column("time")}
        columns |= _spread("com_", self._column("com"), "xy")
        columns["heading"] = self._column("heading")
        position = self._column("position")
        columns |= _spread("x_", position[..., 0]) | _spread("y_", position[..., 1])
        for name in ("theta", "bend", "sensed"):
            columns |= _spread(f"{name}_", self._column(name))
        for name, quantity in (("pressure", "pressure"), ("valve", "valves")):
            values = self._column(quantity)
            columns |= _spread(f"{name}_plus_", values[..., 0]) | _spread(f"{name}_minus_", values[..., 1])
        for name in self._signals[0]:
            columns[name] = np.array([s[name] for s in self._signals], dtype=float)
        columns |= _spread("qpos_", self._column("qpos"))
        return Trajectory(columns, events=tuple(self.events), metadata=self._metadata())

    def _column(self, name: str) -> np.ndarray:
        return np.array([getattr(s, name) for s in self._states], dtype=float)

    def _metadata(self) -> dict[str, object]:
        plant = self._plant
        return (
            plant.describe()
            | self._about
            | {
                "body_length_m": plant.spec.geometry.body_length,
                "controller": self._controller.kind,
                "gait_frequency_hz": self._controller.frequency,
                "valve_switches": plant.openings().tolist(),
            }
        )


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
