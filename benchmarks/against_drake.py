"""Gaits with instantaneous wheel loads in Drake, compared with the same simulation in MuJoCo.

    uv run --group drake python benchmarks/against_drake.py                      # four points, 0.05 ms
    uv run --group drake python benchmarks/against_drake.py --step-ms 0.025 gen2_turn

The chain is built with the elements of Drake; the MuJoCo simulation is
`load_reference.py`. The pitch and roll hinges in the middle of a segment join massless
bodies. Drake accepts massless bodies inside a chain, so no approximation is needed.
Springs are explicit and dampers implicit. Each point is simulated twice:

- law: Drake computes the normal forces of smooth wheels. Friction is
  `load_reference.wheel_force`, explicit, with the loads of the previous step.
- axles: wheels are bodies on axles with the friction of Drake (isotropic, mu_n). The
  dry friction of an axle is a damper whose moment is correct at the speed of the
  previous step.

Axles require the solver `lagged`. The solvers `sap` and `similar` make each step a
convex problem, in which slipping contacts rise above the floor. In `sap` the height is
mu times slip times (relaxation + step), tenths of a millimetre, while the static
penetration is 1.5 µm. The wheels then bounce and are in the air for 95 % of the time on
gen2_turn.
"""

from __future__ import annotations

import argparse
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pydrake.all as drake
from common.grid import table

sys.path.append(str(Path(__file__).parents[1] / "tests/helpers"))
import load_reference as reference
from load_reference import (
    POINTS,
    G,
    Point,
    Result,
    friction_parameters,
    measured,
    moments,
    numbers,
    wheel_force,
)

Place = tuple[float, float, float]
End = tuple[drake.RigidBody, Place]
ORIGIN = (0.0, 0.0, 0.0)
SLIP_M_S = 3e-4
"""Slip speed of the reference law and of the axles, m/s."""


@dataclass(frozen=True)
class Contact:
    """Compliant contact between a wheel and the floor.

    Attributes:
        stiffness: contact stiffness, N/m.
        relaxation: damping at the static load divided by the stiffness, s.
        solver: `discrete_contact_approximation` of Drake.
    """

    stiffness: float = 1e5
    relaxation: float = 0.002
    solver: str = "lagged"

    def material(self, mu: float, static: float) -> drake.ProximityProperties:
        """Return the contact properties of a wheel or the floor, each half as stiff as the contact.

        Args:
            mu: coefficient of friction.
            static: load at rest, N.
        """
        result = drake.ProximityProperties()
        friction = drake.CoulombFriction(mu, mu)
        drake.AddContactMaterial(
            result, point_stiffness=2 * self.stiffness, friction=friction
        )
        lagged = self.stiffness * self.relaxation / static
        result.AddProperty("material", "hunt_crossley_dissipation", lagged)
        result.AddProperty("material", "relaxation_time", self.relaxation / 2)  # sap's
        return result


class Snake:
    """Drake plant of the snake in `load_reference.mjcf`, built from the head backward along -x.

    Args:
        n: parameters of the robot.
        step: time step, s.
        contact: contact between wheels and floor.
        axles: whether wheels are bodies on axles with friction, or smooth geometries of
            their connectors.
    """

    def __init__(
        self, n: dict[str, Any], step: float, contact: Contact, axles: bool
    ) -> None:
        config = drake.MultibodyPlantConfig(
            time_step=step,
            contact_model="point",
            discrete_contact_approximation=contact.solver,
            sap_near_rigid_threshold=0.0,
        )
        builder = drake.DiagramBuilder()
        self.plant, scene = drake.AddMultibodyPlant(config, builder)
        self.plant.mutable_gravity_field().set_gravity_vector([0, 0, -G])
        self._n = n
        touch = contact.material(
            n["mu_n"] if axles else 0.0, n["connectors_kg"][0] * G / 2
        )
        self.connectors: list[drake.RigidBody] = []
        self._axles: list[drake.RevoluteJoint] = []
        self._feet: dict[drake.GeometryId, int] = {}
        bends: list[drake.RevoluteJoint] = []
        for i in range(n["connectors"]):
            self.connectors.append(self._connector(i, touch, axles))
            if i:
                bends += self._segment(i)
        filters = drake.CollisionFilterDeclaration().ExcludeWithin(
            drake.GeometrySet(list(self._feet))
        )
        scene.collision_filter_manager().Apply(filters)
        world = self.plant.world_body()
        below = drake.RigidTransform([0, 0, -0.5])
        self.plant.RegisterCollisionGeometry(
            world, below, drake.Box(20, 20, 1), "floor", touch
        )
        self.plant.Finalize()
        self._bends = np.array([item.velocity_start() for item in bends]).reshape(
            -1, reference.HINGES
        )
        self._simulator = drake.Simulator(builder.Build())
        self.context = self.plant.GetMyMutableContextFromRoot(
            self._simulator.get_mutable_context()
        )
        start = drake.RigidTransform([0, 0, n["com_height_m"]])
        self.plant.SetFreeBodyPose(self.context, self.connectors[0], start)

    def motion(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return rotation matrices, velocities and angular velocities of the connectors."""
        poses = [body.EvalPoseInWorld(self.context) for body in self.connectors]
        speeds = [
            body.EvalSpatialVelocityInWorld(self.context) for body in self.connectors
        ]
        frames = np.array([pose.rotation().matrix() for pose in poses])
        return (
            frames,
            np.array([v.translational() for v in speeds]),
            np.array([v.rotational() for v in speeds]),
        )

    def push(self, forces: np.ndarray, moments: np.ndarray) -> None:
        """Apply a force (N) and a moment (N·m) at the origin of each connector, shape (N, 3)."""
        applied = []
        for body, force, moment in zip(self.connectors, forces, moments, strict=True):
            item = drake.ExternallyAppliedSpatialForce()
            item.body_index = body.index()
            item.F_Bq_W = drake.SpatialForce(moment, force)
            applied.append(item)
        self.plant.get_applied_spatial_force_input_port().FixValue(
            self.context, applied
        )

    def drag(self, moments: np.ndarray) -> None:
        """Brake each axle with an implicit damper that has this moment (N·m) at the present speed."""
        slowest = reference.AXLE_FRACTION * SLIP_M_S / self._n["wheel_radius_m"]
        for axle, moment in zip(self._axles, moments, strict=True):
            axle.SetDamping(
                self.context,
                moment / np.hypot(axle.get_angular_rate(self.context), slowest),
            )

    def advance(self, time: float, moments: np.ndarray) -> np.ndarray:
        """Simulate to a time with moments on the segments (N·m); return the mean loads, N."""
        torques = np.zeros(self.plant.num_velocities())
        torques[self._bends] = moments[:, None]
        self.plant.get_applied_generalized_force_input_port().FixValue(
            self.context, torques
        )
        self._simulator.AdvanceTo(time)
        loads = np.zeros(len(self._feet))
        contacts = self.plant.get_contact_results_output_port().Eval(self.context)
        for k in range(contacts.num_point_pair_contacts()):
            contact = contacts.point_pair_contact_info(k)
            pair = contact.point_pair()
            foot = pair.id_A if pair.id_A in self._feet else pair.id_B
            loads[self._feet[foot]] = abs(contact.contact_force()[2])
        return loads

    def _connector(
        self, i: int, touch: drake.ProximityProperties, axles: bool
    ) -> drake.RigidBody:
        """Add a connector and its wheels; the origin is their centre of mass, as in the MJCF."""
        n = self._n
        track = n["half_track_m"]
        radius = n["wheel_radius_m"]
        wheel = n["wheel_kg"]
        neighbours = 1 if i in (0, n["connectors"] - 1) else 2
        drop = n["com_height_m"] - radius
        links = neighbours / 2 * reference.LINK_FRACTION * min(n["connectors_kg"])
        mass = n["connectors_kg"][i] - 2 * wheel - links
        about = mass * n["connector_gyration_m"] ** 2
        disc = wheel * radius**2 / 4
        across = about + 2 * (wheel * track**2 + disc)
        if axles:  # remainder of the connector after the lower wheels are subtracted
            rise = 2 * wheel / mass * drop
            low = about - 2 * wheel * drop**2 - mass * rise**2
            body = self._body(f"c{i}", mass, (low, low, about), (0, 0, rise))
        else:
            body = self._body(
                f"c{i}", mass + 2 * wheel, (across, about, across), ORIGIN
            )
        for k, y in enumerate((track, -track)):
            carrier = body
            hub = (0, y, -drop)
            if axles:
                carrier = self._body(f"w{i}_{k}", wheel, (disc, 2 * disc, disc), ORIGIN)
                self._axles.append(
                    self._hinge((body, hub), (carrier, ORIGIN), (0, 1, 0), 0.0, 0.0)
                )
                hub = ORIGIN
            shape = drake.Sphere(radius)
            place = drake.RigidTransform(hub)
            self._feet[
                self.plant.RegisterCollisionGeometry(
                    carrier, place, shape, f"f{i}_{k}", touch
                )
            ] = 2 * i + k
        return body

    def _segment(self, i: int) -> list[drake.RevoluteJoint]:
        """Join connector i to the previous one by two bends, pitch and roll; return the bends."""
        n = self._n
        edge = 1 / (2 * (reference.HINGES + 1))
        length = n["segment_length_m"]
        gap = n["rigid_gap_m"]
        half = (length + gap) / 2
        front = gap / 2 + length * edge
        rear = gap / 2 + length * (1 - edge)
        mass = reference.LINK_FRACTION * min(n["connectors_kg"])
        link = self._body(
            f"l{i}",
            mass,
            (mass * n["connector_gyration_m"] ** 2,) * 3,
            ((front - rear) / 2, 0, 0),
        )
        bent, pitched = (
            self.plant.AddRigidBody(f"{name}{i}") for name in ("bent", "pitched")
        )
        bend = (
            (0, 0, -1),
            reference.HINGES * n["stiffness_nm_per_rad"],
            n["damping_time_s"],
        )
        pitch = n["pitch_stiffness_nm_per_rad"]
        roll = n["roll_stiffness_nm_per_rad"]
        slow, (before, after) = n["out_of_plane_damping_time_s"], self.connectors[-2:]
        bends = [
            self._hinge((before, (-front, 0, 0)), (link, ORIGIN), *bend),
            self._hinge((link, (front - rear, 0, 0)), (bent, ORIGIN), *bend),
        ]
        self._hinge(
            (bent, (rear - half, 0, 0)), (pitched, ORIGIN), (0, 1, 0), pitch, slow
        )
        self._hinge((pitched, ORIGIN), (after, (half, 0, 0)), (1, 0, 0), roll, slow)
        return bends

    def _body(
        self, name: str, mass: float, inertia: Place, centre: Place
    ) -> drake.RigidBody:
        about = drake.RotationalInertia(*inertia)
        return self.plant.AddRigidBody(
            name, drake.SpatialInertia.MakeFromCentralInertia(mass, centre, about)
        )

    def _hinge(
        self, before: End, after: End, axis: Place, stiffness: float, lag: float
    ) -> drake.RevoluteJoint:
        name = f"{before[0].name()}_{after[0].name()}"
        frames = []
        for body, place in (before, after):
            frame = drake.FixedOffsetFrame(
                f"{name}_{body.name()}", body, drake.RigidTransform(place)
            )
            frames.append(self.plant.AddFrame(frame))
        joint = self.plant.AddJoint(
            drake.RevoluteJoint(name, *frames, axis, stiffness * lag)
        )
        self.plant.AddForceElement(drake.RevoluteSpring(joint, 0.0, stiffness))
        return joint


def simulate(
    point: Point, periods: int, step: float, contact: Contact, axles: bool
) -> Result:
    """Simulate a gait from rest, as `load_reference.simulate` does.

    Args:
        point: robot and gait.
        periods: number of gait periods.
        step: time step, s.
        contact: contact between wheels and floor.
        axles: whether wheels on axles use the friction of Drake, or the wheel law uses
            the loads of Drake.
    """
    n = numbers(point)
    snake = Snake(n, step, contact, axles)
    count = n["connectors"]
    radius = n["wheel_radius_m"]
    track = n["half_track_m"]
    side = np.tile([track, -track], count)[:, None]
    rest = np.repeat(np.array(n["connectors_kg"]) * G / 2, 2)
    load = rest
    spin = np.zeros(2 * count)
    steps = round(periods * point.period_s / step)
    com = np.empty((steps, 2))
    yaw = np.empty((steps, count))
    loads = np.empty((steps, 2 * count))
    torques = moments(n, point, step, steps)
    friction = friction_parameters(n, SLIP_M_S)
    for k in range(steps):
        if axles:
            snake.drag(n["mu_t"] * load * radius)
        else:
            frame, move, turn = (np.repeat(item, 2, axis=0) for item in snake.motion())
            ahead = frame[:, :, 0] * [1, 1, 0]
            ahead /= np.linalg.norm(ahead, axis=1)[:, None]
            left = np.cross([0, 0, 1], ahead)
            hub = frame[:, :, 1] * side - frame[:, :, 2] * (n["com_height_m"] - radius)
            foot = hub - [0, 0, radius]
            speed = move + np.cross(turn, foot)
            along = (speed * ahead).sum(axis=1)
            across = (speed * left).sum(axis=1)
            wheels = zip(along, across, spin, load, strict=True)
            f_t, f_lat, spin, drag = np.array(
                [wheel_force(*wheel, friction, step) for wheel in wheels]
            ).T
            at_hub = f_t[:, None] * ahead
            at_foot = f_lat[:, None] * left
            moment = (
                np.cross(hub, at_hub)
                + np.cross(foot, at_foot)
                + radius * drag[:, None] * left
            )
            snake.push(
                *(
                    item.reshape(count, 2, 3).sum(axis=1)
                    for item in (at_hub + at_foot, moment)
                )
            )
        loads[k] = load = snake.advance((k + 1) * step, torques[k])
        com[k] = snake.plant.CalcCenterOfMassPositionInWorld(snake.context)[:2]
        frame = snake.motion()[0]
        yaw[k] = np.arctan2(frame[:, 1, 0], frame[:, 0, 0])
    return measured(
        com, np.unwrap(yaw, axis=0), loads, rest, round(point.period_s / step), step
    )


def main() -> None:
    """Print three rows per point."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument(
        "points",
        nargs="*",
        metavar="POINT",
        help=f"of {', '.join(POINTS)}; default: four points",
    )
    parser.add_argument("--step-ms", type=float, default=0.05)
    parser.add_argument("--periods", type=int, default=6)
    parser.add_argument(
        "--stiffness",
        type=float,
        default=Contact.stiffness,
        help="stiffness of a contact, N/m",
    )
    parser.add_argument(
        "--relaxation-ms", type=float, default=1000 * Contact.relaxation
    )
    parser.add_argument(
        "--solver", default=Contact.solver, help="solver: lagged, sap or similar"
    )
    options = parser.parse_args()
    how = options.periods, options.step_ms / 1000
    contact = Contact(options.stiffness, options.relaxation_ms / 1000, options.solver)
    default = ("gen2_straight", "gen2_turn", "stiff_turn", "gen1_straight")
    rows = []
    for name in options.points or default:
        for engine, run in (
            ("MuJoCo", lambda point: reference.simulate(point, *how, SLIP_M_S)),
            ("Drake, law", lambda point: simulate(point, *how, contact, axles=False)),
            ("Drake, axles", lambda point: simulate(point, *how, contact, axles=True)),
        ):
            result = run(POINTS[name])
            rows.append(
                [
                    name,
                    engine,
                    f"{result.speed_mm_s:.2f}",
                    f"{result.yaw_rate:+.4f}",
                    f"{result.air:.2%}",
                    f"{result.swing:.3f}",
                    f"{result.ripple:.4f}",
                ]
            )
            print(*rows[-1], flush=True)
    heads = ["point", "engine", "speed, mm/s", "yaw rate, rad/s"]
    print(table([*heads, "wheels in the air", "swing", "ripple"], rows))


if __name__ == "__main__":
    main()
