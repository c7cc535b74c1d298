"""The two feet of each connector, their contacts with the floor, and their preload.

A connector touches the floor in two points at ± half the track, straight below its own frame.

Loaded contact: the feet are balls without friction, and friction is a law on their contact forces
(`plants.loaded`). Preloaded contact:

- ``rolling``: hinge wheels. They touch the floor as spheres, isotropic with μ_n; the axle's `frictionloss`
  is μ_t × load × radius.
- ``skid``: runners, fixed to the connector, that slide with μ_t along it and μ_n across. Only between a
  plane and a capsule does MuJoCo turn the contact's frame with the geom, to the capsule's axis. A capsule
  that lies flat touches with both ends; these rise ahead like the tip of a ski and touch with the lower one.

Contacts are explicit pairs, which name the floor, so they belong to the scene and not to the robot.

Preload: MuJoCo's contact is convex, which lifts off the floor what slides on it; left alone, a snake's
wheels are in the air more than half the time and it goes up to a tenth too fast. Actuators ``press_i``,
which take no control, push every connector down with κ times its static load, and the pairs' coefficients
are those of the robot over 1 + κ: the friction of the static load, as in the analytical models, from a
contact that stays closed. Floor forces less the preload are the true loads, at rest within 2 %.
docs/models.md says what it costs.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from typing import Any

import mujoco
import numpy as np
from mujoco import MjsBody, MjSpec, mjtObj, mjtSensor

from srs_twin.plants.twin.mjcf.classes import ROOT, foot_radius
from srs_twin.plants.twin.mjcf.numerics import LoadedContact, ModelSettings, PreloadedContact
from srs_twin.robot.spec import GRAVITY, RobotSpec

_NET_FORCE = 3  # contact sensor: sum over the contacts found
_SIDES = {"left": 1, "right": -1}
_RISE = 0.6  # slope of a runner ahead of the point where it touches: no pitch of a connector comes near
_DIP = 1e-6  # m, of a runner in the floor at first: else rounding decides which of them the first step finds
_TOUCHING = 5e-5  # m, of all feet in the floor, where their softness is looked at
_PRESSED = {"rolling": "axle", "skid": "sole"}  # what the sites that the preload presses on are called


def treads(spec: RobotSpec) -> list[str]:
    """Return the names of the geoms that touch the floor: head first, left before right."""
    return [f"tread_{side}_{i}" for i in range(1, len(spec.axles) + 1) for side in _SIDES]


def rest_loads(spec: RobotSpec, gravity: float = GRAVITY) -> np.ndarray:
    """Return the load of each wheel of a snake at rest, head first, shape (axles, 2), N."""
    return np.repeat([[axle.mass * gravity / 2] for axle in spec.axles], 2, axis=1)


def preload_force(spec: RobotSpec, contact: PreloadedContact) -> np.ndarray:
    """Return the force that presses each wheel down besides its load, head first, shape (N, 2), N."""
    return np.repeat(contact.pressed * spec.mass.array()[:, None] * GRAVITY / 2, 2, axis=1)


def pair_attributes(spec: RobotSpec, settings: ModelSettings) -> dict[str, Any]:
    """Return the attributes of a pair of floor and wheel or skid; friction along first, then across."""
    mu_t, mu_n, contact = spec.friction.mu_t, spec.friction.mu_n, settings.contact
    if isinstance(contact, LoadedContact):
        return {"condim": 1, "solref": [settings.contact_time, 1]}
    across = mu_n / (1 + contact.pressed)
    along = across if contact.rolling else mu_t / (1 + contact.pressed)
    return {
        "condim": 3,
        "friction": [along, across, 0.005, 0.0001, 0.0001],
        "solref": [settings.contact_time, 1],
        "solreffriction": [contact.slip_time, 1],
    }


def fixed_inertia(spec: RobotSpec, settings: ModelSettings) -> tuple[float, np.ndarray]:
    """Return the mass (kg) and the moments of inertia (3,) (kg·m²) that a connector's skids add to its own.

    They have the mass of the wheels whose place they take. Wheels that turn on axles are bodies of their own:
    0. On a bench nothing rolls: wheels are fixed there as well. Under `loaded` their spin is friction's.
    """
    rolling = settings.contact.rolling and settings.base == "free"
    if rolling and not settings.loaded:
        return 0.0, np.zeros(3)
    across = 2 * spec.mass.wheel * (spec.geometry.half_track**2 + spec.geometry.wheel_radius**2 / 4)
    spin = 0.0 if rolling else spec.mass.wheel * spec.geometry.wheel_radius**2
    return 2 * spec.mass.wheel, np.array([across, spin, across])


def add_wheels(mj: MjSpec, body: MjsBody, spec: RobotSpec, i: int, settings: ModelSettings) -> None:
    """Put connector i on its wheels or skids."""
    if settings.loaded:
        for (name, place), part in itertools.product(_wheels(spec, i), ("tread", "rim")):
            body.add_geom(mj.find_default(part), name=f"{part}_{name}", pos=place)
        return
    for side, sign in _SIDES.items():
        if settings.contact.rolling:
            _add_wheel(mj, body, spec, i, side, settings.numerics.wheel_spin)
        else:
            reach, y = spec.geometry.wheel_radius, sign * spec.geometry.half_track
            z = foot_radius(spec, settings.contact) - spec.geometry.com_height - _DIP
            runner = [0, y, z, reach, y, z + _RISE * reach]
            body.add_geom(mj.find_default("tread"), name=f"tread_{side}_{i}", fromto=runner)


def _wheels(spec: RobotSpec, i: int) -> Iterator[tuple[str, list[float]]]:
    """Yield side and number of the wheels of connector i, with their centres in its frame."""
    g = spec.geometry
    for number, axle in enumerate(spec.axles, start=1):
        x = 0.0 - axle.behind  # not −0, which would stand in exported files
        for side, sign in _SIDES.items():
            if axle.connector == i:
                yield f"{side}_{number}", [x, sign * g.half_track, g.wheel_radius - g.com_height]


def _add_wheel(mj: MjSpec, body: MjsBody, spec: RobotSpec, i: int, side: str, scale: float) -> None:
    g, mass = spec.geometry, spec.mass.connectors[i - 1]
    spin = spec.mass.wheel * g.wheel_radius**2 / 2
    wheel = body.add_body(name=f"wheel_{side}_{i}", mass=spec.mass.wheel, explicitinertial=True)
    wheel.pos, wheel.ipos = [0, _SIDES[side] * g.half_track, g.wheel_radius - g.com_height], [0, 0, 0]
    wheel.inertia = [spin / 2, scale * spin, spin / 2]
    axle = wheel.add_joint(mj.find_default("axle"), name=f"axle_{side}_{i}")
    axle.frictionloss = spec.friction.mu_t * mass * GRAVITY / 2 * g.wheel_radius
    wheel.add_geom(mj.find_default("tread"), name=f"tread_{side}_{i}")
    wheel.add_geom(mj.find_default("rim"), name=f"rim_{side}_{i}")


def add_preload(mj: MjSpec, spec: RobotSpec, contact: PreloadedContact) -> None:
    """Press every connector down with a constant force along the world's z.

    It acts at the height of the centre about which a tilted foot rolls on the floor, so that it neither
    rights a connector nor tips it over.
    """
    mj.worldbody.add_site(mj.find_default(ROOT), name="origin")
    height = foot_radius(spec, contact) - spec.geometry.com_height
    for i, force in enumerate(preload_force(spec, contact).sum(axis=1), start=1):
        site = f"{_PRESSED[contact.wheels]}_{i}"
        mj.body(f"connector_{i}").add_site(mj.find_default(ROOT), name=site, pos=[0, 0, height])
        actuator = mj.add_actuator(mj.find_default("press"), name=f"press_{i}", target=site)
        actuator.trntype, actuator.refsite = mujoco.mjtTrn.mjTRN_SITE, "origin"
        actuator.biasprm[0] = -force


def add_drag(mj: MjSpec, spec: RobotSpec) -> None:
    """Brake every connector along its heading with an equal share of the robot's drag."""
    for i in range(1, spec.geometry.connectors + 1):
        mj.body(f"connector_{i}").add_site(mj.find_default(ROOT), name=f"drag_{i}")
        actuator = mj.add_actuator(mj.find_default("drag"), name=f"drag_{i}", target=f"drag_{i}")
        actuator.trntype = mujoco.mjtTrn.mjTRN_SITE
        for kind in ("frc", "vel"):
            sensor = mj.add_sensor(
                name=f"drag_{kind}_{i}", type=getattr(mjtSensor, f"mjSENS_ACTUATOR{kind.upper()}")
            )
            sensor.objtype, sensor.objname = mjtObj.mjOBJ_ACTUATOR, f"drag_{i}"


def add_feet(mj: MjSpec, spec: RobotSpec) -> None:
    """Mark the points of each connector where it touches the floor."""
    for i in range(1, spec.geometry.connectors + 1):
        for name, (x, y, _) in _wheels(spec, i):
            place = [x, y, -spec.geometry.com_height]
            mj.body(f"connector_{i}").add_site(mj.find_default(ROOT), name=f"foot_{name}", pos=place)


def add_contacts(mj: MjSpec, spec: RobotSpec, settings: ModelSettings, levels: list[str]) -> None:
    """Add the pairs of all wheels or skids with the floor and its levels, and sensors of what happens there.

    Sensors: the floor's force on each (world frame, N), the velocity of the point of the connector above it
    (world, m/s).
    """
    name = "wheel_on_floor" if settings.contact.rolling else "skid_on_floor"
    default = mj.add_default(name, mj.default)
    for attribute, value in pair_attributes(spec, settings).items():
        setattr(default.pair, attribute, value)
    pairs = [mj.add_pair(default, name=tread, geomname1="floor", geomname2=tread) for tread in treads(spec)]
    for floor in levels:
        pairs += [
            mj.add_pair(default, name=f"{tread}_{floor}", geomname1=floor, geomname2=tread)
            for tread in treads(spec)
        ]
    for pair, slower in zip(pairs, itertools.cycle(_slower(mj, spec)), strict=False):
        pair.solref = [round(settings.contact_time * slower, 7), 1]
    for tread in treads(spec):
        what = (mjtObj.mjOBJ_BODY, "world") if levels else (mjtObj.mjOBJ_GEOM, "floor")
        add_force_sensor(mj, f"floor_force_{tread}", *what, on=tread)
    if settings.loaded:
        return  # there friction is known with its power
    for tread in treads(spec):
        foot = tread.replace("tread", "foot")
        add_velocity_sensor(mj, f"velocity_{foot}", mjtObj.mjOBJ_SITE, foot)


def add_velocity_sensor(mj: MjSpec, name: str, kind: mjtObj, of: str) -> None:
    """Add a sensor of the velocity of a site or of a geom's middle, world frame, m/s."""
    mj.add_sensor(name=name, type=mjtSensor.mjSENS_FRAMELINVEL, objtype=kind, objname=of)


def add_force_sensor(mj: MjSpec, name: str, kind: mjtObj, of: str, *, on: str, place: bool = False) -> None:
    """Add a sensor of the force of a geom or of all geoms of a body on a geom, world frame, N.

    With `place` it also tells where the force acts, m.
    """
    sensor = mj.add_sensor(name=name, type=mjtSensor.mjSENS_CONTACT, objtype=kind, objname=of)
    sensor.reftype, sensor.refname = mjtObj.mjOBJ_GEOM, on
    fields = 1 << int(mujoco.mjtConDataField.mjCONDATA_FORCE)
    fields |= (1 << int(mujoco.mjtConDataField.mjCONDATA_POS)) * place
    sensor.intprm[:3] = [fields, _NET_FORCE, 1]


def _slower(mj: MjSpec, spec: RobotSpec) -> np.ndarray:
    """Return by how much slower each normal contact must be for all to sink in alike, 1 for the fastest.

    MuJoCo softens a contact by a regularisation R that it takes from the tree of bodies: 1.25 times as much
    at gen 2's root as at its ends. What sinks deeper hands part of its load to its neighbours.
    """
    depth = softness(mj.compile(), spec)
    depth *= rest_loads(spec).ravel()
    slower: np.ndarray = np.sqrt(depth.max() / depth)
    return slower


def softness(model: mujoco.MjModel, spec: RobotSpec) -> np.ndarray:
    """Return how softly each normal contact yields, MuJoCo's R, in the order of `treads`, 1/kg."""
    data = mujoco.MjData(model)
    mujoco.mj_resetDataKeyframe(model, data, 0)
    data.qpos[2] -= _TOUCHING
    mujoco.mj_forward(model, data)
    found = {max(contact.geom): data.efc_R[contact.efc_address] for contact in data.contact}
    return np.array([found[model.geom(tread).id] for tread in treads(spec)])
