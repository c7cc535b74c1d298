"""Makes pictures of the README and of docs/ from real runs.

    uv run python docs/pictures.py

`plan.png`, `why.png` and those of sweeps need nothing; `hero.png` is a screenshot of Rerun's viewer and
needs a Vulkan driver (on a machine without a graphics card Debian's mesa-vulkan-drivers).
"""

from __future__ import annotations

import tempfile
from pathlib import Path

from srs_twin import load_scenario
from srs_twin.attribution import explain
from srs_twin.running import run_scenario
from srs_twin.sweep import load_sweep, open_sweep
from srs_twin.sweep.engines import local
from srs_twin.viewing.plan_view import hero_figure
from srs_twin.viewing.screenshot import screenshots
from srs_twin.viewing.waterfall import waterfall

IMAGES = Path(__file__).parent / "images"
MOMENT_S = 3.3
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
        waterfall(explain(turn, runs)).savefig(IMAGES / "why.png", dpi=110)
    scenario = load_scenario("gen2_straight")
    with tempfile.TemporaryDirectory() as folder:
        result = run_scenario(scenario, Path(folder))
        hero_figure(dict(result.trajectories), scenario.robot).savefig(IMAGES / "plan.png", dpi=110)
        (picture,) = screenshots(result.folder / "recording.rrd", [MOMENT_S])
        (IMAGES / "hero.png").write_bytes(picture)


if __name__ == "__main__":
    main()
