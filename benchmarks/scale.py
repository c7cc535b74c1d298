"""A robot of another size makes the same motion: deviations of speed and yaw rate by scale and plant.

    uv run python benchmarks/scale.py [--robot gen2]

Generation 2 with an axial drag turns with offset 0.2 at 2 Hz/√s. Lengths are multiplied
by s, masses and drag by s³, stiffness by s⁴, and times by √s. Default settings: only
the tick of 20 ms √s is given. Explicit settings: time step, slip speeds and contact
times are given, too, multiplied by √s. Single settings: one of them is given. Each
entry is the larger of the relative deviations of speed/√s and yaw rate · √s from those
at s = 1.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Collection
from dataclasses import replace
from pathlib import Path

import numpy as np
from grid import table

from srs_twin import load_robot

sys.path.append(str(Path(__file__).parents[1] / "tests" / "helpers"))
from scaled_robots import PLANTS, SETTINGS, deviations, motion  # noqa: E402

SCALES = (1 / 16, 1 / 4, 4.0, 16.0, 0.05, 20.0)
DRAG_N = 0.02
"""Axial drag at s = 1, about a third of the axle friction of generation 2, N."""


def _entry(
    name: str, spec: object, s: float, explicit: Collection[str], reference: np.ndarray
) -> str:
    try:
        return f"{np.abs(deviations(name, spec, s, explicit, reference)).max():.0e}"  # type: ignore[arg-type]
    except Exception as error:  # the older versions of the table refuse some scales
        return type(error).__name__


def main() -> None:
    """Print tables for default, explicit and single settings."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--robot", default="gen2", help="Name or path of the robot.")
    spec = load_robot(parser.parse_args().robot)
    spec = replace(spec, friction=replace(spec.friction, drag=DRAG_N))
    for title, explicit in (("Default", ()), ("Explicit", SETTINGS)):
        rows = []
        for name, build in PLANTS.items():
            reference = motion(build(spec, 1.0, explicit), 1.0)
            rows.append(
                [name, *(_entry(name, spec, s, explicit, reference) for s in SCALES)]
            )
            print(rows[-1], file=sys.stderr, flush=True)
        print(f"\n{title} settings\n")
        print(table(["plant", *(f"s = {s:g}" for s in SCALES)], rows), flush=True)
    choices = (
        (),
        *((name,) for name in SETTINGS if name != "timestep"),
        ("slip_speed", "tolerance"),
    )
    rows = []
    for name, build in PLANTS.items():
        entries = []
        for chosen in choices:
            reference = motion(build(spec, 1.0, chosen), 1.0)
            entries.append(
                ", ".join(_entry(name, spec, s, chosen, reference) for s in SCALES[-2:])
            )
        rows.append([name, *entries])
    print(f"\nSingle settings, s = {SCALES[-2]:g}, {SCALES[-1]:g}\n")
    print(
        table(["plant", *(" and ".join(chosen) or "none" for chosen in choices)], rows),
        flush=True,
    )


if __name__ == "__main__":
    main()
