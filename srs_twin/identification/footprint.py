"""measure_footprint: what a robot sweeps at each offset, and when the offset changes, by running it.

Section 5.3 measured the curvature of the path, the speed and the circles that bound the body at seven offsets
(Fig. 58, Table 8). Here a plant is run instead.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

from srs_twin.identification.drive import Drive
from srs_twin.identification.measured import Measured
from srs_twin.identification.study import Study
from srs_twin.plants.base import Plant
from srs_twin.spec import RobotSpec


def measure_footprint(
    robot: RobotSpec,
    *,
    frequency: float,
    supply_pa: float | None = None,
    controller: str = "gait",
    target: float = 0.7,
    plant: str | Callable[[], Plant] = "twin",
    offsets: Sequence[float] | None = None,
    changes: Sequence[tuple[float, float]] | None = None,
    periods: int = 6,
    phases: int = 4,
    threads: int | None = None,
    progress: Callable[[int], None] | None = None,
) -> Measured:
    """Run a robot over offsets and measure what it sweeps.

    Args:
        robot: whose footprint it is.
        frequency: of the gait, Hz.
        supply_pa: supply pressure, Pa; default the robot's nominal one.
        controller: "gait" or "ilc".
        target: of learning, rad.
        plant: "twin", "analytical", or what makes a plant.
        offsets: rising; default −0.3 to 0.3 under learning, −0.4 to 0.4 else, in steps of 0.1.
        changes: (before, after) of offsets; default `changes_between`.
        periods: of each run that are measured.
        phases: runs an offset and a change.
        threads: how many runs at once.
        progress: called with how many runs are done.

    Raises:
        InputError: what cannot be measured.
        DivergedError: a run diverged.
    """
    supply = robot.supply.nominal if supply_pa is None else supply_pa
    drive = Drive(robot, frequency, supply, controller, target, plant)
    planned = study(drive, offsets=offsets, changes=changes, periods=periods, phases=phases)
    return planned.measure(threads=threads, progress=progress)


def study(
    drive: Drive, *, offsets: Sequence[float] | None = None,
    changes: Sequence[tuple[float, float]] | None = None, periods: int = 6, phases: int = 4,
) -> Study:  # fmt: skip
    """Return the study of `measure_footprint`, with its defaults filled in.

    Raises:
        InputError: what cannot be measured.
    """
    rows = drive.offsets if offsets is None else tuple(float(each) for each in offsets)
    checked = Study(drive, rows, (), periods, phases)
    return replace(checked, changes=changes_between(rows) if changes is None else tuple(changes))


def changes_between(offsets: Sequence[float]) -> tuple[tuple[float, float], ...]:
    """Return the changes that say most: among the outermost offsets and 0, and half way (where measured).

    Between changes that were measured a footprint is linear in their size.
    """
    low, high = min(offsets), max(offsets)
    full = [each for each in (low, 0.0, high) if each in offsets]
    pairs = [(a, b) for a in full for b in full if a != b]
    if 0.0 in offsets:
        for end in (low, high):
            inner = [each for each in offsets if 0 < each / end < 1]
            half = min(inner, key=lambda each: abs(each - end / 2), default=None)
            if half is not None:
                pairs += [(0.0, half), (half, 0.0)]
    return tuple(pairs)
