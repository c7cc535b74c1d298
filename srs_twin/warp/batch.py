"""WarpBatch: many twins stepped together by MuJoCo Warp, on an accelerator or, to test, on the processor.

Its engine, chambers and friction are those of `TwinSnake`, in single precision. What decides a twin is taken
from one that the processor builds for each distinct robot, so no formula of the model stands here.
"""

from __future__ import annotations

import copy
import warnings
from collections.abc import Sequence
from dataclasses import fields, replace
from types import SimpleNamespace
from typing import Any

import mujoco
import mujoco_warp as mjw
import numpy as np
import warp as wp

from srs_twin.errors import DivergedError, EngineWarning, InputError, whole_steps
from srs_twin.plants.base import Pose, SnakeState
from srs_twin.plants.twin.mjcf.numerics import LoadedContact
from srs_twin.plants.twin.snake import TwinSnake
from srs_twin.pneumatics import Schedule
from srs_twin.pneumatics.chambers import air_bend
from srs_twin.pneumatics.lag import LagPneumatics
from srs_twin.pneumatics.valves import SLOT_S
from srs_twin.warp.kernels import Air, Bodies, Kept, Wave, kernels
from srs_twin.warp.ported import Ported, record, stacked

_ROOM = 4
"""For contacts and rows of constraints, as a multiple of those of a snake at rest."""

_IDLE = ("dof_length",)
"""Numbers of a model that decide when bodies may sleep, which they never do here."""

_ITERATIONS = 50
"""Of the engine's solver at most."""

_LIFTED = 1e-8
"""Snakes at rest are on the verge of touching; rounding must not decide whether they do, m."""

_REACH = 16.0
"""Largest distance of a start from the origin of the device's coordinates, m.

Single precision rounds a coordinate x by up to x 2⁻²⁴: by 2⁻²⁰ m, 1 µm, at 16 m. This is 1 % of the 0.1 mm
that a snake of 0.1 m/s travels in a step of 1 ms; at 2 km it is as much as that step.
"""

_AUTORESET = int(mujoco.mjtDisableBit.mjDSBL_AUTORESET)


class WarpBatch:
    """Many twins with one number of connectors and one tick, on a device; used as `TwinBatch`.

    Attributes:
        twins: of each run, what says of what it is; runs of one robot share it.
        tick: control tick, s.
        state: the last state of every run, with a leading axis of runs on every field.
        errors: of each run, None or what ended it.
        device: where they are.
        origins: position of each run's device coordinates in the world, shape (runs, 2), m. Runs that start
            more than 16 m from the world's origin have theirs at the start, in single precision's range.
    """

    origins: np.ndarray
    state: SnakeState
    errors: list[DivergedError | None]
    _theta: np.ndarray

    def __init__(
        self, twins: Sequence[TwinSnake], *, device: str | None = None, deterministic: bool = False
    ) -> None:
        """Put twins on a device.

        Args:
            twins: of each run; those of one robot may be the same object.
            device: as Warp calls it, such as "cuda:0"; None: its preferred one.
            deterministic: sum in one order, so that a run gives the same bits again.

        Raises:
            InputError: no twin at all, twins that differ in what is one for all runs, or that the device
                engine cannot do, by its name.
        """
        self.device = wp.get_device(device)
        if device is None and not self.device.is_cuda:
            told = "engine 'warp' finds no accelerator and steps on the processor, slower than engine 'cpu'"
            warnings.warn(told, EngineWarning, stacklevel=2)
        self.twins = tuple(twins)
        known: dict[int, int] = {}
        self._which = np.array([known.setdefault(id(twin), len(known)) for twin in self.twins])
        built = self._robots = tuple({id(twin): twin for twin in self.twins}.values())
        for twin in built:
            _refuse(twin, built[0])
        self.tick, self._h = built[0].tick, built[0].timestep
        self._loaded = isinstance(built[0].contact, LoadedContact)
        self.origins = np.zeros((len(self), 2))
        self._put(deterministic)
        self.reset()

    @staticmethod
    def check(twin: TwinSnake) -> None:
        """Refuse a twin of which the device engine cannot do something, by its name.

        Raises:
            InputError: it cannot.
        """
        _refuse(twin, twin)

    @staticmethod
    def accelerated() -> bool:
        """Say whether there is a device that is faster than the processor."""
        return bool(wp.get_preferred_device().is_cuda)

    def __reduce_ex__(self, protocol: Any) -> Any:
        """Refuse: the runs' states are on the device.

        Raises:
            InputError: always.
        """
        raise InputError(
            "a batch of engine 'warp' can be neither copied nor pickled; engine 'cpu' can, and each of its "
            "twins has save() and restore()"
        )

    def __len__(self) -> int:
        """Return the number of runs."""
        return len(self.twins)

    def _put(self, deterministic: bool) -> None:
        """Put models, states and records on the device, and compile what steps them."""
        models = [each.physics.model.ptr for each in self._robots]
        raw = copy.copy(models[0])
        raw.opt.disableflags &= ~_AUTORESET  # the engine knows no other way
        raw.opt.solver, raw.opt.iterations = mujoco.mjtSolver.mjSOL_NEWTON, _ITERATIONS
        data = mujoco.MjData(raw)
        mujoco.mj_resetDataKeyframe(raw, data, 0)
        mujoco.mj_forward(raw, data)
        room = {"nconmax": _ROOM * max(data.ncon, 8), "njmax": _ROOM * max(data.nefc, 8)}
        slot = self._slot = min(SLOT_S, self._h)
        self._slots, self._steps = round(self._h / slot), round(self.tick / self._h)
        segments = self.twins[0].spec.segments
        with wp.ScopedDevice(self.device):
            self._model = mjw.put_model(raw)
            self._model.opt.deterministic = deterministic
            self._data = mjw.put_data(raw, data, nworld=len(self), **room)
            _expand(self._model, [models[k] for k in self._which])
            ported = self._note(data.qpos, segments)
            self._count = wp.zeros(1, dtype=int)
            self._valves = wp.zeros((len(self), self._slots, segments, 2), dtype=int)
            self._given = wp.zeros((len(self), 1, segments, 2), dtype=int)
            self.spent, self._internal = (wp.zeros(len(self), dtype=wp.float64) for _ in range(2))
            dampers = [each.physics.internal.damping for each in self._robots]
            self._dampers = wp.array(np.stack([dampers[k] for k in self._which]), dtype=float)
        numbers = {"h": self._h, "slot": slot, "slots": self._slots, "tick": self._steps}
        self._kernels = kernels(ported, SimpleNamespace(**numbers, middle=self._loaded))
        self._graphs: dict[bool, Any] = {}

    def _note(self, qpos: np.ndarray, segments: int) -> dict[str, Ported]:
        """Put the records of all worlds on the device; return their types."""
        columns = self._robots[0].physics.columns
        hulls = len(columns.bump)
        contacts = len(columns.load) + (hulls if self._loaded else 0)
        self._air = [each.pneumatics for each in self._robots if isinstance(each.pneumatics, LagPneumatics)]
        empty = np.zeros((segments, 2))
        records: dict[str, Sequence[Any]] = {
            "relaxation": [air.relaxation(self._slot) for air in self._air],
            "air": [Air(empty, empty[:, 0], empty.astype(int) - 1, empty.astype(int), empty[:, 0])],
            "kept": [Kept(qpos, np.zeros((contacts, 3)), np.zeros((contacts, 3)), np.zeros((hulls, 3)))],
            "wave": [Wave(1.0, 0.0, 0.0, empty[:, 0])],
        }
        solves = [each.physics.loaded.records for each in self._robots if each.physics.loaded is not None]
        if self._loaded:
            records |= {
                name: [each[name] for each in solves] for name in ("contacts", "pattern", "feet", "work")
            }
        ported = {name: record(values[0]) for name, values in records.items()}
        self._own = {
            name: stacked(ported[name], [v[k] if len(v) > 1 else v[0] for k in self._which], self.device)
            for name, v in records.items()
        }
        bodies = Bodies(*(np.zeros(self._view(name).shape[1:]) for name in Bodies._fields))
        ported |= {"columns": record(columns), "bodies": record(bodies)}
        self._own["bodies"] = self._viewed(ported["bodies"], Bodies._fields)
        self._own["columns"] = ported["columns"].one()
        for name, value in columns._asdict().items():
            whole = wp.array(value, dtype=int) if isinstance(value, np.ndarray) else value
            setattr(self._own["columns"], name, whole)
        if self._loaded:
            engine = solves[0]["engine"]
            ported["engine"] = record(engine, without=("model", "data"))
            self._own["engine"] = self._viewed(ported["engine"], engine._fields[2:])
            self._own["engine"].qfrc_bias = wp.zeros_like(self._data.qfrc_bias)
            self._own["work"].residual = self._data.qfrc_bias
        self._widths = {
            "qpos": len(qpos), "qvel": self._model.nv, "com": 6, "connectors": 4 * len(columns.connectors),
            "chambers": 5 * segments, "force": 3 * contacts, "bumps": 3 * hulls, "spent": 3,
        }  # fmt: skip
        return ported

    def _view(self, name: str) -> Any:
        """Return an array of the engine's data as one of numbers."""
        of = getattr(self._data, name)
        size = wp.types.type_size(of.dtype)
        shape = (*of.shape, size) if size > 1 else of.shape
        return wp.array(ptr=of.ptr, shape=shape, dtype=float, device=self.device) if size > 1 else of

    def _viewed(self, kind: Ported, names: Sequence[str]) -> Any:
        found = kind.each()
        for name in names:
            setattr(found, name, self._view(name))
        return found

    def _launch(self, gait: bool) -> None:
        """Make one step."""
        k, own, data, model = self._kernels, self._own, self._data, self._model
        each = len(self), self.twins[0].spec.segments
        if gait:
            wp.launch(k.wave, dim=each, inputs=[self._count, own["wave"], self._valves])
        else:
            wp.launch(k.command, dim=each, inputs=[self._count, self._given, self._valves])
        wp.launch(k.fill, dim=each, inputs=[own["relaxation"], own["air"], self._valves, data.ctrl])
        if not self._loaded:
            mjw.step(model, data)
        else:
            records = [own[name] for name in ("engine", "contacts", "pattern", "feet", "work")]
            engine, _, _, _, work = records
            wp.launch(k.begin, dim=len(self), inputs=[engine, work, own["kept"]])
            mjw.step1(model, data)
            wp.launch(k.push, dim=len(self), inputs=records)
            mjw.step2(model, data)
            wp.launch(k.middle, dim=len(self), inputs=[engine, work, own["kept"], data.qfrc_bias])
            mjw.com_vel(model, data)
            mjw.rne(model, data)
            wp.launch(k.finish, dim=len(self), inputs=[*records, own["kept"], self.spent])
        wp.launch(
            k.tally,
            dim=len(self),
            inputs=[
                self._count, data.sensordata, own["columns"], own["kept"], data.qvel, self._dampers,
                self.spent, self._internal,
            ],
        )  # fmt: skip

    def run(self, steps: int, *, gait: bool = False) -> None:
        """Make steps without looking; on an accelerator one graph a step.

        Args:
            steps: how many.
            gait: whether the waves of `set_gaits` command the valves, or what was commanded last.
        """
        self._time += steps * self._h
        self._unseen += steps
        with wp.ScopedDevice(self.device):
            if not self.device.is_cuda:
                for _ in range(steps):
                    self._launch(gait)
                return
            if steps and gait not in self._graphs:
                self._launch(gait)  # compiles, and is a step
                steps -= 1
                with wp.ScopedCapture() as capture:
                    self._launch(gait)
                self._graphs[gait] = capture.graph
            for _ in range(steps):
                wp.capture_launch(self._graphs[gait])

    def set_gaits(self, gaits: Sequence[Any]) -> None:
        """Give each run a `control.gait.Gait` that the device follows by itself (`run`, `follow`).

        Raises:
            InputError: not one gait a run.
        """
        if len(gaits) != len(self):
            raise InputError(f"gaits: {len(gaits)} were given for {len(self)} runs; give one a run")
        for gait, twin in zip(gaits, self.twins, strict=True):
            gait.reset(twin.spec, self.tick)
        waves = [Wave(g.frequency, g.offset, g.rest_level, g.phase_lag) for g in gaits]
        fresh = stacked(record(waves[0]), waves, self.device)
        for name in Wave._fields:
            wp.copy(getattr(self._own["wave"], name), getattr(fresh, name))

    def reset(
        self, *, poses: Sequence[Pose] | None = None, seed: int = 0, worlds: Sequence[int] | None = None
    ) -> SnakeState:
        """Lay snakes straight, at rest, chambers empty.

        Args:
            poses: centre of mass x, y (m) and mean heading (rad), one a run that is laid down; default all
                at the origin.
            seed: of the sensors' noise.
            worlds: runs, from 0; None: all, and time begins anew.

        Raises:
            InputError: not one pose a run, or a start too far from the origin in a world with obstacles.
        """
        chosen = np.arange(len(self)) if worlds is None else np.asarray(worlds, dtype=int)
        places = np.zeros((len(chosen), 3)) if poses is None else np.array(poses, dtype=float).reshape(-1, 3)
        if len(places) != len(chosen):
            raise InputError(f"poses: {len(places)} were given for {len(chosen)} runs; give one a run")
        origins = self._origins_of(places, chosen)
        for k in np.unique(self._which[chosen]):
            self._robots[k].reset(seed=seed)
        if worlds is None:
            self.errors = [None] * len(self)
            self._time, self._begun, self._unseen = 0.0, np.zeros(len(self)), 0
            self._count.zero_()
        self._begun[chosen] = self._time
        for k in chosen:
            self.errors[k] = None
        rest = [self._robots[k].physics for k in self._which[chosen]]
        qpos = np.array([each.data.qpos for each in rest])
        self.origins[chosen] = origins
        x, y = (places[:, :2] - origins).T
        turn = places[:, 2]
        c, s = np.cos(turn), np.sin(turn)
        qpos[:, 0], qpos[:, 1] = x + c * qpos[:, 0] - s * qpos[:, 1], y + s * qpos[:, 0] + c * qpos[:, 1]
        qpos[:, 2] += _LIFTED
        half = np.stack([np.cos(turn / 2), np.sin(turn / 2)])
        w, i, j, k = qpos[:, 3:7].T
        (a, b) = half
        qpos[:, 3:7] = np.stack([a * w - b * k, a * i - b * j, a * j + b * i, a * k + b * w], axis=1)
        self._set(self._data.qpos, chosen, qpos)
        for array in (self._data.qvel, self._data.qacc_warmstart, self.spent, self._internal):
            self._set(array, chosen, 0.0)
        air, kept = self._own["air"], self._own["kept"]
        for name in ("pressure", "linear", "openings", "drawn"):
            self._set(getattr(air, name), chosen, 0)
        self._set(air.valves, chosen, -1)
        for name in ("now", "force", "bumps"):
            self._set(getattr(kept, name), chosen, 0.0)
        if self._loaded:
            feet = self._own["feet"]
            for name in ("push", "rim", "load", "slip"):
                value = np.array(
                    [getattr(each.loaded.feet, name) for each in rest if each.loaded is not None]
                )
                self._set(getattr(feet, name), chosen, value)
        theta = (
            np.zeros((len(self), self.twins[0].spec.geometry.connectors)) if worlds is None else self._theta
        )
        theta[chosen] = turn[:, None]
        self._theta = theta
        self.state = self._moment(self._history([self._look()], np.array([self._time]), np.ones(1)))
        return self.state

    def _origins_of(self, places: np.ndarray, chosen: np.ndarray) -> np.ndarray:
        """Return the origins of the device coordinates for these starts, shape (chosen, 2).

        Raises:
            InputError: a start is too far away, and obstacles keep the origin where it is.
        """
        far = np.hypot(*places[:, :2].T) > _REACH
        for place, k in zip(places[far], chosen[far], strict=True):
            if self.twins[k].touches:
                raise InputError(
                    f"run {k} starts at ({place[0]:g}, {place[1]:g}) m, but engine 'warp' computes in "
                    f"single precision and takes starts within {_REACH:g} m of the origin in a world with "
                    "obstacles; move the world nearer to the origin, or use the processor"
                )
        return np.where(far[:, None], places[:, :2], 0.0)

    def _set(self, array: Any, chosen: np.ndarray, value: Any) -> None:
        """Set some worlds' part of an array."""
        if len(chosen) == len(self):
            full = np.broadcast_to(np.asarray(value), (len(self), *array.shape[1:]))
            array.assign(np.ascontiguousarray(full))
            return
        whole = array.numpy()
        whole[chosen] = value
        array.assign(whole)

    def regulate(self) -> None:
        """Take the supplies' pressures from the twins' chambers anew, as these have been regulated since."""
        law, fresh = self._own["relaxation"], [air.relaxation(self._slot) for air in self._air]
        for name in ("asymptotes", "worth"):
            rows = np.array([getattr(fresh[k], name) for k in self._which], dtype=np.float32)
            getattr(law, name).assign(rows)

    def step(self, valves: Any) -> SnakeState:
        """Advance all runs by one tick and return `state`; see `TwinBatch.step`."""
        self.advance(valves, 1)
        return self.state

    def advance(self, valves: Any, samples: int) -> list[SnakeState | None]:
        """Advance all runs by one tick; see `TwinBatch.advance`.

        Args:
            valves: see `TwinBatch.step`; an array, or what has DLPack.
            samples: how many equally spaced samples to return.
        """
        self.command(valves)
        return self._observed(self._steps, samples, gait=False)

    def command(self, valves: Any) -> None:
        """Set what the valves do in each tick from now on.

        Args:
            valves: (runs, segments, 2) or (runs, slots, segments, 2), −1 or 1; NumPy, or of integers on the
                device by DLPack, which is not looked at.

        Raises:
            InputError: a wrong shape, or a state that the valves cannot take.
        """
        shape, segments = tuple(valves.shape), self.twins[0].spec.segments
        if len(shape) not in (3, 4) or shape[0] != len(self) or shape[-2:] != (segments, 2):
            raise InputError(
                f"valves of shape {shape} are not allowed; give ({len(self)}, {segments}, 2), or slots after "
                "the runs"
            )
        if isinstance(valves, np.ndarray):
            self.twins[0].pneumatics.check(valves)
            given = wp.array(valves, dtype=int, device=self.device)
        else:
            given = wp.from_dlpack(valves)
            if given.dtype is not wp.int32:
                raise InputError(f"valves on a device must be int32, not {given.dtype.__name__}")
        given = given if given.ndim == 4 else given.reshape((len(self), 1, segments, 2))
        if given.shape[1] > self._slots * self._steps:
            raise InputError(
                f"{given.shape[1]} slots a tick are too many; there are {self._slots * self._steps}"
            )
        if given.shape != self._given.shape:
            self._given, self._graphs = wp.empty_like(given), {}
        wp.copy(self._given, given)

    def play(self, schedules: Sequence[Schedule | None], samples: int) -> list[SnakeState | None]:
        """Follow schedules that no feedback changes; see `TwinBatch.play`."""
        if len(schedules) != len(self):
            raise InputError(f"schedules: {len(schedules)} were given for {len(self)} runs; give one a run")
        if not any(schedules):
            return [None] * len(self)
        span = max(each.span for each in schedules if each is not None)
        ticks, slots = whole_steps("span", span, "tick", self.tick), self._steps * self._slots
        if max(ticks, samples) % min(ticks, samples):
            raise InputError(f"{samples} samples of {ticks} ticks: engine 'warp' takes whole ones of either")
        middles = (np.arange(ticks * slots) + 0.5) * self.tick / slots
        idle = np.full((len(middles), self.twins[0].spec.segments, 2), -1, dtype=np.int8)
        valves = np.stack(
            [
                idle if each is None else each.states[np.searchsorted(each.starts, middles, "right") - 1]
                for each in schedules
            ]
        )
        parts: list[list[SnakeState]] = [[] for _ in schedules]
        for tick in range(ticks):
            self.command(valves[:, tick * slots : (tick + 1) * slots])
            if samples < ticks and (tick + 1) % (ticks // samples):
                self.run(self._steps)
                continue
            seen = self._observed(self._steps, max(samples // ticks, 1), gait=False)
            for part, one in zip(parts, seen, strict=True):
                if one is not None:
                    part.append(one)
        return [SnakeState.history(part) if part else None for part in parts]

    def follow(self, duration: float, samples: int) -> list[SnakeState | None]:
        """Follow the gaits of `set_gaits`; samples are equally spaced, the last at the end."""
        return self._observed(whole_steps("duration", duration, "time step", self._h), samples, gait=True)

    def arrays(self) -> dict[str, Any]:
        """Return what is on the device, a run a row: qpos, qvel, pressure, valves; DLPack takes them.

        Positions in `qpos` are relative to `origins`.
        """
        air = self._own["air"]
        return {
            "qpos": self._data.qpos,
            "qvel": self._data.qvel,
            "pressure": air.pressure,
            "valves": air.valves,
        }

    def openings(self) -> np.ndarray:
        """Return how often inlets have opened, shape (runs, segments, 2)."""
        return np.asarray(self._own["air"].openings.numpy())

    def describe(self) -> dict[str, Any]:
        """Return what is worth recording besides what the twins say."""
        return {"engine": "warp", "device": self.device.name}

    def _observed(self, steps: int, samples: int, *, gait: bool) -> list[SnakeState | None]:
        """Step and look so many times; return the history of each run that had not ended."""
        each = whole_steps("sample interval", steps * self._h / samples, "time step", self._h)
        rows, times, passed = [], np.empty(samples), np.empty(samples)
        for k in range(samples):
            self.run(each, gait=gait)
            times[k], passed[k] = self._time, self._unseen
            rows.append(self._look())
        going = [error is None for error in self.errors]
        whole = self._history(rows, times, passed)
        found = [self._of(whole, k) if going[k] else None for k in range(len(self))]
        if any(self.errors):
            last = [self.state.at(k) if own is None else own.at(-1) for k, own in enumerate(found)]
            self.state = SnakeState.history(last)
        else:
            self.state = self._moment(whole)
        return found

    def _moment(self, whole: SnakeState) -> SnakeState:
        """Return the last sample."""
        return replace(whole.at(-1), time=self._time - self._begun)

    def _of(self, whole: SnakeState, k: int) -> SnakeState | None:
        """Return one run's history up to where it diverged."""
        own = SnakeState(
            whole.time - self._begun[k], *(getattr(whole, f.name)[:, k] for f in fields(SnakeState)[1:])
        )
        fine = np.isfinite(own.qpos).all(axis=1) & np.isfinite(own.com).all(axis=1)
        if fine.all():
            return own
        last = int(np.argmin(fine))
        self.errors[k] = DivergedError(
            "twin", float(np.asarray(own.time)[last]), "the state is not finite any more"
        )
        return own.at(slice(0, last)) if last else None

    def _look(self) -> Any:
        """Return what is to be seen now, a row a run, on the device; sums begin anew."""
        self._unseen = 0
        own, data, model = self._own, self._data, self._model
        out = wp.zeros((len(self), sum(self._widths.values())), dtype=float, device=self.device)
        with wp.ScopedDevice(self.device):
            mjw.kinematics(model, data)
            mjw.com_pos(model, data)
            mjw.com_vel(model, data)
            mjw.subtree_vel(model, data)
            wp.launch(
                self._kernels.look, dim=len(self),
                inputs=[
                    own["bodies"], own["columns"], own["air"], own["kept"], self.spent, self._internal, out
                ],
            )  # fmt: skip
        return out

    def _history(self, rows: list[Any], times: np.ndarray, steps: np.ndarray) -> SnakeState:
        """Return what rows say, with axes of samples and runs; forces are means over so many steps."""
        table = np.stack([row.numpy() for row in rows]).astype(float)
        ends = np.cumsum([0, *self._widths.values()])
        cut = {name: table[..., a:b] for name, a, b in zip(self._widths, ends[:-1], ends[1:], strict=True)}
        shape = table.shape[:2]
        physics, spec = self._robots[0].physics, self._robots[0].spec
        connectors = cut["connectors"].reshape(*shape, -1, 4)
        chambers = cut["chambers"].reshape(*shape, -1, 5)
        bend, rate = physics.seen(cut["qpos"], cut["qvel"])
        theta = np.unwrap(np.concatenate([self._theta[None], connectors[..., 3]]), axis=0)[1:]
        self._theta = theta[-1].copy()
        force = cut["force"].reshape(*shape, -1, 3) / steps[:, None, None, None]
        wheels = len(physics.columns.load)
        floor = force[..., :wheels, :2].reshape(*shape, -1, 2, 2).sum(axis=-2)
        bumps = cut["bumps"].reshape(*shape, -1, 3) / steps[:, None, None, None]
        if self._loaded:
            bumps = bumps + force[..., wheels:, :]
        torque, sensed, stored = np.empty_like(bend), bend.copy(), np.empty(shape)
        for number, twin in enumerate(self._robots):
            mine = self._which == number
            law, own = twin.spec.bending, chambers[:, mine, :, :2]
            air = law.stiffness * (twin.spec.modules.array("bias") + air_bend(twin.spec, own))
            torque[:, mine] = air - law.stiffness * bend[:, mine] - law.damping * rate[:, mine]
            stored[:, mine] = twin.physics.internal.stored(cut["qpos"][:, mine])
        for k in range(len(self)) if self._robots[0].sensor.kind != "ideal" else ():
            twin = self.twins[k]
            sensed[:, k] = twin.sensor.read(bend[:, k], times, twin.seed + k)
        qpos = cut["qpos"].copy()
        qpos[..., :2] += self.origins
        return SnakeState(
            time=times,
            com=cut["com"][..., :2] + self.origins,
            com_velocity=cut["com"][..., 3:5],
            heading=theta.mean(axis=-1),
            position=connectors[..., :2] + self.origins[:, None],
            theta=theta,
            bend=bend,
            bend_rate=rate,
            pressure=chambers[..., :2],
            valves=chambers[..., 2:4].astype(np.int8),
            sensed=sensed,
            contact_force=np.add.reduceat(floor, np.arange(spec.geometry.connectors), axis=-2),
            obstacle_force=physics.bumped(bumps)[..., :2],
            torque=torque,
            work=cut["spent"].sum(axis=-1) + stored,
            internal_loss=cut["spent"][..., 2],
            air=chambers[..., 4].sum(axis=-1),
            qpos=qpos,
        )


def _refuse(twin: TwinSnake, first: TwinSnake) -> None:
    """Refuse, by its name, what the device engine cannot do, or not beside the first twin.

    Raises:
        InputError: the first such thing.
    """
    air = twin.pneumatics
    cannot = {
        f"pneumatics {air.kind!r}": not isinstance(air, LagPneumatics),
        "leak_per_s": getattr(air, "leaks", False),
        "valve_delay_s": air.describe().get("valve_delay_s", 0.0) > 0,
        f"layout {twin.layout!r}": twin.layout != "3/2",
        "stuck valves": bool(air.stuck),
        "base 'clamped'": not twin.physics.free,
        "a floor that slopes or has steps": twin.uneven,
        "obstacles with contact 'preloaded'": twin.touches and not isinstance(twin.contact, LoadedContact),
    }
    own, other = twin.identity(), first.identity()
    same = own.keys() - {"robot", "robot_digest", "supply_pa"}
    same -= set() if twin.touches or first.touches else {"world"}  # goals and rooms are not felt
    cannot |= {f"runs that differ in {name}": own[name] != other[name] for name in sorted(same)}
    for name, there in cannot.items():
        if there:
            raise InputError(f"engine 'warp' cannot do {name}; the processor can")


def _expand(model: Any, of_each: list[mujoco.MjModel]) -> None:
    """Give each world its own numbers of the model, where worlds differ in them.

    Raises:
        InputError: they differ in what the engine has only once.
    """
    distinct = {id(each): each for each in of_each}
    if len(distinct) == 1:
        return
    for name, array in vars(model).items():
        if not isinstance(array, wp.array) or not hasattr(of_each[0], name) or name in _IDLE:
            continue
        values = {key: np.asarray(getattr(each, name)) for key, each in distinct.items()}
        first = next(iter(values.values()))
        if all(np.array_equal(first, value) for value in values.values()):
            continue
        if array.shape[0] != 1:
            raise InputError(f"engine 'warp' has {name} once for all runs; the processor runs such robots")
        rows = np.stack([values[id(each)] for each in of_each])
        inner = array.shape[1:]
        size = wp.types.type_size(array.dtype)
        rows = rows.reshape(len(of_each), *inner, *((size,) if size > 1 else ()))
        setattr(model, name, wp.array(rows, dtype=array.dtype, device=array.device))
