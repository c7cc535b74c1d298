r"""From markers that are known over time to connectors with places and headings, head first.

**Which marker is where** follows from the names of a file's columns or from `layout`.

**Headings.** With two markers a connector its heading is that of the line through them (Algorithm 1), turned
by the quarter turns that lie between that line and the body. With one, a segment's chord lies along the mean
heading of its ends, so the directions α_j of the chords give all headings but for one number a frame, the ε
by which they may turn in opposite senses:

$$ \theta_{j+1} = 2\alpha_j - \theta_j, \qquad q_j = q_j^0 + 2\,(-1)^{j-1}\varepsilon. $$

The lengths of the chords, which shorten as segments bend, and a second marker on the head tell it:

$$ \varepsilon = \arg\min \sum_j \frac{(L(q_j) + c_j - d_j)^2}{2\sigma^2}
   + \frac{\varepsilon^2}{\sigma_\varepsilon^2} + \frac{(\theta_1 - \vartheta)^2}{\sigma_\vartheta^2}, $$

where q⁰ bends least, d_j are the measured lengths, and c_j what the robot's segments are longer than its file
says. Near a straight body the lengths say little: there ε is known to about 0.1 rad without the head's second
marker.

**Completion.** Where a marker was not seen, the body is laid through those that were (σ), near the bends that
a spline through the complete frames has (σ_q), and, where too little was seen to tell, near where the hidden
markers were interpolated (σ_h):

$$ \min_{x, y, \theta_1, q}\; \sum_m \frac{|p_m - \hat p_m|^2}{\sigma_m^2}
   + \sum_j \frac{(q_j - \hat q_j)^2}{\sigma_q^2}, \qquad
   p_{j+1} = p_j - L(q_j)\,e^{i\alpha_j}, \quad \alpha_j = \theta_j - q_j/2, \quad
   \theta_{j+1} = \theta_j - q_j. $$

Points are complex numbers there. Errors raised here do not name the file; `read_motion` puts its name before
them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from srs_twin.errors import InputError, UnknownNameError
from srs_twin.geometry import chord, chords, pair_heading
from srs_twin.recordings.layout import (
    body_order,
    check_spacing,
    forward_distance,
    head_marker,
    rigid_pairs,
    some_frames,
)
from srs_twin.recordings.tracking import MarkerTable
from srs_twin.robot.spec import Geometry, RobotSpec

NOISE = 5e-4
"""σ, assumed error of a marker's position, m."""

PRIOR = 0.3
"""σ_ε, rad: a gait of one wave over the body has hardly any. Where the head's heading is measured, none."""

BENDS = 0.15
"""σ_q, rad."""

HIDDEN = 1e-2
"""σ_h, m."""

_ASKEW = np.radians(25.0)
_ROUNDS, _STEPS, _COMPLETION_STEPS = 8, 6, 6
_STARTS = np.linspace(-0.6, 0.6, 9)
_FEWEST = 3  # segments whose bends the lengths of their chords tell
_CRAWLED = 0.1  # of the body's length: less does not tell which end leads
_ANOTHER_LENGTH = 0.02  # of a straight segment: from here on it is noted

Groups = list[tuple[int, ...]]
"""The markers of each connector, along the body."""


@dataclass(frozen=True)
class CapturedMarkers:
    """The robot's markers over the frames that are kept.

    Attributes:
        table: the file.
        layout: "single", "head" or "pair".
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

    @property
    def main_columns(self) -> list[int]:
        """The column that each marker was in on most frames."""
        return [int(np.bincount(column[column >= 0]).argmax()) for column in self.columns.T]

    def centres(self, groups: Sequence[tuple[int, ...]]) -> np.ndarray:
        """Return the means of groups of markers, shape (frames, groups, 2), m."""
        return np.stack([self.points[:, list(group)].mean(axis=1) for group in groups], axis=1)


@dataclass(frozen=True)
class TrackedBody:
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


def tracked_body(markers: CapturedMarkers, spec: RobotSpec, head: str | None) -> TrackedBody:
    """Find which marker is on which connector, and how the connectors head.

    Args:
        markers: what was captured.
        spec: the robot.
        head: name of a column at the head, or None.

    Raises:
        InputError: the markers do not make up this robot, or its head cannot be told.
        UnknownNameError: no column has the head's name.
    """
    geometry, layout = spec.geometry, markers.layout
    groups, how = _head_first(markers, spec, head)
    ahead = groups.pop(0)[0] if layout == "head" else None
    position = markers.centres(groups)
    spacing = check_spacing(position, geometry.pitch, spec.name)
    notes = []
    if layout == "pair":
        first, second = (markers.points[:, [group[k] for group in groups]] for k in (0, 1))
        theta, turned = headings_from_pairs(first, second)
        if turned:
            notes.append(
                f"the markers of a pair had changed names {turned} times a frame and pair: set right"
            )
    elif ahead is not None:
        front = markers.points[:, ahead]
        lever = float(np.median(np.linalg.norm(front - position[:, 0], axis=-1)))
        heading = pair_heading(position[:, 0], front)
        theta = headings_from_positions(position, geometry, heading, np.sqrt(2) * NOISE / lever)
    elif spec.segments >= _FEWEST:
        theta = headings_from_positions(position, geometry)
        notes.append(
            "one marker a connector: near a straight body bends that alternate are known to 0.2 rad only"
        )
    else:
        raise InputError(
            f"one marker a connector does not tell how {spec.segments} segments bend, only {_FEWEST} or "
            "more; put a second marker on the head"
        )
    longer = np.median(_beyond_chords(position, theta, geometry), axis=0)
    carried = [(marker, k) for k, group in enumerate(groups) for marker in group]
    carried += [(ahead, 0)] if ahead is not None else []
    position, theta = _completed(markers, carried, position, theta, geometry, longer)
    residual = _beyond_chords(position, theta, geometry) - longer
    if np.abs(longer).max() > _ANOTHER_LENGTH * geometry.pitch:
        listed = ", ".join(f"{1e3 * each:+.1f}" for each in longer)
        notes.append(f"segments are longer than {spec.name}'s by {listed} mm, head first: taken as measured")
    members = tuple(tuple(each for each, at in carried if at == k) for k in range(len(groups)))
    return TrackedBody(position, theta, members, residual, spacing, how, tuple(notes))


def _beyond_chords(position: np.ndarray, theta: np.ndarray, geometry: Geometry) -> np.ndarray:
    """Return what neighbours are farther apart than their bends have it, (frames, segments), m."""
    length = chord(theta[:, :-1] - theta[:, 1:], geometry.segment_length, geometry.rigid_gap)
    return np.asarray(np.linalg.norm(np.diff(position, axis=1), axis=-1) - length)


def _head_first(markers: CapturedMarkers, spec: RobotSpec, head: str | None) -> tuple[Groups, str]:
    """Return the groups of markers from the head on, and how it was found.

    With layout "head" the first group is the marker ahead of the head.
    """
    table, points = markers.table, markers.points
    if table.connectors:
        return _named_groups(markers, spec), "connector 1 of the file"
    if markers.layout == "head":
        order = head_marker(points, body_order(points))
        return [(int(k),) for k in order], "the end with a second marker"
    if markers.layout == "pair":
        pairs = rigid_pairs(points, spec.geometry.connectors)
        order = body_order(points[:, pairs].mean(axis=2))
        groups: Groups = [tuple(int(k) for k in pairs[j]) for j in order]
    else:
        groups = [(int(k),) for k in body_order(points)]
    if head is not None:
        if head not in table.labels:
            raise UnknownNameError("marker", head, table.labels)
        main = markers.main_columns
        front, rear = ([table.labels[main[k]] for k in groups[end]] for end in (0, -1))
        if head not in front + rear:
            raise InputError(f"marker '{head}' is at neither end of the body")
        return groups if head in front else groups[::-1], f"marker '{head}'"
    crawled = forward_distance(float(np.median(np.diff(markers.time))), markers.centres(groups))
    least = _CRAWLED * spec.geometry.body_length
    if abs(crawled) < least:
        raise InputError(
            f"which end is the head cannot be told, the body crawled {1e3 * abs(crawled):.3g} mm along "
            f"itself, less than {1e3 * least:.3g} mm; give head, the name of a marker there"
        )
    return groups if crawled > 0 else groups[::-1], f"the end towards which it crawled ({abs(crawled):.3g} m)"


def _named_groups(markers: CapturedMarkers, spec: RobotSpec) -> Groups:
    """Return the markers of each connector by the names of the columns they were mostly in."""
    named, main, layout = markers.table.connectors, markers.main_columns, markers.layout
    if sorted(main) != list(range(len(named))):
        raise InputError("markers cannot be told by their columns, they change places too often")
    connectors = spec.geometry.connectors
    if max(named) != connectors:
        raise InputError(f"{max(named)} connectors, {spec.name} has {connectors}")
    by_column = [int(marker) for marker in np.argsort(main)]
    groups: Groups = [
        tuple(marker for marker in by_column if named[main[marker]] == k) for k in range(1, connectors + 1)
    ]
    counts = [len(group) for group in groups]
    first, others = {"single": (1, 1), "pair": (2, 2), "head": (2, 1)}[layout]
    wanted = [first] + [others] * (connectors - 1)
    if counts != wanted:
        raise InputError(f"connectors have {counts} markers; layout {layout} has {wanted}")
    if layout == "head":
        place, ahead = groups[0]
        return [(ahead,), (place,), *groups[1:]]
    return groups


def chord_directions(position: np.ndarray) -> np.ndarray:
    """Return the directions from each connector to the one before it, unwrapped, (frames, segments), rad."""
    angle = pair_heading(position[:, 1:], position[:, :-1])
    return np.unwrap(np.unwrap(angle, axis=1)[:, :1], axis=0) + np.unwrap(angle, axis=1) - angle[:, :1]


def headings_from_pairs(first: np.ndarray, second: np.ndarray) -> tuple[np.ndarray, int]:
    """Return headings of the connectors, and on how many of the frames' pairs the markers had changed names.

    Args:
        first: one marker of each connector, head first, shape (frames, N, 2), m.
        second: the other.

    Returns:
        Shape (frames, N), rad, each within a quarter turn of the body; a number.

    Raises:
        InputError: a pair lies neither along nor across the body.
    """
    direction = chord_directions((first + second) / 2)
    inner = (direction[:, 1:] + direction[:, :-1]) / 2
    body = np.concatenate([direction[:, :1], inner, direction[:, -1:]], axis=1)
    angle = pair_heading(first, second)
    # Of doubled angles: a line has no front end.
    mean = np.angle(np.exp(2j * some_frames(angle - body)).mean(axis=0)) / 2
    ahead = np.cos(some_frames(angle - body) - mean).mean(axis=0) < 0
    mean = mean + np.pi * ahead
    quarters = np.rint(mean / (np.pi / 2))
    askew = np.abs(mean - quarters * np.pi / 2)
    if askew.max() > _ASKEW:
        k = int(askew.argmax())
        raise InputError(
            f"the two markers at connector {k + 1} lie {np.degrees(mean[k]):.0f}° from the body; along it or "
            "across it is wanted"
        )
    heading = angle - quarters * np.pi / 2
    # Modulo half a turn: the two markers of a pair may have changed names, and the connector heads ahead.
    off = (heading - body + np.pi / 2) % np.pi - np.pi / 2
    turned = np.abs((heading - body - off + np.pi) % (2 * np.pi) - np.pi) > 1.0
    return np.unwrap(body + off, axis=0), int(turned.sum())


def headings_from_positions(
    position: np.ndarray, geometry: Geometry, head: np.ndarray | None = None, head_error: float = np.inf
) -> np.ndarray:
    """Return headings of the connectors, shape (frames, N), rad.

    Args:
        position: shape (frames, N, 2), m.
        geometry: of the robot.
        head: measured heading of the first connector, shape (frames,), rad, on any turn; None: not measured.
        head_error: its standard error, rad.
    """
    alpha = chord_directions(position)
    distance = np.linalg.norm(np.diff(position, axis=1), axis=-1)
    swing = (-1.0) ** np.arange(alpha.shape[1] + 1)
    sign = swing[:-1]
    # Of the headings that the chords allow those that bend least.
    theta = np.zeros((len(alpha), len(swing)))
    theta[:, 0] = alpha[:, 0]
    for j in range(alpha.shape[1]):
        theta[:, j + 1] = 2 * alpha[:, j] - theta[:, j]
    theta = theta - swing * ((theta[:, :-1] - theta[:, 1:]) * sign).mean(axis=1, keepdims=True) / 2
    bend = theta[:, :-1] - theta[:, 1:]
    aim, weight, prior = np.zeros(len(bend)), 0.0, PRIOR**-2
    if head is not None:
        aim = (head - theta[:, 0] + np.pi) % (2 * np.pi) - np.pi
        weight, prior = 1.0 / head_error**2, 0.0

    def lengths(epsilon: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        turned = bend + 2 * sign * epsilon[:, None]
        return chords(turned, geometry.segment_length, geometry.rigid_gap)[:2]

    # There are many minima: of a coarse grid the one that fits best.
    costs = []
    for start in _STARTS:
        miss = ((lengths(np.full(len(bend), start))[0] - distance) ** 2).sum(axis=1) / (2 * NOISE**2)
        costs.append(miss + start**2 / PRIOR**2 + (start - aim) ** 2 * weight)
    epsilon = _STARTS[np.argmin(costs, axis=0)]
    longer = np.zeros(bend.shape[1])
    for _ in range(_ROUNDS):
        for _ in range(_STEPS):
            length, slope = lengths(epsilon)
            miss, lever = length + longer - distance, 2 * sign * slope
            down = (miss * lever).sum(axis=1) / (2 * NOISE**2) + epsilon * prior + (epsilon - aim) * weight
            curve = (lever**2).sum(axis=1) / (2 * NOISE**2) + prior + weight
            epsilon = epsilon - np.clip(down / curve, -0.2, 0.2)
        longer = np.median(distance - lengths(epsilon)[0], axis=0)
    return np.asarray(theta + swing * epsilon[:, None])


def _laid(
    state: np.ndarray, geometry: Geometry, longer: np.ndarray, connector: np.ndarray, arm: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Return the markers of a chain of chords, how they move with its state, connectors and their headings.

    Args:
        state: x, y, θ_1 and bends, shape (frames, 2 + N).
        geometry: of the robot.
        longer: what its segments are longer than that, shape (segments,), m.
        connector: on which connector each marker is, from 0, shape (markers,).
        arm: from a connector to its marker in the connector's frame, shape (markers,), m.

    Returns:
        Shapes (frames, markers), (frames, markers, 2 + N), (frames, N) and (frames, N).
    """
    bend = state[:, 3:]
    length, slope, _ = chords(bend, geometry.segment_length, geometry.rigid_gap)
    length = length + longer
    zero = np.zeros((len(state), 1))
    headings = state[:, 2:3] - np.concatenate([zero, np.cumsum(bend, axis=1)], axis=1)
    along = np.exp(1j * (headings[:, :-1] - bend / 2))
    first = state[:, :1] + 1j * state[:, 1:2]
    nodes = first - np.concatenate([zero, np.cumsum(length * along, axis=1)], axis=1)
    marks = nodes[:, connector] + arm * np.exp(1j * headings[:, connector])
    lever = np.zeros((*marks.shape, state.shape[1]), dtype=complex)
    lever[..., 0], lever[..., 1] = 1, 1j
    lever[..., 2] = 1j * (marks - first)
    for k in range(bend.shape[1]):
        # What lies behind segment k turns about its rear end, which moves with the chord.
        behind = connector > k
        end = (-slope[:, k] + 0.5j * length[:, k]) * along[:, k]
        turned = end[:, None] - 1j * (marks - nodes[:, k + 1 : k + 2])
        lever[:, behind, 3 + k] = turned[:, behind]
    return marks, lever, nodes, headings


def _completed(
    markers: CapturedMarkers,
    carried: list[tuple[int, int]],
    position: np.ndarray,
    theta: np.ndarray,
    geometry: Geometry,
    longer: np.ndarray,
) -> tuple[np.ndarray, np.ndarray]:
    """Return places and headings of the connectors, those anew that a marker which was not seen tells of.

    Args:
        markers: what was captured.
        carried: markers, and the connector from 0 that each is on.
        position: connectors by the markers, interpolated ones as well, shape (frames, N, 2), m.
        theta: their headings, shape (frames, N), rad.
        geometry: of the robot.
        longer: what its segments are longer than that, shape (segments,), m.
    """
    chosen, connector = np.array(carried).T
    missing = markers.missing[:, chosen]
    torn = missing.any(axis=1)
    if not torn.any() or (~torn).sum() < 4:
        return position, theta
    from scipy.interpolate import CubicSpline

    place, mark = position @ [1, 1j], markers.points[:, chosen] @ [1, 1j]
    local = (mark - place[:, connector]) * np.exp(-1j * theta[:, connector])
    arm = np.median(local[~torn].real, axis=0) + 1j * np.median(local[~torn].imag, axis=0)
    chain = geometry, longer, connector, arm
    # Headings by interpolated markers may be any: two of a pair come close to each other.
    turns = CubicSpline(markers.time[~torn], theta[~torn])(markers.time[torn])
    aim = turns[:, :-1] - turns[:, 1:]
    weight = np.where(missing[torn], HIDDEN**-2, NOISE**-2)
    state = np.concatenate([place[torn, :1].real, place[torn, :1].imag, turns[:, :1], aim], axis=1)
    bends = np.arange(3, state.shape[1])
    for _ in range(_COMPLETION_STEPS):
        seat, lever, _, _ = _laid(state, *chain)
        # Normal equations of each frame: real and imaginary part of every marker.
        normal = np.einsum("fmu,fm,fmv->fuv", lever.conj(), weight, lever).real
        right = np.einsum("fmu,fm,fm->fu", lever.conj(), weight, mark[torn] - seat).real
        normal[:, bends, bends] += BENDS**-2
        right[:, 3:] += (aim - state[:, 3:]) * BENDS**-2
        state = state + np.clip(np.linalg.solve(normal, right[..., None])[..., 0], -0.3, 0.3)
    _, _, nodes, headings = _laid(state, *chain)
    hidden = np.stack([missing[torn][:, connector == k].any(axis=1) for k in range(theta.shape[1])], axis=1)
    # Places that were measured stay; so do headings, where each connector has its own.
    stays = ~hidden & (np.bincount(connector).min() > 1)
    position, theta = position.copy(), theta.copy()
    laid = np.stack([nodes.real, nodes.imag], axis=-1)
    position[torn] = np.where(hidden[..., None], laid, position[torn])
    theta[torn] = np.where(stays, theta[torn], headings)
    return position, theta
