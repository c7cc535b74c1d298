"""Rerun recordings of finished runs.

A recording contains the following entities:

- `world/floor`, `world/eye` (target of the camera), `world/obstacles`,
  `world/plan/{path, edges, goal}`
- `world/<plant>/{body, connectors, wheels, spokes, trail, com, contact}`
- `module/<j>/{bend, pressure, valve, sensed, duty}/<plant>`
- `body/{speed, heading}/<plant>`, `follow/{cross_track, offset}/<plant>`
- `comparison/{shape, path}`, `measured/{shape, path, bend}/<plant>`
- `events/<plant>`: text of controller events and contacts with obstacles

The timeline is `sim_time`, the simulated time in seconds. Plotted pressures are in kPa,
plotted distances are in mm, and all other values have SI units. A recording of several
runs has one parent entity per run.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import rerun as rr
import rerun_bindings as bindings
from rerun.blueprint import Blueprint

from srs_twin.comparison.centre_line import line_height
from srs_twin.errors import InputError
from srs_twin.io.files import atomic_write
from srs_twin.robot.spec import RobotSpec
from srs_twin.trajectory import Trajectory
from srs_twin.viewing.additions import RunPictures, added_to, additions
from srs_twin.viewing.content import RunContent, events_of
from srs_twin.viewing.plots.signals import (
    forward_speed,
    gait_period,
    kind_of,
    period_speed,
    pressure_difference,
)
from srs_twin.viewing.plots.style import (
    MINUS_COLOR,
    PLUS_COLOR,
    REFERENCE,
    Style,
    style_of,
)
from srs_twin.viewing.rerun.blueprint import (
    CAMERA_TARGET,
    Layout,
    run_blueprint,
    side_by_side_blueprint,
)
from srs_twin.viewing.rerun.scene import (
    Entities,
    send_contacts,
    send_lines,
    send_objects,
    send_obstacles,
    send_snake,
)
from srs_twin.viewing.rerun.viewer import verify_recording

if TYPE_CHECKING:
    from rerun.chunk import Chunk

    from srs_twin.comparison.compare import MeasuredDifference


APPLICATION = "srs_twin"
SCENE_HZ = 50.0
"""Approximate maximum sample rate of moving shapes, Hz.

Plotted signals keep all samples.
"""

_WARNINGS = ("saturation", "fault", "reading_lost", "no_new_plan", "contact", "ended")
"""Event kinds logged as warnings."""

_READING_WIDTH = 0.6
"""Line width of sensor readings, points."""

_CHAMBER_COLORS = {"plus": PLUS_COLOR, "minus": MINUS_COLOR}
# Unlike black, grey is visible on dark and light backgrounds.
_REFERENCE = replace(REFERENCE, color="#8a8a8a")


def write_recording(path: str | Path, content: RunContent, *, title: str = "") -> None:
    """Write a Rerun recording of a run.

    The default `title` is the title of the robot.
    """
    trajectories = content.trajectories
    residuals = {
        plant: _residuals(difference) for plant, difference in content.measured.items()
    }
    log = rr.RecordingStream(APPLICATION)
    # On a full disk, `log.save` would leave an incomplete recording, sometimes without
    # an error.
    memory = log.memory_recording()
    send_blueprint(log, run_blueprint(_layout(content, residuals)))
    log.set_log_time_enabled(False)
    log.set_log_tick_enabled(False)
    log.send_recording_name(title or content.spec.title)
    scene = Entities(log, np.zeros(0), "world/")
    _send_floor(scene, trajectories, content.spec)
    send_obstacles(scene, content.world)
    for run in trajectories.values():
        if added := added_to(run):
            send_lines(scene, added.floor_lines(run))
            break
    _send_camera_target(log, trajectories)
    for index, plant in enumerate(trajectories):
        _send_plant(log, content, plant, index)
    comparison = content.comparison
    if comparison is not None:
        errors = {"shape": comparison.shape_error, "path": comparison.path_error}
        for index, (name, error) in enumerate(errors.items()):
            to = Entities(log, comparison.time, "comparison/")
            to.line(name, 1e3 * error, style_of(name, index))
    for index, (plant, errors) in enumerate(residuals.items()):
        to = Entities(log, content.measured[plant].comparison.time, "measured/")
        for name, error in errors.items():
            to.line(f"{name}/{plant}", error, style_of(plant, index))
    Path(path).write_bytes(_drain(log, memory))


def _send_plant(
    log: rr.RecordingStream, content: RunContent, plant: str, index: int
) -> None:
    run = content.trajectories[plant]
    spec = content.spec
    style = replace(style_of(plant, index), label=plant)
    ghost = plant != "twin" and "twin" in content.trajectories
    shapes = subsample(run, SCENE_HZ)
    body = Entities(log, shapes.time, f"world/{plant}/")
    send_snake(body, shapes, spec, style, ghost=ghost)
    send_objects(body, shapes, content.world)
    signals = Entities(log, run.time)
    send_contacts(replace(signals, root=body.root), run, line_height(spec.geometry))
    _send_modules(signals, plant, run, style)
    _send_motion(signals, plant, run, style)
    _send_events(log, plant, run, style)


def _drain(log: rr.RecordingStream, memory: rr.MemoryRecording) -> bytes:
    content: bytes = memory.drain_as_bytes()
    log.disconnect()
    # Without this call, Rerun would keep threads and memory of closed streams.
    bindings.flush_and_cleanup_orphaned_recordings()
    return content


def _residuals(difference: MeasuredDifference) -> dict[str, np.ndarray]:
    signals = difference.signals()
    errors = {
        name: 1e3 * signals[f"{name}_m"]
        for name in ("shape", "path")
        if f"{name}_m" in signals
    }
    return errors | {"bend": difference.bend_rms}


def send_blueprint(log: rr.RecordingStream, blueprint: Blueprint) -> None:
    """Send a blueprint like `log.send_blueprint`, but without a resource leak.

    Rerun 0.41 leaves an auxiliary stream open, which costs two threads and 2 MB of
    memory for each recording.
    """
    carrier = rr.RecordingStream._from_native(  # noqa: SLF001
        bindings.new_blueprint(
            application_id=APPLICATION,
            make_default=False,
            make_thread_default=False,
            default_enabled=True,
        )
    )
    carrier.set_time("blueprint", sequence=0)
    blueprint._log_to_stream(carrier)  # noqa: SLF001
    content = carrier.memory_recording()
    # The blueprint becomes the active layout and the default layout. Otherwise, the
    # viewer would reuse the layout of another robot.
    bindings.send_blueprint(content.storage, True, True, recording=log.to_native())
    carrier.disconnect()


def subsample(trajectory: Trajectory, rate_hz: float) -> Trajectory:
    """Return a trajectory with the sample rate reduced to about `rate_hz`."""
    steps = np.diff(trajectory.time[:2])
    stride = 1
    if len(steps) and steps[0] > 0:
        stride = max(1, round(1 / (rate_hz * steps[0])))
    columns = {name: column[::stride] for name, column in trajectory.columns.items()}
    return replace(trajectory, columns=columns)


def _layout(
    content: RunContent, residuals: Mapping[str, Mapping[str, np.ndarray]]
) -> Layout:
    trajectories = content.trajectories
    spec = content.spec
    followed = trajectories.get("twin") or next(iter(trajectories.values()))
    _, coms = _coms(trajectories)
    # The speed axis includes zero, because a truncated axis exaggerates differences.
    speeds = np.concatenate(
        [[0.0, 1e-3], *(_speed(run)[1] for run in trajectories.values())]
    )
    quantities = [name for errors in residuals.values() for name in errors]
    added = next(filter(None, map(added_to, trajectories.values())), RunPictures())
    return Layout(
        plants=list(trajectories),
        segments=spec.segments,
        start=coms[:, 0].mean(axis=0),
        heading=float(followed["heading"][0]),
        body_length=spec.geometry.body_length,
        separation=_separation(coms),
        period=gait_period(followed),
        compared=content.comparison is not None,
        measured=list(dict.fromkeys(quantities)),
        kind=kind_of(trajectories),
        signals=added.signals,
        speeds=(1.1 * float(speeds.min()), 1.1 * float(speeds.max())),
        events=any(map(events_of, trajectories.values())),
    )


def _coms(trajectories: Mapping[str, Trajectory]) -> tuple[np.ndarray, np.ndarray]:
    time = max((run.time for run in trajectories.values()), key=lambda times: times[-1])
    runs = trajectories.values()
    coms = [
        [np.interp(time, run.time, coordinate) for coordinate in run.com.T]
        for run in runs
    ]
    return time, np.array(coms).transpose(0, 2, 1)


def _separation(coms: np.ndarray) -> float:
    return 2 * float(np.linalg.norm(coms - coms.mean(axis=0), axis=-1).max())


def _send_camera_target(
    log: rr.RecordingStream, trajectories: Mapping[str, Trajectory]
) -> None:
    time, coms = _coms(trajectories)
    to = Entities(log, time, "world/")
    positions = np.pad(coms.mean(axis=0), ((0, 0), (0, 1)))
    to.static(CAMERA_TARGET, rr.Points3D.from_fields(radii=[1e-5]))
    to.send(CAMERA_TARGET, rr.Points3D.columns(positions=positions))


def _send_floor(
    to: Entities, trajectories: Mapping[str, Trajectory], spec: RobotSpec
) -> None:
    points = np.concatenate(
        [run.position.reshape(-1, 2) for run in trajectories.values()]
    )
    margin = spec.geometry.half_track + spec.geometry.pitch
    low = np.min(points, axis=0) - margin
    high = np.max(points, axis=0) + margin
    border = 0.25 * float(np.hypot(*(high - low)))
    (x0, y0), (x1, y1) = low - border, high + border
    corners = [[x0, y0, -0.001], [x1, y0, -0.001], [x1, y1, -0.001], [x0, y1, -0.001]]
    triangles = [[0, 1, 2], [0, 2, 3]]
    floor = rr.Mesh3D(
        vertex_positions=corners,
        triangle_indices=triangles,
        albedo_factor=[228, 230, 233],
    )
    replace(to, root="").static("world", rr.ViewCoordinates.RIGHT_HAND_Z_UP)
    to.static("floor", floor)


def _send_modules(to: Entities, plant: str, run: Trajectory, style: Style) -> None:
    """Log the signals of all modules, without the readings of ideal sensors."""

    def send(name: str, values: np.ndarray, style: Style, steps: bool = False) -> None:
        for j, value in enumerate(values.T, start=1):
            to.line(f"module/{j}/{name}", value, style, steps=steps)

    bends = run.stack("bend")
    pressures = pressure_difference(run)
    send(f"bend/{plant}", bends, style)
    if np.isfinite(pressures).any():
        send(f"pressure/{plant}", 1e-3 * pressures, style)
    if run.has("reference_1"):
        send("bend/reference", run.stack("reference"), _REFERENCE)
    if run.has("valve_plus"):
        states = (run.stack("valve_plus") - run.stack("valve_minus")) / 2
        send(f"valve/{plant}", states, style, steps=True)
    if run.has("measured_bend") and not np.array_equal(
        run.stack("measured_bend"), bends
    ):
        thin = replace(style, label=f"{style.label}, sensed", width=_READING_WIDTH)
        send(f"sensed/{plant}", run.stack("measured_bend"), thin)
    for side, color in _CHAMBER_COLORS.items():
        if run.has(f"duty_{side}"):
            colored = replace(style, label=f"{style.label}, {side}", color=color)
            send(f"duty/{plant}/{side}", run.stack(f"duty_{side}"), colored, steps=True)


def _send_motion(to: Entities, plant: str, run: Trajectory, style: Style) -> None:
    for signal in (signal for added in additions() for signal in added.signals):
        if run.has(signal.column):
            values = signal.factor * run[signal.column]
            to.line(f"follow/{signal.entity}/{plant}", values, style)
    to.line(f"body/heading/{plant}", run["heading"], style)
    time, speed = _speed(run)
    replace(to, time=time).line(f"body/speed/{plant}", speed, style)


def _speed(run: Trajectory) -> tuple[np.ndarray, np.ndarray]:
    period = gait_period(run)
    if period is None:
        return run.time, forward_speed(run)
    return period_speed(run, period)


def _send_events(
    log: rr.RecordingStream, plant: str, run: Trajectory, style: Style
) -> None:
    events = events_of(run)
    if not events:
        return
    columns = rr.TextLog.columns(
        text=[f"{event.kind}: {event.text}" for event in events],
        level=["WARN" if event.kind in _WARNINGS else "INFO" for event in events],
        color=[style.rgb] * len(events),
    )
    Entities(log, np.array([event.time for event in events])).send(
        f"events/{plant}", columns
    )


@dataclass(frozen=True)
class _StoredRun:
    name: str
    chunks: tuple[Chunk, ...]

    @property
    def root(self) -> str:
        return rr.escape_entity_path_part(self.name)

    @property
    def snakes(self) -> list[str]:
        """Names of the plants, recognised by their centre-of-mass entities."""
        paths = (chunk.entity_path.split("/") for chunk in self.chunks)
        return list(
            dict.fromkeys(path[2] for path in paths if path[1::2] == ["world", "com"])
        )

    def points(self, entity: str, component: str, rows: int | None = 1) -> np.ndarray:
        """Return points of the first `rows` samples (None for all), shape (n, 3), m."""
        for chunk in self.chunks:
            if chunk.entity_path == entity and not chunk.is_static:
                batch = chunk.to_record_batch()
                if component in batch.schema.names:
                    points = batch.column(component).slice(0, rows).flatten().flatten()
                    return np.asarray(points.to_numpy(zero_copy_only=False)).reshape(
                        -1, 3
                    )
        raise InputError(
            f"{self.name}: the file was not recorded by srs-twin, because {entity}"
            f" has no {component}"
        )

    def layout(self) -> Layout:
        snakes = self.snakes
        if not snakes:
            raise InputError(
                f"{self.name}: the file was not recorded by srs-twin, because it"
                " contains no snake"
            )
        followed = "twin" if "twin" in snakes else snakes[0]
        connectors = self.points(f"/world/{followed}/connectors", "Boxes3D:centers")[
            :, :2
        ]
        along = connectors[0] - connectors[-1]
        paths = [
            self.points(f"/world/{plant}/com", "Points3D:positions", None)[:, :2]
            for plant in snakes
        ]
        coms = np.array([path[: min(map(len, paths))] for path in paths])
        return Layout(
            plants=snakes,
            segments=len(connectors) - 1,
            start=coms[:, 0].mean(axis=0),
            heading=float(np.arctan2(along[1], along[0])),
            body_length=float(np.hypot(*along)),
            separation=_separation(coms),
            root=self.root,
        )


def write_side_by_side(path: str | Path, recordings: Mapping[str, Path]) -> None:
    """Write a recording that shows several recorded runs side by side."""
    from rerun.chunk import RrdReader

    runs = []
    for name, recording in recordings.items():
        verify_recording(recording)
        reader = RrdReader(recording)
        stored, *_ = reader.recordings()
        # Entities whose names begin with `__` contain properties of the file.
        chunks = reader.stream(store=stored).to_chunks()
        kept = (chunk for chunk in chunks if not chunk.entity_path.startswith("/__"))
        runs.append(_StoredRun(name, tuple(kept)))
    log = rr.RecordingStream(APPLICATION)
    memory = log.memory_recording()
    layouts = {run.name: run.layout() for run in runs}
    send_blueprint(log, side_by_side_blueprint(layouts))
    log.send_recording_name(" | ".join(recordings))
    for run in runs:
        moved = [
            chunk.with_entity_path(f"/{run.root}{chunk.entity_path}")
            for chunk in run.chunks
        ]
        log.send_chunks(moved)
    content = _drain(log, memory)
    with atomic_write(path) as temporary:
        temporary.write_bytes(content)
