"""A robot on the air, streamed to Rerun as it runs: estimate with its spread, what comes next, faults.

Entity tree: `world/floor`, `world/robot/{body, connectors, spread, trail}`, `world/next/{path, fan}`, `lamps`
(a text: what was named), `bend/segment_j`, `off/{bends, poses, pressures}` (by how many standard deviations
measurements were off). The time line is `sim_time`: seconds from the beginning.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager, nullcontext
from pathlib import Path
from threading import Thread
from typing import Protocol

import numpy as np
import rerun as rr
import rerun.blueprint as rrb

from srs_twin.errors import InputError
from srs_twin.robot.spec import RobotSpec
from srs_twin.trajectory import Trajectory
from srs_twin.viewing.plots.signals import body_line
from srs_twin.viewing.plots.style import STYLES, rgb
from srs_twin.viewing.rerun.blueprint import TIMELINE
from srs_twin.viewing.rerun.recording import APPLICATION
from srs_twin.viewing.rerun.viewer import HOST, free_port, lacks_display, running_rerun
from srs_twin.viewing.rerun.web import served

_HEIGHT, _FLAT = 0.02, 0.003
_TRAIL = 300
_NEXT, _FAN, _FINE, _FAULTY = (242, 142, 43), (242, 142, 43, 60), (80, 170, 90), (208, 32, 32)


class LiveEstimate(Protocol):
    """State of a robot as it is known now; `live.shadow.Estimate`."""

    @property
    def time(self) -> float:
        """Time, s."""

    @property
    def connectors(self) -> np.ndarray:
        """Poses of the connectors, shape (N, 3): m, m, rad."""

    @property
    def bend(self) -> np.ndarray:
        """Bends, rad."""

    @property
    def pose(self) -> np.ndarray:
        """Pose of the centre of mass: m, m, rad."""

    @property
    def pose_sd(self) -> np.ndarray:
        """Standard deviations of the pose."""

    @property
    def lost(self) -> str | None:
        """Reason why the estimate is not to be relied on; empty or None where it is."""

    @property
    def off(self) -> Mapping[str, float]:
        """Kind of measurement → error of its prediction, standard deviations."""

    @property
    def faults(self) -> tuple[tuple[str, str, float], ...]:
        """Part, fault and probability of each fault that is named."""


class LiveForecast(Protocol):
    """Predicted poses; `live.prediction.Prediction`."""

    @property
    def pose(self) -> np.ndarray:
        """Poses of the centre of mass, shape (times, 3): m, m, rad."""

    @property
    def pose_sd(self) -> np.ndarray:
        """Their standard deviations."""


class LiveView:
    """Logs estimates and predictions to a stream."""

    def __init__(self, spec: RobotSpec, log: rr.RecordingStream) -> None:
        """Lay out the views.

        Args:
            spec: the robot.
            log: where to.
        """
        self._log, self._spec, self._begun = log, spec, float("nan")
        self._trail: list[list[float]] = []
        self._told: tuple[tuple[str, str, float], ...] | None = None
        n = range(1, spec.segments + 1)
        scene = rrb.Spatial3DView(origin="world", name="Robot, estimate (orange: next second)")
        bends = rrb.TimeSeriesView(origin="bend", name="Bends, rad", axis_y=rrb.ScalarAxis(range=(-1.6, 1.6)))
        off = rrb.TimeSeriesView(origin="off", name="Measurements off by, standard deviations")
        lamps = rrb.TextDocumentView(origin="lamps", name="Faults")
        right = rrb.Vertical(lamps, bends, off, row_shares=[1, 2, 2])
        log.send_blueprint(
            rrb.Blueprint(rrb.Horizontal(scene, right, column_shares=[3, 2]), collapse_panels=True)
        )
        log.log("world", rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
        for j in n:
            log.log(f"bend/segment_{j}", rr.SeriesLines(names=f"segment {j}"), static=True)

    def __call__(self, found: LiveEstimate, coming: LiveForecast | None) -> None:
        """Show what is known now, and what comes next."""
        log = self._log
        if np.isnan(self._begun):
            self._begun = found.time
        log.set_time(TIMELINE, duration=found.time - self._begun)
        g = self._spec.geometry
        place, bend = found.connectors, found.bend
        names = [f"{column}_{i}" for i in range(1, len(place) + 1) for column in ("x", "y", "theta")]
        line = body_line(Trajectory(dict(zip(names, place.reshape(-1, 1), strict=True))), g)[0]
        color = _FAULTY if found.lost else rgb(STYLES["twin"].color)
        log.log(
            "world/robot/body", rr.LineStrips3D([_raised(line, _HEIGHT)], colors=[color], radii=g.width / 4)
        )
        spread = np.full(len(place), 1.96 * float(np.hypot(*found.pose_sd[:2])) + g.width / 4)
        log.log(
            "world/robot/spread",
            rr.Points3D(_raised(place[:, :2], _FLAT), radii=spread, colors=[(*color, 50)]),
        )
        self._trail = [*self._trail[-_TRAIL:], [*found.pose[:2].tolist(), _FLAT]]
        log.log("world/robot/trail", rr.LineStrips3D([self._trail], colors=[color], radii=0.001))
        if coming is not None:
            log.log(
                "world/next/path",
                rr.LineStrips3D([_raised(coming.pose[:, :2], _FLAT)], colors=[_NEXT], radii=0.002),
            )
            wide = 1.96 * np.hypot(coming.pose_sd[:, 0], coming.pose_sd[:, 1])
            log.log(
                "world/next/fan", rr.Points3D(_raised(coming.pose[:, :2], _FLAT), radii=wide, colors=[_FAN])
            )
        for j, each in enumerate(bend.tolist(), start=1):
            log.log(f"bend/segment_{j}", rr.Scalars(each))
        for kind, value in found.off.items():
            log.log(f"off/{kind}", rr.Scalars(value))
        if found.faults != self._told:
            self._told = found.faults
            lines = [f"- 🔴 **{part}**: {fault} ({share:.0%})" for part, fault, share in found.faults]
            lost = f"\n\n🔴 {found.lost}" if found.lost else ""
            text = "\n".join(lines or ["🟢 none"]) + lost
            log.log("lamps", rr.TextDocument(text, media_type=rr.MediaType.MARKDOWN))


@contextmanager
def live_view(
    spec: RobotSpec, *, keep: Path | None, window: bool, web: bool
) -> Iterator[tuple[LiveView, str]]:
    """Stream to a viewer and a file while the block runs; give the view, and the page's address if any.

    Args:
        spec: the robot.
        keep: recording to write; None: none.
        window: whether Rerun's own window opens.
        web: whether a page is served on this machine.

    Raises:
        InputError: Rerun does not start, or a window without a display.
    """
    log = rr.RecordingStream(APPLICATION)
    sinks: list[rr.FileSink | rr.GrpcSink] = [] if keep is None else [rr.FileSink(str(keep))]
    port = free_port()
    address = f"rerun+http://{HOST}:{port}/proxy"
    if window and lacks_display():
        raise InputError("there is no display to open a viewer on; --web serves a page instead")
    viewer = running_rerun("--port", str(port)) if window else nullcontext()
    page = served((), data=port) if web else nullcontext(("", None))
    with viewer, page as (shown, serve):
        if serve is not None:
            Thread(target=serve, daemon=True).start()
        if window or web:
            sinks.append(rr.GrpcSink(address))
        log.set_sinks(*sinks)
        try:
            yield LiveView(spec, log), shown
        finally:
            log.flush()
            log.disconnect()


def _raised(points: np.ndarray, height: float) -> np.ndarray:
    return np.column_stack([points, np.full(len(points), height)])
