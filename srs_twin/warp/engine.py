"""DeviceEngine: models, states and time steps of twins on a device, by MuJoCo Warp."""

from __future__ import annotations

import copy
from collections.abc import Sequence
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
from srs_twin.warp.translation import WarpStruct, stack_records, warp_struct

_CAPACITY_FACTOR = 4
"""Capacity for contacts and constraint rows, as a multiple of those of a snake at rest.
"""

_UNUSED_FIELDS = ("dof_length",)
"""Model fields that may differ between runs: they matter for sleeping bodies only, and no body sleeps."""

_MAX_ITERATIONS = 50
"""Iterations of the engine's solver."""

_AUTORESET = int(mujoco.mjtDisableBit.mjDSBL_AUTORESET)


class DeviceEngine:
    """Twins of a batch on a device.

    Attributes:
        loaded: whether the contacts are loaded.
        slots: valve slots per time step.
        steps: time steps per control tick.
        data: MuJoCo Warp's data of all worlds.
        structs: structs of all worlds by name, as `build_kernels` takes them.
        count: number of time steps since the reset, in an array of one number.
        widths: number of columns of each part of an observation (kernel `observe`).
    """

    def __init__(
        self,
        robots: Sequence[TwinSnake],
        robot_of_run: np.ndarray,
        device: Any,
        deterministic: bool,
    ) -> None:
        """Copy models, states and records to the device, and compile the kernels.

        Args:
            robots: the distinct twins.
            robot_of_run: index of each run's twin.
            device: Warp's device.
            deterministic: sum in a fixed order, so that repeated runs give the same
                bits.

        Raises:
            InputError: the robots differ in a property that all worlds share.
        """
        self._robots = robots
        self._robot_of_run = robot_of_run
        self._device = device
        self._worlds = len(robot_of_run)
        self._segments = robots[0].spec.segments
        self.loaded = isinstance(robots[0].contact, LoadedContact)
        models = [twin.physics.model for twin in self._robots]
        raw = copy.copy(models[0])
        raw.opt.disableflags &= ~_AUTORESET  # MuJoCo Warp supports no other value
        raw.opt.solver = mujoco.mjtSolver.mjSOL_NEWTON
        raw.opt.iterations = _MAX_ITERATIONS
        data = mujoco.MjData(raw)
        mujoco.mj_resetDataKeyframe(raw, data, 0)
        mujoco.mj_forward(raw, data)
        capacity = {
            "nconmax": _CAPACITY_FACTOR * max(data.ncon, 8),
            # A contact that just touches has no row yet.
            "njmax": _CAPACITY_FACTOR * max(data.nefc, data.ncon, 8),
        }
        tick = robots[0].tick
        h = robots[0].timestep
        slot = self._slot = min(valve_slot(tick, robots[0].spec.scale), h)
        self.slots = round(h / slot)
        self.steps = round(tick / h)
        segments = self._segments
        with wp.ScopedDevice(self._device):
            self._model = mjw.put_model(raw)
            self._model.opt.deterministic = deterministic
            self.data = mjw.put_data(raw, data, nworld=self._worlds, **capacity)
            _set_individual_parameters(
                self._model, [models[k] for k in self._robot_of_run]
            )
            structs = self._copy_records(data.qpos)
            self.count = wp.zeros(1, dtype=int)
            self._valves = wp.zeros((self._worlds, self.slots, segments, 2), dtype=int)
            self._commands = wp.zeros((self._worlds, 1, segments, 2), dtype=int)
            self._energy_loss = wp.zeros(self._worlds, dtype=wp.float64)
            self._internal_loss = wp.zeros(self._worlds, dtype=wp.float64)
            damping = [twin.physics.internal_joints.damping for twin in self._robots]
            self._damping = wp.array(
                np.stack([damping[k] for k in self._robot_of_run]), dtype=float
            )
        settings = StepSettings(
            h, slot, self.slots, self.steps, mean_control=self.loaded
        )
        self._kernels = build_kernels(structs, settings)
        self._graphs: dict[bool, Any] = {}

    def _copy_records(self, qpos: np.ndarray) -> dict[str, WarpStruct]:
        """Copy the records of all worlds to the device; return their structs by name."""
        segments = self._segments
        addresses = self._robots[0].physics.sensor_addresses
        hulls = len(addresses.obstacle_force)
        contacts = len(addresses.floor_force) + (hulls if self.loaded else 0)
        self._chambers = [
            twin.pneumatics
            for twin in self._robots
            if isinstance(twin.pneumatics, LagPneumatics)
        ]
        empty = np.zeros((segments, 2))
        rest = np.zeros(segments)
        whole = empty.astype(int)
        forces = np.zeros((contacts, 3))
        records: dict[str, Sequence[Any]] = {
            "relaxation": [
                chambers.relaxation(self._slot) for chambers in self._chambers
            ],
            "chambers": [
                ChamberState(
                    pressure=empty,
                    linear=rest,
                    bend=rest,
                    bend_rate=rest,
                    valves=whole - 1,
                    openings=whole,
                    drawn=rest,
                )
            ],
            "accumulators": [Accumulators(qpos, forces, forces, np.zeros((hulls, 3)))],
            "wave": [GaitWave(1.0, 0.0, 0.0, empty[:, 0])],
        }
        solves = [
            twin.physics.stepper.records
            for twin in self._robots
            if twin.physics.stepper is not None
        ]
        if self.loaded:
            names = "contacts", "sparsity", "contact_state", "work"
            records |= {name: [solve[name] for solve in solves] for name in names}
        structs = {name: warp_struct(values[0]) for name, values in records.items()}
        # There is one record for all robots, or one per robot.
        self.structs = {
            name: stack_records(
                structs[name],
                [v[k] if len(v) > 1 else v[0] for k in self._robot_of_run],
                self._device,
            )
            for name, v in records.items()
        }
        bodies = BodyViews(
            *(np.zeros(self._view(name).shape[1:]) for name in BodyViews._fields)
        )
        structs |= {"addresses": warp_struct(addresses), "bodies": warp_struct(bodies)}
        self.structs["bodies"] = self._views(structs["bodies"], BodyViews._fields)
        self.structs["addresses"] = structs["addresses"].single()
        for name, value in addresses._asdict().items():
            if isinstance(value, np.ndarray):
                on_device = wp.array(value, dtype=int)
            else:
                on_device = value
            setattr(self.structs["addresses"], name, on_device)
        if self.loaded:
            engine = solves[0]["engine"]
            structs["engine"] = warp_struct(
                engine, without=("model", "data", "objects")
            )
            self.structs["engine"] = self._views(structs["engine"], engine._fields[3:])
            # The solve needs c(v₋) and c(v̄), so copy the first: the engine overwrites
            # its array with the second.
            self.structs["engine"].qfrc_bias = wp.zeros_like(self.data.qfrc_bias)
            self.structs["work"].residual = self.data.qfrc_bias
        # Columns of an observation (kernel `observe`).
        self.widths = {
            "qpos": len(qpos),
            "qvel": self._model.nv,
            "com": 6,
            "connectors": 4 * len(addresses.connectors),
            "chambers": 7 * segments,
            "force": 3 * contacts,
            "obstacles": 3 * hulls,
            "energy": 3,
        }
        return structs

    def _view(self, name: str) -> wp.array:
        """Return an array of vectors or matrices of the engine's data as an array of numbers."""
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
        """Launch the kernels of one time step."""
        k = self._kernels
        structs = self.structs
        data = self.data
        model = self._model
        segments = (self._worlds, self._segments)
        worlds = self._worlds
        accumulators = structs["accumulators"]
        if gait:
            wp.launch(
                k.set_gait,
                dim=segments,
                inputs=[self.count, structs["wave"], self._valves],
            )
        else:
            wp.launch(
                k.set_commands,
                dim=segments,
                inputs=[self.count, self._commands, self._valves],
            )
        wp.launch(
            k.advance_chambers,
            dim=segments,
            inputs=[
                structs["relaxation"],
                structs["chambers"],
                self._valves,
                data.ctrl,
            ],
        )
        if not self.loaded:
            mjw.step(model, data)
        else:
            names = "engine", "contacts", "sparsity", "contact_state", "work"
            friction = [structs[name] for name in names]
            engine = structs["engine"]
            work = structs["work"]
            wp.launch(k.begin_step, dim=worlds, inputs=[engine, work, accumulators])
            mjw.step1(model, data)
            wp.launch(k.apply_friction, dim=worlds, inputs=friction)
            mjw.step2(model, data)
            wp.launch(
                k.return_to_middle,
                dim=worlds,
                inputs=[engine, work, accumulators, data.qfrc_bias],
            )
            mjw.com_vel(model, data)
            mjw.rne(model, data)
            wp.launch(
                k.finish_step,
                dim=worlds,
                inputs=[*friction, accumulators, self._energy_loss],
            )
        wp.launch(
            k.accumulate,
            dim=worlds,
            inputs=[
                self.count,
                data.sensordata,
                structs["addresses"],
                accumulators,
                structs["chambers"],
                data.qvel,
                self._damping,
                self._energy_loss,
                self._internal_loss,
            ],
        )

    def rest(
        self, chosen: np.ndarray, qpos: np.ndarray, contacts: Sequence[ContactState]
    ) -> None:
        """Set worlds to rest with empty chambers.

        Args:
            chosen: indices of the worlds.
            qpos: their positions, one row per world.
            contacts: their states of loaded contacts; empty for others.
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
        """Set the rows of the given worlds in an array on the device."""
        if len(chosen) == self._worlds:
            full = np.broadcast_to(np.asarray(value), (self._worlds, *array.shape[1:]))
            array.assign(np.ascontiguousarray(full))
            return
        whole = array.numpy()
        whole[chosen] = value
        array.assign(whole)

    def set_waves(self, waves: Sequence[GaitWave]) -> None:
        """Set the parameters of each world's gait."""
        stacked = stack_records(warp_struct(waves[0]), waves, self._device)
        for name in GaitWave._fields:
            wp.copy(getattr(self.structs["wave"], name), getattr(stacked, name))

    def command(self, commands: wp.array) -> None:
        """Set the valve states of each tick from now on, shape (worlds, slots, segments, 2)."""
        if commands.shape != self._commands.shape:
            self._commands = wp.empty_like(commands)
            self._graphs = {}
        wp.copy(self._commands, commands)

    def update_supply_pressure(self) -> None:
        """Copy the supply pressures of the twins' chambers to the device after they have changed."""
        relaxations = [chambers.relaxation(self._slot) for chambers in self._chambers]
        for name in ("asymptotes", "worth"):
            rows = np.array(
                [getattr(relaxations[k], name) for k in self._robot_of_run],
                dtype=np.float32,
            )
            getattr(self.structs["relaxation"], name).assign(rows)

    def run(self, steps: int, *, gait: bool = False) -> None:
        """Make time steps without observation; on a GPU each step is one CUDA graph.

        Args:
            steps: number of steps.
            gait: whether the gaits of `set_waves` command the valves, instead of the
                latest commands.
        """
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

    def observe(self) -> Any:
        """Return an observation of all worlds on the device, one row per world; reset the accumulators."""
        structs = self.structs
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
            wp.launch(
                self._kernels.observe,
                dim=self._worlds,
                inputs=[
                    structs["bodies"],
                    structs["addresses"],
                    structs["chambers"],
                    structs["accumulators"],
                    self._energy_loss,
                    self._internal_loss,
                    out,
                ],
            )
        return out


def _set_individual_parameters(model: Any, models: list[mujoco.MjModel]) -> None:
    """Give each world its own values of the model fields in which worlds differ.

    Args:
        model: the model of MuJoCo Warp, made from the first of `models`.
        models: the model of each world.

    Raises:
        InputError: the models differ in a field that the engine shares between worlds.
    """
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
