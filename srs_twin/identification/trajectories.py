"""Columns of a captured motion, with the names a plant's trajectory has."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from srs_twin.identification.body import Body
from srs_twin.identification.summary import BendSummary, LogSummary
from srs_twin.identification.velocity import HALF_WIDTH, moving_slope
from srs_twin.spec import RobotSpec
from srs_twin.trajectory import Trajectory

MEASURED = "measured"
"""Stands for the plant in the metadata."""


def trajectory_of(
    body: Body,
    missing: np.ndarray,
    time: np.ndarray,
    spec: RobotSpec,
    summary: LogSummary,
    gait_frequency_hz: float | None,
) -> Trajectory:
    """Return a body over time as a trajectory.

    Args:
        body: the connectors.
        missing: where markers were filled in, shape (frames, markers).
        time: shape (frames,), s.
        spec: the robot; the masses of its connectors give the centre of mass.
        summary: goes into the metadata.
        gait_frequency_hz: as well.
    """
    share = spec.mass.array() / spec.mass.total
    com = np.einsum("i,fij->fj", share, body.position)
    heading = body.theta.mean(axis=1)
    rates = moving_slope(time, np.column_stack([com, heading, body.bend]))
    filled = np.stack([missing[:, list(group)].any(axis=1) for group in body.members], axis=1)
    columns = {
        "time": time, "com_x": com[:, 0], "com_y": com[:, 1], "heading": heading,
        **numbered("x", body.position[..., 0]), **numbered("y", body.position[..., 1]),
        **numbered("theta", body.theta), **numbered("bend", body.bend),
        "com_velocity_x": rates[:, 0], "com_velocity_y": rates[:, 1], "yaw_rate": rates[:, 2],
        **numbered("bend_rate", rates[:, 3:]), **numbered("filled", filled.astype(float)),
        "residual": np.sqrt((body.residual**2).mean(axis=1)),
    }  # fmt: skip
    units = {"com_velocity_x": "m/s", "com_velocity_y": "m/s", "yaw_rate": "rad/s", "residual": "m"}
    units |= {name: "rad/s" for name in columns if name.startswith("bend_rate_")}
    source = {
        "kind": summary.kind, "layout": summary.layout, "up": summary.up,
        "samples_filled": summary.samples_filled, "samples_rejected": summary.samples_rejected,
    }  # fmt: skip
    return Trajectory(columns, units, metadata=metadata(spec, summary, gait_frequency_hz, source))


def numbered(name: str, values: np.ndarray) -> dict[str, np.ndarray]:
    """Return the columns of a (frames, n) array as name_1…name_n."""
    return {f"{name}_{i}": np.ascontiguousarray(column) for i, column in enumerate(values.T, start=1)}


def metadata(
    spec: RobotSpec,
    summary: LogSummary | BendSummary,
    gait_frequency_hz: float | None,
    source: Mapping[str, object],
) -> dict[str, object]:
    """Return what a measured trajectory says of itself.

    Args:
        spec: the robot.
        summary: of what was read.
        gait_frequency_hz: None where it is not known.
        source: what is to be said of the file besides its name, hash and corrections.
    """
    geometry = spec.geometry
    return {
        "plant": MEASURED,
        "robot": spec.name,
        "record_hz": summary.rate_hz,
        "duration_s": summary.end - summary.start,
        "body_length_m": geometry.body_length,
        "segment_length_m": geometry.segment_length,
        "rigid_gap_m": geometry.rigid_gap,
        "mass_kg": spec.mass.total,
        "gait_frequency_hz": gait_frequency_hz,
        "velocity_half_width": HALF_WIDTH,
        "source": {
            "file": summary.source.replace("\\", "/").rpartition("/")[2],
            "sha256": summary.sha256,
            **source,
            "corrections": list(summary.corrections),
        },
    }
