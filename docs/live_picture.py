"""Animation of docs/live-method.md: a robot, its estimate by the live twin, and a stuck valve.

uv run python docs/live_picture.py
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Circle
from matplotlib.ticker import MultipleLocator
from PIL import Image
from shapely import LineString

from srs_twin.comparison.centre_line import centre_lines
from srs_twin.live.estimate import Estimate, Prediction
from srs_twin.robot.geometry import body_shape, relative_headings
from srs_twin.robot.spec import Geometry, RobotSpec
from srs_twin.trajectory import Trajectory

sys.path.insert(0, str(Path(__file__).parents[1] / "tests/helpers"))
from live_runs import Run, recorded, shadowed  # noqa: E402

RUN = Run(3, 10.0, fault="stuck_valve:2+=open@6.0", frequency=1.0)
START_S = 3.0
FRAME_S = 0.1
PREDICTION_INTERVAL_S = 0.5
TRUE_COLOR = "#9aa0a8"
ESTIMATE_COLOR = "#2f6db5"
PREDICTION_COLOR = "#f28e2b"
FAULT_COLOR = "#d02020"
WIDTH_M = 1.0
HEIGHT_M = 0.44
GRID_M = 0.1


def draw_segments(
    axes: Axes, poses: np.ndarray, geometry: Geometry, colors: list[str], **style: float
) -> None:
    """Draw the segments of a snake from the poses of its connectors, shape (connectors, 3)."""
    names = [
        f"{column}_{i}"
        for i in range(1, len(poses) + 1)
        for column in ("x", "y", "connector_heading")
    ]
    row = Trajectory(dict(zip(names, poses.reshape(-1, 1), strict=True)))
    for line, color in zip(centre_lines(row, geometry)[0], colors, strict=True):
        tube = LineString(line).buffer(geometry.width / 2, cap_style="flat")
        axes.fill(*np.asarray(tube.exterior.coords).T, facecolor=color, **style)


def true_poses(truth: np.ndarray, spec: RobotSpec) -> np.ndarray:
    """Return x, y (m) and heading (rad) of the connectors, shape (ticks, connectors, 3).

    Args:
        truth: time (s), bends (rad), centre of mass (m) and heading (rad), shape
            (ticks, segments + 4).
        spec: the robot.
    """
    bends = truth[:, 1:-3]
    com = truth[:, None, -3:-1]
    heading = truth[:, -1:]
    shape = body_shape(
        bends, spec.mass.array(), spec.geometry.segment_length, spec.geometry.rigid_gap
    )
    c = np.cos(heading)
    s = np.sin(heading)
    turned = np.stack(
        [c * shape[..., 0] - s * shape[..., 1], s * shape[..., 0] + c * shape[..., 1]],
        axis=-1,
    )
    return np.concatenate(
        [com + turned, (heading + relative_headings(bends))[..., None]], axis=-1
    )


def draw_frame(
    time: float,
    true: np.ndarray,
    geometry: Geometry,
    estimate: Estimate,
    prediction: Prediction | None,
) -> np.ndarray:
    """Return a frame, shape (height, width, 3)."""
    figure = Figure(figsize=(8.0, 8.0 * HEIGHT_M / WIDTH_M + 0.5), dpi=100)
    canvas = FigureCanvasAgg(figure)
    axes = figure.add_axes((0.0, 0.12, 1.0, 0.88))
    faulty = {name for name, _, _ in estimate.faults}
    colors = [
        FAULT_COLOR if f"segment {j}" in faulty else ESTIMATE_COLOR
        for j in range(1, len(estimate.bend) + 1)
    ]
    draw_segments(axes, true, geometry, [TRUE_COLOR] * len(colors), zorder=2)
    draw_segments(axes, estimate.connectors, geometry, colors, alpha=0.55, zorder=3)
    if prediction is not None:
        axes.plot(
            *prediction.pose[:, :2].T, color=PREDICTION_COLOR, linewidth=2, zorder=4
        )
        for pose, sd in zip(prediction.pose, prediction.pose_sd, strict=True):
            radius = 1.96 * float(np.hypot(sd[0], sd[1]))
            axes.add_patch(
                Circle(
                    tuple(pose[:2].tolist()),
                    radius,
                    color=PREDICTION_COLOR,
                    alpha=0.12,
                    linewidth=0,
                )
            )
    axes.set(
        xlim=estimate.pose[0] + WIDTH_M * np.array([-0.5, 0.5]),
        ylim=estimate.pose[1] + HEIGHT_M * np.array([-0.5, 0.5]),
    )
    axes.set_aspect("equal", adjustable="box")
    axes.set_facecolor("#e9ebee")
    axes.grid(True, color="white")
    axes.set_axisbelow(True)
    axes.xaxis.set_major_locator(MultipleLocator(GRID_M))
    axes.yaxis.set_major_locator(MultipleLocator(GRID_M))
    axes.tick_params(length=0, labelbottom=False, labelleft=False)
    status = (
        "; ".join(f"{name}: {fault}" for name, fault, _ in estimate.faults)
        or "no fault"
    )
    position = {"transform": axes.transAxes, "fontsize": 13}
    axes.text(0.012, 0.93, f"t = {time:.1f} s", **position)
    axes.text(
        0.14,
        0.93,
        status,
        color=FAULT_COLOR if faulty else "#2c7a3f",
        weight="bold",
        **position,
    )
    entries = (
        ("robot", TRUE_COLOR, 8),
        ("estimate", ESTIMATE_COLOR, 8),
        ("next second, 95 %", PREDICTION_COLOR, 3),
    )
    handles = [
        Line2D([], [], color=color, linewidth=width, label=name)
        for name, color, width in entries
    ]
    figure.legend(
        handles=handles,
        loc="lower center",
        ncols=len(handles),
        frameon=False,
        fontsize=12,
    )
    canvas.draw()
    return np.asarray(canvas.buffer_rgba())[..., :3].copy()


def main() -> None:
    """Simulate the run and write docs/images/live.webp."""
    frames = []
    prediction = None
    recording = recorded(RUN)
    poses = true_poses(recording.truth, recording.spec)
    geometry = recording.spec.geometry
    for moment in shadowed(RUN):
        k = round(moment.time * 50)
        if moment.estimate is None or moment.time < START_S:
            continue
        if k % round(PREDICTION_INTERVAL_S * 50) == 0:
            prediction = moment.shadow.predict()
        if k % round(FRAME_S * 50) == 0:
            true = poses[np.abs(recording.truth[:, 0] - moment.shadow.time).argmin()]
            frames.append(
                draw_frame(moment.time, true, geometry, moment.estimate, prediction)
            )
    first, *others = [
        Image.fromarray(frame).quantize(64, dither=Image.Dither.NONE).convert("RGB")
        for frame in frames
    ]
    duration = [round(1e3 * FRAME_S)] * len(others) + [1500]
    path = Path(__file__).parent / "images" / "live.webp"
    first.save(
        path,
        save_all=True,
        append_images=others,
        duration=duration,
        loop=0,
        lossless=True,
        method=4,
    )


if __name__ == "__main__":
    main()
