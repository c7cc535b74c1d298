"""Engine that simulates a batch of twins on a device with MuJoCo Warp."""

from __future__ import annotations

import copy
from collections.abc import Sequence
from dataclasses import fields, is_dataclass
from typing import Any

import mujoco
import mujoco_warp as mjw
import numpy as np
import warp as wp
from numpy.typing import ArrayLike

from srs_twin.errors import InputError
from srs_twin.plants.twin.friction_solve import ContactState
from srs_twin.plants.twin.mjcf.numerics import LoadedContact
from srs_twin.plants.twin.snake import TwinSnake
from srs_twin.pneumatics.lag import LagPneumatics
from srs_twin.pneumatics.valves import valve_slot
from srs_twin.warp.kernels import (
    Accumulators,
    BodyViews,
    ChamberState,
    GaitWave,
    StepSettings,
    build_kernels,
)
from srs_twin.warp.translation import (
    WarpStruct,
    single_record,
    stack_records,
    warp_struct,
)

_CAPACITY_FACTOR = 4
"""Ratio of the allocated contacts or constraint rows to their number at rest."""

_UNUSED_FIELDS = ("dof_length",)
"""Model fields that may differ between robots, as only sleeping bodies use them."""

_MAX_ITERATIONS = 50
"""Maximum number of iterations of MuJoCo's constraint solver."""

_AUTORESET = int(mujoco.mjtDisableBit.mjDSBL_AUTORESET)


class DeviceEngine:
    """Engine that simulates the runs of a batch on a device, with one world per run.

    Attributes:
        loaded: whether the twins have loaded contact.
        slots: number of valve slots per time step.
        steps: number of time steps per control tick.
        structs: batched structs for the kernels, keyed as in `build_kernels`.
        count: number of time steps since the reset, a device array of shape (1,).
        widths: number of columns for each quantity in an observation, keyed by name.
    """

    def __init__(
        self,
        robots: Sequence[TwinSnake],
        robot_of_run: np.ndarray,
        device: wp.Device,
        deterministic: bool,
    ) -> None:
        """Copy models, states and records to the device, and compile the kernels.

        The array `robot_of_run` contains the index of each run's twin in `robots`.

        Raises:
            InputError: the robots differ in a property that all worlds share.
        """
        self._robots = robots
        self._robot_of_run = robot_of_run
        self._device = device
        self._worlds = len(robot_of_run)
        self._segments = robots[0].spec.segments
        self.loaded = isinstance(robots[0].contact, LoadedContact)
        models = [twin.physics.model for twin in robots]
        raw = copy.copy(models[0])
        raw.opt.disableflags &= ~_AUTORESET  # MuJoCo Warp does not support this flag
        raw.opt.solver = mujoco.mjtSolver.mjSOL_NEWTON
        raw.opt.iterations = _MAX_ITERATIONS
        data = mujoco.MjData(raw)
        mujoco.mj_resetDataKeyframe(raw, data, 0)
        mujoco.mj_forward(raw, data)
        capacity = {
            "nconmax": _CAPACITY_FACTOR * max(data.ncon, 8),
            # At rest, contacts that just touch the floor have no constraint rows.
            "njmax": _CAPACITY_FACTOR * max(data.nefc, data.ncon, 8),
        }
        tick = robots[0].tick
        h = robots[0].timestep
        self._slot = min(valve_slot(tick, robots[0].spec.scale), h)
        self.slots = round(h / self._slot)
        self.steps = round(tick / h)
        settings = StepSettings(
            h, self._slot, self.slots, self.steps, mean_control=self.loaded
        )
        with wp.ScopedDevice(device):
            self._model = mjw.put_model(raw)
            self._model.opt.deterministic = deterministic
            self.data = mjw.put_data(raw, data, nworld=self._worlds, **capacity)
            _set_individual_parameters(self._model, [models[k] for k in robot_of_run])
            structs = self._copy_records(data.qpos)
            self._allocate()
        self._kernels = build_kernels(structs, settings)
        self._graphs: dict[bool, wp.Graph] = {}

    def _allocate(self) -> None:
        slots = (self._worlds, self.slots, self._segments, 2)
        self.count = wp.zeros(1, dtype=int)
        self._valves = wp.zeros(slots, dtype=int)
        self._commands = wp.zeros((self._worlds, 1, self._segments, 2), dtype=int)
        self._energy_loss = wp.zeros(self._worlds, dtype=wp.float64)
        self._internal_loss = wp.zeros(self._worlds, dtype=wp.float64)
        damping = [twin.physics.internal_joints.damping for twin in self._robots]
        rows = np.stack([damping[k] for k in self._robot_of_run])
        self._damping = wp.array(rows, dtype=float)

    def _copy_records(self, qpos: np.ndarray) -> dict[str, WarpStruct]:
        addresses = self._robots[0].physics.sensor_addresses
        collision_geoms = len(addresses.obstacle_force)
        contacts = len(addresses.floor_force) + (collision_geoms if self.loaded else 0)
        forces = np.zeros((contacts, 3))
        records = self._chamber_records()
        records["accumulators"] = [
            Accumulators(qpos, forces, forces, np.zeros((collision_geoms, 3)))
        ]
        steppers = [twin.physics.stepper for twin in self._robots]
        solves = [stepper.records for stepper in steppers if stepper is not None]
        if self.loaded:
            for name in ("contacts", "sparsity", "contact_state", "workspace"):
                records[name] = [solve[name] for solve in solves]
        structs = {name: warp_struct(values[0]) for name, values in records.items()}
        # `values` contains one record for all robots, or one record per robot.
        self.structs = {
            name: stack_records(
                structs[name],
                [values[k % len(values)] for k in self._robot_of_run],
                self._device,
            )
            for name, values in records.items()
        }
        names = BodyViews._fields
        bodies = BodyViews(*(np.zeros(self._view(name).shape[1:]) for name in names))
        structs["bodies"] = warp_struct(bodies)
        self.structs["bodies"] = self._views(structs["bodies"], names)
        structs["addresses"] = warp_struct(addresses)
        self.structs["addresses"] = single_record(structs["addresses"], addresses)
        if self.loaded:
            engine = solves[0]["engine"]
            structs["engine"] = warp_struct(
                engine, without=("model", "data", "objects")
            )
            self.structs["engine"] = self._views(structs["engine"], engine._fields[3:])
            # The friction solve needs c(v₋) and c(v̄). The engine overwrites its array
            # with c(v̄), so c(v₋) has a separate array.
            self.structs["engine"].qfrc_bias = wp.zeros_like(self.data.qfrc_bias)
            self.structs["workspace"].residual = self.data.qfrc_bias
        self.widths = {
            "qpos": len(qpos),
            "qvel": self._model.nv,
            "com": 6,
            "connectors": 4 * len(addresses.connectors),
            "chambers": 7 * self._segments,
            "force": 3 * contacts,
            "obstacles": 3 * collision_geoms,
            "energy": 3,
        }
        return structs

    def _chamber_records(self) -> dict[str, list[Any]]:
        self._chambers = [
            twin.pneumatics
            for twin in self._robots
            if isinstance(twin.pneumatics, LagPneumatics)
        ]
        empty = np.zeros((self._segments, 2))
        rest = np.zeros(self._segments)
        none = empty.astype(int)
        state = ChamberState(
            pressure=empty,
            linear=rest,
            bend=rest,
            bend_rate=rest,
            valves=none - 1,
            openings=none,
            drawn=rest,
        )
        return {
            "relaxation": [
                chambers.relaxation(self._slot) for chambers in self._chambers
            ],
            "chambers": [state],
            "wave": [GaitWave(frequency=1.0, offset=0.0, rest=0.0, lag=rest)],
        }

    def _view(self, name: str) -> wp.array:
        # An array of vectors or matrices is viewed as an array of scalars.
        array = getattr(self.data, name)
        size = wp.types.type_size(array.dtype)
        if size == 1:
            return array
        return wp.array(
            ptr=array.ptr, shape=(*array.shape, size), dtype=float, device=self._device
        )

    def _views(self, struct: WarpStruct, names: Sequence[str]) -> Any:
        views = struct.batched()
        for name in names:
            setattr(views, name, self._view(name))
        return views

    def _launch(self, gait: bool) -> None:
        k = self._kernels
        structs = self.structs
        data = self.data
        chambers = structs["chambers"]
        if gait:
            valves = k.set_gait, self.count, structs["wave"]
        else:
            valves = k.set_commands, self.count, self._commands
        self._start(*valves, self._valves, axes=2)
        self._start(
            k.advance_chambers,
            structs["relaxation"],
            chambers,
            self._valves,
            data.ctrl,
            axes=2,
        )
        if self.loaded:
            self._step_loaded_bodies()
        else:
            mjw.step(self._model, data)
        self._start(
            k.accumulate,
            self.count,
            data.sensordata,
            structs["addresses"],
            structs["accumulators"],
            chambers,
            data.qvel,
            self._damping,
            self._energy_loss,
            self._internal_loss,
        )

    def _step_loaded_bodies(self) -> None:
        k = self._kernels
        model = self._model
        data = self.data
        names = "engine", "contacts", "sparsity", "contact_state", "workspace"
        friction = [self.structs[name] for name in names]
        engine = self.structs["engine"]
        workspace = self.structs["workspace"]
        accumulators = self.structs["accumulators"]
        self._start(k.begin_step, engine, workspace, accumulators)
        mjw.step1(model, data)
        self._start(k.apply_friction, *friction)
        mjw.step2(model, data)
        self._start(k.return_to_middle, engine, workspace, accumulators, data.qfrc_bias)
        mjw.com_vel(model, data)
        mjw.rne(model, data)
        self._start(k.finish_step, *friction, accumulators, self._energy_loss)

    def _start(self, kernel: wp.Kernel, *inputs: object, axes: int = 1) -> None:
        threads = (self._worlds, self._segments)[:axes]
        wp.launch(kernel, dim=threads, inputs=inputs)

    def rest(
        self, chosen: np.ndarray, qpos: np.ndarray, contacts: Sequence[ContactState]
    ) -> None:
        """Set chosen worlds to rest with empty chambers.

        Args:
            chosen: indices of the worlds.
            qpos: generalised positions, with one row per chosen world.
            contacts: contact state of each chosen world, or an empty sequence without
                loaded contact.
        """
        self._set(self.data.qpos, chosen, qpos)
        for array in (
            self.data.qvel,
            self.data.qacc_warmstart,
            self._energy_loss,
            self._internal_loss,
        ):
            self._set(array, chosen, 0.0)
        chambers = self.structs["chambers"]
        accumulators = self.structs["accumulators"]
        for name in ("pressure", "linear", "bend", "bend_rate", "openings", "drawn"):
            self._set(getattr(chambers, name), chosen, 0)
        self._set(chambers.valves, chosen, -1)
        for name in ("step_force", "force_sum", "obstacle_sum"):
            self._set(getattr(accumulators, name), chosen, 0.0)
        for name in ContactState._fields if self.loaded else ():
            value = np.array([getattr(state, name) for state in contacts])
            self._set(getattr(self.structs["contact_state"], name), chosen, value)

    def _set(self, array: wp.array, chosen: np.ndarray, value: ArrayLike) -> None:
        if len(chosen) == self._worlds:
            full = np.broadcast_to(np.asarray(value), (self._worlds, *array.shape[1:]))
            array.assign(np.ascontiguousarray(full))
            return
        whole = array.numpy()
        whole[chosen] = value
        array.assign(whole)

    def set_waves(self, waves: Sequence[GaitWave]) -> None:
        """Set the gait parameters of each world."""
        stacked = stack_records(warp_struct(waves[0]), waves, self._device)
        for name in GaitWave._fields:
            wp.copy(getattr(self.structs["wave"], name), getattr(stacked, name))

    def command(self, commands: wp.array) -> None:
        """Set the valve states in a tick, shape (worlds, slots, segments, 2)."""
        if commands.shape != self._commands.shape:
            self._commands = wp.empty_like(commands)
            self._graphs = {}
        wp.copy(self._commands, commands)

    def update_supply_pressure(self) -> None:
        """Copy the supply pressures of the twins to the device."""
        relaxations = [chambers.relaxation(self._slot) for chambers in self._chambers]
        for name in ("asymptotes", "worth"):
            rows = np.array(
                [getattr(relaxations[k], name) for k in self._robot_of_run],
                dtype=np.float32,
            )
            getattr(self.structs["relaxation"], name).assign(rows)

    def run(self, steps: int, *, gait: bool = False) -> None:
        """Compute time steps as in `WarpBatch.run`, using CUDA graphs on a GPU."""
        with wp.ScopedDevice(self._device):
            if not self._device.is_cuda:
                for _ in range(steps):
                    self._launch(gait)
                return
            if steps and gait not in self._graphs:
                self._launch(gait)  # the first step compiles the kernels
                steps -= 1
                with wp.ScopedCapture() as capture:
                    self._launch(gait)
                self._graphs[gait] = capture.graph
            for _ in range(steps):
                wp.capture_launch(self._graphs[gait])

    def observe(self) -> wp.array:
        """Return an observation with one row per world, and reset the force sums."""
        data = self.data
        model = self._model
        out = wp.zeros(
            (self._worlds, sum(self.widths.values())), dtype=float, device=self._device
        )
        with wp.ScopedDevice(self._device):
            mjw.kinematics(model, data)
            mjw.com_pos(model, data)
            mjw.com_vel(model, data)
            mjw.subtree_vel(model, data)
            names = "bodies", "addresses", "chambers", "accumulators"
            records = (self.structs[name] for name in names)
            losses = self._energy_loss, self._internal_loss
            self._start(self._kernels.observe, *records, *losses, out)
        return out


def allocated_bytes(data: mjw.Data) -> int:
    """Return the number of bytes of all device arrays in MuJoCo Warp data."""
    total = 0
    for item in fields(data):
        value = getattr(data, item.name)
        if isinstance(value, wp.array):
            total += value.capacity
        elif is_dataclass(value):
            total += allocated_bytes(value)
    return total


def _set_individual_parameters(model: mjw.Model, models: list[mujoco.MjModel]) -> None:
    # A field in which the models differ gets one value per world.
    distinct = {id(world_model): world_model for world_model in models}
    if len(distinct) == 1:
        return
    for name, array in vars(model).items():
        if (
            not isinstance(array, wp.array)
            or not hasattr(models[0], name)
            or name in _UNUSED_FIELDS
        ):
            continue
        values = {
            key: np.asarray(getattr(world_model, name))
            for key, world_model in distinct.items()
        }
        first = next(iter(values.values()))
        if all(np.array_equal(first, value) for value in values.values()):
            continue
        if array.shape[0] != 1:
            raise InputError(
                f"robots that differ in {name} cannot run together on engine 'warp';"
                " use engine 'cpu'"
            )
        rows = np.stack([values[id(world_model)] for world_model in models])
        inner = array.shape[1:]
        size = wp.types.type_size(array.dtype)
        rows = rows.reshape(len(models), *inner, *((size,) if size > 1 else ()))
        setattr(model, name, wp.array(rows, dtype=array.dtype, device=array.device))
