"""Animation of docs/optimization.md: the original scenario and the best design of a study.

uv run --extra optimize srs-twin optimize gen2_air
uv run python docs/optimum_picture.py runs/studies/gen2_air
"""

from __future__ import annotations

import json
import sys
from pathlib import Path

import numpy as np
from live_picture import ESTIMATE_COLOR, TRUE_COLOR, draw_segments
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from PIL import Image

from srs_twin.rollout import rollout
from srs_twin.scenario.loading import load_scenario
from srs_twin.scenario.scenario import Scenario
from srs_twin.trajectory import Trajectory

DURATION_S = 3.2
FRAME_S = 0.04
START_S = 2.0
"""Start of the animation, after the transient of the gait, s."""

LENGTH_M = 2.1
HALF_WIDTH_M = 0.2
GRID_M = 0.1


def simulate_twin(scenario: Scenario) -> Trajectory:
    """Return the trajectory of the twin in a scenario."""
    plant = scenario.build_plant("twin")
    controller = scenario.build_controller()
    return rollout(
        plant,
        controller,
        START_S + DURATION_S,
        record_hz=1 / FRAME_S,
        seed=scenario.seed,
    )


def connector_poses(run: Trajectory, row: int, start: int) -> np.ndarray:
    """Return the poses of the connectors relative to the position at the first frame, (connectors, 3)."""
    count = sum(name.startswith("connector_heading_") for name in run.columns)
    poses = np.array(
        [
            [run[f"{c}_{i}"][row] for c in ("x", "y", "connector_heading")]
            for i in range(1, count + 1)
        ]
    )
    return poses - [run["com_x"][start], run["com_y"][start], 0.0]


def draw_frame(
    runs: list[tuple[str, Scenario, Trajectory]], row: int, start: int
) -> np.ndarray:
    """Return a frame, shape (height, width, 3)."""
    figure = Figure(figsize=(8.0, 2.9), dpi=100)
    canvas = FigureCanvasAgg(figure)
    for k, (text, scenario, run) in enumerate(runs):
        axes = figure.add_axes((0.0, 0.56 - 0.47 * k, 1.0, 0.42))
        geometry = scenario.robot.geometry
        color = ESTIMATE_COLOR if k else TRUE_COLOR
        draw_segments(
            axes,
            connector_poses(run, row, start),
            geometry,
            [color] * scenario.robot.segments,
            zorder=2,
        )
        axes.set(
            xlim=(-0.25, LENGTH_M - 0.25),
            ylim=(-HALF_WIDTH_M, HALF_WIDTH_M),
            aspect="equal",
            xticks=np.arange(-0.2, LENGTH_M, GRID_M),
        )
        axes.grid(color="#dde1e6")
        axes.tick_params(left=False, labelleft=False, bottom=False, labelbottom=False)
        axes.text(0.01, 0.92, text, transform=axes.transAxes, va="top", fontsize=10)
    figure.text(
        0.99,
        0.01,
        f"{run.time[row] - run.time[start]:.1f} s, grid of 0.1 m",
        ha="right",
        fontsize=9,
    )
    canvas.draw()
    return np.asarray(canvas.buffer_rgba())[..., :3].copy()


def main() -> None:
    """Draw docs/images/optimum.webp."""
    folder = Path(sys.argv[1])
    study = json.loads((folder / "study.json").read_text("utf-8"))
    best = study["best"][0]["metrics"]
    before = study["begun"]
    runs = []
    designs = (
        ("original", load_scenario("gen2_straight"), before),
        ("best", load_scenario(folder / "best/1.yaml"), best),
    )
    for name, scenario, metrics in designs:
        speed = metrics["com_speed_m_s"]
        power = metrics["pneumatic_power_w"]
        text = f"{name}: {speed:.2f} m/s with {power:.0f} W pneumatic power"
        runs.append((text, scenario, simulate_twin(scenario)))
    start = round(START_S / FRAME_S)
    frames = [
        Image.fromarray(draw_frame(runs, k, start))
        for k in range(start, len(runs[0][2].time))
    ]
    target = Path(__file__).parent / "images" / "optimum.webp"
    frames[0].save(
        target,
        save_all=True,
        append_images=frames[1:],
        duration=round(1000 * FRAME_S),
        loop=0,
        quality=60,
    )


if __name__ == "__main__":
    main()
