"""Gaits on momentary wheel loads, simulated a second time: explicitly, and with nothing of srs_twin in it.

    uv run python benchmarks/load_reference.py                 # all points, 0.05 ms
    uv run python benchmarks/load_reference.py --step-ms 0.02 gen2_turn

MuJoCo finds the normal forces of wheels without friction (condim 1); the wheel law, written here once more
from its formulas, acts explicitly with the loads of the step before. Chambers, gait, MJCF and the law are
this file's own; of srs_twin it takes the numbers in calibration/robots and the discretisation that the twin
has as well: two hinges a segment with a fiftieth of the lightest connector's mass between them.

Each wheel spins: its rim's speed is a state of its own, driven by the contact (isotropic, the cone shared by
slip along and across) and held back by the bearing, whose moment the connector feels.
"""

from __future__ import annotations

import argparse
import math
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import yaml

ROBOTS = Path(__file__).parents[1] / "calibration/robots"
G = 9.81
SLIP_M_S = 0.0003
AXLE_M_S = 0.00006
HINGES, LINK_SHARE = 2, 0.02


@dataclass(frozen=True)
class Point:
    """A gait of a robot on a flat floor.

    Attributes:
        robot: a name in calibration/robots.
        frequency_hz: of the gait.
        offset: of the gait.
        kpa: supply; None: the robot's nominal one.
        stiffness: of a segment, N·m/rad; None: the robot's.
        tail: of a tail on two axles: how far the second is behind the last connector's, its centre of mass
            behind that, the height of this, and the radius of gyration, m.
    """

    robot: str
    frequency_hz: float
    offset: float = 0.0
    kpa: float | None = None
    stiffness: float | None = None
    tail: tuple[float, float, float, float] | None = None


_GEN2 = Point("gen2", 2.0, kpa=48.3)
POINTS = {
    "gen2_straight": _GEN2,
    "gen2_bend": replace(_GEN2, offset=0.2),
    "gen2_turn": replace(_GEN2, offset=0.4),
    "gen2_slow": replace(_GEN2, frequency_hz=1.0),
    "gen2_slow_turn": replace(_GEN2, frequency_hz=1.25, offset=0.4),
    "stiff_straight": replace(_GEN2, stiffness=20.0),
    "stiff_bend": replace(_GEN2, stiffness=20.0, offset=0.2),
    "stiff_turn": replace(_GEN2, stiffness=20.0, offset=0.4),
    "stiff_slow_turn": replace(_GEN2, stiffness=20.0, frequency_hz=1.0, offset=0.4),
    "gen1_straight": Point("gen1", 1 / 3),
    "gen3_straight": Point("gen3", 0.9),
    "gen4_straight": Point("gen4", 1.5),
    "gen3_tail": Point("gen3", 0.9, tail=(0.06, 0.045, 0.025, 0.025)),
}


@dataclass(frozen=True)
class Result:
    """What a run gave, over whole periods after two (gen 1: one).

    Attributes:
        speed_mm_s: arc length of the period-averaged path of the centre of mass over time.
        yaw_rate: rad/s.
        air: share of wheels and time without load.
        swing: standard deviation of each wheel's load over its static one, mean over the wheels.
        ripple: standard deviation of the sum of all loads over the weight.
    """

    speed_mm_s: float
    yaw_rate: float
    air: float
    swing: float
    ripple: float


def wheel_force(
    along: np.ndarray, across: np.ndarray, spin: np.ndarray, load: np.ndarray, n: dict[str, Any], step: float
) -> tuple[np.ndarray, ...]:
    """Return friction along and across, the rim's speed after a step, the bearing's moment over the radius.

    The rim's speed w solves m_w/2 (w - w_before)/step = mu_n N (v_t - w)/|slip| - mu_t N sgn w. The two sides
    cross once; found by halving.

    Args:
        along: speed of the wheel's foot along its heading, fixed to the connector, m/s.
        across: across it, m/s.
        spin: rim's speed relative to the connector, m/s.
        load: N.
        n: the robot's numbers.
        step: s.
    """
    mass = n["wheel_kg"] / 2 / step
    low, high = np.minimum(spin, along) - 1e-9, np.maximum(spin, along) + 1e-9
    low, high = np.minimum(low, 0.0), np.maximum(high, 0.0)
    for _ in range(40):
        w = (low + high) / 2
        slip = np.sqrt((along - w) ** 2 + across**2 + SLIP_M_S**2)
        pushed = n["mu_n"] * load * (along - w) / slip
        dragged = n["mu_t"] * load * w / np.sqrt(w**2 + AXLE_M_S**2)
        faster = pushed - dragged > mass * (w - spin)
        low, high = np.where(faster, w, low), np.where(faster, high, w)
    return -pushed, -n["mu_n"] * load * across / slip, w, dragged


def numbers(point: Point) -> dict[str, Any]:
    """Return the robot's numbers by their keys; connectors_kg as a list."""
    text = yaml.safe_load((ROBOTS / f"{point.robot}.yaml").read_text())
    sections = (each for each in text.values() if isinstance(each, dict))
    found = {key: record["value"] for each in sections for key, record in each.items() if "value" in record}
    if not isinstance(found["connectors_kg"], list):
        found["connectors_kg"] = [found["connectors_kg"]] * found["connectors"]
    if point.stiffness is not None:
        found["stiffness_nm_per_rad"] = point.stiffness
    found.setdefault(
        "connector_gyration_m", math.sqrt((found["rigid_gap_m"] ** 2 + 4 * found["half_track_m"] ** 2) / 12)
    )
    # Axles: place in the list of connectors, how far behind, mass they carry.
    found["tail"], found["axles"] = point.tail, [(i, 0.0, m) for i, m in enumerate(found["connectors_kg"])]
    if point.tail is not None:
        (i, _, mass), (back, com, _, _) = found["axles"].pop(), point.tail
        found["axles"] += [(i, 0.0, mass * (1 - com / back)), (i, back, mass * com / back)]
    return found


def mjcf(n: dict[str, Any], step: float) -> str:
    """Return the snake on a plane, grown from its head backward along -x; no friction anywhere."""
    track, radius, height = n["half_track_m"], n["wheel_radius_m"], n["com_height_m"]
    pitch, edge = n["segment_length_m"] + n["rigid_gap_m"], 1 / (2 * (HINGES + 1))
    front, rear = (n["rigid_gap_m"] / 2 + n["segment_length_m"] * share for share in (edge, 1 - edge))
    wheel, link = n["wheel_kg"], LINK_SHARE * min(n["connectors_kg"])

    def inertial(x: float, mass: float, wheels: float = 0.0) -> str:
        about = mass * n["connector_gyration_m"] ** 2
        across = about + wheels * (track**2 + radius**2 / 4)
        return f'<inertial pos="{x} 0 0" mass="{mass + wheels}" diaginertia="{across} {about} {across}"/>'

    def joint(name: str, x: float, axis: str, stiffness: float, lag: float) -> str:
        spring = f'stiffness="{stiffness}" damping="{stiffness * lag}"'
        return f'<joint name="{name}" pos="{x} 0 0" axis="{axis}" {spring}/>'

    def bend(j: int, k: int, x: float) -> str:
        return joint(f"h{j}_{k}", x, "0 0 -1", HINGES * n["stiffness_nm_per_rad"], n["damping_time_s"])

    body = ""
    for i in range(n["connectors"], 0, -1):
        neighbours = 1 if i in (1, n["connectors"]) else 2
        own = n["connectors_kg"][i - 1] - neighbours / 2 * link
        parts = [inertial(0.0, own - 2 * wheel, 2 * wheel)]
        if n["tail"] is not None and i == n["connectors"]:
            _, com, up, gyration = n["tail"]
            about = n["connectors_kg"][i - 1] * gyration**2
            place = f'pos="{-com} 0 {up - height}" mass="{own}"'
            parts = [f'<inertial {place} diaginertia="{about} {about} {about}"/>']
        for a, (at, behind, _) in enumerate(n["axles"]):
            for side, y in (("left", track), ("right", -track)):
                hub = f'pos="{-behind} {y} {radius - height}" size="{radius}"'
                parts += [f'<geom class="foot" name="{side}_{a}" {hub}/>'] * (at == i - 1)
        if i == 1:
            return _scene(
                f'<body name="c1" pos="0 0 {height}"><freejoint/>{"".join(parts)}{body}</body>',
                n["connectors"],
                step,
            )
        j, slow = i - 1, n["out_of_plane_damping_time_s"]
        parts.append(bend(j, 2, pitch - rear))
        parts.append(joint(f"p{j}", pitch / 2, "0 1 0", n["pitch_stiffness_nm_per_rad"], slow))
        parts.append(joint(f"r{j}", pitch / 2, "1 0 0", n["roll_stiffness_nm_per_rad"], slow))
        beyond = f'<body name="c{i}" pos="{front - pitch} 0 0">{"".join(parts)}{body}</body>'
        middle = inertial((front - rear) / 2, link)
        body = f'<body pos="{-front} 0 0">{middle}{bend(j, 1, 0.0)}{beyond}</body>'
    raise ValueError("a snake has connectors")


def _scene(body: str, connectors: int, step: float) -> str:
    segments = range(1, connectors)
    bends = [
        f'<fixed name="t{j}"><joint joint="h{j}_1" coef="1"/><joint joint="h{j}_2" coef="1"/></fixed>'
        for j in segments
    ]
    motors = [f'<motor tendon="t{j}"/>' for j in segments]
    touch = 'condim="1" solref="0.001 1"'
    return f"""<mujoco><compiler angle="radian"/>
    <option timestep="{step}" integrator="implicitfast" gravity="0 0 {-G}" tolerance="1e-10"/>
    <default><default class="foot"><geom type="sphere" mass="0" conaffinity="0" {touch}/></default></default>
    <worldbody><geom type="plane" size="0 0 1" contype="0" {touch}/>{body}</worldbody>
    <tendon>{"".join(bends)}</tendon><actuator>{"".join(motors)}</actuator></mujoco>"""


class Chambers:
    """First-order lags behind valves that follow the square wave of Eq. 13."""

    def __init__(self, n: dict[str, Any], point: Point, step: float) -> None:
        self._supply = 1000 * (n["nominal_kpa"] if point.kpa is None else point.kpa)
        segments = n["connectors"] - 1
        self._lag, self._f, self._offset = (
            n["phase_step_rad"] * np.arange(segments),
            point.frequency_hz,
            point.offset,
        )
        self._fill, self._vent = (math.exp(-step / n[k]) for k in ("tau_fill_s", "tau_vent_s"))
        self._step, self._p = step, np.zeros((segments, 2))
        gain = n["bend_rad"] / (1000 * n["at_pressure_kpa"])
        self._moment, self._gain, self._limit = n["stiffness_nm_per_rad"], gain, n.get("bend_limit_rad")

    def moments(self, time: float) -> np.ndarray:
        """Advance by a step that begins at a time; return the mean moment over it on each segment, N·m."""
        wave = np.sin(2 * math.pi * self._f * (time + self._step / 2) - self._lag) + self._offset >= 0
        filling = np.stack([wave, ~wave], axis=1)
        left = np.where(filling, self._fill, self._vent)
        end = np.where(filling, self._supply, 0.0)
        before, self._p = self._p, end + (self._p - end) * left
        mean = (before + self._p) / 2
        x = self._gain * (mean[:, 0] - mean[:, 1])
        if self._limit is not None:
            x = x / (1 + (x / self._limit) ** 4) ** 0.25
        moments: np.ndarray = self._moment * x
        return moments


def simulate(point: Point, periods: int, step: float = 5e-5, static: bool = False) -> Result:
    """Run a gait from rest.

    Args:
        point: robot and gait.
        periods: how many periods of the gait.
        step: s.
        static: friction takes each wheel's static load, as the analytical model does by default.
    """
    n = numbers(point)
    model = mujoco.MjModel.from_xml_string(mjcf(n, step))
    data = mujoco.MjData(model)
    count, radius, track = len(n["axles"]), n["wheel_radius_m"], n["half_track_m"]
    bodies = np.repeat([model.body(f"c{i + 1}").id for i, _, _ in n["axles"]], 2)
    connectors = np.unique(bodies)
    side = np.tile([track, -track], count)
    back = np.repeat([behind for _, behind, _ in n["axles"]], 2)
    geoms = {
        model.geom(f"{s}_{i}").id: 2 * i + k for i in range(count) for k, s in enumerate(("left", "right"))
    }
    rest = np.repeat([mass * G / 2 for _, _, mass in n["axles"]], 2)
    load = rest.copy()
    steps = round(periods / point.frequency_hz / step)
    com, yaw, loads = np.empty((steps, 2)), np.empty((steps, n["connectors"])), np.empty((steps, 2 * count))
    chambers = Chambers(n, point, step)
    spin = np.zeros(2 * count)
    mujoco.mj_forward(model, data)
    for k in range(steps):
        data.ctrl[:] = chambers.moments(k * step)
        frame = data.xmat[bodies].reshape(-1, 3, 3)
        ahead = frame[:, :2, 0] / np.linalg.norm(frame[:, :2, 0], axis=1)[:, None]
        left = np.stack([-ahead[:, 1], ahead[:, 0]], axis=1)
        places = np.stack([-back, side, 0 * side + radius - n["com_height_m"]], axis=1)
        hub = data.xpos[bodies] + np.einsum("wij,wj->wi", frame, places)
        foot = hub - [0, 0, radius]
        turn, move = data.cvel[bodies, :3], data.cvel[bodies, 3:]
        middle = data.subtree_com[model.body_rootid[bodies]]
        speed = move + np.cross(turn, foot - middle)
        along, across = (speed[:, :2] * ahead).sum(axis=1), (speed[:, :2] * left).sum(axis=1)
        f_t, f_n, spin, drag = wheel_force(along, across, spin, rest if static else load, n, step)
        centre, at_hub, at_foot = data.xipos[bodies], np.zeros((2 * count, 3)), np.zeros((2 * count, 3))
        at_hub[:, :2], at_foot[:, :2] = f_t[:, None] * ahead, f_n[:, None] * left
        moment = np.cross(hub - centre, at_hub) + np.cross(foot - centre, at_foot)
        moment[:, :2] += radius * drag[:, None] * left
        data.xfrc_applied[:] = 0
        np.add.at(data.xfrc_applied, bodies, np.concatenate([at_hub + at_foot, moment], axis=1))
        mujoco.mj_step(model, data)
        load = np.zeros(2 * count)
        for contact in range(data.ncon):
            row = data.contact.efc_address[contact]
            load[geoms[data.contact.geom[contact, 1]]] = data.efc_force[row] if row >= 0 else 0.0
        com[k], loads[k] = data.subtree_com[0, :2], load
        yaw[k] = np.arctan2(data.xmat[connectors, 3], data.xmat[connectors, 0])
    return measured(com, np.unwrap(yaw, axis=0), loads, rest, round(1 / point.frequency_hz / step), step)


def measured(
    com: np.ndarray, yaw: np.ndarray, loads: np.ndarray, rest: np.ndarray, period: int, step: float
) -> Result:
    """Return what a run gave; see `Result`.

    Args:
        com: centre of mass at the end of each step, shape (steps, 2), m.
        yaw: headings, shape (steps, N), unwrapped, rad.
        loads: shape (steps, 2 N), N.
        rest: static loads, shape (2 N,), N.
        period: steps a period of the gait.
        step: s.
    """
    whole = len(com) // period
    first = len(com) - period * (whole - (2 if whole > 3 else 1))
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


def main() -> None:
    """Print a row a point."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("points", nargs="*", metavar="POINT", help=f"of {', '.join(POINTS)}; default all")
    parser.add_argument("--step-ms", type=float, default=0.05)
    parser.add_argument("--periods", type=int, default=0, help="0: five, of gen 1 three")
    parser.add_argument("--static", action="store_true", help="friction takes the static loads")
    given = parser.parse_args()
    for name in given.points or POINTS:
        point = POINTS[name]
        periods = given.periods or (5 if point.frequency_hz > 0.5 else 3)
        r = simulate(point, periods, given.step_ms / 1000, given.static)
        print(
            f"{name:16} {r.speed_mm_s:7.2f} mm/s {r.yaw_rate:+.4f} rad/s; in the air {r.air:.1%}, "
            f"swing {r.swing:.2f}, ripple {r.ripple:.3f}",
            flush=True,
        )


if __name__ == "__main__":
    main()
