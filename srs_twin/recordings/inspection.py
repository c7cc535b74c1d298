"""Inspection of recordings without a robot file.

The inspection detects the file format, clock, axes, markers and possible heads, and
proposes a recording map.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import TYPE_CHECKING, cast

import numpy as np

from srs_twin.errors import InputError, named_in_errors
from srs_twin.io.arguments import checked
from srs_twin.io.files import StrPath
from srs_twin.recordings.body.floor import Up, map_to_floor
from srs_twin.recordings.body.layout import (
    LAYOUT_SIZES,
    MIN_COVERAGE,
    body_order,
    distance_statistics,
    forward_distance,
)
from srs_twin.recordings.body.shape import marker_noise
from srs_twin.recordings.body.tracking import pairwise_distances
from srs_twin.recordings.csv_table import CLOCK, read_table
from srs_twin.recordings.facts import (
    DistanceFacts,
    HeadFacts,
    MarkerFacts,
    RecordingFacts,
    RobotFacts,
    SignalFacts,
    proposed_map,
)
from srs_twin.recordings.formats import identify, read_markers, read_topics
from srs_twin.recordings.formats.base import MarkerTable, axis_columns, in_unit
from srs_twin.recordings.formats.tables import PlainCsv
from srs_twin.recordings.formats.topics import RecordedTopics
from srs_twin.recordings.recorded_file import (
    RecordedFile,
    laid_out,
    read_file,
    start_of,
)
from srs_twin.recordings.recording import (
    LONGEST_GAP,
    in_slots,
    read_motion,
    robot_tracks,
)
from srs_twin.recordings.recording_map import (
    NO_MAP,
    RecordingMap,
    as_map,
    canonical_key,
    log_meaning,
)
from srs_twin.recordings.signals.gaps import (
    MIN_FRAMES,
    FrameGrid,
    at_frames,
    frame_grid,
    runs,
    time_order,
)
from srs_twin.recordings.signals.logs import read_bends, read_valves
from srs_twin.recordings.signals.units import (
    ANGLES,
    PRESSURES,
    QUANTITIES,
    Meaning,
    clean,
    stated_unit,
    symbol,
)
from srs_twin.robot.file import load_robot
from srs_twin.robot.spec import RobotSpec

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_RIGID_NOISE_RATIO = 1.3
"""Maximum ratio of the spread of a constant distance to the spread due to noise."""
_DISTANCE_FRAMES = 2000
_MIN_CRAWLED = 0.3
"""Minimum travelled distance for detecting the head, in marker spacings."""
_MAX_SIGNALS = 200
_QUANTITY_TEXTS = {
    "time": "time",
    "valve": "valve states",
    "duty": "duty",
    "pressure": "pressure, without a unit",
    "setpoint": "pressure, without a unit",
    "bend": "angle, without a unit",
}
_CHARACTER_HEIGHT_IN = 0.06
"""Height per character of a marker name (7 pt, rotated by 60°), inches."""
_MAX_NAME_HEIGHT_IN = 2.0
_MAX_NEIGHBOUR_M = 2.0


@dataclass(frozen=True)
class Scene:
    """Top view of the markers in a recording.

    Attributes:
        places: marker positions, m, shape (frames, markers, 2).
        order: marker indices in order along the body, or an empty tuple if unknown.
    """

    places: np.ndarray
    names: tuple[str, ...]
    order: tuple[int, ...] = ()
    rigid: tuple[tuple[int, int], ...] = ()


@checked
def inspect(
    path: StrPath,
    *,
    map: RecordingMap | Mapping[str, object] | StrPath = NO_MAP,  # noqa: A002
    robot: StrPath | RobotSpec | None = None,
) -> RecordingFacts:
    """Describe a recording and propose a map, like the command `srs-twin inspect`.

    Args:
        path: path of a motion recording, or of a log with valve states, pressures or
            bends.
        map: recording map, given as an object, a mapping or a path.
        robot: robot against which the recording is checked, or None.

    Raises:
        InputError: the file cannot be read.
    """
    spec = None if robot is None else load_robot(robot)
    return inspect_file(path, as_map(map), spec)[0]


def inspect_file(
    path: StrPath, recording_map: RecordingMap, spec: RobotSpec | None
) -> tuple[RecordingFacts, Scene | None]:
    """Return the facts about a file, and the scene if the file contains markers.

    If `spec` is given, the file is also read as a recording or log of this robot.
    """
    facts, scene = _file_facts(path, recording_map)
    if spec is not None:
        try:
            if facts.content == "markers":
                facts.robot = _motion_of_robot(path, recording_map, spec)
            else:
                facts.robot = _log_of_robot(path, recording_map, spec, facts)
        except InputError as error:
            facts.robot = RobotFacts(name=spec.name, reads=False, says=str(error))
    facts.proposals = proposed_map([facts]).splitlines()
    return facts, scene


def _file_facts(
    path: StrPath, recording_map: RecordingMap
) -> tuple[RecordingFacts, Scene | None]:
    start = start_of(path, recording_map.dialect)
    timed = {clean(name) for name in recording_map.meanings(["time"])}
    kind = PlainCsv.name
    if timed.isdisjoint(start.names):
        kind = identify(path, recording_map.dialect)
    if kind == PlainCsv.name:
        file = laid_out(read_file(path), recording_map.dialect)
        if not axis_columns(file.names):
            return _table_facts(file, recording_map), None
    topics = read_topics(path)
    table = None if topics is None else topics.markers
    if topics is not None and table is None and topics.signals:
        return _topics_facts(topics, kind, recording_map), None
    if table is None:
        table = read_markers(path, recording_map.unstated)
    else:
        table = in_unit(table, recording_map.units)
    with named_in_errors(table.name):
        facts, scene = _motion_facts(recording_map.applied(table), recording_map)
    if topics is not None:
        facts.signals = _topics_facts(topics, kind, recording_map).signals
    return facts, scene


def _topics_facts(
    topics: RecordedTopics, kind: str, recording_map: RecordingMap
) -> RecordingFacts:
    signals = list(topics.signals.items())[:_MAX_SIGNALS]
    time = max((times for _, (times, _) in signals), key=len, default=np.zeros(0))
    signal_facts = [
        _signal_facts(name, *series, recording_map) for name, series in signals
    ]
    return _log_facts(topics, kind, signal_facts, time)


def _motion_facts(
    table: MarkerTable, recording_map: RecordingMap
) -> tuple[RecordingFacts, Scene | None]:
    frames = frame_grid(table.time, table.points)
    facts = RecordingFacts(
        file=table.name,
        format=table.kind,
        content="markers",
        sha256=table.sha256,
        rate_hz=1 / frames.period,
        duration_s=float(frames.time[-1] - frames.time[0]),
        frames=int((frames.rows >= 0).sum()),
        frames_missing=int((frames.rows < 0).sum()),
        announced_frames=table.header_frames,
        units=table.unit,
        proposals=[],
        notes=[*table.corrections, *frames.corrections],
    )
    try:
        floor = map_to_floor(
            table.points,
            recording_map.up or "auto",
            table.usual_up,
            recording_map.level,
        )
    except InputError as error:
        facts.notes.append(str(error))
        return facts, None
    points = at_frames(floor.points, frames)
    has_rotation = np.zeros(len(table.labels), dtype=bool)
    if table.rotations is not None:
        has_rotation = np.isfinite(table.rotations).any(axis=(0, 2))
    facts.notes += floor.corrections
    facts.up = cast(Up, floor.up)
    facts.markers = [
        _marker_facts(name, points[:, k], frames, bool(has_rotation[k]))
        for k, name in enumerate(table.labels)
    ]
    facts.bodies = [marker.name for marker in facts.markers if marker.rigid_body]
    identified = replace(table, bodies=bool(facts.bodies))
    return facts, _body_facts(identified, points, frames, facts)


def _marker_facts(
    name: str, position: np.ndarray, frames: FrameGrid, rigid_body: bool
) -> MarkerFacts:
    missing = np.isnan(position[:, 0])
    gaps = runs(missing)
    inner = gaps[(gaps[:, 0] > 0) & (gaps[:, 1] < len(position))]
    longest = 0.0
    if len(inner):
        before, after = frames.time[inner - [1, 0]].T
        longest = float((after - before).max())
    noise = height = None
    if not missing.all():
        noise = marker_noise(position[:, None, :2])
        height = 1e3 * float(np.nanmedian(position[:, 2]))
    return MarkerFacts(
        name=name,
        rigid_body=rigid_body,
        coverage=float(1 - missing.mean()),
        gaps=len(inner),
        longest_gap_s=longest,
        noise_mm=None if noise is None else 1e3 * noise,
        noise_m=noise,
        height_mm=height,
    )


def _body_facts(
    table: MarkerTable, points: np.ndarray, frames: FrameGrid, facts: RecordingFacts
) -> Scene | None:
    slots = in_slots(table, points)
    near = _neighbour_distance(slots.points[..., :2])
    if np.isnan(near):
        facts.notes.append("no frame has two visible markers")
        return None
    if near > _MAX_NEIGHBOUR_M:
        facts.notes.append(
            f"neighbouring markers are {near:.3g} m apart; if the lengths are in mm,"
            " give --units mm"
        )
    tracks, notes = robot_tracks(table, slots, LONGEST_GAP / frames.period, 2 * near)
    facts.notes += notes
    lasting = (~np.isnan(tracks.points[..., 0])).mean(axis=0) >= MIN_COVERAGE
    places = tracks.points[:, lasting]
    count = places.shape[1]
    names = _marker_names(tracks.columns[:, lasting], table.labels, facts)
    facts.tracks = count
    facts.positions_of_nothing = tracks.unassigned
    scene = Scene(places, names)
    complete = places[np.isfinite(places[..., 0]).all(axis=1)]
    if len(complete) < MIN_FRAMES or count < 2:
        facts.notes.append(
            f"{len(complete)} frames show all {count} persistent markers"
        )
        return scene
    facts.layouts = _possible_layouts(count, bodies=table.bodies)
    noise = marker_noise(places)
    facts.noise_mm = 1e3 * noise
    median, spread = distance_statistics(complete)
    pairs = _rigid_pairs(median, spread, noise)
    facts.rigid_pairs = [[names[a], names[b]] for a, b in pairs]
    order = _order_along_body(complete, facts)
    facts.order = [names[k] for k in order]
    facts.distances = [
        DistanceFacts(
            markers=[names[a], names[b]],
            median_mm=1e3 * median[a, b],
            spread_mm=1e3 * spread[a, b],
        )
        for a, b in pairwise(order)
    ]
    heads = _heads(complete, frames.period, order, pairs, near)
    facts.head = [HeadFacts(marker=names[end], why=reason) for end, reason in heads]
    return replace(scene, order=tuple(order), rigid=tuple(pairs))


def _order_along_body(points: np.ndarray, facts: RecordingFacts) -> list[int]:
    try:
        order: list[int] = body_order(points).tolist()
    except InputError as error:
        facts.notes.append(str(error))
        return []
    return order


def _neighbour_distance(points: np.ndarray) -> float:
    nearest = np.fmin.reduce(pairwise_distances(points, _DISTANCE_FRAMES), axis=2)
    known = nearest[~np.isnan(nearest)]
    return float(np.median(known)) if known.size else math.nan


def _possible_layouts(markers: int, *, bodies: bool) -> dict[str, int]:
    if bodies:
        return {"pair": markers}  # a rigid body is replaced by two points
    connectors = {
        layout: divmod(markers - size.extra, size.per_connector)
        for layout, size in LAYOUT_SIZES.items()
    }
    return {layout: whole for layout, (whole, rest) in connectors.items() if rest == 0}


def _rigid_pairs(
    median: np.ndarray, spread: np.ndarray, noise: float
) -> list[tuple[int, int]]:
    closest = np.nanmin(median, axis=0)
    constant = spread < _RIGID_NOISE_RATIO * np.sqrt(2) * noise
    rigid = constant & (median <= 1.5 * np.minimum.outer(closest, closest))
    # On a body that hardly bends, many distances are nearly constant. Markers that have
    # a constant distance to several other markers are therefore excluded.
    single = rigid.sum(axis=0) == 1
    pairs = np.argwhere(np.triu(rigid & single & single[:, None]))
    return [(a, b) for a, b in pairs.tolist()]


def _marker_names(
    origin: np.ndarray, labels: Sequence[str], facts: RecordingFacts
) -> tuple[str, ...]:
    from scipy.optimize import linear_sum_assignment

    counts = np.stack(
        [np.bincount(column[column >= 0], minlength=len(labels)) for column in origin.T]
    )
    _, chosen = linear_sum_assignment(-counts)
    away = counts.sum() - counts[np.arange(len(chosen)), chosen].sum()
    facts.in_other_columns = float(away / counts.sum())
    if away > 0:
        facts.notes.append(
            f"{100 * facts.in_other_columns:.2g} % of the positions are not in the"
            " columns of their markers, because markers switch columns; a map that"
            " assigns markers by column name is therefore wrong in some frames"
        )
    return tuple(labels[k] for k in chosen)


def _heads(
    points: np.ndarray,
    period: float,
    order: Sequence[int],
    pairs: Sequence[tuple[int, int]],
    near: float,
) -> Iterator[tuple[int, str]]:
    if len(order) <= 2:
        return
    for end, second in (order[:2], order[:-3:-1]):
        if [{end, second}] == [set(pair) for pair in pairs]:
            yield end, "the only end with a second marker on a rigid part"
    crawled = forward_distance(period, points[:, order])
    if abs(crawled) > _MIN_CRAWLED * near:
        end = order[0 if crawled > 0 else -1]
        yield end, f"the body crawled {abs(crawled):.3g} m towards this end"


def _motion_of_robot(
    path: StrPath, recording_map: RecordingMap, spec: RobotSpec
) -> RobotFacts:
    recording = read_motion(path, spec, map=recording_map)
    length = recording.trajectory.stack("length")
    markers = recording.summary.markers
    low, median, high = np.quantile(length, [0.02, 0.5, 0.98], axis=0)
    assert markers is not None, "it is a recording of markers"
    return RobotFacts(
        name=spec.name,
        reads=True,
        says=recording.summary.text(),
        layout=markers.layout,
        bend_error_rad=markers.bend_error_rad,
        length_mm=(1e3 * median).tolist(),
        stretch=((high - low) / spec.geometry.segment_length).tolist(),
    )


def _log_of_robot(
    path: StrPath, recording_map: RecordingMap, spec: RobotSpec, facts: RecordingFacts
) -> RobotFacts:
    meanings = [_meaning(signal.name, recording_map) for signal in facts.signals or ()]
    kinds = {meaning.kind for meaning in meanings if meaning}
    lines = []
    if "bend" in kinds:
        bends = read_bends(path, spec, longest_gap_s=LONGEST_GAP, map=recording_map)
        lines.append(bends.summary.text())
    if kinds != {"bend"}:
        log = read_valves(path, spec, recording_map)
        lines.append(f"{log.source}: {log.kind} log, {len(log.time)} rows")
        lines += [f"corrected: {note}" for note in log.corrections]
    return RobotFacts(name=spec.name, reads=True, says="\n".join(lines))


def _meaning(name: str, recording_map: RecordingMap) -> Meaning | None:
    own = log_meaning(canonical_key(name))
    return recording_map.meanings(QUANTITIES).get(name, own)


def _table_facts(file: RecordedFile, recording_map: RecordingMap) -> RecordingFacts:
    timed = {
        name: meaning
        for name, meaning in recording_map.meanings(["time"]).items()
        if clean(name) in file.names
    }
    clock = next(iter(read_table(file, CLOCK, timed).columns), None)
    times = None
    unit = "no time"
    if clock is not None:
        times = file.times(clock.place, clock.unit)
        unit = f"time in {clock.unit}" if clock.unit else "time without a unit"
    time = None if times is None else times.time
    signals: list[SignalFacts] = []
    columns = []
    understood = []
    for k, name in enumerate(file.names[:_MAX_SIGNALS]):
        if clock is not None and k == clock.place:
            continue
        try:
            values = file.rows(file.header_lines, [k], len(file.names))[0][:, 0]
            columns.append(values)
            if _meaning(name, recording_map) is not None:
                understood.append(values)
            signals.append(_signal_facts(name, time, values, recording_map))
        except InputError as error:
            if "is not a number" not in str(error):
                raise
            signals.append(SignalFacts(name=name, looks_like="text", understood=False))
    facts = _log_facts(file, PlainCsv.name, signals, time)
    facts.notes = [f"a log of {len(signals)} signals, {unit}", *file.notes]
    if times is not None:
        facts.notes += times.notes
        try:
            # Other columns, such as a counter of received rows, are not read.
            read = np.transpose(understood or columns)
            facts.notes += time_order(times.time, read)[1]
        except InputError as error:
            facts.notes.append(f"`replay` and `calibrate` refuse this file: {error}")
        if facts.starts_s is not None:
            facts.starts_s += (times.epoch_ns or 0) / 1e9
    return facts


def _log_facts(
    source: RecordedFile | RecordedTopics,
    kind: str,
    signals: Sequence[SignalFacts],
    time: np.ndarray | None,
) -> RecordingFacts:
    facts = RecordingFacts(
        file=source.name,
        format=kind,
        content="log",
        sha256=source.sha256,
        signals=list(signals),
        proposals=[],
        notes=list(source.notes),
    )
    if time is not None and len(time) > 1:
        step = np.diff(time)
        facts.starts_s = float(time[0])
        facts.duration_s = float(np.ptp(time))
        facts.rows = len(time)
        facts.steps_back = int((step < 0).sum())
        facts.repeated_times = int((step == 0).sum())
        if facts.duration_s > 0:
            facts.rate_hz = (len(time) - 1) / facts.duration_s
    return facts


def _signal_facts(
    name: str, time: np.ndarray | None, values: np.ndarray, recording_map: RecordingMap
) -> SignalFacts:
    known = values[np.isfinite(values)]
    if not known.size:
        return SignalFacts(name=name, looks_like="nothing", understood=False)
    meaning = _meaning(name, recording_map)
    different = np.unique(known)
    high = float(different[-1])
    facts = SignalFacts(
        name=name,
        looks_like=_stated_quantity(name, known, meaning),
        understood=meaning is not None,
        low=float(different[0]),
        high=high,
        distinct=len(different),
    )
    if len(different) <= 3 and time is not None:
        opened = time[1:][(values[1:] == high) & (values[:-1] != high)]
        facts.openings_per_s = 0.0
        if len(opened) > 2 and np.ptp(opened) > 0:
            facts.openings_per_s = float(1 / np.median(np.diff(opened)))
    return facts


def _stated_quantity(name: str, values: np.ndarray, meaning: Meaning | None) -> str:
    def unit_in(units: Mapping[str, float]) -> str:
        given = (meaning.unit or meaning.default) if meaning else ""
        return stated_unit(name, units) or symbol(given, units)

    if unit := unit_in(PRESSURES):
        low, high = np.array([values.min(), values.max()]) * PRESSURES[unit] / 1e3
        return f"pressure, {unit}: {low:g} to {high:g} kPa"
    if unit := unit_in(ANGLES):
        return f"angle, {unit}"
    if meaning is None:
        return "unknown"
    return _QUANTITY_TEXTS[meaning.kind]


def markers_view(scene: Scene) -> Figure:
    """Plot marker paths from above, with the body and rigid pairs at three times."""
    from srs_twin.viewing.plots.style import PLUS_COLOR, finish, panels

    places = scene.places
    low = np.nanmin(places, axis=(0, 1))
    high = np.nanmax(places, axis=(0, 1))
    wide, deep = np.maximum(high - low, 1e-3)
    longest_name = max(map(len, scene.names), default=0)
    name_height = min(_CHARACTER_HEIGHT_IN * longest_name, _MAX_NAME_HEIGHT_IN)
    drawn_height = 8.0 * deep / wide + name_height
    figure, (axes,) = panels(float(np.clip(drawn_height + 1.4, 2.8, 7.0)))
    axes.plot(*places.transpose(2, 0, 1), color="0.8", linewidth=0.6, zorder=1)
    complete = np.flatnonzero(np.isfinite(places[..., 0]).all(axis=1))
    if complete.size:
        order = list(scene.order or range(places.shape[1]))
        frames = {
            "first frame": (complete[0], "0.55"),
            "middle frame": (complete[len(complete) // 2], "0.35"),
            "last frame": (complete[-1], "0.1"),
        }
        for label, (moment, shade) in frames.items():
            axes.plot(
                *places[moment, order].T,
                "o-" if scene.order else "o",
                color=shade,
                label=label,
                markersize=4,
                linewidth=1.2,
                zorder=2,
            )
            for pair in scene.rigid:
                axes.plot(
                    *places[moment, list(pair)].T,
                    color=PLUS_COLOR,
                    linewidth=2.5,
                    zorder=3,
                )
        for name, place in zip(scene.names, places[complete[0]], strict=True):
            axes.annotate(
                name, place, (1, 4), textcoords="offset points", rotation=60, fontsize=7
            )
        metres_per_inch = max(wide / 8.0, deep / (5.6 - name_height))
        top = places[complete[0], :, 1].max() + name_height * metres_per_inch
        axes.update_datalim([(low[0], top)])
        axes.autoscale_view()
        axes.legend(fontsize=7)
    axes.set_aspect("equal", adjustable="datalim")
    finish(
        axes,
        "y (m)",
        "x (m)",
        title=f"{places.shape[1]} markers; lines: order along the body at the first,"
        " middle and last frame",
    )
    return figure
