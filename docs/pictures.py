"""Makes the README's pictures from a real run.

    uv run python docs/pictures.py

`plan.png`, `why.png` and `fig31.png` need nothing; `hero.png` is a screenshot of Rerun's viewer and needs a
Vulkan driver (on a machine without a graphics card Debian's mesa-vulkan-drivers).
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


def main() -> None:
    """Run gen2_straight, gen2_turn and the sweep fig31 and write the pictures."""
    IMAGES.mkdir(exist_ok=True)
    with tempfile.TemporaryDirectory() as folder, open_sweep(load_sweep("fig31"), Path(folder)) as sweep:
        sweep.run(local(), sweep.missing())
        speed = next(name for name in sweep.finish().files if name.endswith("com_speed_m_s.png"))
        (IMAGES / "fig31.png").write_bytes((Path(folder) / speed).read_bytes())
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
