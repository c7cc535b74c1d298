"""Live view of a robot in Rerun.

The view shows the estimated state with its uncertainty, the predicted motion, the
innovations and the detected faults. The timeline `sim_time` counts seconds since the
start. The following entities are logged:

- `world/floor`
- `world/robot/{body, connectors, spread, trail}`: estimate
- `world/next/{path, fan}`: prediction
- `lamps`: text with the detected faults
- `bend/segment_j`: estimated bends, rad
- `off/{bends, poses, pressures}`: innovations in standard deviations
"""

from __future__ import annotations

import math
from collections import deque
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
from srs_twin.viewing.rerun.scene import at_height
from srs_twin.viewing.rerun.viewer import (
    HOST,
    free_port,
    lacks_display,
    running_rerun,
    serve_recordings,
)

_BODY_HEIGHT_M = 0.02
_FLOOR_HEIGHT_M = 0.003
"""Height above the floor at which lines do not flicker, m."""

_MAX_TRAIL_POINTS = 300
_PREDICTION_COLOR = (242, 142, 43)
_PREDICTION_ALPHA = 60
_LOST_COLOR = (208, 32, 32)
"""Colour of the body if the estimate is unreliable."""

_Z95 = 1.96
"""Half-width of the 95 % interval in a standard normal distribution."""


class LiveEstimate(Protocol):
    """Interface of a state estimate, such as `live.estimate.Estimate`."""

    @property
    def time(self) -> float:
        """Time of the estimate, s."""

    @property
    def connectors(self) -> np.ndarray:
        """Connector poses (x, y, heading), shape (N, 3), m, m, rad."""

    @property
    def bend(self) -> np.ndarray:
        """Bends, shape (segments,), rad."""

    @property
    def pose(self) -> np.ndarray:
        """Centre of mass (x, y) and mean heading, shape (3,), m, m, rad."""

    @property
    def pose_sd(self) -> np.ndarray:
        """Standard deviations of x, y (m) and heading (rad), shape (3,)."""

    @property
    def lost(self) -> str | None:
        """Reason why the estimate is unreliable, else None or an empty string."""

    @property
    def off(self) -> Mapping[str, float]:
        """Innovation of each kind of measurement, in standard deviations."""

    @property
    def faults(self) -> tuple[tuple[str, str, float], ...]:
        """Component, fault and probability of each detected fault."""


class LiveForecast(Protocol):
    """Interface of a predicted motion, such as `live.estimate.Prediction`."""

    @property
    def pose(self) -> np.ndarray:
        """Predicted poses, shape (times, 3), m, m, rad."""

    @property
    def pose_sd(self) -> np.ndarray:
        """Standard deviations of x, y (m) and heading (rad), shape (times, 3)."""


class LiveView:
    """Logger that sends estimates and predictions to a Rerun stream."""

    def __init__(self, spec: RobotSpec, log: rr.RecordingStream) -> None:
        self._log = log
        self._spec = spec
        self._start = math.nan
        self._trail: deque[list[float]] = deque(maxlen=_MAX_TRAIL_POINTS + 1)
        self._logged_faults: tuple[tuple[str, str, float], ...] | None = None
        scene = rrb.Spatial3DView(
            origin="world", name="Robot, estimate (orange: next second)"
        )
        bends = rrb.TimeSeriesView(
            origin="bend", name="Bends, rad", axis_y=rrb.ScalarAxis(range=(-1.6, 1.6))
        )
        innovations = rrb.TimeSeriesView(
            origin="off", name="Innovations, standard deviations"
        )
        faults = rrb.TextDocumentView(origin="lamps", name="Faults")
        right = rrb.Vertical(faults, bends, innovations, row_shares=[1, 2, 2])
        whole = rrb.Horizontal(scene, right, column_shares=[3, 2])
        log.send_blueprint(rrb.Blueprint(whole, collapse_panels=True))
        log.log("world", rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
        for j in range(1, spec.segments + 1):
            log.log(
                f"bend/segment_{j}", rr.SeriesLines(names=f"segment {j}"), static=True
            )

    def __call__(self, estimate: LiveEstimate, prediction: LiveForecast | None) -> None:
        """Log an estimate and a prediction."""
        log = self._log
        if math.isnan(self._start):
            self._start = estimate.time
        log.set_time(TIMELINE, duration=estimate.time - self._start)
        self._log_robot(estimate)
        if prediction is not None:
            self._log_prediction(prediction)
        for j, bend in enumerate(estimate.bend.tolist(), start=1):
            log.log(f"bend/segment_{j}", rr.Scalars(bend))
        for kind, innovation in estimate.off.items():
            log.log(f"off/{kind}", rr.Scalars(innovation))
        if estimate.faults != self._logged_faults:
            self._logged_faults = estimate.faults
            text = _fault_text(estimate)
            log.log("lamps", rr.TextDocument(text, media_type=rr.MediaType.MARKDOWN))

    def _log_robot(self, estimate: LiveEstimate) -> None:
        geometry = self._spec.geometry
        poses = estimate.connectors
        columns: dict[str, np.ndarray] = {}
        for i, pose in enumerate(poses, start=1):
            x, y, theta = pose[:, None]
            columns |= {f"x_{i}": x, f"y_{i}": y, f"connector_heading_{i}": theta}
        line = body_line(Trajectory(columns), geometry)[0]
        color = _LOST_COLOR if estimate.lost else rgb(STYLES["twin"].color)
        thickness = geometry.width / 4
        strips = [at_height(line, _BODY_HEIGHT_M)]
        body = rr.LineStrips3D(strips, colors=[color], radii=thickness)
        self._log.log("world/robot/body", body)
        sd = float(np.hypot(*estimate.pose_sd[:2]))
        radii = np.full(len(poses), _Z95 * sd + thickness)
        points = at_height(poses[:, :2], _FLOOR_HEIGHT_M)
        spread = rr.Points3D(points, radii=radii, colors=[(*color, 50)])
        self._log.log("world/robot/spread", spread)
        self._trail.append([*estimate.pose[:2].tolist(), _FLOOR_HEIGHT_M])
        trail = rr.LineStrips3D([list(self._trail)], colors=[color], radii=0.001)
        self._log.log("world/robot/trail", trail)

    def _log_prediction(self, prediction: LiveForecast) -> None:
        points = at_height(prediction.pose[:, :2], _FLOOR_HEIGHT_M)
        path = rr.LineStrips3D([points], colors=[_PREDICTION_COLOR], radii=0.002)
        self._log.log("world/next/path", path)
        radii = _Z95 * np.hypot(prediction.pose_sd[:, 0], prediction.pose_sd[:, 1])
        color = (*_PREDICTION_COLOR, _PREDICTION_ALPHA)
        fan = rr.Points3D(points, radii=radii, colors=[color])
        self._log.log("world/next/fan", fan)


def _fault_text(estimate: LiveEstimate) -> str:
    lines = [
        f"- 🔴 **{part}**: {fault} ({probability:.0%})"
        for part, fault, probability in estimate.faults
    ]
    text = "\n".join(lines or ["🟢 none"])
    if estimate.lost:
        text += f"\n\n🔴 {estimate.lost}"
    return text


@contextmanager
def live_view(
    spec: RobotSpec, *, recording: Path | None, window: bool, web: bool
) -> Iterator[tuple[LiveView, str]]:
    """Stream a live view to viewers and to a file during a `with` block.

    The context manager yields the view and the URL of the web page. Without a web page,
    the URL is an empty string.
    """
    log = rr.RecordingStream(APPLICATION)
    sinks: list[rr.FileSink | rr.GrpcSink] = []
    if recording is not None:
        sinks.append(rr.FileSink(str(recording)))
    port = free_port()
    address = f"rerun+http://{HOST}:{port}/proxy"
    if window and lacks_display():
        raise InputError(
            "no display was found for the viewer; use `--web` to show the view in a"
            " browser"
        )
    viewer = running_rerun("--port", str(port)) if window else nullcontext()
    page = serve_recordings((), data_port=port) if web else nullcontext(("", None))
    with viewer, page as (url, serve):
        if serve is not None:
            Thread(target=serve, daemon=True).start()
        if window or web:
            sinks.append(rr.GrpcSink(address))
        log.set_sinks(*sinks)
        try:
            yield LiveView(spec, log), url
        finally:
            log.flush()
            log.disconnect()
