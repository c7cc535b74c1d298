"""Compare the plants in a turn, and attribute their difference to assumptions.

python examples/compare_and_explain.py
"""

import srs_twin as srs

CHANGES = {"duration_s": 4, "controller.offset": 0.2}


def main() -> None:
    """Print the verdict, and the contributions to the difference in speed."""
    found = srs.run_scenario("gen2_turn", set=CHANGES)
    for plant, metrics in found.metrics["plants"].items():
        print(
            f"{plant}: {1e3 * metrics['com_speed_m_s']:.1f} mm/s,"
            f" {metrics['yaw_rate_rad_s']:.2f} rad/s"
        )

    scenario = srs.load_scenario("gen2_turn", set=CHANGES)
    attribution = srs.explain(scenario, found.trajectories)
    print("contributions to the difference in speed:")
    for share in sorted(attribution.shares, key=lambda share: -abs(share.value[0])):
        print(f"  {1e3 * share.value[0]:+6.1f} mm/s  {share.title}")
    print(f"  {1e3 * attribution.remainder[0]:+6.1f} mm/s  not explained")
    print(f"  {1e3 * attribution.gap[0]:+6.1f} mm/s  in all")


if __name__ == "__main__":
    main()
