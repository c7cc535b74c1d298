"""Images of the README and of docs/, generated from runs.

    uv run python docs/pictures.py

The scene in `hero.png` is rendered by Rerun and needs a Vulkan driver
(mesa-vulkan-drivers of Debian on a machine without a GPU). `web.png` is a screenshot of
a browser (chromium, chromium-driver), and `strobe.png` is rendered by MuJoCo (libegl1,
libgl1-mesa-dri). All other images have no additional requirements.
"""

from __future__ import annotations

import io
import sys
import tempfile
import threading
from pathlib import Path

from PIL import Image

from srs_twin import load_scenario
from srs_twin.attribution import explain
from srs_twin.experiment import RunResult, run_scenario
from srs_twin.scenario.scenario import Scenario
from srs_twin.studies.sweep.execution import local, open_sweep
from srs_twin.studies.sweep.loading import load_sweep
from srs_twin.viewing.mujoco.render import write_strobe
from srs_twin.viewing.plots.runs import attribution_plot
from srs_twin.viewing.plots.style import STYLES
from srs_twin.viewing.rerun.viewer import serve_recordings

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))
import browser  # noqa: E402
from hero import hero_figure, write_plan_animation  # noqa: E402
from screenshot import screenshots  # noqa: E402

IMAGES = Path(__file__).parent / "images"
SCENE_TIME_S = 5.3
_VIEWER_BAR_PX = 36
"""Height of the bar of the viewer, which shows warnings about the machine, pixels."""

SWEEPS = {"fig31": "com_speed_m_s", "ilc_spread": "scatter_path_bend_per_m"}
"""Sweep → name of its plot."""


def main() -> None:
    """Run two scenarios and two sweeps, and draw them; takes five minutes, mainly for ilc_spread."""
    IMAGES.mkdir(exist_ok=True)
    for name, plot in SWEEPS.items():
        with (
            tempfile.TemporaryDirectory() as folder,
            open_sweep(load_sweep(name), Path(folder)) as sweep,
        ):
            sweep.run(local(), sweep.missing())
            plot_file = next(
                file for file in sweep.finish().files if file.endswith(f"{plot}.png")
            )
            (IMAGES / f"{name}.png").write_bytes(
                (Path(folder) / plot_file).read_bytes()
            )
    turn = load_scenario("gen2_turn")
    with tempfile.TemporaryDirectory() as folder:
        runs = run_scenario(turn, Path(folder)).trajectories
        attribution_plot(explain(turn, runs)).savefig(IMAGES / "why.png", dpi=110)
    scenario = load_scenario("gen2_straight")
    with tempfile.TemporaryDirectory() as folder:
        result = run_scenario(scenario, Path(folder))
        write_plan_animation(IMAGES / "plan.webp", result.trajectories, scenario.robot)
        draw_run(scenario, result)


def draw_run(scenario: Scenario, result: RunResult) -> None:
    """Write the images of a run that Rerun, a browser and MuJoCo render."""
    recording = result.folder / "recording.rrd"
    (scene,) = screenshots(
        recording, [SCENE_TIME_S], scene_only=True, size=(1300, 1000)
    )
    hero_figure(scene, result.trajectories, SCENE_TIME_S).savefig(IMAGES / "hero.png")
    with (
        serve_recordings([recording]) as (address, serve),
        browser.chromium(1280, 800) as chromium,
    ):
        threading.Thread(target=serve, daemon=True).start()
        chromium.get(address)
        blue = STYLES["twin"].rgb
        page, _ = browser.picture(
            chromium,
            lambda pixels: (
                browser.shows_a_snake(pixels)
                and browser.share(pixels[:, -400:], blue) > 0.001
            ),
        )
        image = Image.open(io.BytesIO(page))
        image.crop((0, _VIEWER_BAR_PX, *image.size)).save(IMAGES / "web.png")
    write_strobe(IMAGES / "strobe.png", scenario, result.trajectories["twin"])


if __name__ == "__main__":
    main()
