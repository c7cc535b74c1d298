"""Wheels and skids of connectors, their contacts with the floor, and their preload.

Each connector touches the floor at two points, half the track to the left and half the
track to the right of its centre.

**Loaded contact.** The wheels are frictionless spheres, and friction is computed from
their contact forces (`contact_loaded`).

**Preloaded contact.**

- ``rolling``: The feet are wheels on hinges. Each wheel is a sphere with an isotropic
  friction coefficient of μ_n. The `frictionloss` of its axle is μ_t × load × radius and
  brakes the wheel along its heading.
- ``skid``: The feet are runners that are fixed to the connector. The friction
  coefficient of a runner is μ_t along the connector and μ_n across it. Each runner is a
  capsule, because MuJoCo aligns the contact frame with a geom only between a plane and
  a capsule. Runners are raised at the front like skis, because a horizontal capsule
  would touch the floor at both ends.

MuJoCo's convex friction model lifts a sliding contact off the floor. Without a preload,
wheels would be in the air for more than half of the time, and snakes would be up to 12
% too fast. The actuator ``press_i`` therefore presses connector i down with a constant
force of κ times its static load. The friction coefficients of the contact pairs are the
friction coefficients of the robot divided by 1 + κ. The contacts then stay closed, and
the friction is that under the static load, as in the analytical model. At rest, the
floor forces minus the preload equal the true loads within 2 %.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from typing import NamedTuple

import mujoco
import numpy as np
from mujoco import MjsBody, MjSpec, mjtObj, mjtSensor

from srs_twin.plants.twin.mjcf.belly import patches
from srs_twin.plants.twin.mjcf.classes import ROOT, foot_radius
from srs_twin.plants.twin.mjcf.numerics import (
    LoadedContact,
    ModelSettings,
    PreloadedContact,
)
from srs_twin.robot.spec import GRAVITY, RobotSpec

_NET_FORCE = 3  # Reduction mode of a contact sensor, sum over all contacts.
_SIDES = {"left": 1, "right": -1}  # Sign of y.
# Slope of a runner towards the front, far above the pitch angle of any connector.
_RUNNER_SLOPE = 0.6

# The following lengths are in m, for a robot with a length unit of 1 (`robot.scale`).
# Runners start slightly below the floor surface, so that the first step detects their
# contacts.
_RUNNER_DEPTH = 1e-6
# Depth of all feet in the floor at which regularisations are evaluated.
_REFERENCE_DEPTH = 5e-5
# Depth over which a contact reaches its full stiffness, MuJoCo's default.
_TRANSITION_DEPTH = 0.001

# Names of the sites on which the preload acts.
_PRELOAD_SITES = {"rolling": "axle", "skid": "sole"}


def axle_masses(spec: RobotSpec, settings: ModelSettings) -> list[float]:
    """Return the mass carried by each axle or pair of skin contacts, head first, kg."""
    return [
        pair.mass
        for pair in (spec.axles if spec.skin is None else patches(spec, settings))
    ]


def treads(spec: RobotSpec, settings: ModelSettings = ModelSettings()) -> list[str]:  # noqa: B008
    """Return the names of the geoms that touch the floor, from head to tail.

    On each axle, the left geom precedes the right geom.
    """
    return [
        f"tread_{side}_{i + 1}"
        for i in range(len(axle_masses(spec, settings)))
        for side in _SIDES
    ]


def static_loads(
    spec: RobotSpec, settings: ModelSettings, gravity: float = GRAVITY
) -> np.ndarray:
    """Return the load of each contact at rest, head first, shape (axles, 2), N."""
    return np.repeat(
        [[mass * gravity / 2] for mass in axle_masses(spec, settings)], 2, axis=1
    )


def preload_force(spec: RobotSpec, contact: PreloadedContact) -> np.ndarray:
    """Return the preload of each wheel, head first, shape (N, 2), N."""
    return np.repeat(
        contact.preload_ratio * spec.mass.array()[:, None] * GRAVITY / 2, 2, axis=1
    )


def pair_attributes(spec: RobotSpec, settings: ModelSettings) -> dict[str, object]:
    """Return the attributes of contact pairs between the floor and wheels or skids.

    In `friction`, the coefficient along the heading precedes the coefficient across it.
    """
    mu_t = spec.friction.mu_t
    mu_n = spec.friction.mu_n
    contact = settings.contact.for_robot(spec)
    normal: dict[str, object] = {
        "solref": [settings.contact_time(spec), 1],
        # The other numbers of this impedance are defaults of MuJoCo, too.
        "solimp": [0.9, 0.95, _TRANSITION_DEPTH * spec.scale.length, 0.5, 2.0],
    }
    if isinstance(contact, LoadedContact):
        return {"condim": 1} | normal
    across = mu_n / (1 + contact.preload_ratio)
    along = mu_t / (1 + contact.preload_ratio)
    if contact.rolling:
        along = across
    return {
        "condim": 3,
        "friction": [along, across, 0.005, 0.0001, 0.0001],
        "solreffriction": [contact.slip_time, 1],
    } | normal


class FixedInertia(NamedTuple):
    """Inertia of parts that are fixed to a body.

    Attributes:
        mass: mass of the parts, kg.
        moments: moments of inertia, shape (3,), kg·m².
    """

    mass: float
    moments: np.ndarray


def fixed_inertia(spec: RobotSpec, settings: ModelSettings) -> FixedInertia:
    """Return the inertia of the skids or wheels that are fixed to a connector.

    Skids have the mass of the wheels that they replace. With preloaded contact, wheels
    are separate bodies, so the result is zero. Without a floor, the wheels do not
    rotate. With loaded contact, the friction law includes the spin of the wheels.
    """
    rolling = settings.contact.rolling and settings.base == "free"
    if rolling and not settings.loaded:
        return FixedInertia(0.0, np.zeros(3))
    g = spec.geometry
    across = 2 * spec.mass.wheel * (g.half_track**2 + g.wheel_radius**2 / 4)
    spin = 0.0 if rolling else spec.mass.wheel * g.wheel_radius**2
    return FixedInertia(2 * spec.mass.wheel, np.array([across, spin, across]))


def add_wheels(
    mj: MjSpec, body: MjsBody, spec: RobotSpec, i: int, settings: ModelSettings
) -> None:
    """Add the wheels or skids of connector i."""
    if settings.loaded:
        for (name, centre), geom in itertools.product(
            _wheels(spec, i), ("tread", "rim")
        ):
            body.add_geom(mj.find_default(geom), name=f"{geom}_{name}", pos=centre)
        return
    for side, sign in _SIDES.items():
        if settings.contact.rolling:
            _add_wheel(mj, body, spec, i, side, settings.numerics.wheel_spin)
        else:
            reach = spec.geometry.wheel_radius
            y = sign * spec.geometry.half_track
            z = (
                foot_radius(spec, settings.contact)
                - spec.geometry.com_height
                - _RUNNER_DEPTH * spec.scale.length
            )
            runner = [0, y, z, reach, y, z + _RUNNER_SLOPE * reach]
            body.add_geom(
                mj.find_default("tread"), name=f"tread_{side}_{i}", fromto=runner
            )


def _wheels(spec: RobotSpec, i: int) -> Iterator[tuple[str, list[float]]]:
    g = spec.geometry
    for number, axle in enumerate(spec.axles, start=1):
        x = 0.0 - axle.behind  # avoids −0 in exported files
        for side, sign in _SIDES.items():
            if axle.connector == i:
                yield (
                    f"{side}_{number}",
                    [x, sign * g.half_track, g.wheel_radius - g.com_height],
                )


def _add_wheel(
    mj: MjSpec, body: MjsBody, spec: RobotSpec, i: int, side: str, scale: float
) -> None:
    g = spec.geometry
    mass = spec.mass.connectors[i - 1]
    spin = spec.mass.wheel * g.wheel_radius**2 / 2
    wheel = body.add_body(
        name=f"wheel_{side}_{i}", mass=spec.mass.wheel, explicitinertial=True
    )
    wheel.pos = [0, _SIDES[side] * g.half_track, g.wheel_radius - g.com_height]
    wheel.ipos = [0, 0, 0]
    wheel.inertia = [spin / 2, scale * spin, spin / 2]
    axle = wheel.add_joint(mj.find_default("axle"), name=f"axle_{side}_{i}")
    axle.frictionloss = spec.friction.mu_t * mass * GRAVITY / 2 * g.wheel_radius
    wheel.add_geom(mj.find_default("tread"), name=f"tread_{side}_{i}")
    wheel.add_geom(mj.find_default("rim"), name=f"rim_{side}_{i}")


def add_preload(mj: MjSpec, spec: RobotSpec, contact: PreloadedContact) -> None:
    """Add constant forces that press the connectors down along the world's z axis.

    When a connector tilts, its round foot rolls on the floor. The force acts at the
    height of the centre of the foot and therefore exerts no moment on the connector.
    """
    mj.worldbody.add_site(mj.find_default(ROOT), name="origin")
    height = foot_radius(spec, contact) - spec.geometry.com_height
    for i, force in enumerate(preload_force(spec, contact).sum(axis=1), start=1):
        site = f"{_PRELOAD_SITES[contact.wheels]}_{i}"
        mj.body(f"connector_{i}").add_site(
            mj.find_default(ROOT), name=site, pos=[0, 0, height]
        )
        actuator = mj.add_actuator(
            mj.find_default("press"), name=f"press_{i}", target=site
        )
        actuator.trntype = mujoco.mjtTrn.mjTRN_SITE
        actuator.refsite = "origin"
        actuator.biasprm[0] = -force


def add_drag(mj: MjSpec, spec: RobotSpec) -> None:
    """Distribute the axial drag equally among the connectors, along their headings."""
    for i in range(1, spec.geometry.connectors + 1):
        mj.body(f"connector_{i}").add_site(mj.find_default(ROOT), name=f"drag_{i}")
        actuator = mj.add_actuator(
            mj.find_default("drag"), name=f"drag_{i}", target=f"drag_{i}"
        )
        actuator.trntype = mujoco.mjtTrn.mjTRN_SITE
        for kind in ("frc", "vel"):
            sensor = mj.add_sensor(
                name=f"drag_{kind}_{i}",
                type=getattr(mjtSensor, f"mjSENS_ACTUATOR{kind.upper()}"),
            )
            sensor.objtype = mjtObj.mjOBJ_ACTUATOR
            sensor.objname = f"drag_{i}"


def add_feet(mj: MjSpec, spec: RobotSpec) -> None:
    """Add sites at the points where each connector touches the floor."""
    for i in range(1, spec.geometry.connectors + 1):
        for name, (x, y, _) in _wheels(spec, i):
            place = [x, y, -spec.geometry.com_height]
            mj.body(f"connector_{i}").add_site(
                mj.find_default(ROOT), name=f"foot_{name}", pos=place
            )


def add_contacts(
    mj: MjSpec, spec: RobotSpec, settings: ModelSettings, levels: list[str]
) -> None:
    """Add contact pairs between feet and floor, and sensors for their forces.

    Each sensor measures the floor force on one foot in the world frame (N). With
    preloaded contact, additional sensors measure the velocity of each foot in the world
    frame (m/s). The list `levels` contains the names of the raised floor levels.
    """
    name = "wheel_on_floor" if settings.contact.rolling else "skid_on_floor"
    if spec.skin is not None:
        name = "skin_on_floor"
    default = mj.add_default(name, mj.default)
    for attribute, value in pair_attributes(spec, settings).items():
        setattr(default.pair, attribute, value)
    names = treads(spec, settings)
    pairs = [
        mj.add_pair(default, name=tread, geomname1="floor", geomname2=tread)
        for tread in names
    ]
    pairs += [
        mj.add_pair(default, name=f"{tread}_{floor}", geomname1=floor, geomname2=tread)
        for floor in levels
        for tread in names
    ]
    unit = spec.scale.time
    for pair, factor in zip(
        pairs, itertools.cycle(_contact_time_factors(mj, spec, settings)), strict=False
    ):
        # The time constant is rounded to 0.1 µs, so that exported files are readable.
        # It is rounded in the time unit of the robot, so that the rounding does not
        # depend on the scale of the robot.
        pair.solref = [round(settings.contact_time(spec) * factor / unit, 7) * unit, 1]
    source = (mjtObj.mjOBJ_BODY, "world") if levels else (mjtObj.mjOBJ_GEOM, "floor")
    for tread in names:
        add_force_sensor(mj, f"floor_force_{tread}", *source, on=tread)
    if settings.loaded:
        return  # the power of friction is known without velocity sensors
    for tread in names:
        foot = tread.replace("tread", "foot")
        add_velocity_sensor(mj, f"velocity_{foot}", mjtObj.mjOBJ_SITE, foot)


def add_velocity_sensor(mj: MjSpec, name: str, kind: mjtObj, target: str) -> None:
    """Add a sensor for the world-frame velocity of a site or geom centre, m/s."""
    mj.add_sensor(
        name=name, type=mjtSensor.mjSENS_FRAMELINVEL, objtype=kind, objname=target
    )


def add_force_sensor(
    mj: MjSpec, name: str, kind: mjtObj, source: str, *, on: str, position: bool = False
) -> None:
    """Add a sensor for the contact force on a geom in the world frame, N.

    The force on the geom `on` is exerted by `source`, which is a geom or a body with
    all its geoms. If `position` is true, the sensor also measures the point of
    application, m.
    """
    sensor = mj.add_sensor(
        name=name, type=mjtSensor.mjSENS_CONTACT, objtype=kind, objname=source
    )
    sensor.reftype = mjtObj.mjOBJ_GEOM
    sensor.refname = on
    fields = 1 << int(mujoco.mjtConDataField.mjCONDATA_FORCE)
    fields |= (1 << int(mujoco.mjtConDataField.mjCONDATA_POS)) * position
    sensor.intprm[:3] = [fields, _NET_FORCE, 1]


def _contact_time_factors(
    mj: MjSpec, spec: RobotSpec, settings: ModelSettings
) -> np.ndarray:
    """Return factors for the contact time constants that make all wheels sink equally.

    MuJoCo computes the regularisation R of a contact from the kinematic tree. For
    generation 2, R is 1.25 times as large at the root as at the ends. Without these
    factors, contacts with a larger R would sink deeper and transfer part of their load
    to adjacent contacts.
    """
    depth = contact_regularisation(mj.compile(), spec, settings)
    depth *= static_loads(spec, settings).ravel()
    factors: np.ndarray = np.sqrt(depth.max() / depth)
    return factors


def contact_regularisation(
    model: mujoco.MjModel, spec: RobotSpec, settings: ModelSettings
) -> np.ndarray:
    """Return the regularisation R of the normal force on each of the `treads`, 1/kg."""
    data = mujoco.MjData(model)
    mujoco.mj_resetDataKeyframe(model, data, 0)
    data.qpos[2] -= _REFERENCE_DEPTH * spec.scale.length
    mujoco.mj_forward(model, data)
    by_geom = {
        max(contact.geom): data.efc_R[contact.efc_address] for contact in data.contact
    }
    return np.array([by_geom[model.geom(tread).id] for tread in treads(spec, settings)])
