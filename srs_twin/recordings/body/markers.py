"""From markers that are known over time to the body: which marker is where on it, and which end leads.

Layouts: ``single``, one marker at each connector; ``head``, one more ahead of the head's, so that its heading
is measured; ``pair``, two at each connector, along or across the body, as the dissertation's first and third
robots had them (Sections 2.3.1 and 2.3.2); ``middles``, one at each connector and one at the middle of each
segment; ``head_middles``, these and one more ahead of the head's.

Neighbours along the body are never farther apart than a straight segment is long, others sometimes are: the
tree that joins all markers over the least of their largest distances is the body. Markers of one rigid part
keep their distance.

Errors raised here do not name the file; `read_motion` puts its name before them.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial
from itertools import pairwise

import numpy as np

from srs_twin.errors import InputError, UnknownNameError
from srs_twin.recordings.body.shape import Marks, Shape, determined, fit_shape, marker_arms
from srs_twin.recordings.body.tracking import distances, some_frames
from srs_twin.recordings.marker_table import MarkerTable
from srs_twin.recordings.signals.units import LENGTHS
from srs_twin.robot.spec import RobotSpec

CARRIED = {"single": (1, 0), "head": (1, 1), "pair": (2, 0), "middles": (2, -1), "head_middles": (2, 0)}
"""Layout → markers per connector, and how many more or fewer in all."""

LAYOUTS = ("auto", *CARRIED)

Places = dict[int, tuple[int, str]]
"""Marker → its station (0, 2, … the connectors, head first; 1, 3, … the segments' middles) and side."""

SOLID = 0.2  # of the frames a marker of the robot is seen on, or more
_APART = 2.0  # times the length of a segment: farther from all others nothing is on the robot
_TINY = 0.1  # of the body's length: no body curls up so far
_FAR = 2.5  # times a segment's length: farther apart no two neighbours are
_SAMPLED = 2000  # frames that distances are taken from
_NEAR_SAMPLED = 300


def robot_markers(
    points: np.ndarray, connectors: int, pitch: float, layout: str, named: int
) -> tuple[list[str], np.ndarray]:
    """Choose the robot's markers.

    Args:
        points: of all tracks, shape (frames, tracks, 2), m.
        connectors: N.
        pitch: length of a straight segment, m.
        layout: one of `LAYOUTS`; "auto" takes the one that has as many markers as are there.
        named: how many columns have a place on the robot by their names; 0: none.

    Returns:
        The layouts that it may be ("named" for those), and which tracks the robot's markers are.

    Raises:
        InputError: too few or too many markers.
    """
    seen = ~np.isnan(points[..., 0])
    share = seen.mean(axis=0)
    solid = np.flatnonzero(share >= SOLID)
    if len(solid) > connectors and not named:
        # Only those that have another one near on most frames they are seen on.
        near = (distances(points[:, solid], _NEAR_SAMPLED) < _APART * pitch).any(axis=2)
        there = seen[some_frames(len(points), _NEAR_SAMPLED)][:, solid]
        solid = solid[near.sum(axis=0) > 0.5 * there.sum(axis=0)]
    layouts = {each: per * connectors + more for each, (per, more) in CARRIED.items()}
    if named:
        layout, layouts = "named", {"named": named}
    fitting = [layout]
    if layout == "auto":
        # At once: a marker that was lost for long may have become two tracks.
        together = int(np.quantile(seen[:, solid].sum(axis=1), 0.95, method="lower")) if solid.size else 0
        fitting = [each for each, count in layouts.items() if count == together]
    wanted = layouts[fitting[0]] if fitting else -1
    if wanted < 0 or len(solid) < wanted:
        listed = ", ".join(f"{count} ({each})" for each, count in layouts.items())
        shares = ", ".join(f"{100 * each:.0f} %" for each in sorted(share, reverse=True)[:12])
        raise InputError(
            f"{len(solid)} markers that could be the robot's; {connectors} connectors carry {listed}. "
            f"Seen on these shares of the frames: {shares}. Give --layout, export without others, or say in "
            "a map where each is (--map)"
        )
    return fitting, np.sort(solid[np.argsort(-share[solid], kind="stable")[:wanted]])


def body_order(points: np.ndarray) -> np.ndarray:
    """Return markers in their order along the body, from one of its ends.

    Args:
        points: shape (frames, markers, 2), m.

    Raises:
        InputError: they do not lie along one line.
    """
    from scipy.sparse.csgraph import depth_first_order, minimum_spanning_tree

    # The largest but on a few frames. To a sparse graph 0 would be no edge.
    tree = minimum_spanning_tree(np.quantile(distances(points, _SAMPLED), 0.98, axis=0) + 1.0)
    neighbours = np.bincount(np.concatenate(tree.nonzero()), minlength=points.shape[1])
    ends = np.flatnonzero(neighbours == 1)
    if len(ends) != 2:
        raise InputError(f"the markers do not lie along one body: {len(ends)} of them are at an end")
    return np.asarray(depth_first_order(tree, ends[0], directed=False, return_predecessors=False))


def rigid_pairs(points: np.ndarray, connectors: int) -> np.ndarray:
    """Return which markers form pairs of constant distance, shape (connectors, 2).

    Raises:
        InputError: no such pairs.
    """
    mean, spread = median_and_spread(points)
    score = spread + 0.02 * mean
    pairs: list[tuple[int, int]] = []
    free = set(range(points.shape[1]))
    rows, columns = np.triu_indices(len(score), k=1)
    for k in np.argsort(score[rows, columns], kind="stable"):
        a, b = int(rows[k]), int(columns[k])
        if {a, b} <= free:
            pairs.append((a, b))
            free -= {a, b}
    # Pairs along the body may be as far from each other as their markers are: then the order tells them.
    try:
        chain = [(int(a), int(b)) for a, b in body_order(points).reshape(-1, 2)]
    except InputError:
        chain = pairs
    pairs = min(pairs, chain, key=lambda some: sum(score[a, b] for a, b in some))
    worst = max(spread[a, b] / max(mean[a, b], 1e-9) for a, b in pairs)
    if len(pairs) != connectors or worst > 0.2:
        raise InputError(
            f"no {connectors} pairs of markers keep their distance (one changes by {100 * worst:.0f} %); "
            "are there two at each connector? Give --layout"
        )
    return np.array(pairs)


def median_and_spread(points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return medians and spreads of the distances; a few frames that are wrong do not count."""
    apart = distances(points, _SAMPLED)
    # Of a marker from itself, or of two that were never seen at once.
    apart[:, np.isnan(apart).all(axis=0)] = np.inf
    with np.errstate(invalid="ignore"):
        low, middle, high = np.nanquantile(apart, [0.25, 0.5, 0.75], axis=0)
        return middle, np.nan_to_num(0.74 * (high - low), nan=np.inf)


def check_scale(points: np.ndarray, spec: RobotSpec) -> None:
    """Refuse markers that are as far from each other as those of no such robot, before any is followed.

    Args:
        points: in slots, shape (frames, slots, 2), m.
        spec: the robot.

    Raises:
        InputError: the nearest two are farther apart than neighbours can be, or all of them hardly apart.
    """
    pitch, straight = spec.geometry.pitch, spec.segments * spec.geometry.pitch
    apart = distances(points, _SAMPLED)
    apart = apart[np.isfinite(apart).any(axis=(1, 2))]
    if not len(apart):
        raise InputError(f"never two markers at once; {spec.segments + 1} or more are wanted")
    nearest, farthest = (np.median(each(apart, axis=(1, 2))) for each in (np.nanmin, np.nanmax))
    if nearest > _FAR * pitch or farthest < _TINY * straight:
        raise InputError(
            f"markers lie {1e3 * nearest:.4g} to {1e3 * farthest:.4g} mm apart, the connectors of "
            f"{spec.name} {1e3 * pitch:.4g} mm{unit_hint(float(farthest / straight))}"
        )


def unit_hint(ratio: float) -> str:
    """Return which unit may have been meant where lengths are `ratio` times what they should be."""
    for unit, factor in LENGTHS.items():
        for given, direction in ((factor, "in"), (1 / factor, "not in")):
            if factor != 1 and 0.7 < ratio * given < 1.1:
                return f"; were lengths {direction} {unit}?"
    return "; is it this robot?"


def forward_distance(period: float, points: np.ndarray) -> float:
    """Return how far markers moved towards the first of them, m; below 0 away from it.

    Args:
        period: of the frames, s.
        points: in order along the body, shape (frames, N, 2), m.
    """
    stride = max(1, round(0.25 / period))
    some = points[::stride] if len(points) > stride else points[[0, -1]]
    centre, along = some.mean(axis=1), some[:, 0] - some[:, -1]
    along = along / np.maximum(np.linalg.norm(along, axis=-1, keepdims=True), 1e-9)
    return float(
        sum(((b - a) * (u + v) / 2).sum() for (a, u), (b, v) in pairwise(zip(centre, along, strict=True)))
    )


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
        layout: one of `body.LAYOUTS`, or "named".
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
    geometry, order = spec.geometry, list(places)
    points, missing = markers.points[:, order], markers.missing[:, order]
    station = np.array([places[marker][0] for marker in order])
    arm = marker_arms(points, missing, list(places.values()), [markers.name(marker) for marker in order])
    way = determined(station, arm, geometry)
    if not way:
        raise InputError(_undetermined(station, spec))
    shape = fit_shape(markers.time, points, missing, Marks(station, arm, geometry), way)
    notes = _length_notes(shape, spec, way)
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
                f"which end has the second marker of the head cannot be told; give --head, its name ({ends})"
            )
        return ways[found], "the end with a second marker"
    centres = np.stack([markers.points[:, list(group)].mean(axis=1) for group in groups], axis=1)
    crawled = forward_distance(float(np.median(np.diff(markers.time))), centres)
    least = _CRAWLED * spec.geometry.body_length
    if abs(crawled) < least:
        raise InputError(
            f"which end is the head cannot be told, the body crawled {1e3 * abs(crawled):.3g} mm along "
            f"itself, less than {1e3 * least:.3g} mm; give --head, the name of a marker there ({ends})"
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
        raise InputError(f"the layout of the markers cannot be told ({listed}); give --layout")
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
