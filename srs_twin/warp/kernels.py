"""Kernels around MuJoCo Warp's steps: chambers, friction on momentary loads, and what a run keeps.

One thread a world, or one a segment; a world's records are views of those of all.
"""

# No `annotations` from the future: Warp reads the types themselves.
from types import SimpleNamespace
from typing import Any, NamedTuple

import numpy as np
import warp as wp

from srs_twin.plants.twin import friction_held, friction_solve
from srs_twin.pneumatics import chambers, lag
from srs_twin.pneumatics.chambers import AMBIENT_PA
from srs_twin.warp.ported import Ported, ported

_SOLVE = (
    *("_clear", "_multiply", "dot", "point", "_look", "_feel", "_carry", "_project", "_forces", "_slip"),
    *("_load", "_theta", "_law", "_residual", "_assemble", "_search", "_solve"),
    *("approach", "expect", "settle", "note"),
)
_AT_REST = 1e-5  # rad: below it what bends is the slope


class Air(NamedTuple):
    """What chambers keep.

    Attributes:
        pressure: gauge, shape (segments, 2), Pa.
        linear: x, shape (segments,), rad.
        valves: states of the last slot, shape (segments, 2).
        openings: how often each inlet has opened, same shape.
        drawn: work that each segment's air has cost since the beginning, shape (segments,), J.
    """

    pressure: np.ndarray
    linear: np.ndarray
    valves: np.ndarray
    openings: np.ndarray
    drawn: np.ndarray


class Wave(NamedTuple):
    """A gait's, as `control.gait` has it.

    Attributes:
        frequency: f, Hz.
        offset: φ.
        rest: sine of r π/2.
        lag: of each segment, shape (segments,), rad.
    """

    frequency: float
    offset: float
    rest: float
    lag: np.ndarray


class Bodies(NamedTuple):
    """What is seen of the engine, named as in MjData."""

    qpos: np.ndarray
    qvel: np.ndarray
    subtree_com: np.ndarray
    subtree_linvel: np.ndarray
    xpos: np.ndarray
    xmat: np.ndarray
    sensordata: np.ndarray


class Kept(NamedTuple):
    """What a world has done.

    Attributes:
        place: qpos at mid-step.
        now: forces on wheels and hulls in the last step, shape (contacts, 3), N.
        force: their sum since the last sample, same shape.
        bumps: sum of what obstacles press with since then, shape (hulls, 3), N.
    """

    place: np.ndarray
    now: np.ndarray
    force: np.ndarray
    bumps: np.ndarray


def functions() -> dict[str, Any]:
    """Return Warp functions of the laws and of the friction solve, by their names."""
    found = ported([friction_held.held, friction_held.rolling, chambers.volume, chambers._log_cosh])
    found = ported([chambers.bent, lag._segment, lag._filling], **found)
    found = ported([friction_solve._factor, friction_solve._substitute, friction_solve.divide_alone], **found)
    found["_divide"] = found["divide_alone"]  # the engine's own is the processor's
    return ported([getattr(friction_solve, name) for name in _SOLVE], **found)


def kernels(records: dict[str, Ported], spec: SimpleNamespace) -> SimpleNamespace:
    """Return the kernels for records of given shapes.

    Args:
        records: by what they are: `relaxation`, `air`, `wave`, `kept`, and under `loaded` those of the
            friction solve.
        spec: numbers that are the same for all worlds: `h` (s), `slot` (s), `slots` (a step), `tick` (steps),
            `middle` (whether the mean of a step's pressures drives it).
    """
    laws = functions()
    bent, segment, filling = laws["bent"], laws["_segment"], laws["_filling"]
    Relaxation, AirEach, WaveEach = (records[k].each for k in ("relaxation", "air", "wave"))
    relaxation, air_of, wave_of = (records[k].world for k in ("relaxation", "air", "wave"))
    H, SLOT, SLOTS, TICK, MIDDLE = spec.h, spec.slot, spec.slots, spec.tick, spec.middle
    HALF = 0.5 if MIDDLE else 0.0
    options = {"enable_backward": False, "module": "unique"}

    @wp.kernel(**options)
    def command(count: wp.array(dtype=int), given: wp.array4d(dtype=int), out: wp.array4d(dtype=int)):
        """Take the valves of the step's slots from those of a tick."""
        i, j = wp.tid()
        begun = (count[0] % TICK) * SLOTS
        for s in range(SLOTS):
            row = (begun + s) * given.shape[1] / (TICK * SLOTS)
            out[i, s, j, 0] = given[i, row, j, 0]
            out[i, s, j, 1] = given[i, row, j, 1]

    @wp.kernel(**options)
    def wave(count: wp.array(dtype=int), each: WaveEach, out: wp.array4d(dtype=int)):
        """Take them from a gait, in the middle of each slot."""
        i, j = wp.tid()
        own = wave_of(each, i)
        for s in range(SLOTS):
            time = (wp.float64(count[0] * SLOTS + s) + wp.float64(0.5)) * wp.float64(SLOT)
            turns = wp.float64(own.frequency) * time
            angle = wp.float64(6.283185307179586) * (turns - wp.floor(turns)) - wp.float64(own.lag[j])
            value = wp.sin(angle) + wp.float64(own.offset)
            edge = wp.float64(own.rest) - wp.float64(1e-9)
            out[i, s, j, 0] = 2 * int(value >= edge) - 1
            out[i, s, j, 1] = 2 * int(value < -edge) - 1

    @wp.kernel(**options)
    def fill(
        each: Relaxation, all_air: AirEach, valves: wp.array4d(dtype=int), ctrl: wp.array2d(dtype=float)
    ):
        """Let the chambers relax over a step, slot by slot, and say what drives the bodies."""
        i, j = wp.tid()
        law, air = relaxation(each, i), air_of(all_air, i)
        pressure = air.pressure[j]
        first = float(pressure[0])  # Warp would else read it where it is used
        second = float(pressure[1])
        before, _, _ = bent(air.linear[j], law.law)
        before += law.bias[j]
        for s in range(SLOTS):
            state = valves[i, s, j]
            held = filling(state, pressure[0], pressure[1], before, law.space, AMBIENT_PA)
            plus, minus, x = segment(
                state, law.kinds[j], pressure, air.linear[j], law.asymptotes, law.gain[j], law.decay, law.lag,
                law.mode,
            )  # fmt: skip
            after, _, _ = bent(x, law.law)
            after += law.bias[j]
            content = filling(state, plus, minus, after, law.space, AMBIENT_PA)
            air.drawn[j] = air.drawn[j] + law.worth * (content - held)
            pressure[0] = plus
            pressure[1] = minus
            air.linear[j] = x
            for side in range(2):
                if state[side] == 1 and air.valves[j, side] != 1:
                    air.openings[j, side] = air.openings[j, side] + 1
                air.valves[j, side] = state[side]
            before = after
        mean, other = first + HALF * (pressure[0] - first), second + HALF * (pressure[1] - second)
        linear = law.gain[j, 0] * mean - law.gain[j, 1] * other
        _, share, _ = bent(0.0, law.law)
        if wp.abs(linear) > _AT_REST:
            turned, _, _ = bent(linear, law.law)
            share = turned / linear
        ctrl[i, 2 * j] = mean * share
        ctrl[i, 2 * j + 1] = other * share

    KeptEach, kept_of, LOADED = records["kept"].each, records["kept"].world, "work" in records
    ColumnsOne = records["columns"].one
    BodiesEach, bodies_of = records["bodies"].each, records["bodies"].world

    @wp.kernel(**options)
    def tally(
        count: wp.array(dtype=int), sensed: wp.array2d(dtype=float), at: ColumnsOne, kept: KeptEach,
        speeds: wp.array2d(dtype=float), dampers: wp.array2d(dtype=float),
        spent: wp.array(dtype=wp.float64), internal: wp.array(dtype=wp.float64),
    ):  # fmt: skip
        """Sum forces and what is spent; where friction is the engine's, from its sensors."""
        i = wp.tid()
        lost = float(0.0)  # see `internal_joints`
        for j in range(at.hinges.shape[0]):
            mean = float(0.0)
            for n in range(at.hinges.shape[1]):
                mean += speeds[i, at.hinges[j, n]] / float(at.hinges.shape[1])
            for n in range(at.hinges.shape[1]):
                apart = speeds[i, at.hinges[j, n]] - mean
                lost += dampers[i, at.hinges[j, n]] * apart * apart
        for n in range(at.others.shape[0]):
            speed = speeds[i, at.others[n]]
            lost += dampers[i, at.others[n]] * speed * speed
        internal[i] = internal[i] + wp.float64(H * lost)
        own, power = kept_of(kept, i), float(0.0)
        for w in range(at.load.shape[0]):
            if not LOADED:
                for k in range(2):
                    power -= own.now[w, k] * sensed[i, at.foot[w] + k]
                for k in range(3):
                    own.now[w, k] = sensed[i, at.load[w] + k]
        for w in range(own.now.shape[0]):
            for k in range(3):
                own.force[w, k] = own.force[w, k] + own.now[w, k]
        for w in range(at.bump.shape[0]):
            for k in range(3):
                own.bumps[w, k] = own.bumps[w, k] + sensed[i, at.bump[w] + k]
        for w in range(at.pushed.shape[0]):
            power -= sensed[i, at.pushed[w]] * sensed[i, at.moving[w]]
        spent[i] = spent[i] + wp.float64(H * power)
        if i == 0:
            count[0] = count[0] + 1

    @wp.kernel(**options)
    def look(
        bodies: BodiesEach, at: ColumnsOne, all_air: AirEach, kept: KeptEach,
        spent: wp.array(dtype=wp.float64), internal: wp.array(dtype=wp.float64), out: wp.array2d(dtype=float),
    ):  # fmt: skip
        """Write what is to be seen of each world into a row, and begin new sums."""
        i = wp.tid()
        body, air, own, k = bodies_of(bodies, i), air_of(all_air, i), kept_of(kept, i), int(0)
        for n in range(body.qpos.shape[0]):
            out[i, k] = body.qpos[n]
            k += 1
        for n in range(body.qvel.shape[0]):
            out[i, k] = body.qvel[n]
            k += 1
        for n in range(3):
            out[i, k + n] = body.subtree_com[0, n]
            out[i, k + 3 + n] = body.subtree_linvel[0, n]
        k += 6
        for c in range(at.connectors.shape[0]):
            for n in range(3):
                out[i, k + n] = body.xpos[at.connectors[c], n]
            out[i, k + 3] = wp.atan2(body.xmat[at.connectors[c], 3], body.xmat[at.connectors[c], 0])
            k += 4
        for j in range(air.linear.shape[0]):
            for side in range(2):
                out[i, k + side] = air.pressure[j, side]
                out[i, k + 2 + side] = float(air.valves[j, side])
            out[i, k + 4] = air.drawn[j]
            k += 5
        for w in range(own.force.shape[0]):
            for n in range(3):
                out[i, k + n] = own.force[w, n]
                own.force[w, n] = 0.0
            k += 3
        for w in range(own.bumps.shape[0]):
            for n in range(3):
                out[i, k + n] = own.bumps[w, n]
                own.bumps[w, n] = 0.0
            k += 3
        out[i, k] = float(spent[i])
        out[i, k + 1] = body.sensordata[at.energy]
        out[i, k + 2] = float(internal[i])

    found = SimpleNamespace(command=command, wave=wave, fill=fill, tally=tally, look=look)
    return _friction(found, records, laws, H, options) if "work" in records else found


@wp.func
def advance(qpos: wp.array(dtype=float), qvel: wp.array(dtype=float), h: float):
    """Move the root, which is first, and the hinges."""
    for k in range(3):
        qpos[k] = qpos[k] + h * qvel[k]
    turn = wp.vec3(qvel[3], qvel[4], qvel[5])
    speed = wp.length(turn)
    half = 0.5 * h * speed
    axis = turn / wp.max(speed, 1e-20)
    w, x, y, z = qpos[3], qpos[4], qpos[5], qpos[6]
    c, u = wp.cos(half), wp.sin(half) * axis
    a, b = c * w - x * u[0] - y * u[1] - z * u[2], c * x + w * u[0] + y * u[2] - z * u[1]
    d, e = c * y + w * u[1] + z * u[0] - x * u[2], c * z + w * u[2] + x * u[1] - y * u[0]
    size = 1.0 / wp.sqrt(a * a + b * b + d * d + e * e)
    qpos[3] = size * a
    qpos[4] = size * b
    qpos[5] = size * d
    qpos[6] = size * e
    for i in range(6, qvel.shape[0]):
        qpos[i + 1] = qpos[i + 1] + h * qvel[i]


def _friction(found: SimpleNamespace, records: dict[str, Ported], laws: Any, H: float, options: Any) -> Any:
    """Add the kernels of momentary loads, between MuJoCo's half-steps."""
    approach, expect, settle, note = (laws[name] for name in ("approach", "expect", "settle", "note"))
    names = "engine", "contacts", "pattern", "feet", "work", "kept"
    EngineEach, ContactsEach, PatternEach, FeetEach, WorkEach, KeptEach = (records[n].each for n in names)
    engine_of, contacts_of, pattern_of, feet_of, work_of, kept_of = (records[n].world for n in names)

    @wp.kernel(**options)
    def begin(engines: EngineEach, works: WorkEach, kept: KeptEach):
        """Go to mid-step with v₋."""
        i = wp.tid()
        engine, work = engine_of(engines, i), work_of(works, i)
        for k in range(engine.qvel.shape[0]):
            work.before[k] = engine.qvel[k]
        advance(engine.qpos, engine.qvel, 0.5 * H)
        for k in range(engine.qpos.shape[0]):
            kept.place[i, k] = engine.qpos[k]

    @wp.kernel(**options)
    def push(
        engines: EngineEach, contacts: ContactsEach, patterns: PatternEach, feet: FeetEach, works: WorkEach
    ):
        i = wp.tid()
        approach(
            engine_of(engines, i), contacts_of(contacts, i), pattern_of(patterns, i), feet_of(feet, i),
            work_of(works, i),
        )  # fmt: skip

    @wp.kernel(**options)
    def middle(engines: EngineEach, works: WorkEach, kept: KeptEach, bias: wp.array2d(dtype=float)):
        """Take v̂ from the engine's step, and go back to where it was made."""
        i = wp.tid()
        engine, work = engine_of(engines, i), work_of(works, i)
        for k in range(engine.qvel.shape[0]):
            work.predicted[k] = engine.qvel[k]
            engine.qfrc_bias[k] = bias[i, k]
        for k in range(engine.qpos.shape[0]):
            engine.qpos[k] = kept.place[i, k]
        expect(engine, work)

    @wp.kernel(**options)
    def finish(
        engines: EngineEach, contacts: ContactsEach, patterns: PatternEach, feet: FeetEach, works: WorkEach,
        all_kept: KeptEach, spent: wp.array(dtype=wp.float64),
    ):  # fmt: skip
        """Find friction, go to the step's end, keep what there was."""
        i = wp.tid()
        engine, contact, own = engine_of(engines, i), contacts_of(contacts, i), feet_of(feet, i)
        work, kept = work_of(works, i), kept_of(all_kept, i)
        settle(engine, contact, pattern_of(patterns, i), own, work, H)
        power = note(contact, own, work, kept.now)
        spent[i] = spent[i] + wp.float64(H * power)
        advance(engine.qpos, engine.qvel, 0.5 * H)

    found.begin, found.push, found.middle, found.finish = begin, push, middle, finish
    return found
