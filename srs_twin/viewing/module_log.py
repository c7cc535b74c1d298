"""Signals of each module in a recording besides bend and pressure: valves, readings, duties."""

from __future__ import annotations

import numpy as np
import rerun as rr

from srs_twin.trajectory import Trajectory
from srs_twin.viewing.blueprint import TIMELINE
from srs_twin.viewing.colors import MINUS_RGB, PLUS_RGB, Style

_READING_WIDTH = 0.6
_SIDES = (("plus", PLUS_RGB), ("minus", MINUS_RGB))


def send_modules(log: rr.RecordingStream, plant: str, run: Trajectory, style: Style) -> None:
    """Log `module/<j>/valve/<plant>`, and `sensed` and `duty` where they say more than bend and valve.

    The state of a module's valves is 1 where they drive towards positive bends, −1 towards negative ones, 0
    where both do the same.
    """
    if run.has("valve_plus"):
        state = (run.stack("valve_plus") - run.stack("valve_minus")) / 2
        for j, values in enumerate(state.T, start=1):
            line = rr.SeriesLines(
                colors=[style.rgb], names=[style.label], widths=[style.width], interpolation_mode="StepAfter"
            )
            _send(log, f"module/{j}/valve/{plant}", run.time, values, line, changes=True)
    if run.has("sensed") and not np.array_equal(run.stack("sensed"), run.stack("bend")):
        for j, values in enumerate(run.stack("sensed").T, start=1):
            line = rr.SeriesLines(
                colors=[style.rgb], names=[f"{style.label}, sensed"], widths=[_READING_WIDTH]
            )
            _send(log, f"module/{j}/sensed/{plant}", run.time, values, line)
    for side, rgb in _SIDES:
        if run.has(f"duty_{side}"):
            for j, values in enumerate(run.stack(f"duty_{side}").T, start=1):
                line = rr.SeriesLines(
                    colors=[rgb], names=[f"{style.label}, {side}"], widths=[style.width],
                    interpolation_mode="StepAfter",
                )  # fmt: skip
                _send(log, f"module/{j}/duty/{plant}/{side}", run.time, values, line, changes=True)


def _send(
    log: rr.RecordingStream,
    path: str,
    time: np.ndarray,
    values: np.ndarray,
    line: rr.SeriesLines,
    *,
    changes: bool = False,
) -> None:
    """Log a signal; of one in steps only the samples at which it changes, and the last."""
    if changes:
        kept = np.append(np.flatnonzero(np.append(True, values[1:] != values[:-1])), len(values) - 1)
        # What a sample says has held since the one before.
        since = np.append(np.maximum(kept[:-1] - 1, 0), kept[-1])
        time, values = time[since], values[kept]
    log.log(path, line, static=True)
    scalars = rr.Scalars.columns(scalars=np.asarray(values, dtype=float))
    log.send_columns(path, [rr.TimeColumn(TIMELINE, duration=time)], scalars)
