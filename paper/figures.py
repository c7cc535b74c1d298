"""Figures of the paper, drawn from runs.

    uv run python paper/figures.py

Takes a few minutes and needs neither a display nor a GPU.
"""

from pathlib import Path

from srs_twin import explain, load_scenario
from srs_twin.experiment import run_scenario
from srs_twin.viewing.plots.from_above import plan_view
from srs_twin.viewing.plots.runs import attribution_plot

HERE = Path(__file__).parent


def main() -> None:
    """Draw both plants in a turn, and the contributions to their difference."""
    scenario = load_scenario("gen2_turn")
    runs = run_scenario(scenario).trajectories
    plan_view(runs, scenario.robot).savefig(HERE / "turn.png", dpi=150)
    attribution_plot(explain(scenario, runs)).savefig(HERE / "attribution.png", dpi=150)


if __name__ == "__main__":
    main()
