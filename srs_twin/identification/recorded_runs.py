"""Recordings as data of fits: gait runs that drive the plants, and lengths measured from markers."""

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
from srs_twin.identification.parameters import free_parameters
from srs_twin.pneumatics import Pneumatics
from srs_twin.pneumatics.recorded import RecordedPressures
from srs_twin.recordings.recording import Recording
from srs_twin.recordings.takes import NO_MARKERS, commands, only_bends, pressures
from srs_twin.robot.spec import RobotSpec


def gait_run(recording: Recording, name: str, supply_pa: float) -> GaitRun:
    """Return a recording as a gait run with its valve states, or with its pressures if these were logged.

    Raises:
        InputError: the recording has no log, or only bends.
    """
    trajectory = recording.trajectory
    if only_bends(trajectory):
        raise InputError(f"{name}: {NO_MARKERS}")
    controller = Replay(commands(recording, name), trajectory.metadata.get("gait_frequency_hz"))
    logged = pressures(recording)
    chambers = logged and partial(_recorded_pressures, *logged, supply_pa)
    return GaitRun(trajectory, controller, supply_pa, name, chambers)


def _recorded_pressures(
    time: np.ndarray, values: np.ndarray, supply_pa: float, spec: RobotSpec
) -> Pneumatics:
    return RecordedPressures(spec, time, values, supply_pa=supply_pa)


MEASURED_LENGTHS = ("geometry.rigid_gap_m", "geometry.segment_length_m")
"""Lengths that markers determine; their sum is the pitch."""

FROM_MARKERS = "measured from the markers, not from the walk"


def measured_length(
    recordings: Sequence[Recording], spec: RobotSpec, names: Sequence[str]
) -> Parameter | None:
    r"""Return the rigid gap or segment length from markers; None if they do not determine it.

    The pitch is the sum of rigid gap and segment length of a straight segment. Each follows from the pitch
    and the other one in the robot file. With the arc lengths ℓ that the markers give for the gap g of the
    file,

    $$ \ell = a + b\,q^2, \qquad \text{pitch} = a + g . $$

    b contains the elongation of segments and the effect of a wrong g, which vanishes if the recordings are
    read with the measured gap. The standard error includes the scatter over segments, whose markers are
    placed differently, and the noise of the two outermost markers.

    Args:
        recordings: recordings, some or all with markers.
        spec: robot with which they were read.
        names: requested parameters; with both lengths nothing is measured, as markers show only their sum.
    """
    requested = [name for name in names if name in MEASURED_LENGTHS]
    marked = [recording for recording in recordings if recording.summary.markers is not None]
    if len(requested) != 1 or not marked:
        return None
    from scipy import stats

    parameter, count = free_parameters(spec, requested)[0], spec.segments
    straight_lengths = np.empty((len(marked), count))
    for row, recording in zip(straight_lengths, marked, strict=True):
        bends, lengths = recording.trajectory.stack("bend"), recording.trajectory.stack("length")
        row[:] = [np.polyfit(q**2, length, 1)[1] for q, length in zip(bends.T, lengths.T, strict=True)]
    means = straight_lengths.mean(axis=0)
    value = parameter.start + float(means.mean()) - spec.geometry.segment_length
    noise = max(r.summary.markers.noise_m for r in marked if r.summary.markers is not None)
    scatter = float(means.std(ddof=1)) if count > 1 else 0.0
    error = math.hypot(scatter / math.sqrt(count), math.sqrt(2) * noise / count)
    half_width = float(stats.t.ppf(0.5 + LEVEL / 2, max(count - 1, 1))) * error
    value, low, high = (
        parameter.value(parameter.coordinate(v)) for v in (value, value - half_width, value + half_width)
    )
    is_identified = error <= IDENTIFIED_ERROR * parameter.slope(value)
    verdict: Verdict = "identified" if is_identified else "weakly identified"
    return Parameter(parameter.name, parameter.unit, verdict, value, error, low, high, FROM_MARKERS)
