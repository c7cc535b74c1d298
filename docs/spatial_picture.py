"""Pictures of docs/spatial.md: the lifted snake, and the tracks of its supported parts on the floor.

uv run srs-twin run spatial_sidewinding
uv run python docs/spatial_picture.py runs/spatial_sidewinding

The run of two plants gives a picture of the tracks on both:

uv run srs-twin compare spatial_two_plants
uv run python docs/spatial_picture.py runs/spatial_two_plants
"""

from __future__ import annotations

import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from PIL import Image

from srs_twin.trajectory import Trajectory

IMAGES = Path(__file__).parent / "images"
VIEW_TIME_S = 8.0
BODY_EVERY_S = 2.0


def draw_tracks(axes: Axes, run: Trajectory) -> None:
    """Draw the connectors that press on the floor over time, and the body at intervals, from above."""
    x = run.stack("x")
    y = run.stack("y")
    load = run.stack("load")
    touches = load > 0.0
    time = np.broadcast_to(run.time[:, None], load.shape)
    marks = axes.scatter(
        x[touches], y[touches], c=time[touches], s=2, cmap="viridis", linewidths=0
    )
    for begin in np.arange(0.0, run.time[-1] + 1e-9, BODY_EVERY_S):
        row = int(np.searchsorted(run.time, begin - 1e-9))
        axes.plot(x[row], y[row], color="0.6", linewidth=1.0, zorder=0)
        axes.plot(x[row, 0], y[row, 0], "o", color="0.3", markersize=3, zorder=0)
    axes.set(xlabel="x (m)", ylabel="y (m)")
    axes.set_aspect("equal")
    axes.figure.colorbar(marks, ax=axes, label="time (s)")


def draw_scene(figure: Figure, folder: Path) -> None:
    """Draw the twin and its tracks."""
    with tempfile.TemporaryDirectory() as temporary:
        scene = Path(temporary) / "scene.png"
        command = [
            "srs-twin",
            "render",
            str(folder),
            "--image",
            f"t={VIEW_TIME_S:g}",
            "--size",
            "640x460",
        ]
        subprocess.run([*command, "--out", str(scene), "--quiet"], check=True)
        axes = figure.add_axes((0.0, 0.0, 0.56, 1.0))
        axes.imshow(np.asarray(Image.open(scene)))
        axes.axis("off")
    draw_tracks(
        figure.add_axes((0.64, 0.14, 0.34, 0.8)),
        Trajectory.from_parquet(folder / "twin.parquet"),
    )


def draw_both(figure: Figure, folder: Path) -> None:
    """Draw the tracks on both plants side by side."""
    for axes, plant in zip(
        figure.subplots(1, 2, sharey=True), ("analytical", "twin"), strict=True
    ):
        draw_tracks(axes, Trajectory.from_parquet(folder / f"{plant}.parquet"))
        axes.set_title(
            {"analytical": "quasistatic model", "twin": "twin (MuJoCo)"}[plant]
        )


def main() -> None:
    """Draw the run in the folder of the command line and write the picture."""
    folder = Path(sys.argv[1])
    both = (folder / "analytical.parquet").is_file()
    figure = Figure(
        figsize=(11.0, 4.6), dpi=100, layout="constrained" if both else None
    )
    canvas = FigureCanvasAgg(figure)
    (draw_both if both else draw_scene)(figure, folder)
    canvas.draw()
    picture = Image.fromarray(np.asarray(canvas.buffer_rgba())[..., :3])
    picture.save(
        IMAGES / ("two_sidewinders.png" if both else "sidewinding.png"), optimize=True
    )


if __name__ == "__main__":
    main()
