"""Propagate the uncertain parameters of a robot file to the speed of the model.

python examples/uncertainty.py [SAMPLES]
"""

import sys

import srs_twin as srs


def main() -> None:
    """Print the interval of the speed, its main causes, and what to measure next."""
    samples = int(sys.argv[1]) if len(sys.argv) > 1 else 256
    found = srs.uncertainty(
        "gen2_straight",
        set={"duration_s": 4},
        plants=["analytical"],
        samples=samples,
        workers=1,
    )
    speed = found.plants["analytical"]["com_speed_m_s"]
    low, high = (1e3 * end for end in speed.interval("interval_95"))
    print(f"speed: {1e3 * speed.value:.0f} mm/s, 95 % interval {low:.0f} to {high:.0f}")
    print("interval after a measurement of one parameter to 10 %:")
    for measured in found.measure_next()[:3]:
        low, high = (1e3 * end for end in measured.interval_95)
        print(f"  {measured.parameter}: {low:.0f} to {high:.0f} mm/s")


if __name__ == "__main__":
    main()
