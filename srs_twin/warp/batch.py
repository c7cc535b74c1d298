"""Simulation of many twins on a GPU with MuJoCo Warp (`WarpBatch`).

The equations of `TwinSnake` are solved in single precision. The model of each distinct
robot is compiled on the CPU and copied to the device.
"""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from dataclasses import fields, replace
from typing import NoReturn, SupportsIndex

import numpy as np
import warp as wp

from srs_twin.compute.claims import Claimable
from srs_twin.control.gait import Gait
from srs_twin.errors import DivergedError, EngineWarning, InputError, count_steps
from srs_twin.plants.base import Pose, SnakeState
from srs_twin.plants.twin.batch import check_one_per_run
from srs_twin.plants.twin.mjcf.numerics import LoadedContact
from srs_twin.plants.twin.snake import TwinSnake
from srs_twin.pneumatics import Schedule
from srs_twin.pneumatics.lag import LagPneumatics
from srs_twin.warp.engine import DeviceEngine, allocated_bytes
from srs_twin.warp.kernels import GaitWave

_INITIAL_LIFT = 1e-8
"""Height by which each snake is lifted at the start, m.

Without the lift, rounding errors would decide whether a snake at rest touches the
floor.
"""

_MAX_START_DISTANCE = 16.0
"""Maximum distance between a starting position and the device origin, m.

In single precision, a coordinate x has a rounding error of up to 2⁻²⁴ x, which is 1 µm
at 16 m. This error is 1 % of the distance that a snake at 0.1 m/s moves in a time step
of 1 ms.
"""

_MEMORY_FRACTION = 0.5
"""Maximum fraction of the free memory that one batch may occupy."""

_TWIN_BYTES = 3_000_000
"""Estimated CPU memory of one `TwinSnake`, bytes (2.8 MB for generation 2)."""


class WarpBatch(Claimable):
    """Batch of twins on a device, with the interface of `TwinBatch`.

    All twins have equal numbers of connectors and equal control ticks.

    Attributes:
        twins: `TwinSnake` of each run, which contains the settings of the run.
        tick: control tick, s.
        state: latest states of all runs, with a leading axis of runs in every field.
        errors: error that ended each run, or None if the run has not diverged.
        device: Warp device.
        origins: position of each run's device origin in the world frame, shape (runs,
            2), m. The device origin is the world origin, or the starting position if it
            is more than 16 m from the world origin.
    """

    claiming_methods = (*Claimable.claiming_methods, "run", "follow", "command")

    origins: np.ndarray
    state: SnakeState
    errors: list[DivergedError | None]
    _connector_heading: np.ndarray

    def __init__(
        self,
        twins: Sequence[TwinSnake],
        *,
        device: str | None = None,
        deterministic: bool = False,
    ) -> None:
        """Copy twins to a device.

        Args:
            twins: twin of each run. Runs with equal robots may share one object.
            device: name of the Warp device, such as "cuda:0", or None for Warp's
                default device.
            deterministic: whether sums are computed in a fixed order, so that repeated
                runs are bit-identical.

        Raises:
            InputError: the twins differ in a setting that must be equal for all runs,
                or the device engine does not support a setting.
        """
        self.device = wp.get_device(device)
        if device is None and not self.device.is_cuda:
            message = (
                "engine 'warp' finds no GPU and runs on the CPU, which is slower than"
                " engine 'cpu'"
            )
            warnings.warn(message, EngineWarning, stacklevel=2)
        self.twins = tuple(twins)
        numbers: dict[TwinSnake, int] = {}
        self._robot_of_run = np.array(
            [numbers.setdefault(twin, len(numbers)) for twin in self.twins]
        )
        self._robots = tuple(numbers)
        first = self._robots[0]
        for twin in self._robots:
            _check_supported(twin, first)
        self.tick = first.tick
        self._h = first.timestep
        self.origins = np.zeros((len(self), 2))
        self._engine = DeviceEngine(
            self._robots, self._robot_of_run, self.device, deterministic
        )
        self.reset()

    @staticmethod
    def check(twin: TwinSnake) -> None:
        """Check that the device engine supports a twin.

        Raises:
            InputError: the engine does not support a setting of the twin.
        """
        _check_supported(twin, twin)

    @staticmethod
    def accelerated() -> bool:
        """Return whether Warp has found a GPU."""
        return bool(wp.get_preferred_device().is_cuda)

    @staticmethod
    def max_worlds(twin: TwinSnake, samples: int, device: str | None = None) -> int:
        """Return how many runs of a twin fit into half of the free memory.

        The device stores the states, and the CPU memory stores the twins and the
        recorded trajectories.

        Args:
            twin: twin with the robot and settings of all runs.
            samples: number of recorded samples per run.
            device: name of the Warp device, or None for Warp's default device.
        """
        place = wp.get_device(device)
        engine = DeviceEngine([twin], np.zeros(1, dtype=int), place, False)
        state_bytes = allocated_bytes(engine.data)
        state = twin.reset()
        values = sum(np.size(getattr(state, item.name)) for item in fields(state))
        # A trajectory exists twice in memory while its samples are concatenated.
        run_bytes = _TWIN_BYTES + 2 * samples * values * np.dtype(float).itemsize
        if place.is_cpu:
            run_bytes += state_bytes
        fits = int(_MEMORY_FRACTION * wp.get_device("cpu").free_memory / run_bytes)
        if place.is_cuda:
            fits = min(fits, int(_MEMORY_FRACTION * place.free_memory / state_bytes))
        return max(1, fits)

    def __reduce_ex__(self, protocol: SupportsIndex) -> NoReturn:
        raise InputError(
            "a batch of engine 'warp' can be neither copied nor pickled; use engine"
            " 'cpu', or `save()` and `restore()` of its twins"
        )

    def __len__(self) -> int:
        return len(self.twins)

    def run(self, steps: int, *, gait: bool = False) -> None:
        """Compute time steps without recording states.

        Args:
            steps: number of time steps.
            gait: whether the valves follow the gaits set by `set_gaits` instead of the
                latest valve commands.
        """
        self._time += steps * self._h
        self._unobserved_steps += steps
        self._engine.run(steps, gait=gait)

    def set_gaits(self, gaits: Sequence[Gait]) -> None:
        """Set the gait (`control.gait.Gait`) of each run, for `run` and `follow`.

        Raises:
            InputError: the number of gaits differs from the number of runs.
        """
        check_one_per_run("gaits", gaits, len(self))
        for gait, twin in zip(gaits, self.twins, strict=True):
            gait.reset(twin.spec, self.tick)
        waves = [
            GaitWave(g.frequency, g.offset, g.rest_level, g.phase_lag) for g in gaits
        ]
        self._engine.set_waves(waves)

    def reset(
        self,
        *,
        poses: Sequence[Pose] | None = None,
        seed: int = 0,
        worlds: Sequence[int] | None = None,
    ) -> SnakeState:
        """Reset snakes to a straight shape at rest with empty chambers.

        Args:
            poses: x and y coordinates of the centre of mass (m) and mean heading (rad)
                for each run that is reset, by default 0.
            seed: random seed of the sensor noise.
            worlds: indices of the runs to reset. By default, all runs are reset and the
                time is set to 0.

        Raises:
            InputError: the number of poses is wrong, or a run with obstacles starts too
                far from the origin.
        """
        chosen = np.arange(len(self)) if worlds is None else np.asarray(worlds, int)
        if poses is None:
            places = np.zeros((len(chosen), 3))
        else:
            places = np.array(poses, dtype=float).reshape(-1, 3)
        check_one_per_run("poses", places, len(chosen))
        origins = self._origins_of(places, chosen)
        for k in np.unique(self._robot_of_run[chosen]):
            self._robots[k].reset(seed=seed)
        if worlds is None:
            self.errors = [None] * len(self)
            self._begun = np.zeros(len(self))
            self._time = 0.0
            self._unobserved_steps = 0
            self._connector_heading = np.zeros(
                (len(self), self.twins[0].spec.geometry.connectors)
            )
            self._engine.count.zero_()
        self._begun[chosen] = self._time
        self._connector_heading[chosen] = places[:, 2:]
        for k in chosen:
            self.errors[k] = None
        self.origins[chosen] = origins
        places[:, :2] -= origins
        rest = [self._robots[k].physics for k in self._robot_of_run[chosen]]
        qpos = _moved(np.array([physics.data.qpos for physics in rest]), places)
        states = [
            physics.stepper.contact_state
            for physics in rest
            if physics.stepper is not None
        ]
        self._engine.rest(chosen, qpos, states)
        now = np.array([self._time])
        self.state = self._last_state(
            self._history([self._observe()], now, steps=np.ones(1))
        )
        return self.state

    def _origins_of(self, places: np.ndarray, chosen: np.ndarray) -> np.ndarray:
        far = np.hypot(*places[:, :2].T) > _MAX_START_DISTANCE
        for place, k in zip(places[far], chosen[far], strict=True):
            if self.twins[k].has_contact:
                raise InputError(
                    f"run {k} starts at ({place[0]:g}, {place[1]:g}) m, which is too"
                    " far from the origin. Engine 'warp' computes in single precision"
                    f" and needs starts within {_MAX_START_DISTANCE:g} m of the origin"
                    " in a world with obstacles; move the world closer to the origin,"
                    " or use engine 'cpu'"
                )
        return np.where(far[:, None], places[:, :2], 0.0)

    def update_supply_pressure(self) -> None:
        """Copy the supply pressures of the twins to the device."""
        self._engine.update_supply_pressure()

    def step(self, valves: np.ndarray | wp.array) -> SnakeState:
        """Advance all runs by one control tick, as in `TwinBatch.step`."""
        self.advance(valves, 1)
        return self.state

    def advance(
        self, valves: np.ndarray | wp.array, samples: int
    ) -> list[SnakeState | None]:
        """Advance all runs by one control tick, as in `TwinBatch.advance`.

        The valve states may be a NumPy array or a DLPack array on the device.
        """
        self.command(valves)
        return self._run_observed(self._engine.steps, samples, gait=False)

    def command(self, valves: np.ndarray | wp.array) -> None:
        """Set the valve states for the next control ticks.

        Args:
            valves: valve states −1 or 1 in a NumPy array or an int32 device array
                (DLPack), shape (runs, segments, 2) or (runs, slots, segments, 2). The
                values of device arrays are not checked.

        Raises:
            InputError: the shape or the type is wrong, or the valve layout does not
                allow a state.
        """
        shape = tuple(valves.shape)
        segments = self.twins[0].spec.segments
        if (
            len(shape) not in (3, 4)
            or shape[0] != len(self)
            or shape[-2:] != (segments, 2)
        ):
            raise InputError(
                f"valves of shape {shape} are not allowed; the shape must be"
                f" ({len(self)}, {segments}, 2) or ({len(self)}, slots, {segments}, 2)"
            )
        if isinstance(valves, np.ndarray):
            self.twins[0].pneumatics.check(valves)
            commands = wp.array(valves, dtype=int, device=self.device)
        else:
            commands = wp.from_dlpack(valves)
            if commands.dtype is not wp.int32:
                raise InputError(
                    "the valves on a device must have the type int32, not"
                    f" {commands.dtype.__name__}"
                )
        if commands.ndim != 4:
            commands = commands.reshape((len(self), 1, segments, 2))
        most = self._engine.slots * self._engine.steps
        if commands.shape[1] > most:
            raise InputError(
                f"{commands.shape[1]} slots per tick are not allowed; use at most"
                f" {most}"
            )
        self._engine.command(commands)

    def play(
        self, schedules: Sequence[Schedule | None], samples: int
    ) -> list[SnakeState | None]:
        """See `TwinBatch.play`."""
        check_one_per_run("schedules", schedules, len(self))
        if not any(schedules):
            return [None] * len(self)
        span = max(schedule.span for schedule in schedules if schedule is not None)
        ticks = count_steps("span", span, "tick", self.tick)
        slots = self._engine.slots * self._engine.steps
        if max(ticks, samples) % min(ticks, samples):
            raise InputError(
                f"engine 'warp' cannot record {samples} samples in {ticks} ticks; one"
                " of these numbers must be a multiple of the other"
            )
        middles = (np.arange(ticks * slots) + 0.5) * self.tick / slots
        idle = np.full(
            (len(middles), self.twins[0].spec.segments, 2), -1, dtype=np.int8
        )
        valves = np.stack(
            [
                (
                    idle
                    if s is None
                    else s.states[np.searchsorted(s.starts, middles, "right") - 1]
                )
                for s in schedules
            ]
        )
        histories: list[list[SnakeState]] = [[] for _ in schedules]
        for tick in range(ticks):
            self.command(valves[:, tick * slots : (tick + 1) * slots])
            if samples < ticks and (tick + 1) % (ticks // samples):
                self.run(self._engine.steps)
                continue
            ticked = self._run_observed(
                self._engine.steps, max(samples // ticks, 1), gait=False
            )
            for pieces, piece in zip(histories, ticked, strict=True):
                if piece is not None:
                    pieces.append(piece)
        return [SnakeState.history(pieces) if pieces else None for pieces in histories]

    def follow(self, duration: float, samples: int) -> list[SnakeState | None]:
        """Simulate the gaits set by `set_gaits` for a duration (s).

        The samples are equally spaced, and the last one is at the end of the duration.
        """
        return self._run_observed(
            count_steps("duration", duration, "time step", self._h), samples, gait=True
        )

    def arrays(self) -> dict[str, wp.array]:
        """Return qpos, qvel, pressure and valves as device arrays, keyed by name.

        The arrays have a leading axis of runs and support DLPack. Positions in `qpos`
        are relative to `origins`.
        """
        chambers = self._engine.structs["chambers"]
        data = self._engine.data
        return {
            "qpos": data.qpos,
            "qvel": data.qvel,
            "pressure": chambers.pressure,
            "valves": chambers.valves,
        }

    def openings(self) -> np.ndarray:
        """Return how often each inlet valve has opened, shape (runs, segments, 2)."""
        return np.asarray(self._engine.structs["chambers"].openings.numpy())

    def describe(self) -> dict[str, object]:
        """Return the names of the engine and the device, to be stored in recordings."""
        return {"engine": "warp", "device": self.device.name}

    def _run_observed(
        self, steps: int, samples: int, *, gait: bool
    ) -> list[SnakeState | None]:
        interval = count_steps(
            "sample interval", steps * self._h / samples, "time step", self._h
        )
        rows = []
        times = np.empty(samples)
        passed = np.empty(samples)
        for k in range(samples):
            self.run(interval, gait=gait)
            times[k] = self._time
            passed[k] = self._unobserved_steps
            rows.append(self._observe())
        running = [error is None for error in self.errors]
        together = self._history(rows, times, passed)
        histories = [
            self._history_of_run(together, k) if running[k] else None
            for k in range(len(self))
        ]
        if any(self.errors):
            last = [
                self.state.at(k) if own is None else own.at(-1)
                for k, own in enumerate(histories)
            ]
            self.state = SnakeState.history(last)
        else:
            self.state = self._last_state(together)
        return histories

    def _last_state(self, history: SnakeState) -> SnakeState:
        return replace(history.at(-1), time=self._time - self._begun)

    def _history_of_run(self, together: SnakeState, k: int) -> SnakeState | None:
        history = SnakeState(
            together.time - self._begun[k],
            *(getattr(together, f.name)[:, k] for f in fields(SnakeState)[1:]),
        )
        fine = np.isfinite(history.qpos).all(axis=1) & np.isfinite(history.com).all(
            axis=1
        )
        if fine.all():
            return history
        last = int(np.argmin(fine))
        self.errors[k] = DivergedError(
            "twin",
            float(np.asarray(history.time)[last]),
            "the state is no longer finite",
        )
        if last:
            return history.at(slice(0, last))
        return None

    def _observe(self) -> wp.array:
        self._unobserved_steps = 0
        return self._engine.observe()

    def _history(
        self, rows: list[wp.array], times: np.ndarray, steps: np.ndarray
    ) -> SnakeState:
        # The fields of the result have leading axes of samples and runs. Forces are
        # averaged over `steps`, the number of time steps before each sample.
        table = np.stack([row.numpy() for row in rows]).astype(float)
        shape = table.shape[:2]
        widths = self._engine.widths
        parts = np.split(table, np.cumsum(list(widths.values()))[:-1], axis=-1)
        cut = dict(zip(widths, parts, strict=True))
        physics = self._robots[0].physics
        connectors = cut["connectors"].reshape(*shape, -1, 4)
        chambers = cut["chambers"].reshape(*shape, -1, 7)
        bend, rate = physics.bends_and_rates(cut["qpos"], cut["qvel"])
        connector_heading = np.concatenate(
            [self._connector_heading[None], connectors[..., 3]]
        )
        connector_heading = np.unwrap(connector_heading, axis=0)[1:]
        self._connector_heading = connector_heading[-1].copy()
        over = steps[:, None, None, None]
        force = cut["force"].reshape(*shape, -1, 3) / over
        obstacles = cut["obstacles"].reshape(*shape, -1, 3) / over
        wheels = len(physics.sensor_addresses.floor_force)
        if self._engine.loaded:
            obstacles = obstacles + force[..., wheels:, :]
        floor = force[..., :wheels, :2].reshape(*shape, -1, 2, 2).sum(axis=-2)
        first_axles = np.arange(connectors.shape[-2])
        free = chambers[..., 5]
        torque, stored = self._moments(cut["qpos"], bend, rate, free, chambers[..., 6])
        qpos = cut["qpos"].copy()
        qpos[..., :2] += self.origins
        return SnakeState(
            time=times,
            com=cut["com"][..., :2] + self.origins,
            com_velocity=cut["com"][..., 3:5],
            heading=connector_heading.mean(axis=-1),
            position=connectors[..., :2] + self.origins[:, None],
            connector_heading=connector_heading,
            bend=bend,
            bend_rate=rate,
            pressure=chambers[..., :2],
            valves=chambers[..., 2:4].astype(np.int8),
            measured_bend=self._sensed(bend, times),
            contact_force=np.add.reduceat(floor, first_axles, axis=-2),
            obstacle_force=physics.connector_forces(obstacles)[..., :2],
            torque=torque,
            work=cut["energy"].sum(axis=-1) + stored,
            internal_loss=cut["energy"][..., 2],
            pneumatic_energy=chambers[..., 4].sum(axis=-1),
            qpos=qpos,
        )

    def _moments(
        self,
        qpos: np.ndarray,
        bend: np.ndarray,
        rate: np.ndarray,
        free: np.ndarray,
        free_rate: np.ndarray,
    ) -> tuple[np.ndarray, np.ndarray]:
        # Return the moments of the segments (N·m) and the stored energy (J). All
        # arguments have leading axes of samples and runs. The free bends in `free` do
        # not include the rest bends.
        torque = np.empty_like(bend)
        stored = np.empty(bend.shape[:2])
        for number, twin in enumerate(self._robots):
            mine = self._robot_of_run == number
            target = free[:, mine] + twin.spec.modules.array("bias")
            torque[:, mine] = twin.spec.bending.moment(
                target - bend[:, mine], free_rate[:, mine] - rate[:, mine]
            )
            joints = twin.physics.internal_joints
            stored[:, mine] = joints.stored(qpos[:, mine], target)
        return torque, stored

    def _sensed(self, bend: np.ndarray, times: np.ndarray) -> np.ndarray:
        measured_bend = bend.copy()
        if self._robots[0].sensor.kind != "ideal":
            for k, twin in enumerate(self.twins):
                measured_bend[:, k] = twin.sensor.read(bend[:, k], times, twin.seed + k)
        return measured_bend


def _moved(qpos: np.ndarray, places: np.ndarray) -> np.ndarray:
    # Each row of `places` contains a translation in x and y (m) and a rotation (rad).
    moved = qpos.copy()
    yaw = places[:, 2]
    c = np.cos(yaw)
    s = np.sin(yaw)
    moved[:, 0] = places[:, 0] + c * qpos[:, 0] - s * qpos[:, 1]
    moved[:, 1] = places[:, 1] + s * qpos[:, 0] + c * qpos[:, 1]
    moved[:, 2] += _INITIAL_LIFT
    # The new orientation is the product of the yaw quaternion and the old orientation.
    w, i, j, k = qpos[:, 3:7].T
    a = np.cos(yaw / 2)
    b = np.sin(yaw / 2)
    moved[:, 3:7] = np.stack(
        [a * w - b * k, a * i - b * j, a * j + b * i, a * k + b * w], axis=1
    )
    return moved


def _check_supported(twin: TwinSnake, first: TwinSnake) -> None:
    air = twin.pneumatics
    twin.spec.require_planar("the device engine")
    unsupported = {
        f"pneumatics {air.kind!r}": not isinstance(air, LagPneumatics),
        "leak_per_s": bool(air.describe().get("leak_per_s")),
        "valve_delay_s": bool(air.describe().get("valve_delay_s")),
        f"layout {twin.layout!r}": twin.layout != "3/2",
        "stuck valves": bool(air.stuck),
        "base 'clamped'": not twin.physics.free,
        "a floor that slopes or has steps": twin.uneven,
        "objects": twin.objects > 0,
        "obstacles with contact 'preloaded'": (
            twin.has_contact and not isinstance(twin.contact, LoadedContact)
        ),
    }
    settings = twin.identity()
    first_settings = first.identity()
    same = settings.keys() - {"robot", "robot_digest", "supply_pa"}
    if not (twin.has_contact or first.has_contact):
        same.remove("world")  # goals and bounds do not affect the motion
    unsupported |= {
        f"runs that differ in {name}": settings[name] != first_settings[name]
        for name in sorted(same)
    }
    for name, present in unsupported.items():
        if present:
            raise InputError(f"engine 'warp' does not support {name}; use engine 'cpu'")
