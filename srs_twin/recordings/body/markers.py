"""Assignment of tracked markers to the body: layout, order along the body, and head.

Layouts: ``single`` has one marker per connector; ``head`` has one more ahead of the head, which gives its
heading; ``pair`` has two per connector, along or across the body, as the first and third robot of the
dissertation (Sections 2.3.1 and 2.3.2); ``middles`` has one per connector and one at the middle of each
segment; ``head_middles`` has these and one more ahead of the head.

The distance between neighbours along the body is at most the length of a straight segment, while other
markers are sometimes farther apart. The body is therefore the minimum spanning tree of the largest distances.
Markers on the same rigid part keep their distance.

Errors raised here do not name the file; `read_motion` adds its name.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from srs_twin.errors import InputError, UnknownNameError
from srs_twin.recordings.body.shape import (
    BodyShape,
    LengthModel,
    MarkerPlacement,
    fit_shape,
    length_model,
    marker_offsets,
)
from srs_twin.recordings.body.tracking import pairwise_distances, sample_frames
from srs_twin.recordings.formats.base import MarkerTable
from srs_twin.recordings.signals.units import LENGTHS
from srs_twin.robot.spec import RobotSpec


class LayoutSize(NamedTuple):
    """Number of markers of a layout: N per_connector + extra, for N connectors."""

    per_connector: int
    extra: int


LAYOUT_SIZES = {
    "single": LayoutSize(1, 0),
    "head": LayoutSize(1, 1),
    "pair": LayoutSize(2, 0),
    "middles": LayoutSize(2, -1),
    "head_middles": LayoutSize(2, 0),
}
"""Layout → number of markers."""

LAYOUTS = ("auto", *LAYOUT_SIZES)
"""Names of the layouts; "auto" determines it from the markers."""

Places = dict[int, tuple[int, str]]
"""Marker → station (0, 2, … are the connectors, head first; 1, 3, … the middles of segments) and side."""

MIN_COVERAGE = 0.2
"""Smallest fraction of the frames on which a marker of the robot is visible, 1."""
_MAX_NEIGHBOUR_PITCH = 2.0
"""Distance to the nearest marker, in segment lengths, above which a marker is not on the robot."""
_MIN_EXTENT = 0.1
"""Smallest extent of all markers, in lengths of the straight body: no body bends into a smaller space."""
_MAX_NEAREST_PITCH = 2.5
"""Largest distance of the two nearest markers, in segment lengths."""
_DISTANCE_FRAMES = 2000
"""Number of sampled frames from which distances are computed."""
_NEIGHBOUR_FRAMES = 300
"""Number of sampled frames on which neighbours are searched."""
_MIN_CRAWLED = 0.1
"""Smallest forward distance that determines which end is the head, in body lengths."""
_NOTED_LENGTH = 0.02
"""Deviation of the median segment length, relative to a straight segment, above which a note is given."""
_NOTED_STRETCH = 0.05
"""Range of a segment length, relative to the segment, above which a note is given."""
_MAX_FIXED_STD = 0.03
"""Largest standard deviation of lengths that must be constant, relative to a segment, 1."""
_COMPARED_FRAMES = 600
"""Number of frames on which alternative assignments are compared."""
_CLEAR_NOISE_RATIO = 1.3
"""Ratio of the residual noise of the second-best to the best assignment above which the latter is used, 1."""
_MAX_LENGTH_RATIO = 1.15
"""Measured length of a segment, divided by that of the robot, that its shortest length must not exceed, 1."""
_MIN_LENGTH_RATIO = 0.85
"""Measured length of a segment, divided by that of the robot, that its largest length must reach, 1."""


def robot_markers(
    points: np.ndarray, connectors: int, pitch: float, layout: str, named: int
) -> tuple[list[str], np.ndarray]:
    """Select the markers of the robot.

    Args:
        points: positions of all tracks, shape (frames, tracks, 2), m.
        connectors: N.
        pitch: length of a straight segment, m.
        layout: one of `LAYOUTS`; "auto" selects the layouts whose number of markers is visible.
        named: number of columns whose names state a place on the robot; 0 if there are none.

    Returns:
        Possible layouts (["named"] for named columns), and the tracks of the robot's markers.

    Raises:
        InputError: there are too few or too many markers.
    """
    visible = ~np.isnan(points[..., 0])
    coverage = visible.mean(axis=0)
    candidates = np.flatnonzero(coverage >= MIN_COVERAGE)
    if len(candidates) > connectors and not named:
        # A marker of the robot has a neighbour on most of the frames on which it is visible.
        limit = _MAX_NEIGHBOUR_PITCH * pitch
        has_neighbour = (pairwise_distances(points[:, candidates], _NEIGHBOUR_FRAMES) < limit).any(axis=2)
        sampled = visible[sample_frames(len(points), _NEIGHBOUR_FRAMES)][:, candidates]
        candidates = candidates[has_neighbour.sum(axis=0) > 0.5 * sampled.sum(axis=0)]
    counts = {name: size.per_connector * connectors + size.extra for name, size in LAYOUT_SIZES.items()}
    if named:
        layout, counts = "named", {"named": named}
    possible = [layout]
    if layout == "auto":
        # Count the markers on the same frame: a marker that was hidden for long may have become two tracks.
        jobs_option = visible[:, candidates].sum(axis=1)
        count = int(np.quantile(jobs_option, 0.95, method="lower")) if candidates.size else 0
        possible = [name for name, required in counts.items() if required == count]
    required = counts[possible[0]] if possible else -1
    if required < 0 or len(candidates) < required:
        raise InputError(_wrong_number(len(candidates), connectors, counts, coverage))
    best = np.argsort(-coverage[candidates], kind="stable")[:required]
    return possible, np.sort(candidates[best])


def _wrong_number(candidates: int, connectors: int, counts: dict[str, int], coverage: np.ndarray) -> str:
    listed = ", ".join(f"{count} ({layout})" for layout, count in counts.items())
    shares = ", ".join(f"{100 * share:.0f} %" for share in sorted(coverage, reverse=True)[:12])
    return (
        f"{candidates} markers may belong to the robot, but {connectors} connectors have {listed}; the "
        f"tracks are visible on {shares} of the frames. Give --layout, export without other markers, or give "
        "the place of each marker in a map (--map)"
    )


def body_order(points: np.ndarray) -> np.ndarray:
    """Return the markers in their order along the body, from one of its ends.

    Args:
        points: shape (frames, markers, 2), m.

    Raises:
        InputError: the markers are not along one line.
    """
    from scipy.sparse.csgraph import depth_first_order, minimum_spanning_tree

    # The quantile replaces the maximum, because a few frames may be wrong. An offset is added because a
    # sparse graph has no edges of length 0.
    tree = minimum_spanning_tree(
        np.quantile(pairwise_distances(points, _DISTANCE_FRAMES), 0.98, axis=0) + 1.0
    )
    neighbours = np.bincount(np.concatenate(tree.nonzero()), minlength=points.shape[1])
    ends = np.flatnonzero(neighbours == 1)
    if len(ends) != 2:
        raise InputError(f"the markers are not along one body: {len(ends)} of them are at an end")
    return np.asarray(depth_first_order(tree, ends[0], directed=False, return_predecessors=False))


def rigid_pairs(points: np.ndarray, connectors: int) -> np.ndarray:
    """Return the pairs of markers with a constant distance, shape (connectors, 2).

    Raises:
        InputError: there are no such pairs.
    """
    median, spread = distance_statistics(points)
    score = spread + 0.02 * median
    pairs: list[tuple[int, int]] = []
    free = set(range(points.shape[1]))
    rows, columns = np.triu_indices(len(score), k=1)
    for k in np.argsort(score[rows, columns], kind="stable"):
        a, b = int(rows[k]), int(columns[k])
        if {a, b} <= free:
            pairs.append((a, b))
            free -= {a, b}
    # The distance of adjacent pairs along the body may equal that of their markers; the order is unique then.
    try:
        in_order = [(int(a), int(b)) for a, b in body_order(points).reshape(-1, 2)]
    except InputError:
        in_order = pairs
    pairs = min(pairs, in_order, key=lambda option: sum(score[a, b] for a, b in option))
    worst = max(spread[a, b] / max(median[a, b], 1e-9) for a, b in pairs)
    if len(pairs) != connectors or worst > 0.2:
        raise InputError(
            f"no {connectors} pairs of markers keep their distance (one changes by {100 * worst:.0f} %); "
            "are there two at each connector? Give --layout"
        )
    return np.array(pairs)


def distance_statistics(points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return medians and standard deviations of all distances, both of shape (markers, markers), m.

    The standard deviations are computed from quartiles; a few wrong frames have no effect.
    """
    distance = pairwise_distances(points, _DISTANCE_FRAMES)
    # NaN for a marker and itself, and for two markers that are never visible on the same frame.
    distance[:, np.isnan(distance).all(axis=0)] = np.inf
    with np.errstate(invalid="ignore"):
        low, median, high = np.nanquantile(distance, [0.25, 0.5, 0.75], axis=0)
        # 0.74 converts the interquartile range of normal values to their standard deviation.
        return median, np.nan_to_num(0.74 * (high - low), nan=np.inf)


def check_scale(points: np.ndarray, spec: RobotSpec) -> None:
    """Check, before the markers are tracked, that their distances fit the robot.

    Args:
        points: in slots, shape (frames, slots, 2), m.
        spec: the robot.

    Raises:
        InputError: the two nearest markers are farther apart than neighbours can be, or all are too close
            together.
    """
    pitch, straight = spec.geometry.pitch, spec.segments * spec.geometry.pitch
    distance = pairwise_distances(points, _DISTANCE_FRAMES)
    distance = distance[np.isfinite(distance).any(axis=(1, 2))]
    if not len(distance):
        raise InputError(
            f"no frame has two visible markers; the robot needs {spec.segments + 1} or more of them"
        )
    nearest, farthest = (np.median(extreme(distance, axis=(1, 2))) for extreme in (np.nanmin, np.nanmax))
    if nearest > _MAX_NEAREST_PITCH * pitch or farthest < _MIN_EXTENT * straight:
        raise InputError(
            f"markers are {1e3 * nearest:.4g} to {1e3 * farthest:.4g} mm apart, the connectors of "
            f"{spec.name} {1e3 * pitch:.4g} mm{unit_hint(float(farthest / straight))}"
        )


def unit_hint(ratio: float) -> str:
    """Return a hint at the unit of length, for lengths that are `ratio` times the expected ones."""
    for unit, factor in LENGTHS.items():
        for correction, preposition in ((factor, "in"), (1 / factor, "not in")):
            if factor != 1 and 0.7 < ratio * correction < 1.1:
                return f"; are the lengths {preposition} {unit}?"
    return "; is it this robot?"


def forward_distance(period: float, points: np.ndarray) -> float:
    """Return the distance travelled towards the first marker, m; negative towards the last one.

    Args:
        period: time between frames, s.
        points: in order along the body, shape (frames, N, 2), m.
    """
    stride = max(1, round(0.25 / period))
    sampled = points[::stride] if len(points) > stride else points[[0, -1]]
    centre, axis = sampled.mean(axis=1), sampled[:, 0] - sampled[:, -1]
    axis = axis / np.maximum(np.linalg.norm(axis, axis=-1, keepdims=True), 1e-9)
    return float(
        sum(((b - a) * (u + v) / 2).sum() for (a, u), (b, v) in pairwise(zip(centre, axis, strict=True)))
    )


@dataclass(frozen=True)
class CapturedMarkers:
    """Markers of the robot on the frames that are kept.

    Attributes:
        table: the file.
        layout: one of `LAYOUTS`, or "named".
        time: shape (frames,), s.
        points: interpolated where a marker is hidden, shape (frames, markers, 2), m.
        columns: column of the file from which each sample came, −1 where it is hidden, (frames, markers).
        rejected: number of samples of these markers that were outliers.
        other: number of samples in the file that do not belong to the robot.
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
        """Hidden markers, shape (frames, markers)."""
        return self.columns < 0

    @cached_property
    def main_columns(self) -> list[int]:
        """Most frequent column of each marker."""
        return [int(np.bincount(column[column >= 0]).argmax()) for column in self.columns.T]

    def thinned(self) -> CapturedMarkers:
        """Return the markers on a sample of the frames."""
        frames = sample_frames(len(self.time), _COMPARED_FRAMES)
        return replace(self, time=self.time[frames], points=self.points[frames], columns=self.columns[frames])

    def name(self, marker: int) -> str:
        """Return the name of the most frequent column of a marker."""
        return self.table.labels[self.main_columns[marker]]


@dataclass(frozen=True)
class TrackedBody:
    """Shape of the robot in a recording.

    Attributes:
        shape: connectors, headings, bends and lengths, with errors.
        missing: connectors with a hidden marker, shape (frames, N).
        spacing: largest distance of adjacent connectors, shape (segments,), m.
        head: text on how the head was determined.
        corrections: texts on results and assumptions.
    """

    shape: BodyShape
    missing: np.ndarray
    spacing: np.ndarray
    head: str
    corrections: tuple[str, ...]

    @property
    def position(self) -> np.ndarray:
        """Connectors, shape (frames, N, 2), m."""
        return np.stack([self.shape.connector.real, self.shape.connector.imag], axis=-1)

    @property
    def theta(self) -> np.ndarray:
        """Headings of the connectors, unwrapped, shape (frames, N), rad."""
        return self.shape.theta

    @property
    def bend(self) -> np.ndarray:
        """q_j = θ_j − θ_{j+1}, shape (frames, segments), rad."""
        return np.asarray(self.theta[:, :-1] - self.theta[:, 1:])


def tracked_body(markers: CapturedMarkers, spec: RobotSpec, head: str | None) -> TrackedBody:
    """Assign markers to the body and fit its shape.

    Args:
        markers: markers of the robot.
        spec: the robot.
        head: name of a column at the head, or None.

    Raises:
        InputError: the markers do not fit this robot or do not determine its shape, or the head cannot be
            determined.
        UnknownNameError: no column has the name given as the head.
    """
    places, head_note = _places_from_head(markers, spec, head)
    shape, station, notes = _fit_body(markers, spec, places)
    spacing = np.quantile(np.abs(np.diff(shape.connector, axis=1)), 0.98, axis=0)
    # A hidden marker at the middle of a segment makes both connectors of the segment uncertain.
    missing = np.zeros(shape.theta.shape, dtype=bool)
    for k, number in enumerate(station):
        for connector in {int(number) // 2, (int(number) + 1) // 2}:
            missing[:, connector] |= shape.missing[:, k]
    return TrackedBody(shape, missing, spacing, head_note, tuple(notes))


def _fit_body(
    markers: CapturedMarkers, spec: RobotSpec, places: Places
) -> tuple[BodyShape, np.ndarray, list[str]]:
    """Return the shape that fits markers at given places, their stations, and notes."""
    geometry, order = spec.geometry, list(places)
    points, missing = markers.points[:, order], markers.missing[:, order]
    station = np.array([places[marker][0] for marker in order])
    names = [markers.name(marker) for marker in order]
    offset = marker_offsets(points, missing, list(places.values()), names)
    model = length_model(station, offset, geometry)
    if model is None:
        raise InputError(_undetermined(station, spec))
    shape = fit_shape(markers.time, points, missing, MarkerPlacement(station, offset, geometry), model)
    notes = _length_notes(shape, spec, model)
    if model is LengthModel.FIXED:
        notes.append(
            "one marker per connector: near a straight body, alternating bends are known to 0.2 rad only"
        )
    return shape, station, notes


def _undetermined(station: np.ndarray, spec: RobotSpec) -> str:
    """Return the message for markers that do not determine the shape."""
    counts = sorted(Counter(station.tolist()).items())
    listed = ", ".join(f"{count} at {_station_name(number)}" for number, count in counts)
    remedy = (
        "put a second marker on the head"
        if set(range(0, 2 * spec.segments + 1, 2)) <= set(station.tolist())
        else "use a marker at each connector and a second one on the head, or two at each connector"
    )
    return f"markers ({listed}) do not determine the bends of {spec.segments} segments; {remedy}"


def _station_name(station: int) -> str:
    return f"{'middle' if station % 2 else 'connector'} {station // 2 + 1}"


def _length_notes(shape: BodyShape, spec: RobotSpec, model: LengthModel) -> list[str]:
    """Return notes on the segment lengths.

    Raises:
        InputError: the lengths do not fit the robot, or they vary although the bends depend on constant
            lengths.
    """
    geometry, notes = spec.geometry, []
    low, median, high = np.quantile(shape.length, [0.02, 0.5, 0.98], axis=0) + geometry.rigid_gap
    # Segments may stretch by a quarter and more, but not during the whole recording.
    wrong = np.flatnonzero(
        (low > _MAX_LENGTH_RATIO * geometry.pitch) | (high < _MIN_LENGTH_RATIO * geometry.pitch)
    )
    if wrong.size:
        k, ratio = int(wrong[0]), float(np.median(median)) / geometry.pitch
        raise InputError(
            f"markers {k + 1} and {k + 2} from the head are {1e3 * median[k]:.4g} mm apart along the body, "
            f"the connectors of {spec.name} {1e3 * geometry.pitch:.4g} mm{unit_hint(ratio)}"
        )
    if model is LengthModel.FIXED and shape.length_std > _MAX_FIXED_STD * geometry.segment_length:
        raise InputError(
            f"the segment lengths vary by {1e3 * shape.length_std:.2g} mm (standard deviation), so one "
            "marker per connector does not determine the bends; put a second marker on the head"
        )
    deviation = median - geometry.pitch
    if np.abs(deviation).max() > _NOTED_LENGTH * geometry.pitch:
        listed = ", ".join(f"{1e3 * value:+.1f}" for value in deviation)
        notes.append(
            f"segments are longer than those of {spec.name} by {listed} mm, head first: used as measured"
        )
    low, high = ((length - geometry.pitch) / geometry.segment_length for length in (low, high))
    if model is LengthModel.FREE and shape.length_std > _NOTED_STRETCH * geometry.segment_length / 4:
        listed = ", ".join(f"{100 * a:+.0f} to {100 * b:+.0f} %" for a, b in zip(low, high, strict=True))
        notes.append(f"segments stretch ({listed} of {spec.name}, head first): lengths used as measured")
    return notes


def _groups_along_body(markers: CapturedMarkers, spec: RobotSpec) -> list[tuple[int, ...]]:
    """Return the markers of each station, from one end of the body to the other."""
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
    return places | {marker: (step * k, "") for k, group in enumerate(groups) for marker in group}


def _places_from_head(markers: CapturedMarkers, spec: RobotSpec, head: str | None) -> tuple[Places, str]:
    """Return station and side of each marker, and a text on how the head was determined."""
    if markers.table.places:
        return _named_places(markers, spec), "connector 1 of the file"
    groups, layout, labels = _groups_along_body(markers, spec), markers.layout, markers.table.labels
    options = [_stations(layout, order) for order in (groups, groups[::-1])]
    if head is not None:
        if head not in labels:
            raise UnknownNameError("marker", head, labels)
        heads = [[markers.name(k) for k, (station, _) in places.items() if not station] for places in options]
        if head not in heads[0] + heads[1]:
            raise InputError(f"marker '{head}' is at neither end of the body")
        return options[head not in heads[0]], f"marker '{head}'"
    ends = " or ".join(f"'{markers.name(groups[end][0])}'" for end in (0, -1))
    if "head" in layout:
        best, _ = _best_fit([partial(_fit_thinned, markers, spec, places) for places in options])
        if best is None:
            raise InputError(
                "the end with the second marker of the head cannot be determined; give --head with the name "
                f"of the marker ({ends})"
            )
        return options[best], "the end with a second marker"
    centres = np.stack([markers.points[:, list(group)].mean(axis=1) for group in groups], axis=1)
    crawled = forward_distance(float(np.median(np.diff(markers.time))), centres)
    required = _MIN_CRAWLED * spec.geometry.body_length
    if abs(crawled) < required:
        raise InputError(
            f"the head cannot be determined, because the body crawled {1e3 * abs(crawled):.3g} mm along "
            f"itself, less than {1e3 * required:.3g} mm; give --head with the name of a marker at the head "
            f"({ends})"
        )
    return options[crawled < 0], f"the end towards which it crawled ({abs(crawled):.3g} m)"


def select_layout(
    markers: CapturedMarkers, layouts: Sequence[str], spec: RobotSpec, head: str | None
) -> CapturedMarkers:
    """Return the markers with the layout that fits best.

    Raises:
        InputError: no layout fits, or several fit about equally well.
    """
    if len(layouts) == 1:
        return replace(markers, layout=layouts[0])
    thinned = markers.thinned()

    def fit(layout: str) -> BodyShape:
        return tracked_body(replace(thinned, layout=layout), spec, head).shape

    best, notes = _best_fit([partial(fit, layout) for layout in layouts])
    if best is None:
        listed = "; ".join(f"{layout}: {note}" for layout, note in zip(layouts, notes, strict=True))
        raise InputError(f"the layout of the markers cannot be determined ({listed}); give --layout")
    return replace(markers, layout=layouts[best])


def _best_fit(fits: Sequence[Callable[[], BodyShape]]) -> tuple[int | None, list[str]]:
    """Return the index of the fit with the smallest noise, or None if another one is similar, and notes."""
    noises, notes = [], []
    for fit in fits:
        try:
            noise = fit().noise
            notes.append(f"residual of {1e3 * noise:.2g} mm")
        except UnknownNameError:
            raise
        except InputError as error:
            noise = np.inf
            notes.append(str(error))
        noises.append(noise)
    best, second = np.sort(noises)[:2]
    clear = np.isfinite(best) and second > _CLEAR_NOISE_RATIO * best
    return (int(np.argmin(noises)) if clear else None), notes


def _fit_thinned(markers: CapturedMarkers, spec: RobotSpec, places: Places) -> BodyShape:
    """Return the shape that fits a sample of the frames."""
    return _fit_body(markers.thinned(), spec, places)[0]


def _named_places(markers: CapturedMarkers, spec: RobotSpec) -> Places:
    """Return the places of markers by the names of their most frequent columns."""
    places, main = markers.table.places, markers.main_columns
    if sorted(main) != list(range(len(places))):
        raise InputError("the markers change their columns too often to be identified by them")
    last = max(station for station, _ in places)
    if last > 2 * spec.segments:
        raise InputError(
            f"{_station_name(last)} does not exist; {spec.name} has {spec.geometry.connectors} connectors"
        )
    return {int(marker): places[main[marker]] for marker in np.argsort(main)}
