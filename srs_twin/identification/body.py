"""Body: markers that are known over time, as connectors with places and headings, head first."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from srs_twin.errors import InputError, UnknownNameError
from srs_twin.identification.chain import (
    body_order,
    check_spacing,
    forward_distance,
    head_marker,
    rigid_pairs,
)
from srs_twin.identification.completion import completed
from srs_twin.identification.headings import NOISE, from_pairs, from_positions
from srs_twin.identification.markers import MarkerTable
from srs_twin.shape import chord, pair_heading
from srs_twin.spec import Geometry, RobotSpec

_FEWEST = 3  # segments whose bends the lengths of their chords tell
_CRAWLED = 0.1  # of the body's length: less does not tell which end leads
_ANOTHER_LENGTH = 0.02  # of a straight segment: from here on it is said


@dataclass(frozen=True)
class Body:
    """The robot as it was captured.

    Attributes:
        position: connectors, shape (frames, N, 2), m.
        theta: their headings, unwrapped, shape (frames, N), rad.
        members: which markers each connector carries, N tuples.
        residual: by how much the distances of neighbours differ from what their bends make of the robot's
            segments, once those may be longer than the robot's file says, shape (frames, segments), m.
        spacing: largest distance of neighbours, shape (segments,), m.
        head: how the head was found, in words.
        corrections: what was found and assumed, in words.
    """

    position: np.ndarray
    theta: np.ndarray
    members: tuple[tuple[int, ...], ...]
    residual: np.ndarray
    spacing: np.ndarray
    head: str
    corrections: tuple[str, ...]

    @property
    def bend(self) -> np.ndarray:
        """q_j = θ_j − θ_{j+1}, shape (frames, segments), rad."""
        return np.asarray(self.theta[:, :-1] - self.theta[:, 1:])


def body_of(
    table: MarkerTable,
    time: np.ndarray,
    points: np.ndarray,
    origin: np.ndarray,
    layout: str,
    spec: RobotSpec,
    head: str | None,
) -> Body:
    """Tell which marker is on which connector, and how the connectors head.

    Args:
        table: the file.
        time: shape (frames,), s.
        points: markers, interpolated where they were not seen, shape (frames, markers, 2), m.
        origin: from which column each sample came, −1 where it was not seen, shape (frames, markers).
        layout: "single", "head" or "pair".
        spec: the robot.
        head: name of a column at the head, or None.

    Raises:
        InputError: the markers do not make up this robot, or its head cannot be told.
    """
    main = [int(np.bincount(column[column >= 0]).argmax()) for column in origin.T]
    groups, told = _groups(table, points, layout, spec, main)
    places = np.stack([points[:, list(group)].mean(axis=1) for group in groups], axis=1)
    if told:
        order, how = np.arange(len(groups)), told
    else:
        period = float(np.median(np.diff(time)))
        order, how = _head_first(table, places, groups, layout, main, period, spec, head)
    groups = [groups[k] for k in order]
    if layout == "head":
        extra, groups = groups[0], groups[1:]
    position = np.stack([points[:, list(group)].mean(axis=1) for group in groups], axis=1)
    geometry = spec.geometry
    spacing = check_spacing(table.name, position, geometry.pitch, spec.name)
    said = []
    if layout == "pair":
        first, second = (np.stack([points[:, group[k]] for group in groups], axis=1) for k in (0, 1))
        theta, turned = from_pairs(table.name, first, second)
        if turned:
            said.append(f"the markers of a pair had changed names {turned} times a frame and pair: set right")
    elif layout == "head":
        ahead = points[:, extra[0]] - position[:, 0]
        lever = float(np.median(np.linalg.norm(ahead, axis=-1)))
        heading = pair_heading(position[:, 0], points[:, extra[0]])
        theta, _ = from_positions(position, geometry, heading, np.sqrt(2) * NOISE / lever)
    else:
        if spec.segments < _FEWEST:
            raise InputError(
                f"{table.name}: one marker a connector does not tell how {spec.segments} segments bend, only "
                f"{_FEWEST} or more; put a second marker on the head"
            )
        theta, _ = from_positions(position, geometry)
        said.append(
            "one marker a connector: near a straight body bends that alternate are known to 0.2 rad only"
        )
    longer = np.median(_misses(position, theta, geometry), axis=0)
    carried = [(marker, k) for k, group in enumerate(groups) for marker in group]
    carried += [(extra[0], 0)] if layout == "head" else []
    chosen, connector = np.array(carried).T
    missing = origin[:, chosen] < 0
    position, theta = completed(
        time, points[:, chosen], missing, connector, position, theta, geometry, longer
    )
    residual = _misses(position, theta, geometry) - longer
    if np.abs(longer).max() > _ANOTHER_LENGTH * geometry.pitch:
        listed = ", ".join(f"{1e3 * each:+.1f}" for each in longer)
        said.append(f"segments are longer than {spec.name}'s by {listed} mm, head first: taken as measured")
    members = tuple(tuple(int(chosen[k]) for k in np.flatnonzero(connector == c)) for c in range(len(groups)))
    return Body(position, theta, members, residual, spacing, how, tuple(said))


def _misses(position: np.ndarray, theta: np.ndarray, geometry: Geometry) -> np.ndarray:
    """Return what neighbours are farther apart than their bends have it, (frames, segments), m."""
    length = chord(theta[:, :-1] - theta[:, 1:], geometry.segment_length, geometry.rigid_gap)
    return np.asarray(np.linalg.norm(np.diff(position, axis=1), axis=-1) - length)


def _groups(
    table: MarkerTable, points: np.ndarray, layout: str, spec: RobotSpec, main: list[int]
) -> tuple[list[tuple[int, ...]], str]:
    """Return the markers of each connector along the body, and how the head is known, if it is.

    With layout "head" the marker ahead of the head is the first, and the head is known.
    """
    if table.connectors:
        return _named(table, layout, spec, main), "connector 1 of the file"
    if layout == "pair":
        pairs = rigid_pairs(table.name, points, spec.geometry.connectors)
        centre = points[:, pairs].mean(axis=2)
        return [tuple(int(k) for k in pairs[j]) for j in body_order(table.name, centre)], ""
    order = body_order(table.name, points)
    if layout == "head":
        order = head_marker(table.name, points, order)
        return [(int(k),) for k in order], "the end with a second marker"
    return [(int(k),) for k in order], ""


def _named(table: MarkerTable, layout: str, spec: RobotSpec, main: list[int]) -> list[tuple[int, ...]]:
    """Return the markers of each connector by the names of the columns they were mostly in."""
    if sorted(main) != list(range(len(table.connectors))):
        raise InputError(
            f"{table.name}: markers cannot be told by their columns, they change places too often"
        )
    connectors = spec.geometry.connectors
    if max(table.connectors) != connectors:
        raise InputError(f"{table.name}: {max(table.connectors)} connectors, {spec.name} has {connectors}")
    members: dict[int, list[int]] = {}
    for marker in np.argsort(main):
        members.setdefault(table.connectors[main[marker]], []).append(int(marker))
    counts = [len(members[k]) for k in range(1, connectors + 1)]
    wanted = {"single": [1] * connectors, "pair": [2] * connectors, "head": [2] + [1] * (connectors - 1)}[
        layout
    ]
    if counts != wanted:
        raise InputError(f"{table.name}: connectors have {counts} markers; layout {layout} has {wanted}")
    groups = [tuple(members[k]) for k in range(1, connectors + 1)]
    if layout == "head":
        (place, ahead), rest = groups[0], groups[1:]
        return [(ahead,), (place,), *rest]
    return groups


def _head_first(
    table: MarkerTable,
    places: np.ndarray,
    groups: list[tuple[int, ...]],
    layout: str,
    main: list[int],
    period: float,
    spec: RobotSpec,
    head: str | None,
) -> tuple[np.ndarray, str]:
    """Return the groups' order from the head on, and how it was found."""
    order = np.arange(len(groups))
    if head is not None:
        if head not in table.labels:
            raise UnknownNameError("marker", head, table.labels)
        columns = [main[k] for k in (*groups[0], *groups[-1])]
        at = [columns.index(c) for c in columns if table.labels[c] == head]
        if not at:
            raise InputError(f"{table.name}: marker '{head}' is at neither end of the body")
        return (order if at[0] < len(groups[0]) else order[::-1]), f"marker '{head}'"
    crawled = forward_distance(period, places)
    least = _CRAWLED * spec.geometry.body_length
    if layout == "head":
        return order, "the end with a second marker"
    if abs(crawled) < least:
        raise InputError(
            f"{table.name}: which end is the head cannot be told, the body crawled {1e3 * abs(crawled):.3g} "
            "mm along "
            f"itself, less than {1e3 * least:.3g} mm; give head, the name of a marker there"
        )
    return (order if crawled > 0 else order[::-1]), f"the end towards which it crawled ({abs(crawled):.3g} m)"
