"""Finished runs as Rerun recordings, whole columns at once; nothing is logged while they simulate.

Entity tree: `world/floor`, `world/eye` (what the camera follows), `world/obstacles`,
`world/plan/{path, edges, goal}`,
`world/<plant>/{body/segment_j, connectors, wheels, spokes, trail, com, contact}`,
`module/<j>/{bend, pressure, valve, sensed, duty}/<plant>`, `follow/{cross_track, offset}/<plant>`,
`events/<plant>` (text: what the controller did, and touching obstacles), `body/{speed, heading}/<plant>`,
`comparison/{shape, path}`, `measured/{shape, path, bend}/<plant>`.
The time line is `sim_time`, in seconds of simulation. SI, except pressures in kPa and differences in mm,
as the views' names say.

Several recordings in one file lie beneath their names; its blueprint shows them side by side.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import rerun as rr
from rerun.blueprint import Blueprint

from srs_twin.comparison.contacts import touches
from srs_twin.errors import InputError
from srs_twin.io.files import atomic_write
from srs_twin.robot.spec import RobotSpec
from srs_twin.robot.world import World
from srs_twin.trajectory import Event, Trajectory
from srs_twin.viewing.additions import FloorLine, RunPictures, added_to, additions
from srs_twin.viewing.plots.signals import (
    check_drawable,
    forward_speed,
    gait_period,
    kind_of,
    period_speed,
    pressure_difference,
)
from srs_twin.viewing.plots.style import MINUS_COLOR, PLUS_COLOR, REFERENCE, Style, style_of
from srs_twin.viewing.rerun.blueprint import Layout, run_blueprint, side_by_side_blueprint
from srs_twin.viewing.rerun.scene import (
    Entities,
    line_height,
    send_contacts,
    send_lines,
    send_obstacles,
    send_snake,
)
from srs_twin.viewing.rerun.viewer import verify_recording

if TYPE_CHECKING:
    from rerun.chunk import Chunk

    from srs_twin.comparison.compare import Comparison, MeasuredDifference


APPLICATION = "srs_twin"
SCENE_HZ = 50.0
"""Shapes are kept at most this often; plots keep every sample."""

_EYE = "eye"
_WARNINGS = ("saturation", "fault", "reading_lost", "no_new_plan", "contact", "ended")
_READING_WIDTH = 0.6
_SIDES = {"plus": PLUS_COLOR, "minus": MINUS_COLOR}
# The viewer may be dark or light: black would not be seen in one of them.
_REFERENCE = replace(REFERENCE, color="#8a8a8a")


def write_recording(
    path: str | Path,
    *,
    spec: RobotSpec,
    trajectories: Mapping[str, Trajectory],
    comparison: Comparison | None = None,
    title: str = "",
    world: World | None = None,
    measured: Mapping[str, MeasuredDifference] | None = None,
) -> None:
    """Write `recording.rrd`: both snakes on the floor, and their signals side by side in plots.

    Args:
        path: file to write; an existing one is replaced.
        spec: the robot that ran.
        trajectories: plant → what it did. With a twin, the other plants are ghosts.
        comparison: gives the plots of shape and path difference.
        title: the recording's name in the viewer.
        world: whose obstacles stand on the floor; None: there are none.
        measured: plant → how far it is from the measured robot; gives plots of it.

    Raises:
        InputError: there is no trajectory, or one of them is empty.
    """
    check_drawable(trajectories)
    residuals = {plant: _residuals(difference) for plant, difference in (measured or {}).items()}
    told = list(dict.fromkeys(name for each in residuals.values() for name in each))
    log = rr.RecordingStream(APPLICATION)
    # Not `log.save`: where the disk is full that leaves a part of a recording, and at worst no error.
    memory = log.memory_recording()
    send_blueprint(log, run_blueprint(_layout(trajectories, spec, comparison is not None, told)))
    log.set_log_time_enabled(False)
    log.set_log_tick_enabled(False)
    log.send_recording_name(title or spec.title)
    still = Entities(log, np.zeros(0), "world/")
    _send_floor(still, trajectories, spec)
    send_obstacles(still, world or World())
    send_lines(still, next((added.floor_lines(run) for run, added in _added(trajectories)), []))
    _send_eye(log, trajectories)
    for index, (plant, run) in enumerate(trajectories.items()):
        style = replace(style_of(plant, index), label=plant)
        ghost = plant != "twin" and "twin" in trajectories
        scene = thinned(run, SCENE_HZ)
        send_snake(Entities(log, scene.time, f"world/{plant}/"), scene, spec.geometry, style, ghost=ghost)
        send_contacts(Entities(log, run.time, f"world/{plant}/"), run, line_height(spec.geometry))
        _send_modules(Entities(log, run.time), plant, run, style)
        _send_motion(Entities(log, run.time), plant, run, style)
        _send_events(log, plant, run, style)
    if comparison is not None:
        errors = {"shape": comparison.shape_error, "path": comparison.path_error}
        for index, (name, error) in enumerate(errors.items()):
            to = Entities(log, comparison.time, "comparison/")
            to.line(name, 1e3 * error, style_of(name, index))
    for index, (plant, found) in enumerate(residuals.items()):
        for name, error in found.items():
            to = Entities(log, (measured or {})[plant].comparison.time, "measured/")
            to.line(f"{name}/{plant}", error, style_of(plant, index))
    Path(path).write_bytes(_drained(log, memory))


def write_floor(path: str | Path, title: str, world: World, lines: Sequence[FloorLine]) -> None:
    """Write a recording of a world and lines on its floor.

    Args:
        path: file to write; an existing one is replaced.
        title: name of the recording in the viewer.
        world: obstacles.
        lines: on the floor.
    """
    log = rr.RecordingStream(APPLICATION)
    memory = log.memory_recording()
    log.set_log_time_enabled(False)
    log.set_log_tick_enabled(False)
    log.send_recording_name(title)
    to = Entities(log, np.zeros(0), "world/")
    send_obstacles(to, world)
    send_lines(to, lines)
    Path(path).write_bytes(_drained(log, memory))


def _drained(log: rr.RecordingStream, memory: rr.MemoryRecording) -> bytes:
    """Return what went through a stream, and end it."""
    content: bytes = memory.drain_as_bytes()
    log.disconnect()
    # A stream that nobody refers to any more keeps its threads and what went through it until it is told.
    rr.bindings.flush_and_cleanup_orphaned_recordings()
    return content


def _residuals(difference: MeasuredDifference) -> dict[str, np.ndarray]:
    """Return what was measured of shape and path (mm) and bends (RMS over segments, rad), shape (T,) each."""
    signals = difference.signals()
    errors = {name: 1e3 * signals[f"{name}_m"] for name in ("shape", "path") if f"{name}_m" in signals}
    return errors | {"bend": difference.bend_rms}


def send_blueprint(log: rr.RecordingStream, blueprint: Blueprint) -> None:
    """Send a blueprint as `log.send_blueprint` does, but end the stream that carries it.

    Rerun 0.41 forgets to: every recording of a process would leave two threads and two megabytes.
    """
    carrier = rr.RecordingStream._from_native(
        rr.bindings.new_blueprint(
            application_id=APPLICATION, make_default=False, make_thread_default=False, default_enabled=True
        )
    )
    carrier.set_time("blueprint", sequence=0)
    blueprint._log_to_stream(carrier)
    content = carrier.memory_recording()
    # Active, not only default: a viewer that has shown another robot before must not keep its layout.
    rr.bindings.send_blueprint(content.storage, True, True, recording=log.to_native())
    carrier.disconnect()


def thinned(trajectory: Trajectory, rate_hz: float) -> Trajectory:
    """Return every n-th sample, so that at most `rate_hz` remain."""
    steps = np.diff(trajectory.time[:2])
    every = max(1, round(1 / (rate_hz * steps[0]))) if len(steps) and steps[0] > 0 else 1
    columns = {name: column[::every] for name, column in trajectory.columns.items()}
    return Trajectory(columns, trajectory.units, trajectory.events, trajectory.metadata)


def _added(trajectories: Mapping[str, Trajectory]) -> Iterator[tuple[Trajectory, RunPictures]]:
    """Yield the runs that an extension adds pictures to, with its additions."""
    for run in trajectories.values():
        if added := added_to(run):
            yield run, added


def _layout(
    trajectories: Mapping[str, Trajectory], spec: RobotSpec, compared: bool, measured: Sequence[str]
) -> Layout:
    followed = trajectories.get("twin") or next(iter(trajectories.values()))
    _, coms = _coms(trajectories)
    # With zero: an axis cut off makes a small difference look large.
    speeds = np.concatenate([[0.0, 1e-3], *(_speed(run)[1] for run in trajectories.values())])
    return Layout(
        plants=list(trajectories),
        eye=_EYE,
        segments=spec.segments,
        start=coms[:, 0].mean(axis=0),
        heading=float(followed["heading"][0]),
        body_length=spec.geometry.body_length,
        apart=_apart(coms),
        period=gait_period(followed),
        compared=compared,
        measured=measured,
        kind=kind_of(trajectories),
        signals=next((added.signals for _, added in _added(trajectories)), ()),
        speeds=(1.1 * float(speeds.min()), 1.1 * float(speeds.max())),
        events=any(map(events_of, trajectories.values())),
    )


def _coms(trajectories: Mapping[str, Trajectory]) -> tuple[np.ndarray, np.ndarray]:
    """Return times (T,) in s and all centres of mass (plants, T, 2) in m; they stay where a run ended."""
    time = max((run.time for run in trajectories.values()), key=lambda each: each[-1])
    runs = trajectories.values()
    coms = [np.column_stack([np.interp(time, run.time, each) for each in run.com.T]) for run in runs]
    return time, np.array(coms)


def _apart(coms: np.ndarray) -> float:
    """Return twice the greatest distance of a centre of mass (plants, T, 2) from the middle of all, m."""
    return 2 * float(np.linalg.norm(coms - coms.mean(axis=0), axis=-1).max())


def _send_eye(log: rr.RecordingStream, trajectories: Mapping[str, Trajectory]) -> None:
    """Log what the camera follows: the middle of all plants, as a point too small to be seen."""
    time, coms = _coms(trajectories)
    to, places = Entities(log, time, "world/"), np.pad(coms.mean(axis=0), ((0, 0), (0, 1)))
    to.fixed(_EYE, rr.Points3D.from_fields(radii=[1e-5]))
    to.moving(_EYE, rr.Points3D.columns(positions=places))


def _send_floor(to: Entities, trajectories: Mapping[str, Trajectory], spec: RobotSpec) -> None:
    points = np.concatenate([run.position.reshape(-1, 2) for run in trajectories.values()])
    margin = spec.geometry.half_track + spec.geometry.pitch
    low, high = np.min(points, axis=0) - margin, np.max(points, axis=0) + margin
    beyond = 0.25 * float(np.hypot(*(high - low)))
    (x0, y0), (x1, y1) = low - beyond, high + beyond
    corners = [[x0, y0, -0.001], [x1, y0, -0.001], [x1, y1, -0.001], [x0, y1, -0.001]]
    triangles = [[0, 1, 2], [0, 2, 3]]
    floor = rr.Mesh3D(vertex_positions=corners, triangle_indices=triangles, albedo_factor=[228, 230, 233])
    replace(to, root="").fixed("world", rr.ViewCoordinates.RIGHT_HAND_Z_UP)
    to.fixed("floor", floor)


def _send_modules(to: Entities, plant: str, run: Trajectory, style: Style) -> None:
    """Log `module/<j>/{bend, pressure, valve}/<plant>`, and `sensed` and `duty` where they say more.

    The state of a module's valves is 1 where they drive towards positive bends, −1 towards negative ones, 0
    where both do the same.
    """

    def send(signal: str, values: np.ndarray, look: Style, name: str = plant, steps: bool = False) -> None:
        for j, each in enumerate(values.T, start=1):
            to.line(f"module/{j}/{signal}/{name}", each, look, steps=steps)

    bends, pressures = run.stack("bend"), pressure_difference(run)
    send("bend", bends, style)
    if np.isfinite(pressures).any():
        send("pressure", 1e-3 * pressures, style)
    if run.has("reference_1"):
        send("bend", run.stack("reference"), _REFERENCE, "reference")
    if run.has("valve_plus"):
        send("valve", (run.stack("valve_plus") - run.stack("valve_minus")) / 2, style, steps=True)
    if run.has("sensed") and not np.array_equal(run.stack("sensed"), bends):
        thin = replace(style, label=f"{style.label}, sensed", width=_READING_WIDTH)
        send("sensed", run.stack("sensed"), thin)
    for side, color in _SIDES.items():
        if run.has(f"duty_{side}"):
            look = replace(style, label=f"{style.label}, {side}", color=color)
            send("duty", run.stack(f"duty_{side}"), look, f"{plant}/{side}", steps=True)


def _send_motion(to: Entities, plant: str, run: Trajectory, style: Style) -> None:
    """Log heading and speed of the body, and how it keeps to a plan."""
    for added in additions():
        for signal in added.signals:
            if run.has(signal.column):
                to.line(f"follow/{signal.entity}/{plant}", signal.factor * run[signal.column], style)
    to.line(f"body/heading/{plant}", run["heading"], style)
    time, speed = _speed(run)
    replace(to, time=time).line(f"body/speed/{plant}", speed, style)


def _speed(run: Trajectory) -> tuple[np.ndarray, np.ndarray]:
    """Return times (s) and speeds (m/s), over a gait period where there is one."""
    period = gait_period(run)
    return (run.time, forward_speed(run)) if period is None else period_speed(run, period)


def events_of(run: Trajectory) -> list[Event]:
    """Return a run's events and its contacts with obstacles, in order of time."""
    return sorted([*run.events, *_contacts(run), *_end(run)], key=lambda event: event.time)


def _send_events(log: rr.RecordingStream, plant: str, run: Trajectory, style: Style) -> None:
    """Log a run's events as `events/<plant>`; nothing where there are none."""
    events = events_of(run)
    if not events:
        return
    columns = rr.TextLog.columns(
        text=[f"{event.kind}: {event.text}" for event in events],
        level=["WARN" if event.kind in _WARNINGS else "INFO" for event in events],
        color=[style.rgb] * len(events),
    )
    Entities(log, np.array([event.time for event in events])).moving(f"events/{plant}", columns)


def _contacts(run: Trajectory) -> Iterator[Event]:
    for touch in touches(run):
        # One that a single sample saw is shorter than what lies between samples.
        lasted = f", for {touch.end - touch.begin:.2g} s" if touch.end > touch.begin else ""
        text = f"connector {touch.connector}, at most {touch.force:.2g} N{lasted}"
        yield Event(touch.begin, "contact", text)


def _end(run: Trajectory) -> Iterator[Event]:
    by = run.metadata.get("ended_by")
    if by is not None:
        yield Event(float(run.time[-1]), "ended", f"the run, by its {by}")


@dataclass(frozen=True)
class _Part:
    """One of the recordings.

    Attributes:
        name: what it is called.
        chunks: all that it holds.
    """

    name: str
    chunks: tuple[Chunk, ...]

    @property
    def root(self) -> str:
        """The entity that everything of it lies beneath."""
        return rr.escape_entity_path_part(self.name)

    @property
    def snakes(self) -> list[str]:
        """Names under world/ of what has a centre of mass."""
        paths = (chunk.entity_path.split("/") for chunk in self.chunks)
        return list(dict.fromkeys(path[2] for path in paths if path[1::2] == ["world", "com"]))

    def points(self, entity: str, component: str, rows: int | None = 1) -> np.ndarray:
        """Return the first rows (None: all) of a component with points, shape (n, 3)."""
        for chunk in self.chunks:
            if chunk.entity_path == entity and not chunk.is_static:
                batch = chunk.to_record_batch()
                if component in batch.schema.names:
                    points = batch.column(component).slice(0, rows).flatten().flatten()
                    return np.asarray(points.to_numpy(zero_copy_only=False)).reshape(-1, 3)
        raise InputError(f"{self.name}: not a recording of srs-twin (it has no {component} at {entity})")

    def layout(self) -> Layout:
        """Return where the eye is to be."""
        snakes = self.snakes
        if not snakes:
            raise InputError(f"{self.name}: not a recording of srs-twin (no snake is in it)")
        followed = "twin" if "twin" in snakes else snakes[0]
        connectors = self.points(f"/world/{followed}/connectors", "Boxes3D:centers")[:, :2]
        along = connectors[0] - connectors[-1]
        paths = [self.points(f"/world/{each}/com", "Points3D:positions", None)[:, :2] for each in snakes]
        coms = np.array([path[: min(map(len, paths))] for path in paths])
        seen = any(chunk.entity_path == f"/world/{_EYE}" for chunk in self.chunks)
        return Layout(
            plants=snakes,
            eye=_EYE if seen else f"{followed}/com",  # recordings before 2026-11 have none
            segments=len(connectors) - 1,
            start=coms[:, 0].mean(axis=0),
            heading=float(np.arctan2(along[1], along[0])),
            body_length=float(np.hypot(*along)),
            apart=_apart(coms),
            period=None,
            compared=False,
            root=self.root,
        )


def write_side_by_side(path: str | Path, recordings: Mapping[str, Path]) -> None:
    """Write one recording of several: each on a floor of its own, above its speed and heading.

    Args:
        path: file to write.
        recordings: name → file of `write_recording`; names differ.

    Raises:
        InputError: one of them is none, or the file cannot be written.
    """
    from rerun.chunk import RrdReader

    parts = []
    for name, recording in recordings.items():
        verify_recording(recording)
        reader = RrdReader(recording)
        (stored, *_) = reader.recordings()
        # Properties tell of the recording as a whole.
        chunks = (c for c in reader.stream(store=stored).to_chunks() if not c.entity_path.startswith("/__"))
        parts.append(_Part(name, tuple(chunks)))
    log = rr.RecordingStream(APPLICATION)
    memory = log.memory_recording()
    send_blueprint(log, side_by_side_blueprint({part.name: part.layout() for part in parts}))
    log.send_recording_name(" | ".join(recordings))
    for part in parts:
        log.send_chunks([chunk.with_entity_path(f"/{part.root}{chunk.entity_path}") for chunk in part.chunks])
    content = _drained(log, memory)
    with atomic_write(path) as beside:
        beside.write_bytes(content)
