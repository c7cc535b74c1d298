"""Bench: a captured motion of a robot that is held at its head, in the frame of the clamp.

Plants on a bench are held where the head of a straight body lies whose centre of mass is at the origin. A
recording is turned and moved so that its head is held there.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from srs_twin.errors import InputError
from srs_twin.identification.recording import Recording
from srs_twin.identification.trajectories import numbered
from srs_twin.spec import RobotSpec
from srs_twin.trajectory import Trajectory

_MOVED = 0.05  # of a segment's length
_TURNED = np.radians(5.0)


def on_bench(recording: Recording, spec: RobotSpec) -> Recording:
    """Return a recording in the frame of its clamp.

    Raises:
        InputError: the head moves, so that nothing holds it.
    """
    trajectory = recording.trajectory
    head, aim = trajectory.position[:, 0], trajectory["theta_1"]
    # Medians: a few frames that are wrong do not count.
    held, heading = np.median(head, axis=0), float(np.median(aim))
    moved = float(np.quantile(np.linalg.norm(head - held, axis=1), 0.95))
    turned = float(np.quantile(np.abs(aim - heading), 0.95))
    pitch = spec.geometry.pitch
    if moved > _MOVED * pitch or turned > _TURNED:
        raise InputError(
            f"{recording.summary.source}: the head moves by {1e3 * moved:.3g} mm and turns by "
            f"{np.degrees(turned):.2g}°; on a bench it is held (is the other end held? Give head)"
        )
    mass = spec.mass.array()
    ahead = pitch * float(np.arange(len(mass)) @ mass) / float(mass.sum())
    return replace(recording, trajectory=_moved(trajectory, held, heading, ahead))


def _moved(trajectory: Trajectory, held: np.ndarray, heading: float, ahead: float) -> Trajectory:
    """Return a motion turned by −heading about a point, which then lies ahead on the x axis."""
    back, origin = np.exp(-1j * heading), held @ [1, 1j]

    def placed(points: np.ndarray) -> np.ndarray:
        return np.asarray((points @ [1, 1j] - origin) * back + ahead)

    com, place = placed(trajectory.com), placed(trajectory.position)
    columns = dict(trajectory.columns) | {
        "com_x": com.real, "com_y": com.imag, "heading": trajectory["heading"] - heading,
        **numbered("x", place.real), **numbered("y", place.imag),
        **numbered("theta", trajectory.stack("theta") - heading),
    }  # fmt: skip
    if "com_velocity_x" in columns:
        velocity = (columns["com_velocity_x"] + 1j * columns["com_velocity_y"]) * back
        columns |= {"com_velocity_x": velocity.real, "com_velocity_y": velocity.imag}
    return replace(trajectory, columns=columns, metadata={**trajectory.metadata, "base": "clamped"})
