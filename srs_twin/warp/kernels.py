"""Warp kernels for chambers, loaded contact and contact-force sums.

The kernels run before and after the time steps of MuJoCo Warp. A kernel runs one thread
per world, or one thread per segment of each world.
"""

# Warp needs annotations that are types, so `from __future__ import annotations` is not
# allowed here.
from collections.abc import Mapping
from types import SimpleNamespace
from typing import NamedTuple

import numpy as np
import warp as wp

from srs_twin.pneumatics.chambers import AMBIENT_PA, apply_bend_law
from srs_twin.pneumatics.lag import advance_segment, filling_content
from srs_twin.warp.translation import WarpStruct, as_warp_functions, warp_functions


class StepSettings(NamedTuple):
    """Constants that are compiled into the kernels.

    Attributes:
        h: time step, s.
        slot: duration of a valve slot, s.
        slots: number of valve slots per time step.
        tick: number of time steps per control tick.
        mean_control: whether the bodies are driven by the mean control over a time step
            instead of the control at the beginning of the step.
    """

    h: float
    slot: float
    slots: int
    tick: int
    mean_control: bool


class ChamberState(NamedTuple):
    """State of the chambers of one world.

    Attributes:
        pressure: gauge pressure, shape (segments, 2), Pa.
        linear: argument x of the bend law φ(x) (`pneumatics.chambers`), shape
            (segments,), rad.
        bend, bend_rate: free bend minus the rest bend (rad) and its time derivative
            (rad/s), shape (segments,).
        valves: valve states in the latest slot, shape (segments, 2).
        openings: number of times that each inlet valve has opened, shape (segments, 2).
        drawn: pneumatic energy consumed by each segment since the reset, shape
            (segments,), J.
    """

    pressure: np.ndarray
    linear: np.ndarray
    bend: np.ndarray
    bend_rate: np.ndarray
    valves: np.ndarray
    openings: np.ndarray
    drawn: np.ndarray


class GaitWave(NamedTuple):
    """Parameters of a gait (`control.gait.Gait`).

    Attributes:
        frequency: gait frequency f, Hz.
        offset: steering offset φ, dimensionless.
        rest: rest level sin(π r/2) for the rest fraction r, dimensionless.
        lag: phase lag of each segment, shape (segments,), rad.
    """

    frequency: float
    offset: float
    rest: float
    lag: np.ndarray


class BodyViews(NamedTuple):
    """Views of the observed engine data, named like the fields of MjData."""

    qpos: np.ndarray
    qvel: np.ndarray
    subtree_com: np.ndarray
    subtree_linvel: np.ndarray
    xpos: np.ndarray
    xmat: np.ndarray
    sensordata: np.ndarray


class Accumulators(NamedTuple):
    """Mid-step positions and contact-force sums of one world.

    Attributes:
        mid_qpos: generalised positions in the middle of the time step, shape (nq,).
        step_force: floor force on each wheel in the latest time step, shape (contacts,
            3), N. With loaded contact, the friction on each collision geom follows.
        force_sum: sum of `step_force` over the time steps since the latest sample,
            shape (contacts, 3), N.
        obstacle_sum: sum of the normal forces of obstacles over the time steps since
            the latest sample, shape (collision geoms, 3), N.
    """

    mid_qpos: np.ndarray
    step_force: np.ndarray
    force_sum: np.ndarray
    obstacle_sum: np.ndarray


_OPTIONS: dict[str, bool | str] = {"enable_backward": False, "module": "unique"}
"""Options of all kernels.

Each kernel has its own Warp module, because its constants depend on the batch.
"""

Kernels = dict[str, wp.Kernel]


def build_kernels(
    structs: Mapping[str, WarpStruct], settings: StepSettings
) -> SimpleNamespace:
    """Build the kernels of a batch.

    Args:
        structs: structs with the keys `relaxation`, `chambers`, `wave`, `accumulators`,
            `addresses` and `bodies`. Loaded contact also needs `engine`, `contacts`,
            `sparsity`, `contact_state` and `workspace`.
        settings: constants for all worlds.
    """
    functions = as_warp_functions(_PARTS, **warp_functions())
    loaded = "workspace" in structs
    kernels = _valve_kernels(structs["wave"], settings)
    kernels |= _chamber_kernel(structs, settings, functions)
    kernels |= _accumulation_kernel(structs, settings.h, loaded, functions)
    kernels |= _observation_kernel(structs, functions)
    if loaded:
        kernels |= _middle_kernels(structs, settings.h, functions["set_mid_velocity"])
        kernels |= _friction_kernels(structs, settings.h, functions)
    return SimpleNamespace(**kernels)


def _valve_kernels(wave: WarpStruct, settings: StepSettings) -> Kernels:
    GaitWaves = wave.batched
    wave_of = wave.select
    # Warp treats captured variables as compile-time constants.
    SLOT = settings.slot
    SLOTS = settings.slots
    TICK = settings.tick

    @wp.kernel(**_OPTIONS)
    def set_commands(
        count: wp.array(dtype=int),
        commands: wp.array4d(dtype=int),
        out: wp.array4d(dtype=int),
    ):
        i, j = wp.tid()
        begun = (count[0] % TICK) * SLOTS
        for s in range(SLOTS):
            row = (begun + s) * commands.shape[1] / (TICK * SLOTS)
            out[i, s, j, 0] = commands[i, row, j, 0]
            out[i, s, j, 1] = commands[i, row, j, 1]

    @wp.kernel(**_OPTIONS)
    def set_gait(
        count: wp.array(dtype=int), waves: GaitWaves, out: wp.array4d(dtype=int)
    ):
        i, j = wp.tid()
        gait = wave_of(waves, i)
        for s in range(SLOTS):
            time = (wp.float64(count[0] * SLOTS + s) + wp.float64(0.5)) * wp.float64(
                SLOT
            )
            # Double precision keeps the phase accurate in long runs.
            turns = wp.float64(gait.frequency) * time
            angle = wp.float64(6.283185307179586) * (
                turns - wp.floor(turns)
            ) - wp.float64(gait.lag[j])
            value = wp.sin(angle) + wp.float64(gait.offset)
            # Without the margin of 1e-9, rounding could delay valve events by one slot.
            edge = wp.float64(gait.rest) - wp.float64(1e-9)
            out[i, s, j, 0] = 2 * int(value >= edge) - 1
            out[i, s, j, 1] = 2 * int(value < -edge) - 1

    return {"set_commands": set_commands, "set_gait": set_gait}


def _chamber_kernel(
    structs: Mapping[str, WarpStruct],
    settings: StepSettings,
    functions: Mapping[str, wp.Function],
) -> Kernels:
    slot = functions["advance_slot"]
    apply_bend_law = functions["apply_bend_law"]
    Relaxations = structs["relaxation"].batched
    relaxation_of = structs["relaxation"].select
    ChamberStates = structs["chambers"].batched
    chambers_of = structs["chambers"].select
    SLOTS = settings.slots
    END_WEIGHT = 0.5 if settings.mean_control else 0.0

    @wp.kernel(**_OPTIONS)
    def advance_chambers(
        relaxations: Relaxations,
        all_chambers: ChamberStates,
        valves: wp.array4d(dtype=int),
        ctrl: wp.array2d(dtype=float),
    ):
        i, j = wp.tid()
        relaxation = relaxation_of(relaxations, i)
        air = chambers_of(all_chambers, i)
        pressure = air.pressure[j]
        # The second term cancels the lag of the bend that damping would cause.
        driven = air.bend[j] + relaxation.damping_time * air.bend_rate[j]
        bend = air.bend[j] + relaxation.bias[j]
        for s in range(SLOTS):
            bend = slot(relaxation, air, valves[i, s, j], j, bend)
        free, derivative, _ = apply_bend_law(air.linear[j], relaxation)
        pull = relaxation.gain[j, 0] * pressure[0] - relaxation.gain[j, 1] * pressure[1]
        air.bend[j] = free
        air.bend_rate[j] = derivative * (pull - air.linear[j]) / relaxation.tau
        end = air.bend[j] + relaxation.damping_time * air.bend_rate[j]
        driven += END_WEIGHT * (end - driven)
        # Each control is a chamber pressure, so it must not be negative.
        ctrl[i, 2 * j] = wp.max(driven, 0.0) / relaxation.gain[j, 0]
        ctrl[i, 2 * j + 1] = wp.max(-driven, 0.0) / relaxation.gain[j, 1]

    return {"advance_chambers": advance_chambers}


def _accumulation_kernel(
    structs: Mapping[str, WarpStruct],
    h: float,
    loaded: bool,
    functions: Mapping[str, wp.Function],
) -> Kernels:
    internal_power = functions["internal_power"]
    preloaded_power = functions["preloaded_power"]
    external_power = functions["external_power"]
    add_forces = functions["add_forces"]
    AllAccumulators = structs["accumulators"].batched
    accumulators_of = structs["accumulators"].select
    ChamberStates = structs["chambers"].batched
    chambers_of = structs["chambers"].select
    Addresses = structs["addresses"].single
    H = h
    LOADED = loaded

    @wp.kernel(**_OPTIONS)
    def accumulate(
        count: wp.array(dtype=int),
        sensors: wp.array2d(dtype=float),
        at: Addresses,
        all_accumulators: AllAccumulators,
        all_chambers: ChamberStates,
        qvel: wp.array2d(dtype=float),
        damping: wp.array2d(dtype=float),
        energy_loss: wp.array(dtype=wp.float64),
        internal_loss: wp.array(dtype=wp.float64),
    ):
        i = wp.tid()
        air = chambers_of(all_chambers, i)
        sums = accumulators_of(all_accumulators, i)
        internal = internal_power(air, at, qvel[i], damping[i])
        internal_loss[i] = internal_loss[i] + wp.float64(H * internal)
        power = external_power(at, sensors[i])
        if not LOADED:
            power += preloaded_power(sums, at, sensors[i])
        energy_loss[i] = energy_loss[i] + wp.float64(H * power)
        add_forces(sums, at, sensors[i])
        if i == 0:
            count[0] = count[0] + 1

    return {"accumulate": accumulate}


def _observation_kernel(
    structs: Mapping[str, WarpStruct], functions: Mapping[str, wp.Function]
) -> Kernels:
    write_bodies = functions["write_bodies"]
    write_chambers = functions["write_chambers"]
    move_sums = functions["move_sums"]
    AllBodies = structs["bodies"].batched
    bodies_of = structs["bodies"].select
    ChamberStates = structs["chambers"].batched
    chambers_of = structs["chambers"].select
    AllAccumulators = structs["accumulators"].batched
    accumulators_of = structs["accumulators"].select
    Addresses = structs["addresses"].single

    @wp.kernel(**_OPTIONS)
    def observe(
        bodies: AllBodies,
        at: Addresses,
        all_chambers: ChamberStates,
        all_accumulators: AllAccumulators,
        energy_loss: wp.array(dtype=wp.float64),
        internal_loss: wp.array(dtype=wp.float64),
        out: wp.array2d(dtype=float),
    ):
        i = wp.tid()
        body = bodies_of(bodies, i)
        sums = accumulators_of(all_accumulators, i)
        row = out[i]
        k = write_bodies(body, at, row)
        k = write_chambers(chambers_of(all_chambers, i), row, k)
        k = move_sums(sums.force_sum, row, k)
        k = move_sums(sums.obstacle_sum, row, k)
        row[k] = float(energy_loss[i])
        row[k + 1] = body.sensordata[at.kinetic_energy]
        row[k + 2] = float(internal_loss[i])

    return {"observe": observe}


def advance_slot(relaxation, air, state, j, before):  # type: ignore[no-untyped-def]
    """Advance the chambers of segment j by a slot and return the new free bend, rad.

    The argument `before` is the free bend at the beginning of the slot, rad.
    """
    pressure = air.pressure[j]
    content_before = filling_content(
        state, pressure[0], pressure[1], before, relaxation, AMBIENT_PA
    )
    plus, minus, x = advance_segment(state, j, pressure, air.linear[j], relaxation)
    after, _, _ = apply_bend_law(x, relaxation)
    after += relaxation.bias[j]
    content = filling_content(state, plus, minus, after, relaxation, AMBIENT_PA)
    # The supply provides the air that enters the filling chambers.
    air.drawn[j] = air.drawn[j] + relaxation.worth * (content - content_before)
    pressure[0] = plus
    pressure[1] = minus
    air.linear[j] = x
    for side in range(2):
        if state[side] == 1 and air.valves[j, side] != 1:
            air.openings[j, side] = air.openings[j, side] + 1
        air.valves[j, side] = state[side]
    return after


def internal_power(air, at, qvel, damping):  # type: ignore[no-untyped-def]
    """Return the power dissipated by the damping of the segments, W."""
    power = float(0.0)
    hinges = at.hinges.shape[1]
    for j in range(at.hinges.shape[0]):
        # The dampers act on the difference between each hinge velocity and the free
        # bend rate, which is divided equally among the hinges of a segment.
        fraction = air.bend_rate[j] / float(hinges)
        for n in range(hinges):
            deviation = qvel[at.hinges[j, n]] - fraction
            power += damping[at.hinges[j, n]] * deviation * deviation
    for n in range(at.out_of_plane.shape[0]):
        speed = qvel[at.out_of_plane[n]]
        power += damping[at.out_of_plane[n]] * speed * speed
    return power


def preloaded_power(sums, at, sensors):  # type: ignore[no-untyped-def]
    """Return the power dissipated by floor friction (W), and store the wheel forces.

    The sensors report velocities one step later than forces, so the velocities are
    multiplied by the forces of the previous step.
    """
    power = float(0.0)
    for w in range(at.floor_force.shape[0]):
        for k in range(2):
            power -= sums.step_force[w, k] * sensors[at.foot_velocity[w] + k]
        for k in range(3):
            sums.step_force[w, k] = sensors[at.floor_force[w] + k]
    return power


def external_power(at, sensors):  # type: ignore[no-untyped-def]
    """Return the power dissipated by external forces other than wheel forces, W."""
    power = float(0.0)
    for w in range(at.external_force.shape[0]):
        power -= sensors[at.external_force[w]] * sensors[at.external_velocity[w]]
    return power


def add_forces(sums, at, sensors):  # type: ignore[no-untyped-def]
    """Add the contact forces of the latest time step to the force sums."""
    for w in range(sums.step_force.shape[0]):
        for k in range(3):
            sums.force_sum[w, k] = sums.force_sum[w, k] + sums.step_force[w, k]
    for w in range(at.obstacle_force.shape[0]):
        for k in range(3):
            force = sensors[at.obstacle_force[w] + k]
            sums.obstacle_sum[w, k] = sums.obstacle_sum[w, k] + force


def write_bodies(body, at, row):  # type: ignore[no-untyped-def]
    """Write body states to an observation row, and return the next free column."""
    k = int(0)
    for n in range(body.qpos.shape[0]):
        row[k] = body.qpos[n]
        k += 1
    for n in range(body.qvel.shape[0]):
        row[k] = body.qvel[n]
        k += 1
    for n in range(3):
        row[k + n] = body.subtree_com[0, n]
        row[k + 3 + n] = body.subtree_linvel[0, n]
    k += 6
    for c in range(at.connectors.shape[0]):
        b = at.connectors[c]
        for n in range(3):
            row[k + n] = body.xpos[b, n]
        # The heading is the horizontal direction of the connector's x axis.
        row[k + 3] = wp.atan2(body.xmat[b, 3], body.xmat[b, 0])
        k += 4
    return k


def write_chambers(air, row, begin):  # type: ignore[no-untyped-def]
    """Write chamber states to an observation row, and return the next free column."""
    k = int(begin)
    for j in range(air.linear.shape[0]):
        for side in range(2):
            row[k + side] = air.pressure[j, side]
            row[k + 2 + side] = float(air.valves[j, side])
        row[k + 4] = air.drawn[j]
        row[k + 5] = air.bend[j]
        row[k + 6] = air.bend_rate[j]
        k += 7
    return k


def move_sums(sums, row, begin):  # type: ignore[no-untyped-def]
    """Move force sums to an observation row, and return the next free column."""
    k = int(begin)
    for w in range(sums.shape[0]):
        for n in range(3):
            row[k + n] = sums[w, n]
            sums[w, n] = 0.0
        k += 3
    return k


_PARTS = (
    advance_slot,
    internal_power,
    preloaded_power,
    external_power,
    add_forces,
    write_bodies,
    write_chambers,
    move_sums,
)
"""Functions called by the kernels, which `as_warp_functions` translates."""


@wp.func
def integrate_position(
    qpos: wp.array(dtype=float), qvel: wp.array(dtype=float), h: float
):
    """Integrate the generalised positions over a time h (s) at constant velocities.

    The coordinates of the free joint precede the coordinates of the hinges.
    """
    for k in range(3):
        qpos[k] = qpos[k] + h * qvel[k]
    rotation = wp.vec3(qvel[3], qvel[4], qvel[5])
    speed = wp.length(rotation)
    half = 0.5 * h * speed
    axis = rotation / wp.max(speed, 1e-20)
    w = qpos[3]
    x = qpos[4]
    y = qpos[5]
    z = qpos[6]
    c = wp.cos(half)
    u = wp.sin(half) * axis
    a = c * w - x * u[0] - y * u[1] - z * u[2]
    b = c * x + w * u[0] + y * u[2] - z * u[1]
    d = c * y + w * u[1] + z * u[0] - x * u[2]
    e = c * z + w * u[2] + x * u[1] - y * u[0]
    size = 1.0 / wp.sqrt(a * a + b * b + d * d + e * e)
    qpos[3] = size * a
    qpos[4] = size * b
    qpos[5] = size * d
    qpos[6] = size * e
    for i in range(6, qvel.shape[0]):
        qpos[i + 1] = qpos[i + 1] + h * qvel[i]


def _middle_kernels(
    structs: Mapping[str, WarpStruct], h: float, set_mid_velocity: wp.Function
) -> Kernels:
    Engines = structs["engine"].batched
    engine_of = structs["engine"].select
    Workspaces = structs["workspace"].batched
    workspace_of = structs["workspace"].select
    AllAccumulators = structs["accumulators"].batched
    H = h

    @wp.kernel(**_OPTIONS)
    def begin_step(
        engines: Engines, workspaces: Workspaces, all_accumulators: AllAccumulators
    ):
        i = wp.tid()
        engine = engine_of(engines, i)
        workspace = workspace_of(workspaces, i)
        for k in range(engine.qvel.shape[0]):
            workspace.v_start[k] = engine.qvel[k]
        integrate_position(engine.qpos, engine.qvel, 0.5 * H)
        for k in range(engine.qpos.shape[0]):
            all_accumulators.mid_qpos[i, k] = engine.qpos[k]

    @wp.kernel(**_OPTIONS)
    def return_to_middle(
        engines: Engines,
        workspaces: Workspaces,
        all_accumulators: AllAccumulators,
        bias: wp.array2d(dtype=float),
    ):
        # Store the predicted velocity v̂, and restore the positions at mid-step.
        i = wp.tid()
        engine = engine_of(engines, i)
        workspace = workspace_of(workspaces, i)
        for k in range(engine.qvel.shape[0]):
            workspace.v_predicted[k] = engine.qvel[k]
            engine.qfrc_bias[k] = bias[i, k]
        for k in range(engine.qpos.shape[0]):
            engine.qpos[k] = all_accumulators.mid_qpos[i, k]
        set_mid_velocity(engine, workspace)

    return {"begin_step": begin_step, "return_to_middle": return_to_middle}


def _friction_kernels(
    structs: Mapping[str, WarpStruct], h: float, functions: Mapping[str, wp.Function]
) -> Kernels:
    apply_stored_friction = functions["apply_stored_friction"]
    solve_friction = functions["solve_friction"]
    store_friction = functions["store_friction"]
    names = (
        "engine",
        "contacts",
        "sparsity",
        "contact_state",
        "workspace",
        "accumulators",
    )
    Engines, AllContacts, Sparsities, ContactStates, Workspaces, AllAccumulators = (
        structs[name].batched for name in names
    )
    engine_of, contacts_of, sparsity_of, state_of, workspace_of, accumulators_of = (
        structs[name].select for name in names
    )
    H = h

    @wp.kernel(**_OPTIONS)
    def apply_friction(
        engines: Engines,
        contacts: AllContacts,
        sparsities: Sparsities,
        states: ContactStates,
        workspaces: Workspaces,
    ):
        i = wp.tid()
        contact = contacts_of(contacts, i)
        sparsity = sparsity_of(sparsities, i)
        state = state_of(states, i)
        workspace = workspace_of(workspaces, i)
        apply_stored_friction(
            engine_of(engines, i), contact, sparsity, state, workspace, H
        )

    @wp.kernel(**_OPTIONS)
    def finish_step(
        engines: Engines,
        contacts: AllContacts,
        sparsities: Sparsities,
        states: ContactStates,
        workspaces: Workspaces,
        all_accumulators: AllAccumulators,
        energy_loss: wp.array(dtype=wp.float64),
    ):
        i = wp.tid()
        engine = engine_of(engines, i)
        contact = contacts_of(contacts, i)
        state = state_of(states, i)
        workspace = workspace_of(workspaces, i)
        sums = accumulators_of(all_accumulators, i)
        solve_friction(engine, contact, sparsity_of(sparsities, i), state, workspace, H)
        power = store_friction(contact, state, workspace, sums.step_force)
        energy_loss[i] = energy_loss[i] + wp.float64(H * power)
        integrate_position(engine.qpos, engine.qvel, 0.5 * H)

    return {"apply_friction": apply_friction, "finish_step": finish_step}
