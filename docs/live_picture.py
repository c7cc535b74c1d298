"""Makes the picture of docs/live-method.md: a robot, what its shadow knows of it, and a valve that sticks.

uv run python docs/live_picture.py
"""

from __future__ import annotations

import sys
from collections import deque
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
from srs_twin.live.prediction import Prediction
from srs_twin.live.shadow import Estimate
from srs_twin.robot.spec import Geometry
from srs_twin.trajectory import Trajectory

sys.path.insert(0, str(Path(__file__).parents[1] / "tests/helpers"))
from live_runs import Moment, Run, shadowed  # noqa: E402

RUN = Run(3, 10.0, fault="stuck_valve:2+=open@6.0", frequency=1.0)
FROM_S, FRAME_S, PREDICTED_S = 3.0, 0.1, 0.5
TRUE, KNOWN, NEXT, BROKEN = "#9aa0a8", "#2f6db5", "#f28e2b", "#d02020"
ACROSS, UP, GRID_M = 1.0, 0.44, 0.1


def tubes(axes: Axes, place: np.ndarray, geometry: Geometry, colors: list[str], **look: float) -> None:
    """Draw segments from the connectors' x, y, heading (connectors, 3)."""
    names = [f"{column}_{i}" for i in range(1, len(place) + 1) for column in ("x", "y", "theta")]
    row = Trajectory(dict(zip(names, place.reshape(-1, 1), strict=True)))
    for line, color in zip(centre_lines(row, geometry)[0], colors, strict=True):
        tube = LineString(line).buffer(geometry.width / 2, cap_style="flat")
        axes.fill(*np.asarray(tube.exterior.coords).T, facecolor=color, **look)


def picture(moment: Moment, true: np.ndarray, found: Estimate, coming: Prediction | None) -> np.ndarray:
    """Return one picture, shape (height, width, 3)."""
    figure = Figure(figsize=(8.0, 8.0 * UP / ACROSS + 0.5), dpi=100)
    canvas = FigureCanvasAgg(figure)
    axes = figure.add_axes((0.0, 0.12, 1.0, 0.88))
    geometry = moment.robot.twin.spec.geometry
    broken = {part for part, _, _ in found.faults}
    colors = [BROKEN if f"segment {j}" in broken else KNOWN for j in range(1, len(found.bend) + 1)]
    tubes(axes, true, geometry, [TRUE] * len(colors), zorder=2)
    tubes(axes, found.connectors, geometry, colors, alpha=0.55, zorder=3)
    if coming is not None:
        axes.plot(*coming.pose[:, :2].T, color=NEXT, linewidth=2, zorder=4)
        for pose, sd in zip(coming.pose, coming.pose_sd, strict=True):
            wide = 1.96 * float(np.hypot(sd[0], sd[1]))
            axes.add_patch(Circle(tuple(pose[:2].tolist()), wide, color=NEXT, alpha=0.12, linewidth=0))
    axes.set(
        xlim=found.pose[0] + ACROSS * np.array([-0.5, 0.5]), ylim=found.pose[1] + UP * np.array([-0.5, 0.5])
    )
    axes.set_aspect("equal", adjustable="box")
    axes.set_facecolor("#e9ebee")
    axes.grid(True, color="white")
    axes.set_axisbelow(True)
    axes.xaxis.set_major_locator(MultipleLocator(GRID_M))
    axes.yaxis.set_major_locator(MultipleLocator(GRID_M))
    axes.tick_params(length=0, labelbottom=False, labelleft=False)
    told = "; ".join(f"{part}: {fault}" for part, fault, _ in found.faults) or "sound"
    where = {"transform": axes.transAxes, "fontsize": 13}
    axes.text(0.012, 0.93, f"t = {moment.time:.1f} s", **where)
    axes.text(0.14, 0.93, told, color=BROKEN if broken else "#2c7a3f", weight="bold", **where)
    keys = (("robot", TRUE, 8), ("estimate", KNOWN, 8), ("next second, 95 %", NEXT, 3))
    handles = [Line2D([], [], color=color, linewidth=width, label=name) for name, color, width in keys]
    figure.legend(handles=handles, loc="lower center", ncols=len(handles), frameon=False, fontsize=12)
    canvas.draw()
    return np.asarray(canvas.buffer_rgba())[..., :3].copy()


def main() -> None:
    """Run and draw."""
    pictures, coming = [], None
    past: deque[tuple[float, np.ndarray]] = deque(maxlen=20)
    for moment in shadowed(RUN):
        state, k = moment.robot.state, round(moment.time * 50)
        past.append((moment.time, np.column_stack([state.position, state.theta])))
        if moment.estimate is None or moment.time < FROM_S:
            continue
        if k % round(PREDICTED_S * 50) == 0:
            coming = moment.shadow.predict()
        if k % round(FRAME_S * 50) == 0:
            true = min(past, key=lambda each: abs(each[0] - moment.shadow.time))[1]
            pictures.append(picture(moment, true, moment.estimate, coming))
    first, *others = [
        Image.fromarray(each).quantize(64, dither=Image.Dither.NONE).convert("RGB") for each in pictures
    ]
    duration = [round(1e3 * FRAME_S)] * len(others) + [1500]
    path = Path(__file__).parent / "images" / "live.webp"
    first.save(path, save_all=True, append_images=others, duration=duration, loop=0, lossless=True, method=4)


if __name__ == "__main__":
    main()
