"""Makes pictures of the README and of docs/ from real runs.

    uv run python docs/pictures.py

`plan.webp`, `why.png` and those of sweeps need nothing; the scene in `hero.png` is Rerun's and needs a
Vulkan driver (on a machine without a graphics card Debian's mesa-vulkan-drivers); `web.png` is the page in a
browser (chromium, chromium-driver); `strobe.png` is drawn by MuJoCo (libegl1, libgl1-mesa-dri).
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
from srs_twin.viewing.mujoco.strobe import write_strobe
from srs_twin.viewing.plots.runs import attribution_plot
from srs_twin.viewing.plots.style import STYLES
from srs_twin.viewing.rerun.web import served

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))
import browser  # noqa: E402
from hero import hero_figure, write_plan_animation  # noqa: E402
from screenshot import screenshots  # noqa: E402

IMAGES = Path(__file__).parent / "images"
MOMENT_S = 5.3
_BAR = 36  # pixels of the viewer's bar, with warnings about this machine
SWEEPS = {"fig31": "com_speed_m_s", "ilc_spread": "scatter_path_bend_per_m"}
"""Sweep → which of its plots."""


def main() -> None:
    """Run gen2_straight, gen2_turn and two sweeps (five minutes, most of it ilc_spread) and draw them."""
    IMAGES.mkdir(exist_ok=True)
    for name, plot in SWEEPS.items():
        with tempfile.TemporaryDirectory() as folder, open_sweep(load_sweep(name), Path(folder)) as sweep:
            sweep.run(local(), sweep.missing())
            drawn = next(file for file in sweep.finish().files if file.endswith(f"{plot}.png"))
            (IMAGES / f"{name}.png").write_bytes((Path(folder) / drawn).read_bytes())
    turn = load_scenario("gen2_turn")
    with tempfile.TemporaryDirectory() as folder:
        runs = run_scenario(turn, Path(folder)).trajectories
        attribution_plot(explain(turn, runs)).savefig(IMAGES / "why.png", dpi=110)
    scenario = load_scenario("gen2_straight")
    with tempfile.TemporaryDirectory() as folder:
        result = run_scenario(scenario, Path(folder))
        write_plan_animation(IMAGES / "plan.webp", result.trajectories, scenario.robot)
        look(scenario, result)


def look(scenario: Scenario, result: RunResult) -> None:
    """Make the pictures of a run in Rerun's viewer, in a browser, and by MuJoCo."""
    recording = result.folder / "recording.rrd"
    (scene,) = screenshots(recording, [MOMENT_S], scene_only=True, size=(1300, 1000))
    hero_figure(scene, result.trajectories, MOMENT_S).savefig(IMAGES / "hero.png")
    with served([recording]) as (address, serve), browser.chromium(1280, 800) as chromium:
        threading.Thread(target=serve, daemon=True).start()
        chromium.get(address)
        blue = STYLES["twin"].rgb
        page, _ = browser.picture(
            chromium,
            lambda shown: browser.shows_a_snake(shown) and browser.share(shown[:, -400:], blue) > 0.001,
        )
        shown = Image.open(io.BytesIO(page))
        shown.crop((0, _BAR, *shown.size)).save(IMAGES / "web.png")
    write_strobe(IMAGES / "strobe.png", scenario, result.trajectories["twin"])


if __name__ == "__main__":
    main()
