"""Plan a path through a course of your own, and follow it on both plants.

python examples/own_course.py
"""

from pathlib import Path

import srs_twin as srs

COURSE = Path(__file__).with_suffix(".yaml")


def main() -> None:
    """Print the plan, and how each plant follows it."""
    planned = srs.plan_scenario(COURSE)
    print(f"plan: {planned.plan.outcome.value}")
    if planned.quality is None:
        return
    print(
        f"  {planned.metrics['plan_length_m']:.2f} m long,"
        f" {1e3 * planned.quality.clearance_m:.0f} mm from the obstacles"
    )
    found = srs.run_scenario(COURSE)
    for plant, metrics in found.metrics["plants"].items():
        print(
            f"{plant}: goal {'reached' if metrics['goal_reached'] else 'not reached'},"
            f" {metrics['contacts']:.0f} contacts,"
            f" {1e3 * metrics['cross_track_rms_m']:.0f} mm RMS from the path"
        )


if __name__ == "__main__":
    main()
