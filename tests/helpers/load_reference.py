"""Explicit simulation of gaits with instantaneous wheel loads.

It is independent of srs_twin, and a reference for the twins.

    uv run python tests/helpers/load_reference.py                  # convergence of the stored values
    uv run python tests/helpers/load_reference.py --run            # run all points and store their values
    uv run python tests/helpers/load_reference.py --twins          # errors of the twins
    uv run python tests/helpers/load_reference.py --twin-slip      # errors of the twin at smaller slip speeds
    uv run python tests/helpers/load_reference.py --sensitivity    # to heights, tracks and contact times
    uv run python tests/helpers/load_reference.py --slip-mm-s 0.3 --step-ms 0.05 gen2_turn    # one run

MuJoCo computes the normal forces of frictionless wheels (condim 1). Friction is an
explicit force: positions and velocities at the beginning of a step, loads of the step
before. Gait, chambers, MJCF and friction law are implemented in this file. It shares
with srs_twin the values in calibration/robots and the discretisation: two hinges per
segment, a fiftieth of the lightest connector's mass between them, and valves that
switch at whole slots of 0.1 ms.

Each wheel spins. Its rim speed is a state, driven by the contact (isotropic friction,
the cone shared by slip along and across) and slowed by the bearing, whose moment acts
on the connector.

Both frictions are smoothed below a slip speed. A value is extrapolated to step 0 at
each slip speed, then to slip speed 0, see `extrapolate`.
"""

from __future__ import annotations

import argparse
import ctypes
import json
import math
import sys
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import yaml
from numba import njit

VALUES = Path(__file__).with_suffix(".json")
"""Stored runs of the points, see `Runs`."""
ROBOTS = Path(__file__).parents[2] / "calibration/robots"
G = 9.81
HINGES = 2
LINK_FRACTION = 0.02
SLOT_S = 1e-4
"""Valves switch at whole slots, as the gaits of srs_twin do."""
ROUND_S = 0.004
"""Periods are multiples of it: half a period is then a whole number of the twins' steps, 1 or 2 ms."""
RECORD_S = 1e-4
AXLE_FRACTION = 0.2
"""Slip speed of the bearing over that of the contact."""
SLIPS_M_S = (2e-3, 1e-3, 5e-4, 2.5e-4)
STEP_FRACTIONS_S2_M = (0.1, 0.05)
"""Time steps over the slip speed. Friction is stable up to about 2/(mu_n g) = 0.3 s²/m.
"""
CONTACT_S = 0.001
"""Time constant of the normal contacts."""
TWIN_SLIPS_M_S = (1e-3, 5e-4, 2.5e-4)
"""Slip speeds of the twin, whose default is the first."""
MEASURED = 2
"""Number of periods that are measured, at the end of a run."""


@dataclass(frozen=True)
class Point:
    """A gait of a robot on a flat floor.

    Attributes:
        robot: a name in calibration/robots.
        frequency_hz: of the gait; see `period_s`.
        offset: of the gait.
        kpa: supply pressure; None: the robot's nominal one.
        stiffness: of a segment, N·m/rad; None: the robot's.
        tail: of a tail on two axles, m: distances of its second axle and of its centre
            of mass behind the last connector's axle, height of the centre of mass,
            radius of gyration.
        damping_s: damping time of the segments, s; None: the mode time constant of Eq.
            14.
        changes: other numbers of the robot, as (key, value).
        periods: number of periods to simulate; from the last but two on, the gait is
            periodic within 0.05 %.
    """

    robot: str
    frequency_hz: float
    offset: float = 0.0
    kpa: float | None = None
    stiffness: float | None = None
    tail: tuple[float, float, float, float] | None = None
    damping_s: float | None = None
    changes: tuple[tuple[str, float], ...] = ()
    periods: int = 6

    @property
    def period_s(self) -> float:
        """Period of the gait, rounded to a multiple of `ROUND_S`."""
        return ROUND_S * round(1 / self.frequency_hz / ROUND_S)


_GEN2 = Point("gen2", 2.0, kpa=48.3)
POINTS = {
    "gen2_straight": _GEN2,
    "gen2_bend": replace(_GEN2, offset=0.2),
    "gen2_turn": replace(_GEN2, offset=0.4),
    "gen2_slow": replace(_GEN2, frequency_hz=1.0, periods=4),
    "gen2_slow_bend": replace(_GEN2, frequency_hz=1.0, offset=0.2, periods=4),
    "gen2_slow_turn": replace(_GEN2, frequency_hz=1.25, offset=0.4),
    "gen2_high": replace(_GEN2, frequency_hz=1.5, kpa=55.0, offset=0.3),
    "stiff_straight": replace(_GEN2, stiffness=20.0),
    "stiff_bend": replace(_GEN2, stiffness=20.0, offset=0.2),
    "stiff_turn": replace(_GEN2, stiffness=20.0, offset=0.4),
    "stiff_slow_turn": replace(
        _GEN2, stiffness=20.0, frequency_hz=1.0, offset=0.4, periods=4
    ),
    "gen1_straight": Point("gen1", 1.0),
    "gen1_turn": Point("gen1", 1.0, offset=0.3),
    "gen1_slow": Point("gen1", 1 / 3, periods=3),
    "gen1_slow_turn": Point("gen1", 1 / 3, offset=0.3, periods=3),
    "gen3_straight": Point("gen3", 0.9, periods=4),
    "gen3_turn": Point("gen3", 0.9, offset=0.2, periods=4),
    "gen4_straight": Point("gen4", 1.5),
    "gen4_turn": Point("gen4", 1.5, offset=0.3),
    "gen3_tail": Point("gen3", 0.9, tail=(0.06, 0.045, 0.025, 0.025), periods=4),
}
POINTS |= {
    f"{name}_damped": replace(point, damping_s=0.008)
    for name, point in POINTS.items()
    if not name.startswith(("stiff", "gen1_slow", "gen3_tail"))
}


@dataclass(frozen=True)
class Result:
    """Measures of a run, over its last periods.

    Attributes:
        speed_mm_s: length of the path of the centre of mass over time; the path is
            sampled once per period.
        yaw_rate: mean rate of the mean heading, rad/s.
        air: share of wheels and time without load.
        swing: standard deviation of each wheel's load over its static one, mean over
            the wheels.
        ripple: standard deviation of the sum of all loads over the weight.
    """

    speed_mm_s: float
    yaw_rate: float
    air: float
    swing: float
    ripple: float


@njit
def wheel_force(along, across, spin, load, friction, step):  # type: ignore[no-untyped-def]
    """Return friction along and across (N), the new rim speed (m/s), the bearing's moment over the radius.

    The rim's speed w solves m_w/2 (w - w_before)/step = mu_n N (v_t - w)/|slip| - mu_t
    N sgn w. Both sides are smooth and monotone in w, so they cross once: Newton's
    method, with bisection as its safeguard.

    Args:
        along: speed of the wheel's foot along its heading, fixed to the connector, m/s.
        across: across it, m/s.
        spin: rim's speed relative to the connector, m/s.
        load: N.
        friction: mu_t, mu_n, mass of a wheel (kg), slip speeds of contact and bearing (m/s).
        step: s.
    """
    mu_t, mu_n, mass, eps, axle = friction
    rate = mass / 2 / step
    low = min(spin, along, 0.0) - 1e-9
    high = max(spin, along, 0.0) + 1e-9
    w = min(max(spin, low), high)
    for _ in range(60):
        slip = math.sqrt((along - w) ** 2 + across**2 + eps**2)
        rim = math.sqrt(w**2 + axle**2)
        excess = (
            mu_n * load * (along - w) / slip - mu_t * load * w / rim - rate * (w - spin)
        )
        if excess > 0:
            low = w
        else:
            high = w
        derivative = (
            mu_n * load * (across**2 + eps**2) / slip**3
            + mu_t * load * axle**2 / rim**3
            + rate
        )
        move = excess / derivative
        if abs(move) < 1e-13:
            break
        w += move
        if not low < w < high:
            w = (low + high) / 2
    slip = math.sqrt((along - w) ** 2 + across**2 + eps**2)
    drag = mu_t * load * w / math.sqrt(w**2 + axle**2)
    return -mu_n * load * (along - w) / slip, -mu_n * load * across / slip, w, drag


def friction_parameters(n: dict[str, Any], slip: float) -> tuple[float, ...]:
    """Return the `friction` argument of `wheel_force` for a robot's numbers and a slip speed (m/s)."""
    return n["mu_t"], n["mu_n"], n["wheel_kg"], slip, AXLE_FRACTION * slip


def numbers(point: Point) -> dict[str, Any]:
    """Return the robot's numbers by their keys; connectors_kg as a list."""
    text = yaml.safe_load((ROBOTS / f"{point.robot}.yaml").read_text())
    sections = (item for item in text.values() if isinstance(item, dict))
    outcome = {
        key: record["value"]
        for item in sections
        for key, record in item.items()
        if "value" in record
    }
    if not isinstance(outcome["connectors_kg"], list):
        outcome["connectors_kg"] = [outcome["connectors_kg"]] * outcome["connectors"]
    outcome.update(point.changes)
    outcome["damping_time_s"] = (
        outcome["tau_mode_s"] if point.damping_s is None else point.damping_s
    )
    if point.stiffness is not None:
        outcome["stiffness_nm_per_rad"] = point.stiffness
    outcome.setdefault(
        "connector_gyration_m",
        math.sqrt(
            (outcome["rigid_gap_m"] ** 2 + 4 * outcome["half_track_m"] ** 2) / 12
        ),
    )
    # Axles: place in the list of connectors, distance behind, mass they carry.
    outcome["axles"] = [(i, 0.0, m) for i, m in enumerate(outcome["connectors_kg"])]
    outcome["tail"] = point.tail
    if point.tail is not None:
        (i, _, mass), (back, com, _, _) = outcome["axles"].pop(), point.tail
        outcome["axles"] += [
            (i, 0.0, mass * (1 - com / back)),
            (i, back, mass * com / back),
        ]
    return outcome


def mjcf(n: dict[str, Any], step: float, contact: float = CONTACT_S) -> str:
    """Return the snake on a plane, grown from its head backward along -x, without friction.

    Args:
        n: the robot's numbers.
        step: s.
        contact: time constant of the normal contacts, s.
    """
    track = n["half_track_m"]
    radius = n["wheel_radius_m"]
    height = n["com_height_m"]
    pitch = n["segment_length_m"] + n["rigid_gap_m"]
    edge = 1 / (2 * (HINGES + 1))
    front, rear = (
        n["rigid_gap_m"] / 2 + n["segment_length_m"] * fraction
        for fraction in (edge, 1 - edge)
    )
    wheel = n["wheel_kg"]
    link = LINK_FRACTION * min(n["connectors_kg"])

    def inertial(x: float, mass: float, wheels: float = 0.0) -> str:
        about = mass * n["connector_gyration_m"] ** 2
        across = about + wheels * (track**2 + radius**2 / 4)
        return (
            f'<inertial pos="{x} 0 0" mass="{mass + wheels}" diaginertia="{across}'
            f' {about} {across}"/>'
        )

    def joint(name: str, x: float, axis: str, stiffness: float, lag: float) -> str:
        spring = f'stiffness="{stiffness}" damping="{stiffness * lag}"'
        return f'<joint name="{name}" pos="{x} 0 0" axis="{axis}" {spring}/>'

    def bend(j: int, k: int, x: float) -> str:
        return joint(
            f"h{j}_{k}",
            x,
            "0 0 -1",
            HINGES * n["stiffness_nm_per_rad"],
            n["damping_time_s"],
        )

    body = ""
    for i in range(n["connectors"], 0, -1):
        neighbours = 1 if i in (1, n["connectors"]) else 2
        own = n["connectors_kg"][i - 1] - neighbours / 2 * link
        elements = [inertial(0.0, own - 2 * wheel, 2 * wheel)]
        if n["tail"] is not None and i == n["connectors"]:
            _, com, up, gyration = n["tail"]
            about = n["connectors_kg"][i - 1] * gyration**2
            place = f'pos="{-com} 0 {up - height}" mass="{own}"'
            elements = [f'<inertial {place} diaginertia="{about} {about} {about}"/>']
        for a, (at, behind, _) in enumerate(n["axles"]):
            for side, y in (("left", track), ("right", -track)):
                hub = f'pos="{-behind} {y} {radius - height}"'
                name = f'name="{side}_{a}"'
                foot = f'<geom class="foot" {name} {hub} size="{radius}"/>'
                # A little larger than the wheel: a touch sensor adds up the contacts
                # inside its site.
                zone = f'<site {name} {hub} size="{1.2 * radius}"/>'
                elements += [foot, zone] * (at == i - 1)
        if i == 1:
            return _scene(
                '<body name="c1" pos="0 0'
                f' {height}"><freejoint/>{"".join(elements)}{body}</body>',
                n,
                (step, contact),
            )
        j = i - 1
        slow = n["out_of_plane_damping_time_s"]
        elements.append(bend(j, 2, pitch - rear))
        elements.append(
            joint(f"p{j}", pitch / 2, "0 1 0", n["pitch_stiffness_nm_per_rad"], slow)
        )
        elements.append(
            joint(f"r{j}", pitch / 2, "1 0 0", n["roll_stiffness_nm_per_rad"], slow)
        )
        beyond = (
            f'<body name="c{i}" pos="{front - pitch} 0'
            f' 0">{"".join(elements)}{body}</body>'
        )
        middle = inertial((front - rear) / 2, link)
        body = f'<body pos="{-front} 0 0">{middle}{bend(j, 1, 0.0)}{beyond}</body>'
    raise ValueError("a snake has connectors")


def _scene(body: str, n: dict[str, Any], times: tuple[float, float]) -> str:
    segments, (step, contact) = range(1, n["connectors"]), times
    bends = [
        f'<fixed name="t{j}"><joint joint="h{j}_1" coef="1"/><joint joint="h{j}_2"'
        ' coef="1"/></fixed>'
        for j in segments
    ]
    motors = [f'<motor tendon="t{j}"/>' for j in segments]
    sensors = [
        f'<touch site="{side}_{a}"/>'
        for a in range(len(n["axles"]))
        for side in ("left", "right")
    ]
    touch = f'condim="1" solref="{contact} 1"'
    return f"""<mujoco><compiler angle="radian"/>
    <option timestep="{step}" integrator="implicitfast" gravity="0 0 {-G}" tolerance="1e-10">
      <flag island="disable"/></option>
    <default><default class="foot"><geom type="sphere" mass="0" conaffinity="0" {touch}/></default></default>
    <worldbody><geom type="plane" size="0 0 1" contype="0" {touch}/>{body}</worldbody>
    <tendon>{"".join(bends)}</tendon><actuator>{"".join(motors)}</actuator>
    <sensor>{"".join(sensors)}</sensor></mujoco>"""


def moments(n: dict[str, Any], point: Point, step: float, steps: int) -> np.ndarray:
    """Return the mean moment on each segment over each step, shape (steps, segments), N·m.

    Chambers are first-order lags behind valves that follow the square wave of Eq. 13.

    Args:
        n: the robot's numbers.
        point: the gait and the supply pressure.
        step: s.
        steps: number of steps.
    """
    supply = 1000 * (n["nominal_kpa"] if point.kpa is None else point.kpa)
    lag = n["phase_step_rad"] * np.arange(n["connectors"] - 1)
    elements = math.ceil(step / SLOT_S - 1e-9)
    part = step / elements
    # The middle of a slot decides. Rounding must not decide the sign of an exact zero.
    middle = SLOT_S * (
        np.floor(part * (np.arange(elements * steps) + 0.5) / SLOT_S) + 0.5
    )
    wave = (
        np.sin(2 * math.pi / point.period_s * middle[:, None] - lag) + point.offset
        >= -1e-12
    )
    left = [math.exp(-part / n[key]) for key in ("tau_vent_s", "tau_fill_s")]
    x = (
        n["bend_rad"]
        / (1000 * n["at_pressure_kpa"])
        * _differences(wave, supply, *left)
    )
    if (limit := n.get("bend_limit_rad")) is not None:
        x = x / (1 + (x / limit) ** 4) ** 0.25
    # k q_f + c q_f' with q_f' = (x − q_f)/τ₂ and c = k T. With T = τ₂ the mode does not
    # appear.
    fraction = n["damping_time_s"] / n["tau_mode_s"]
    x = fraction * x + (1 - fraction) * _mean_lags(x, part, n["tau_mode_s"])
    return np.asarray(
        n["stiffness_nm_per_rad"] * x.reshape(steps, elements, -1).mean(axis=1)
    )


@njit
def _mean_lags(x, part, time):  # type: ignore[no-untyped-def]
    """Return the mean in each part of the response of a first-order lag to values constant in each part."""
    lagged = np.zeros(x.shape[1])
    outcome = np.empty_like(x)
    kept = math.exp(-part / time)
    for k in range(len(x)):
        outcome[k] = x[k] + (lagged - x[k]) * (1 - kept) * time / part
        lagged = x[k] + (lagged - x[k]) * kept
    return outcome


@njit
def _differences(wave, supply, vented, filled):  # type: ignore[no-untyped-def]
    """Return the mean difference between the chambers of each segment over each step, Pa."""
    steps, segments = wave.shape
    outcome = np.empty((steps, segments))
    p = np.zeros((segments, 2))
    for k in range(steps):
        for j in range(segments):
            before = p[j, 0] - p[j, 1]
            for side in range(2):
                if wave[k, j] == (side == 0):
                    p[j, side] = supply + (p[j, side] - supply) * filled
                else:
                    p[j, side] *= vented
            outcome[k, j] = (before + p[j, 0] - p[j, 1]) / 2
    return outcome


_ENGINE = ctypes.CDLL(str(next(Path(mujoco.__file__).parent.glob("libmujoco*"))))
_step1 = _ENGINE.mj_step1
_step2 = _ENGINE.mj_step2
for _function in (_step1, _step2):
    # Compiled code has addresses as integers.
    _function.argtypes = [ctypes.c_ssize_t, ctypes.c_ssize_t]
    _function.restype = None


@njit
def _run(engine, views, wheels, friction, sizes, torques, records):  # type: ignore[no-untyped-def]
    """Step from rest and record; the arguments are made in `simulate`."""
    xmat, xpos, xipos, cvel, com, ctrl, applied, measured_bend = views
    bodies, places, connectors, loads, constant = wheels
    radius, step, every = sizes
    path, yaw, carried = records
    spin = np.zeros(len(bodies))
    load = loads.copy()
    ahead = np.zeros(3)
    hub = np.zeros(3)
    arm = np.zeros(3)
    steps = len(torques)
    for k in range(steps + 1):
        _step1(engine[0], engine[1])
        if k and k % every == 0:
            j = k // every - 1
            path[j] = com[0, :2]
            carried[j] = load
            for i, body in enumerate(connectors):
                yaw[j, i] = math.atan2(xmat[body, 3], xmat[body, 0])
        if k == steps:
            break
        ctrl[:] = torques[k]
        applied[:] = 0.0
        for w, body in enumerate(bodies):
            frame = xmat[body]
            v = cvel[body]
            size = math.hypot(frame[0], frame[3])
            ahead[0] = frame[0] / size
            ahead[1] = frame[3] / size
            for a in range(3):
                hub[a] = xpos[body, a]
                for b in range(3):
                    hub[a] += frame[3 * a + b] * places[w, b]
            # cvel is the velocity at the centre of mass of the whole snake.
            rx = hub[0] - com[1, 0]
            ry = hub[1] - com[1, 1]
            rz = hub[2] - radius - com[1, 2]
            vx = v[3] + v[1] * rz - v[2] * ry
            vy = v[4] + v[2] * rx - v[0] * rz
            along = vx * ahead[0] + vy * ahead[1]
            across = -vx * ahead[1] + vy * ahead[0]
            pressed = loads[w] if constant else load[w]
            f_t, f_lat, spin[w], drag = wheel_force(
                along, across, spin[w], pressed, friction, step
            )
            # The force that spins the wheel acts at the hub, the force across at the
            # foot.
            fx = f_t * ahead[0] - f_lat * ahead[1]
            fy = f_t * ahead[1] + f_lat * ahead[0]
            for a in range(3):
                arm[a] = hub[a] - xipos[body, a]
            lateral = -radius * f_lat
            applied[body, 0] += fx
            applied[body, 1] += fy
            applied[body, 3] += (
                -arm[2] * fy - lateral * ahead[0] - radius * drag * ahead[1]
            )
            applied[body, 4] += (
                arm[2] * fx - lateral * ahead[1] + radius * drag * ahead[0]
            )
            applied[body, 5] += arm[0] * fy - arm[1] * fx
        _step2(engine[0], engine[1])
        load[:] = measured_bend


def simulate(
    point: Point,
    periods: int | None = None,
    step: float = 5e-5,
    slip: float = 3e-4,
    *,
    contact: float = CONTACT_S,
    static: bool = False,
) -> Result:
    """Run a gait from rest.

    Args:
        point: robot and gait.
        periods: number of periods of the gait; None: those of the point.
        step: s.
        slip: slip speed, m/s.
        contact: time constant of the normal contacts, s.
        static: friction takes each wheel's static load, as the analytical model does by
            default.
    """
    n = numbers(point)
    every = max(1, round(RECORD_S / step))
    model = mujoco.MjModel.from_xml_string(mjcf(n, step, contact))
    data = mujoco.MjData(model)
    count = len(n["axles"])
    radius = n["wheel_radius_m"]
    bodies = np.repeat([model.body(f"c{i + 1}").id for i, _, _ in n["axles"]], 2)
    back = np.repeat([behind for _, behind, _ in n["axles"]], 2)
    side = np.tile([n["half_track_m"], -n["half_track_m"]], count)
    places = np.stack([-back, side, 0 * side + radius - n["com_height_m"]], axis=1)
    rest = np.repeat([mass * G / 2 for _, _, mass in n["axles"]], 2)
    torques = moments(
        n,
        point,
        step,
        round((point.periods if periods is None else periods) * point.period_s / step),
    )
    samples = len(torques) // every
    records = (
        np.empty((samples, 2)),
        np.empty((samples, n["connectors"])),
        np.empty((samples, 2 * count)),
    )
    _run(
        (model._address, data._address),
        (
            data.xmat,
            data.xpos,
            data.xipos,
            data.cvel,
            data.subtree_com,
            data.ctrl,
            data.xfrc_applied,
            data.sensordata,
        ),
        (bodies, places, np.unique(bodies), rest, static),
        friction_parameters(n, slip),
        (radius, step, every),
        torques,
        records,
    )
    path, yaw, loads = records
    return measured(
        path,
        np.unwrap(yaw, axis=0),
        loads,
        rest,
        round(point.period_s / (every * step)),
        every * step,
    )


def measured(
    com: np.ndarray,
    yaw: np.ndarray,
    loads: np.ndarray,
    rest: np.ndarray,
    period: int,
    step: float,
) -> Result:
    """Return the measures of a run over its last `MEASURED` periods, or all but the first of a shorter run.

    Args:
        com: centre of mass at the end of each step, shape (steps, 2), m.
        yaw: headings, shape (steps, N), unwrapped, rad.
        loads: shape (steps, 2 N), N.
        rest: static loads, shape (2 N,), N.
        period: steps per period of the gait.
        step: s.
    """
    first = len(com) - period * min(MEASURED, len(com) // period - 1)
    ends = np.arange(first, len(com) + 1, period) - 1
    path = com[ends]
    time = step * (ends[-1] - ends[0])
    speed = np.linalg.norm(np.diff(path, axis=0), axis=1).sum() / time
    heading = yaw.mean(axis=1)
    used = loads[first:]
    return Result(
        1000 * float(speed),
        float((heading[ends[-1]] - heading[ends[0]]) / time),
        float((used <= 1e-9).mean()),
        float((used / rest).std(axis=0).mean()),
        float((used.sum(axis=1) / rest.sum()).std()),
    )


@dataclass(frozen=True)
class Runs:
    """Runs of a point at all slip speeds and steps.

    Attributes:
        speed_mm_s, yaw_rate: see `Result`, shape (slip speeds, steps).
        air, swing, ripple: see `Result`, of the run with the smallest slip speed and
            step.
    """

    speed_mm_s: list[list[float]]
    yaw_rate: list[list[float]]
    air: float
    swing: float
    ripple: float

    @property
    def speed(self) -> tuple[float, float]:
        """Extrapolated speed and its error, mm/s."""
        return extrapolate(self.speed_mm_s)

    @property
    def yaw(self) -> tuple[float, float]:
        """Extrapolated yaw rate and its error, rad/s."""
        return extrapolate(self.yaw_rate)


def extrapolate(values: Sequence[Sequence[float]]) -> tuple[float, float]:
    """Return the limit for step 0 and slip speed 0, and an estimate of its error.

    At each slip speed, the step is extrapolated linearly. The slip speeds are
    extrapolated from the last three of them by a power law, whose order is fitted
    between 1/2 and 1. The error is the difference from the same extrapolation without
    the smallest slip speed, plus the last correction for the step.

    Args:
        values: shape (slip speeds, 2), both halved from each to the next.
    """
    grid = np.asarray(values)
    fine = 2 * grid[:, 1] - grid[:, 0]
    before, limit = (
        _power_limit(*fine[k : k + 3]) for k in (len(fine) - 4, len(fine) - 3)
    )
    return limit, abs(limit - before) + abs(float(fine[-1] - grid[-1, 1]))


def _power_limit(first: float, second: float, third: float) -> float:
    ratio = (third - second) / (second - first) if second != first else 0.5
    ratio = min(max(ratio, 0.5), math.sqrt(0.5))
    return float(third + (third - second) * ratio / (1 - ratio))


def stored() -> dict[str, Runs]:
    """Return the stored runs by their points."""
    text = VALUES.read_text() if VALUES.exists() else "{}"
    return {name: Runs(**runs) for name, runs in json.loads(text).items()}


def run_all(names: Iterable[str]) -> None:
    """Run points at all slip speeds and steps, and store each when it is complete."""
    for name in names:
        results = [
            [simulate(POINTS[name], None, s * e, e) for s in STEP_FRACTIONS_S2_M]
            for e in SLIPS_M_S
        ]
        last = results[-1][-1]
        runs = Runs(
            [[round(r.speed_mm_s, 4) for r in row] for row in results],
            [[round(r.yaw_rate, 6) for r in row] for row in results],
            *(round(item, 5) for item in (last.air, last.swing, last.ripple)),
        )
        kept = stored() | {name: runs}
        lines = [
            f'"{key}": {json.dumps(vars(kept[key]))}' for key in POINTS if key in kept
        ]
        VALUES.write_text("{\n" + ",\n".join(lines) + "\n}\n")
        print(name, runs.speed, runs.yaw, file=sys.stderr, flush=True)


def table(head: Iterable[str], rows: Iterable[Iterable[str]]) -> str:
    """Return a Markdown table."""
    head = list(head)
    return "\n".join(
        f"| {' | '.join(row)} |" for row in (head, ["---"] * len(head), *rows)
    )


def turns(runs: Runs) -> bool:
    """Return whether the gait turns, so that errors of its yaw rate can be given in %."""
    return abs(runs.yaw[0]) > 0.05


def convergence(names: Iterable[str]) -> str:
    """Return a table of both measures over the slip speeds, at step 0."""
    slips = [f"{1000 * slip:g} mm/s" for slip in SLIPS_M_S]
    head = ["point", *slips, "limit", "error, %", "last step, %"]
    rows = []
    for name in names:
        runs = stored()[name]
        for values, unit, digits in (
            (runs.speed_mm_s, "mm/s", 2),
            (runs.yaw_rate, "rad/s", 4),
        ):
            if unit == "rad/s" and not turns(runs):
                continue
            (limit, error), grid = extrapolate(values), np.array(values)
            fine = 2 * grid[:, 1] - grid[:, 0]
            step = grid[-1, 1] - grid[-1, 0]
            rows.append(
                [
                    f"{name}, {unit}",
                    *(f"{value:.{digits}f}" for value in (*fine, limit)),
                    *(f"{100 * abs(value / limit):.2f}" for value in (error, step)),
                ]
            )
    return table(head, rows)


def twins(names: Iterable[str]) -> str:
    """Return a table of the reference and the errors of the twins."""
    from twin_at_reference import (
        crawled,
    )  # here, because the simulation takes nothing from srs_twin

    settings = [
        (contact, step)
        for contact in ("loaded", "preloaded")
        for step in (0.001, 0.002)
    ]
    head = [
        "point",
        "mm/s",
        "rad/s",
        "error, %",
        *(f"{c}, {1000 * step:g} ms" for c, step in settings),
    ]
    rows = []
    for name in names:
        runs = stored()[name]
        cells = []
        for contact, step in settings:
            if POINTS[name].tail is not None and contact == "preloaded":
                cells.append("–")  # has no second axle
                continue
            cells.append(_apart(crawled(name, None, step, contact=contact), runs))
        (speed, speed_error), (yaw, yaw_error) = runs.speed, runs.yaw
        own = [
            100 * speed_error / speed,
            *([100 * yaw_error / abs(yaw)] if turns(runs) else []),
        ]
        rows.append(
            [
                name,
                f"{speed:.2f}",
                f"{yaw:.4f}" if turns(runs) else "–",
                ", ".join(f"{item:.2f}" for item in own),
                *cells,
            ]
        )
    return table(head, rows)


def twin_slips(names: Iterable[str]) -> str:
    """Return a table of the loaded twin's errors at smaller slip speeds, 1 ms, and extrapolated."""
    from twin_at_reference import (
        crawled,
    )  # here, because the simulation takes nothing from srs_twin

    from srs_twin import LoadedContact

    rows = []
    for name in names:
        runs = stored()[name]
        results = [
            crawled(name, contact=LoadedContact(slip_speed=slip))
            for slip in TWIN_SLIPS_M_S
        ]
        limit = {
            key: _power_limit(*(vars(r)[key] for r in results))
            for key in ("speed_mm_s", "yaw_rate")
        }
        results.append(replace(results[-1], **limit))
        rows.append([name, *(_apart(item, runs) for item in results)])
    return table(
        [
            "point",
            *(f"{1000 * slip:g} mm/s" for slip in TWIN_SLIPS_M_S),
            "extrapolated",
        ],
        rows,
    )


def _apart(result: Result, runs: Runs) -> str:
    errors = [100 * (result.speed_mm_s / runs.speed[0] - 1)]
    if turns(runs):
        errors.append(100 * (result.yaw_rate / runs.yaw[0] - 1))
    return ", ".join(f"{item:+.1f}".replace("-", "−") for item in errors)


def sensitivity(names: Iterable[str]) -> str:
    """Return a table of the changes, %, with other heights, tracks and contact times."""
    rows = []
    eps = SLIPS_M_S[-1]
    run = partial(simulate, periods=None, step=STEP_FRACTIONS_S2_M[0] * eps, slip=eps)
    for name in names:
        point = POINTS[name]
        base = run(point)
        track = numbers(point)["half_track_m"]
        others = [
            run(replace(point, changes=(("com_height_m", 0.0125),))),
            run(replace(point, changes=(("half_track_m", 1.05 * track),))),
            *(run(point, contact=factor * CONTACT_S) for factor in (0.5, 2.0)),
        ]
        cells = []
        for item in others:
            changes = [100 * (item.speed_mm_s / base.speed_mm_s - 1)]
            if abs(base.yaw_rate) > 0.05:
                changes.append(100 * (item.yaw_rate / base.yaw_rate - 1))
            cells.append(
                ", ".join(f"{change:+.2f}".replace("-", "−") for change in changes)
            )
        rows.append([name, *cells])
    contacts = (
        f"contact time {1000 * factor * CONTACT_S:g} ms" for factor in (0.5, 2.0)
    )
    return table(
        ["point", "com_height_m 12.5 mm", "half_track_m +5 %", *contacts], rows
    )


def main() -> None:
    """Run points, or print tables of what is stored."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument(
        "points",
        nargs="*",
        metavar="POINT",
        help=f"of {', '.join(POINTS)}; default all",
    )
    parser.add_argument(
        "--run", action="store_true", help="run the points again and store the values"
    )
    tables: dict[str, Callable[[Iterable[str]], str]] = {
        "--twins": twins,
        "--twin-slip": twin_slips,
        "--sensitivity": sensitivity,
    }
    for name, make in tables.items():
        parser.add_argument(
            name, action="store_const", const=make, dest="table", help=_summary(make)
        )
    parser.add_argument(
        "--slip-mm-s", type=float, help="a single run at this slip speed"
    )
    parser.add_argument("--step-ms", type=float, help="step of the single run")
    parser.add_argument("--periods", type=int, help="periods of the single run")
    parser.add_argument(
        "--static",
        action="store_true",
        help="friction of the single run takes static loads",
    )
    options = parser.parse_args()
    names = options.points or list(POINTS)
    if options.slip_mm_s is not None or options.step_ms is not None or options.static:
        eps = 0.3 if options.slip_mm_s is None else options.slip_mm_s
        step = 100 * eps / 1000 if options.step_ms is None else options.step_ms
        for name in names:
            r = simulate(
                POINTS[name],
                options.periods,
                step / 1000,
                eps / 1000,
                static=options.static,
            )
            print(
                f"{name:16} {r.speed_mm_s:7.2f} mm/s {r.yaw_rate:+.4f} rad/s; in the"
                f" air {r.air:.1%}, swing {r.swing:.2f}, ripple {r.ripple:.3f}",
                flush=True,
            )
        return
    if options.run:
        run_all(names)
    print((options.table or convergence)(names))


def _summary(function: Callable[..., Any]) -> str:
    return (
        (function.__doc__ or "")
        .partition("\n")[0]
        .replace("%", "%%")
        .replace("Return", "print")
    )


if __name__ == "__main__":
    main()
