"""Recordings as data of fits: runs to drive the plants with, and lengths that markers show."""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import partial

import numpy as np

from srs_twin.control.replay import Replay
from srs_twin.errors import InputError
from srs_twin.identification.estimate import IDENTIFIED_ERROR, Parameter, Verdict
from srs_twin.identification.least_squares import LEVEL
from srs_twin.identification.locomotion import GaitRun
from srs_twin.pneumatics import Pneumatics
from srs_twin.pneumatics.recorded import RecordedPressures
from srs_twin.recordings.recording import Recording
from srs_twin.recordings.takes import NO_MARKERS, commands, only_bends, pressures
from srs_twin.robot.spec import RobotSpec


def gait_run(recording: Recording, name: str, supply_pa: float) -> GaitRun:
    """Return a recording as a run whose valves are commanded again, or whose pressures chambers have again.

    Raises:
        InputError: there is no log, or bends alone were measured.
    """
    trajectory = recording.trajectory
    if only_bends(trajectory):
        raise InputError(f"{name}: {NO_MARKERS}")
    driver = Replay(commands(recording, name), trajectory.metadata.get("gait_frequency_hz"))
    logged = pressures(recording)
    chambers = logged and partial(_recorded, *logged, supply_pa)
    return GaitRun(trajectory, driver, supply_pa, name, chambers)


def _recorded(time: np.ndarray, values: np.ndarray, supply_pa: float, spec: RobotSpec) -> Pneumatics:
    return RecordedPressures(spec, time, values, supply_pa=supply_pa)


MEASURED_LENGTHS = ("geometry.rigid_gap_m", "geometry.segment_length_m")


def measured_length(takes: Sequence[Recording], spec: RobotSpec, names: Sequence[str]) -> Parameter | None:
    r"""Return the rigid gap or the length of a segment as markers show it; None where they do not.

    A straight segment with its gap is the pitch, and one of both follows from the other, which the robot file
    states. With the arcs' lengths ℓ that explain the markers beside the file's gap g,

    $$ \ell = a + b\,q^2, \qquad \text{pitch} = a + g . $$

    b is what segments stretch, and what a wrong g leaves, which vanishes where takes are read with the gap
    found. The standard error is that of a mean over segments, whose markers are not placed alike, and of the
    noise of the two outermost markers.

    Args:
        takes: recordings, some or all of markers.
        spec: the robot they were read with.
        names: what is asked for; nothing is measured where it holds both, whose sum alone is seen.
    """
    asked = [name for name in names if name in MEASURED_LENGTHS]
    seen = [take for take in takes if take.summary.markers is not None]
    if len(asked) != 1 or not seen:
        return None
    from scipy import stats

    unknown, count = free_parameters(spec, asked)[0], spec.segments
    straight = np.empty((len(seen), count))
    for row, take in zip(straight, seen, strict=True):
        bend, length = take.trajectory.stack("bend"), take.trajectory.stack("length")
        row[:] = [np.polyfit(q**2, each, 1)[1] for q, each in zip(bend.T, length.T, strict=True)]
    own = straight.mean(axis=0)
    value = unknown.start + float(own.mean()) - spec.geometry.segment_length
    noise = max(take.summary.markers.noise_m for take in seen if take.summary.markers is not None)
    spread = float(own.std(ddof=1)) if count > 1 else 0.0
    error = math.hypot(spread / math.sqrt(count), math.sqrt(2) * noise / count)
    reach = float(stats.t.ppf(0.5 + LEVEL / 2, max(count - 1, 1))) * error
    value, low, high = (unknown.value(unknown.coordinate(v)) for v in (value, value - reach, value + reach))
    verdict: Verdict = (
        "identified" if error <= IDENTIFIED_ERROR * unknown.slope(value) else "weakly identified"
    )
    return Parameter(unknown.name, unknown.unit, verdict, value, error, low, high, FROM_MARKERS)


FROM_MARKERS = "measured from the markers, not from the walk"
