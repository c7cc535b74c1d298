"""Assignment of tracked markers to the body, and fit of the body shape."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np

from srs_twin.errors import InputError, UnknownNameError
from srs_twin.recordings.body.frame_fit import MarkerPlacement, marker_offsets
from srs_twin.recordings.body.layout import (
    body_order,
    forward_distance,
    rigid_pairs,
    unit_hint,
)
from srs_twin.recordings.body.shape import (
    BodyShape,
    LengthModel,
    fit_shape,
    length_model,
)
from srs_twin.recordings.body.tracking import sample_frames
from srs_twin.recordings.formats.base import MarkerTable
from srs_twin.robot.spec import RobotSpec

Places = dict[int, tuple[int, str]]
"""Station and side of each marker, keyed by marker index.

Even stations are the connectors, starting with 0 at the head, and odd stations are the
middles of the segments.
"""

_MIN_CRAWLED = 0.1
"""Minimum travelled distance for detecting the head, in body lengths."""
_NOTED_LENGTH = 0.02
"""Relative deviation of a median segment length above which a note is added."""
_NOTED_STRETCH = 0.05
"""Relative range of a segment length above which a note is added."""
_MAX_FIXED_STD = 0.03
"""Maximum standard deviation of constant lengths, relative to the nominal length."""
_COMPARED_FRAMES = 600
_CLEAR_NOISE_RATIO = 1.3
"""Minimum ratio of the noise with the second-best assignment to the smallest noise."""
_MAX_LENGTH_RATIO = 1.15
"""Upper bound on the shortest length of a segment, relative to the nominal length."""
_MIN_LENGTH_RATIO = 0.85
"""Lower bound on the longest length of a segment, relative to the nominal length."""


@dataclass(frozen=True)
class CapturedMarkers:
    """Robot markers in the frames of the trajectory.

    Attributes:
        points: marker positions, m, shape (frames, markers, 2). The positions of hidden
            markers are interpolated.
        columns: file column of each sample, or −1 for a hidden marker, shape (frames,
            markers).
        other: number of samples in the file that do not belong to the robot.
    """

    table: MarkerTable
    layouts: list[str]
    time: np.ndarray
    points: np.ndarray
    columns: np.ndarray
    rejected: int
    other: int

    @property
    def missing(self) -> np.ndarray:
        """Mask of hidden markers, shape (frames, markers)."""
        return self.columns < 0

    @cached_property
    def main_columns(self) -> list[int]:
        """File column that contains most samples of each marker."""
        return [
            int(np.bincount(column[column >= 0]).argmax()) for column in self.columns.T
        ]

    def thinned(self) -> CapturedMarkers:
        """Return the markers in a subset of the frames."""
        frames = sample_frames(len(self.time), _COMPARED_FRAMES)
        return replace(
            self,
            time=self.time[frames],
            points=self.points[frames],
            columns=self.columns[frames],
        )

    def name(self, marker: int) -> str:
        """Return the name of the file column that contains most samples of a marker."""
        return self.table.labels[self.main_columns[marker]]


@dataclass(frozen=True)
class TrackedBody:
    """Shape of the robot in a recording.

    Attributes:
        missing: mask of connectors with a hidden marker, shape (frames, N).
        spacing: 98 % quantile of the distance between adjacent connectors, m, shape
            (segments,).
    """

    layout: str
    shape: BodyShape
    missing: np.ndarray
    spacing: np.ndarray
    head: str
    corrections: tuple[str, ...]


class _Assignment(NamedTuple):
    layout: str
    places: Places
    head: str


def tracked_body(
    markers: CapturedMarkers, spec: RobotSpec, head: str | None
) -> TrackedBody:
    """Assign markers to the body and fit the shape of the body.

    `head` is the column name of a marker at the head, or None to detect the head.
    """
    options: list[_Assignment] = []
    refused: list[str] = []
    for layout in markers.layouts:
        try:
            options += _assignments(markers, layout, spec, head)
        except InputError as error:
            if len(markers.layouts) == 1 or isinstance(error, UnknownNameError):
                raise
            refused.append(f"{layout}: {error}")
    if len(options) == 1:
        (chosen,) = options
    else:
        chosen = _best_fit(markers, spec, options, refused)
    shape, station, notes = _fit_body(markers, spec, chosen.places)
    spacing = np.quantile(np.abs(np.diff(shape.connector, axis=1)), 0.98, axis=0)
    # A hidden marker at the middle of a segment makes both adjacent connectors
    # uncertain.
    missing = np.zeros(shape.theta.shape, dtype=bool)
    for number, hidden in zip(station, shape.missing.T, strict=True):
        missing[:, [number // 2, (number + 1) // 2]] |= hidden[:, None]
    return TrackedBody(
        chosen.layout, shape, missing, spacing, chosen.head, tuple(notes)
    )


def _fit_body(
    markers: CapturedMarkers, spec: RobotSpec, places: Places
) -> tuple[BodyShape, np.ndarray, list[str]]:
    geometry = spec.geometry
    order = list(places)
    points = markers.points[:, order]
    missing = markers.missing[:, order]
    station = np.array([places[marker][0] for marker in order])
    names = [markers.name(marker) for marker in order]
    offset = marker_offsets(points, missing, list(places.values()), names)
    model = length_model(station, offset, geometry)
    if model is None:
        raise InputError(_undetermined(station, spec))
    shape = fit_shape(
        markers.time, points, missing, MarkerPlacement(station, offset, geometry), model
    )
    notes = _length_notes(shape, spec, model)
    if model is LengthModel.FIXED:
        notes.append(
            "with one marker per connector, alternating bends of a nearly straight"
            " body have an uncertainty of 0.2 rad"
        )
    return shape, station, notes


def _undetermined(station: np.ndarray, spec: RobotSpec) -> str:
    counts = Counter(sorted(station.tolist()))
    listed = ", ".join(
        f"{count} at {_station_name(number)}" for number, count in counts.items()
    )
    remedy = (
        "use one marker per connector and a second marker on the head, or two"
        " markers per connector"
    )
    if counts.keys() >= set(range(0, 2 * spec.segments + 1, 2)):
        remedy = "put a second marker on the head"
    return (
        f"the markers ({listed}) do not determine the bends of {spec.segments}"
        f" segments; {remedy}"
    )


def _station_name(station: int) -> str:
    return f"{'middle' if station % 2 else 'connector'} {station // 2 + 1}"


def _length_notes(shape: BodyShape, spec: RobotSpec, model: LengthModel) -> list[str]:
    geometry = spec.geometry
    pitch = geometry.pitch
    notes = []
    low, median, high = (
        np.quantile(shape.length, [0.02, 0.5, 0.98], axis=0) + geometry.rigid_gap
    )
    # A segment may stretch by more than a quarter, but not during the whole recording.
    wrong = (low > _MAX_LENGTH_RATIO * pitch) | (high < _MIN_LENGTH_RATIO * pitch)
    if wrong.any():
        k = int(wrong.argmax())
        ratio = float(np.median(median)) / pitch
        raise InputError(
            f"markers {k + 1} and {k + 2} from the head are {1e3 * median[k]:.4g} mm"
            f" apart along the body, but the connectors of {spec.name} are"
            f" {1e3 * pitch:.4g} mm apart{unit_hint(ratio)}"
        )
    relative_std = shape.length_std / geometry.segment_length
    if model is LengthModel.FIXED and relative_std > _MAX_FIXED_STD:
        raise InputError(
            "one marker per connector does not determine the bends, because the"
            f" segment lengths vary by {1e3 * shape.length_std:.2g} mm (standard"
            " deviation); put a second marker on the head"
        )
    deviation = median - pitch
    if np.abs(deviation).max() > _NOTED_LENGTH * pitch:
        listed = ", ".join(f"{1e3 * value:+.1f}" for value in deviation)
        notes.append(
            f"the segment lengths differ from those of {spec.name} by {listed} mm (head"
            " first); the measured lengths are used"
        )
    if model is LengthModel.FREE and relative_std > _NOTED_STRETCH / 4:
        ends = (np.stack([low, high], axis=1) - pitch) / geometry.segment_length
        listed = ", ".join(f"{100 * a:+.0f} to {100 * b:+.0f} %" for a, b in ends)
        notes.append(
            f"the segment lengths vary ({listed} relative to {spec.name}, head first);"
            " the measured lengths are used"
        )
    return notes


def _groups_along_body(
    markers: CapturedMarkers, layout: str, spec: RobotSpec
) -> list[tuple[int, ...]]:
    groups = np.arange(markers.points.shape[1])[:, None]
    if layout == "pair" and markers.table.bodies:
        groups = groups.reshape(-1, 2)
    elif layout == "pair":
        groups = rigid_pairs(markers.points, spec.geometry.connectors)
    order = body_order(markers.points[:, groups].mean(axis=2))
    return [tuple(group) for group in groups[order].tolist()]


def _stations(layout: str, groups: list[tuple[int, ...]]) -> Places:
    places: Places = {}
    if "head" in layout:
        places[groups[0][0]] = (0, "ahead")
        groups = groups[1:]
    step = 1 if "middles" in layout else 2
    return places | {
        marker: (step * k, "") for k, group in enumerate(groups) for marker in group
    }


def _assignments(
    markers: CapturedMarkers, layout: str, spec: RobotSpec, head: str | None
) -> list[_Assignment]:
    if markers.table.places:
        return [
            _Assignment(layout, _named_places(markers, spec), "connector 1 of the file")
        ]
    groups = _groups_along_body(markers, layout, spec)
    labels = markers.table.labels
    options = [_stations(layout, order) for order in (groups, groups[::-1])]
    if head is not None:
        if head not in labels:
            raise UnknownNameError("marker", head, labels)
        heads = [
            [markers.name(k) for k, (station, _) in places.items() if not station]
            for places in options
        ]
        if head not in heads[0] + heads[1]:
            raise InputError(
                f"the marker '{head}' is at neither end of the body; give a marker"
                " at one of the ends"
            )
        return [_Assignment(layout, options[head not in heads[0]], f"marker '{head}'")]
    if "head" in layout:
        return [
            _Assignment(layout, places, "the end with a second marker")
            for places in options
        ]
    centres = np.stack(
        [markers.points[:, list(group)].mean(axis=1) for group in groups], axis=1
    )
    crawled = forward_distance(float(np.median(np.diff(markers.time))), centres)
    required = _MIN_CRAWLED * spec.geometry.body_length
    if abs(crawled) < required:
        ends = " or ".join(f"'{markers.name(groups[end][0])}'" for end in (0, -1))
        raise InputError(
            "the head cannot be determined, because the body crawled only"
            f" {1e3 * abs(crawled):.3g} mm along its axis (at least"
            f" {1e3 * required:.3g} mm are needed); set --head to the name of the"
            f" marker at the head ({ends})"
        )
    reason = f"the end towards which it crawled ({abs(crawled):.3g} m)"
    return [_Assignment(layout, options[crawled < 0], reason)]


def _best_fit(
    markers: CapturedMarkers,
    spec: RobotSpec,
    options: Sequence[_Assignment],
    refused: Sequence[str],
) -> _Assignment:
    thinned = markers.thinned()
    noises = list[float]()
    notes = [*refused]
    for option in options:
        try:
            noises.append(_fit_body(thinned, spec, option.places)[0].noise)
            note = f"residual of {1e3 * noises[-1]:.2g} mm"
        except InputError as error:
            noises.append(np.inf)
            note = str(error)
        notes.append(
            f"{option.layout} with '{markers.name(next(iter(option.places)))}' at the"
            f" head: {note}"
        )
    best, second = np.sort([*noises, np.inf, np.inf])[:2]
    if not (np.isfinite(best) and second > _CLEAR_NOISE_RATIO * best):
        raise InputError(
            "the layout and the head of the markers cannot be determined"
            f" ({'; '.join(notes)}); give --layout, or set --head to the name of the"
            " marker at the head"
        )
    return options[int(np.argmin(noises))]


def _named_places(markers: CapturedMarkers, spec: RobotSpec) -> Places:
    places = markers.table.places
    main = markers.main_columns
    if sorted(main) != list(range(len(places))):
        raise InputError(
            "the markers cannot be identified by column name, because they switch"
            " columns too often; remove the marker places (`markers` in --map, or"
            " --marker), so that the markers are identified by their motion"
        )
    last = max(station for station, _ in places)
    if last > 2 * spec.segments:
        raise InputError(
            f"{_station_name(last)} does not exist, because {spec.name} has"
            f" {spec.geometry.connectors} connectors"
        )
    return {main.index(column): place for column, place in enumerate(places)}
