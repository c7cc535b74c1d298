"""Run a robot of your own, which is described in one file.

python examples/own_robot.py
"""

import json
import tempfile
from pathlib import Path

import srs_twin as srs

ROBOT = Path(__file__).with_suffix(".yaml")


def main() -> None:
    """Print the robot, its speeds with two stiffnesses, and what it looks like as MJCF."""
    spec = srs.load_robot(ROBOT)
    print(f"{spec.title}: {spec.segments} segments, {spec.mass.total:.2f} kg")
    for stiffness in (0.5, 1.0):
        changes = {
            "robot": {
                "base": str(ROBOT),
                "bending": {"stiffness_nm_per_rad": stiffness},
            },
            "supply": {"pressure_kpa": 45},
            "duration_s": 4,
        }
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / "own_robot_straight.yaml"
            controller = {"controller": {"kind": "gait", "frequency_hz": 1.5}}
            # A scenario file is YAML, of which JSON is a part.
            path.write_text(json.dumps(changes | controller), "utf-8")
            found = srs.compare(path)
        print(f"{stiffness:g} N m/rad: {found}")


if __name__ == "__main__":
    main()
