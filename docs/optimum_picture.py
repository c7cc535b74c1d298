"""Makes the picture of docs/optimization.md: the scenario as it stands and the best design of a study.

uv run --extra optimize srs-twin optimize gen2_air
    uv run python docs/optimum_picture.py runs/studies/gen2_air
"""

from __future__ import annotations

import json
import sys
from pathlib import Path

import numpy as np
from live_picture import KNOWN, TRUE, tubes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from PIL import Image

from srs_twin.rollout import rollout
from srs_twin.scenario.loading import load_scenario
from srs_twin.scenario.scenario import Scenario
from srs_twin.trajectory import Trajectory

SECONDS, FRAME_S, FROM_S = 3.2, 0.04, 2.0
LONG, HIGH, GRID_M = 2.1, 0.2, 0.1


def way(scenario: Scenario) -> Trajectory:
    """Return a twin's run."""
    plant, controller = scenario.build_plant("twin"), scenario.build_controller()
    return rollout(plant, controller, FROM_S + SECONDS, record_hz=1 / FRAME_S, seed=scenario.seed)


def places(run: Trajectory, row: int, begun: int) -> np.ndarray:
    """Return x, y, heading of the connectors, x from where the body was when the picture begins."""
    count = sum(name.startswith("theta_") for name in run.columns)
    found = np.array([[run[f"{c}_{i}"][row] for c in ("x", "y", "theta")] for i in range(1, count + 1)])
    return found - [run["com_x"][begun], run["com_y"][begun], 0.0]


def picture(runs: list[tuple[str, Scenario, Trajectory]], row: int, begun: int) -> np.ndarray:
    """Return one picture, shape (height, width, 3)."""
    figure = Figure(figsize=(8.0, 2.9), dpi=100)
    canvas = FigureCanvasAgg(figure)
    for k, (text, scenario, run) in enumerate(runs):
        axes = figure.add_axes((0.0, 0.56 - 0.47 * k, 1.0, 0.42))
        geometry = scenario.robot.geometry
        color = KNOWN if k else TRUE
        tubes(axes, places(run, row, begun), geometry, [color] * scenario.robot.segments, zorder=2)
        axes.set(
            xlim=(-0.25, LONG - 0.25),
            ylim=(-HIGH, HIGH),
            aspect="equal",
            xticks=np.arange(-0.2, LONG, GRID_M),
        )
        axes.grid(color="#dde1e6")
        axes.tick_params(left=False, labelleft=False, bottom=False, labelbottom=False)
        axes.text(0.01, 0.92, text, transform=axes.transAxes, va="top", fontsize=10)
    figure.text(0.99, 0.01, f"{run.time[row] - run.time[begun]:.1f} s, grid of 0.1 m", ha="right", fontsize=9)
    canvas.draw()
    return np.asarray(canvas.buffer_rgba())[..., :3].copy()


def main() -> None:
    """Draw docs/images/optimum.webp."""
    folder = Path(sys.argv[1])
    told = json.loads((folder / "study.json").read_text("utf-8"))
    best, before = told["best"][0]["metrics"], told["begun"]
    runs = []
    asked = (
        ("as it stands", load_scenario("gen2_straight"), before),
        ("best", load_scenario(folder / "best/1.yaml"), best),
    )
    for name, scenario, metrics in asked:
        text = f"{name}: {metrics['com_speed_m_s']:.2f} m/s with {metrics['pneumatic_power_w']:.0f} W of air"
        runs.append((text, scenario, way(scenario)))
    begun = round(FROM_S / FRAME_S)
    frames = [Image.fromarray(picture(runs, k, begun)) for k in range(begun, len(runs[0][2].time))]
    target = Path(__file__).parent / "images" / "optimum.webp"
    frames[0].save(
        target, save_all=True, append_images=frames[1:], duration=round(1000 * FRAME_S), loop=0, quality=60
    )


if __name__ == "__main__":
    main()
