"""From markers that are known over time to the body: which marker is where on it, and which end leads.

Errors raised here do not name the file; `read_motion` puts its name before them.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial

import numpy as np

from srs_twin.errors import InputError, UnknownNameError
from srs_twin.recordings.layout import (
    Places,
    body_order,
    forward_distance,
    rigid_pairs,
    unit_hint,
)
from srs_twin.recordings.shape import Marks, Shape, determined, fit_shape, marker_arms
from srs_twin.recordings.tracking import MarkerTable, some_frames
from srs_twin.robot.spec import RobotSpec

_CRAWLED = 0.1  # of the body's length: less does not tell which end leads
_ANOTHER_LENGTH = 0.02  # of a straight segment: from here on it is noted
_STRETCHES = 0.05  # of a segment's length: from here on it is noted
_MUST_NOT = 0.03  # of a segment's length: more than this no segment may vary where lengths tell the bends
_SOME = 600  # frames on which explanations are compared
_CLEARLY = 1.3  # times as much noise must another explanation leave
_LONGEST, _SHORTEST = 1.15, 0.85  # times the robot's: no segment is always longer or shorter


@dataclass(frozen=True)
class CapturedMarkers:
    """The robot's markers over the frames that are kept.

    Attributes:
        table: the file.
        layout: one of `layout.LAYOUTS`, or "named".
        time: shape (frames,), s.
        points: interpolated where a marker was not seen, shape (frames, markers, 2), m.
        columns: from which column of the file each sample came, −1 where it was not seen, (frames, markers).
        rejected: how many samples of them were outliers.
        other: how many samples of the file were of nothing on the robot.
    """

    table: MarkerTable
    layout: str
    time: np.ndarray
    points: np.ndarray
    columns: np.ndarray
    rejected: int
    other: int

    @property
    def missing(self) -> np.ndarray:
        """Where markers were not seen, shape (frames, markers)."""
        return self.columns < 0

    @cached_property
    def main_columns(self) -> list[int]:
        """The column that each marker was in on most frames."""
        return [int(np.bincount(column[column >= 0]).argmax()) for column in self.columns.T]

    def thinned(self) -> CapturedMarkers:
        """Return some of the frames, evenly spread."""
        some = some_frames(len(self.time), _SOME)
        return replace(self, time=self.time[some], points=self.points[some], columns=self.columns[some])

    def name(self, marker: int) -> str:
        """Return the name of the column that a marker was in on most frames."""
        return self.table.labels[self.main_columns[marker]]


@dataclass(frozen=True)
class TrackedBody:
    """The robot as it was captured.

    Attributes:
        shape: connectors, headings, bends and lengths, with errors.
        missing: whether a marker of each connector was not seen, shape (frames, N).
        spacing: largest distance of neighbouring connectors, shape (segments,), m.
        head: how the head was found, in words.
        corrections: what was found and assumed, in words.
    """

    shape: Shape
    missing: np.ndarray
    spacing: np.ndarray
    head: str
    corrections: tuple[str, ...]

    @property
    def position(self) -> np.ndarray:
        """Connectors, shape (frames, N, 2), m."""
        return np.stack([self.shape.node.real, self.shape.node.imag], axis=-1)

    @property
    def theta(self) -> np.ndarray:
        """Their headings, unwrapped, shape (frames, N), rad."""
        return self.shape.theta

    @property
    def bend(self) -> np.ndarray:
        """q_j = θ_j − θ_{j+1}, shape (frames, segments), rad."""
        return np.asarray(self.theta[:, :-1] - self.theta[:, 1:])


def tracked_body(markers: CapturedMarkers, spec: RobotSpec, head: str | None) -> TrackedBody:
    """Find which marker is where on the body, and the body that explains them.

    Args:
        markers: what was captured.
        spec: the robot.
        head: name of a column at the head, or None.

    Raises:
        InputError: the markers do not make up this robot, do not determine its shape, or its head cannot be
            told.
        UnknownNameError: no column has the head's name.
    """
    places, how = _head_first(markers, spec, head)
    shape, station, notes = _explain(markers, spec, places)
    spacing = np.quantile(np.abs(np.diff(shape.node, axis=1)), 0.98, axis=0)
    # A middle that was hidden is a gap of the connectors beside it.
    hidden = np.zeros(shape.theta.shape, dtype=bool)
    for k, at in enumerate(station):
        for connector in {int(at) // 2, (int(at) + 1) // 2}:
            hidden[:, connector] |= shape.missing[:, k]
    return TrackedBody(shape, hidden, spacing, how, tuple(notes))


def _explain(
    markers: CapturedMarkers, spec: RobotSpec, places: Places
) -> tuple[Shape, np.ndarray, list[str]]:
    """Return the body that explains markers at these places, their stations, and what is to be said of it."""
    geometry, notes, order = spec.geometry, [], list(places)
    points, missing = markers.points[:, order], markers.missing[:, order]
    station = np.array([places[marker][0] for marker in order])
    arm, points, missing, turned = marker_arms(
        points, missing, [places[marker] for marker in order], [markers.name(marker) for marker in order]
    )
    if turned:
        notes.append(f"the markers of a pair had changed names {turned} times a frame and pair: set right")
    way = determined(station, arm, geometry)
    if not way:
        raise InputError(_undetermined(station, spec))
    shape = fit_shape(markers.time, points, missing, Marks(station, arm, geometry), way)
    notes += _length_notes(shape, spec, way)
    if way == "fixed":
        notes.append(
            "one marker a connector: near a straight body bends that alternate are known to 0.2 rad only"
        )
    return shape, station, notes


def _undetermined(station: np.ndarray, spec: RobotSpec) -> str:
    """Say what is missing where markers do not determine the shape."""
    where = ", ".join(f"{count} at {_called(at)}" for at, count in sorted(Counter(station.tolist()).items()))
    remedy = (
        "put a second marker on the head"
        if set(range(0, 2 * spec.segments + 1, 2)) <= set(station.tolist())
        else "a marker at each connector and a second one on the head do, or two at each connector"
    )
    return f"markers ({where}) do not tell how {spec.segments} segments bend; {remedy}"


def _called(station: int) -> str:
    return f"{'middle' if station % 2 else 'connector'} {station // 2 + 1}"


def _length_notes(shape: Shape, spec: RobotSpec, way: str) -> list[str]:
    """Return what is to be said of the segments' lengths.

    Raises:
        InputError: no such robot has them, or they vary where they must not.
    """
    geometry, said = spec.geometry, []
    low, straight, high = np.quantile(shape.length, [0.02, 0.5, 0.98], axis=0) + geometry.rigid_gap
    # Segments stretch by a quarter and more, but then they are not that long all the time.
    bad = np.flatnonzero((low > _LONGEST * geometry.pitch) | (high < _SHORTEST * geometry.pitch))
    if bad.size:
        k, ratio = int(bad[0]), float(np.median(straight)) / geometry.pitch
        raise InputError(
            f"markers {k + 1} and {k + 2} from the head are {1e3 * straight[k]:.4g} mm apart along the body, "
            f"the connectors of {spec.name} {1e3 * geometry.pitch:.4g} mm{unit_hint(ratio)}"
        )
    if way == "fixed" and shape.length_spread > _MUST_NOT * geometry.segment_length:
        raise InputError(
            f"the segments' lengths vary by {1e3 * shape.length_spread:.2g} mm (standard deviation): one "
            "marker at each connector does not tell how they bend then; put a second marker on the head"
        )
    off = straight - geometry.pitch
    if np.abs(off).max() > _ANOTHER_LENGTH * geometry.pitch:
        listed = ", ".join(f"{1e3 * each:+.1f}" for each in off)
        said.append(f"segments are longer than {spec.name}'s by {listed} mm, head first: taken as measured")
    low, high = ((each - geometry.pitch) / geometry.segment_length for each in (low, high))
    if way == "free" and shape.length_spread > _STRETCHES * geometry.segment_length / 4:
        listed = ", ".join(f"{100 * a:+.0f} to {100 * b:+.0f} %" for a, b in zip(low, high, strict=True))
        said.append(f"segments stretch ({listed} of {spec.name}'s, head first): lengths taken as measured")
    return said


def _along_body(markers: CapturedMarkers, spec: RobotSpec) -> list[tuple[int, ...]]:
    """Return groups of markers from one end of the body to the other."""
    if markers.layout != "pair":
        return [(int(k),) for k in body_order(markers.points)]
    pairs = rigid_pairs(markers.points, spec.geometry.connectors)
    return [tuple(int(k) for k in pairs[j]) for j in body_order(markers.points[:, pairs].mean(axis=2))]


def _stations(layout: str, groups: list[tuple[int, ...]]) -> Places:
    """Return station and side of each marker of groups, head first."""
    places: Places = {}
    if "head" in layout:
        places[groups[0][0]], groups = (0, "ahead"), groups[1:]
    step = 1 if "middles" in layout else 2
    return places | {each: (step * k, "") for k, group in enumerate(groups) for each in group}


def _head_first(markers: CapturedMarkers, spec: RobotSpec, head: str | None) -> tuple[Places, str]:
    """Return station and side of each marker, and how the head was found."""
    if markers.table.places:
        return _named_places(markers, spec), "connector 1 of the file"
    groups, layout, labels = _along_body(markers, spec), markers.layout, markers.table.labels
    ways = [_stations(layout, way) for way in (groups, groups[::-1])]
    if head is not None:
        if head not in labels:
            raise UnknownNameError("marker", head, labels)
        near = [[markers.name(k) for k, (station, _) in way.items() if not station] for way in ways]
        if head not in near[0] + near[1]:
            raise InputError(f"marker '{head}' is at neither end of the body")
        return ways[head not in near[0]], f"marker '{head}'"
    ends = " or ".join(f"'{markers.name(groups[end][0])}'" for end in (0, -1))
    if "head" in layout:
        found, _ = _likeliest([partial(_explained, markers, spec, way) for way in ways])
        if found is None:
            raise InputError(
                f"which end has the second marker of the head cannot be told; give head, its name ({ends})"
            )
        return ways[found], "the end with a second marker"
    centres = np.stack([markers.points[:, list(group)].mean(axis=1) for group in groups], axis=1)
    crawled = forward_distance(float(np.median(np.diff(markers.time))), centres)
    least = _CRAWLED * spec.geometry.body_length
    if abs(crawled) < least:
        raise InputError(
            f"which end is the head cannot be told, the body crawled {1e3 * abs(crawled):.3g} mm along "
            f"itself, less than {1e3 * least:.3g} mm; give head, the name of a marker there ({ends})"
        )
    return ways[crawled < 0], f"the end towards which it crawled ({abs(crawled):.3g} m)"


def likeliest_layout(
    markers: CapturedMarkers, layouts: Sequence[str], spec: RobotSpec, head: str | None
) -> CapturedMarkers:
    """Return markers with the layout of several that explains them best.

    Raises:
        InputError: none does, or several do about as well.
    """
    if len(layouts) == 1:
        return replace(markers, layout=layouts[0])
    some = markers.thinned()
    ways = [replace(some, layout=each) for each in layouts]
    found, said = _likeliest([lambda way=way: tracked_body(way, spec, head).shape for way in ways])  # type: ignore[misc]
    if found is None:
        listed = "; ".join(f"{layout}: {why}" for layout, why in zip(layouts, said, strict=True))
        raise InputError(f"the layout of the markers cannot be told ({listed}); give layout")
    return replace(markers, layout=layouts[found])


def _likeliest(ways: Sequence[Callable[[], Shape]]) -> tuple[int | None, list[str]]:
    """Return which explanation leaves least, None where another leaves about as little; and words on each."""
    noise, said = [], []
    for way in ways:
        try:
            left = way().noise
            said.append(f"leaves {1e3 * left:.2g} mm")
        except UnknownNameError:
            raise
        except InputError as error:
            left = np.inf
            said.append(str(error))
        noise.append(left)
    best, second = np.sort(noise)[:2]
    sure = np.isfinite(best) and second > _CLEARLY * best
    return (int(np.argmin(noise)) if sure else None), said


def _explained(markers: CapturedMarkers, spec: RobotSpec, places: Places) -> Shape:
    """Return the body that explains some of the frames."""
    return _explain(markers.thinned(), spec, places)[0]


def _named_places(markers: CapturedMarkers, spec: RobotSpec) -> Places:
    """Return where markers are by the names of the columns they were mostly in."""
    named, main = markers.table.places, markers.main_columns
    if sorted(main) != list(range(len(named))):
        raise InputError("markers cannot be told by their columns, they change places too often")
    last = max(station for station, _ in named)
    if last > 2 * spec.segments:
        raise InputError(f"{_called(last)}: {spec.name} has {spec.geometry.connectors} connectors")
    return {int(marker): named[main[marker]] for marker in np.argsort(main)}
