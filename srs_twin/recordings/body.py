r"""Body: markers that are known over time, as connectors with places and headings, head first.

Headings of the connectors, from two markers at each or from one.

With two markers a connector its heading is that of the line through them (Algorithm 1), turned by the quarter
turns that lie between that line and the body.

With one, a segment's chord lies along the mean heading of its ends, so the directions α_j of the chords give
all headings but for one number a frame, the ε by which they may turn in opposite senses:

$$ \theta_{j+1} = 2\alpha_j - \theta_j, \qquad q_j = q_j^0 + 2\,(-1)^{j-1}\varepsilon. $$

The lengths of the chords, which shorten as segments bend, and a second marker on the head tell it:

$$ \varepsilon = \arg\min \sum_j \frac{(L(q_j) + c_j - d_j)^2}{2\sigma^2}
   + \frac{\varepsilon^2}{\sigma_\varepsilon^2} + \frac{(\theta_1 - \vartheta)^2}{\sigma_\vartheta^2}, $$

where q⁰ bends least, d_j are the measured lengths, and c_j what the robot's segments are longer than its file
says. Near a straight body the lengths say little: there ε is known to about 0.1 rad without the head's second
marker.

Completion: frames on which a marker was not seen, from those that were and from what the body can do.

The body is laid through the markers that were seen (σ), near the bends that a spline through the complete
frames has (σ_q), and, where too little was seen to tell, near where the hidden markers were interpolated
(σ_h):

$$ \min_{x, y, \theta_1, q}\; \sum_m \frac{|p_m - \hat p_m|^2}{\sigma_m^2}
   + \sum_j \frac{(q_j - \hat q_j)^2}{\sigma_q^2}, \qquad
   p_{j+1} = p_j - L(q_j)\,e^{i\alpha_j}, \quad \alpha_j = \theta_j - q_j/2, \quad
   \theta_{j+1} = \theta_j - q_j. $$

Points are complex numbers here.
"""

from __future__ import annotations

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

_ASKEW = np.radians(25.0)
_ROUNDS, _STEPS = 8, 6
_STARTS = np.linspace(-0.6, 0.6, 9)


def chord_directions(position: np.ndarray) -> np.ndarray:
    """Return the directions from each connector to the one before it, unwrapped, (frames, segments), rad."""
    angle = pair_heading(position[:, 1:], position[:, :-1])
    return np.unwrap(np.unwrap(angle, axis=1)[:, :1], axis=0) + np.unwrap(angle, axis=1) - angle[:, :1]


def from_pairs(name: str, first: np.ndarray, second: np.ndarray) -> tuple[np.ndarray, int]:
    """Return headings of the connectors, and on how many of the frames' pairs the markers had changed names.

    Args:
        name: of the file.
        first: one marker of each connector, head first, shape (frames, N, 2), m.
        second: the other.

    Returns:
        Shape (frames, N), rad, each within a quarter turn of the body; a number.

    Raises:
        InputError: a pair lies neither along nor across the body.
    """
    direction = chord_directions((first + second) / 2)
    body = np.concatenate(
        [direction[:, :1], (direction[:, 1:] + direction[:, :-1]) / 2, direction[:, -1:]], axis=1
    )
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
            f"{name}: the two markers at connector {k + 1} lie {np.degrees(mean[k]):.0f}° from the body; "
            "along it or "
            "across it is wanted"
        )
    heading = angle - quarters * np.pi / 2
    # Modulo half a turn: the two markers of a pair may have changed names, and the connector heads ahead.
    off = (heading - body + np.pi / 2) % np.pi - np.pi / 2
    turned = np.abs((heading - body - off + np.pi) % (2 * np.pi) - np.pi) > 1.0
    return np.unwrap(body + off, axis=0), int(turned.sum())


def from_positions(
    position: np.ndarray, geometry: Geometry, head: np.ndarray | None = None, head_error: float = np.inf
) -> tuple[np.ndarray, np.ndarray]:
    """Return headings of the connectors, and c_j.

    Args:
        position: shape (frames, N, 2), m.
        geometry: of the robot.
        head: measured heading of the first connector, shape (frames,), rad, on any turn; None: not measured.
        head_error: its standard error, rad.

    Returns:
        Shape (frames, N), rad; shape (segments,), m.
    """
    alpha = chord_directions(position)
    distance = np.linalg.norm(np.diff(position, axis=1), axis=-1)
    sign = (-1.0) ** np.arange(alpha.shape[1])
    theta = _least_bent(alpha, sign)
    bend = theta[:, :-1] - theta[:, 1:]
    aim, weight, prior = np.zeros(len(bend)), 0.0, PRIOR**-2
    if head is not None:
        prior = 0.0
        aim = (head - theta[:, 0] + np.pi) % (2 * np.pi) - np.pi
        weight = 1.0 / head_error**2
    longer = np.zeros(bend.shape[1])
    epsilon = _best_start(bend, sign, distance, longer, geometry, aim, weight)
    for _ in range(_ROUNDS):
        for _ in range(_STEPS):
            length, slope, _ = chords(
                bend + 2 * sign * epsilon[:, None], geometry.segment_length, geometry.rigid_gap
            )
            miss, lever = length + longer - distance, 2 * sign * slope
            down = (miss * lever).sum(axis=1) / (2 * NOISE**2) + epsilon * prior + (epsilon - aim) * weight
            curve = (lever**2).sum(axis=1) / (2 * NOISE**2) + prior + weight
            epsilon = epsilon - np.clip(down / curve, -0.2, 0.2)
        length = chords(bend + 2 * sign * epsilon[:, None], geometry.segment_length, geometry.rigid_gap)[0]
        longer = np.median(distance - length, axis=0)
    swing = (-1.0) ** np.arange(theta.shape[1])
    return theta + swing * epsilon[:, None], longer


def _least_bent(alpha: np.ndarray, sign: np.ndarray) -> np.ndarray:
    """Return the headings that bend least among those that the chords allow, (frames, N), rad."""
    theta = np.zeros((alpha.shape[0], alpha.shape[1] + 1))
    theta[:, 0] = alpha[:, 0]
    for j in range(alpha.shape[1]):
        theta[:, j + 1] = 2 * alpha[:, j] - theta[:, j]
    epsilon = -((theta[:, :-1] - theta[:, 1:]) * sign).mean(axis=1) / 2
    swing = (-1.0) ** np.arange(theta.shape[1])
    return np.asarray(theta + swing * epsilon[:, None])


def _best_start(
    bend: np.ndarray,
    sign: np.ndarray,
    distance: np.ndarray,
    longer: np.ndarray,
    geometry: Geometry,
    aim: np.ndarray,
    weight: float,
) -> np.ndarray:
    """Return the ε of a coarse grid that fits each frame best, shape (frames,): there are many minima."""
    costs = []
    for start in _STARTS:
        length = chords(bend + 2 * sign * start, geometry.segment_length, geometry.rigid_gap)[0]
        miss = ((length + longer - distance) ** 2).sum(axis=1) / (2 * NOISE**2)
        costs.append(miss + start**2 / PRIOR**2 + (start - aim) ** 2 * weight)
    return np.asarray(_STARTS[np.argmin(costs, axis=0)])


BENDS = 0.15
"""σ_q, rad."""

HIDDEN = 1e-2
"""σ_h, m."""

_COMPLETION_STEPS = 6


def completed(
    time: np.ndarray,
    points: np.ndarray,
    missing: np.ndarray,
    connector: np.ndarray,
    position: np.ndarray,
    theta: np.ndarray,
    geometry: Geometry,
    longer: np.ndarray,
) -> tuple[np.ndarray, np.ndarray]:
    """Return places and headings of the connectors, those anew that a marker which was not seen tells of.

    Args:
        time: shape (frames,), s.
        points: markers, interpolated where they were not seen, shape (frames, markers, 2), m.
        missing: where that is, shape (frames, markers).
        connector: on which connector each marker is, from 0, shape (markers,).
        position: connectors by the markers, interpolated ones as well, shape (frames, N, 2), m.
        theta: their headings, shape (frames, N), rad.
        geometry: of the robot.
        longer: by how much its segments are longer than that, shape (segments,), m.
    """
    torn = missing.any(axis=1)
    if not torn.any() or (~torn).sum() < 4:
        return position, theta
    from scipy.interpolate import CubicSpline

    place, mark = position @ [1, 1j], points @ [1, 1j]
    local = (mark - place[:, connector]) * np.exp(-1j * theta[:, connector])
    arm = np.median(local[~torn].real, axis=0) + 1j * np.median(local[~torn].imag, axis=0)
    # Headings by interpolated markers may be any: two of a pair come close to each other.
    turns = CubicSpline(time[~torn], theta[~torn])(time[torn])
    aim = turns[:, :-1] - turns[:, 1:]
    weight = np.where(missing[torn], HIDDEN**-2, NOISE**-2)
    state = np.concatenate([place[torn, :1].real, place[torn, :1].imag, turns[:, :1], aim], axis=1)
    for _ in range(_COMPLETION_STEPS):
        seat, lever, _, _ = _laid(state, arm, connector, geometry, longer)
        miss = mark[torn] - seat
        # Normal equations of each frame: real and imaginary part of every marker.
        normal = np.einsum("fmu,fm,fmv->fuv", lever.conj(), weight, lever).real
        right = np.einsum("fmu,fm,fm->fu", lever.conj(), weight, miss).real
        bends = np.arange(3, state.shape[1])
        normal[:, bends, bends] += BENDS**-2
        right[:, 3:] += (aim - state[:, 3:]) * BENDS**-2
        state = state + np.clip(np.linalg.solve(normal, right[..., None])[..., 0], -0.3, 0.3)
    _, _, nodes, headings = _laid(state, arm, connector, geometry, longer)
    hidden = np.stack([missing[torn][:, connector == k].any(axis=1) for k in range(theta.shape[1])], axis=1)
    # Places that were measured stay; so do headings, where each connector has its own.
    stays = ~hidden & (np.bincount(connector).min() > 1)
    position, theta = position.copy(), theta.copy()
    laid = np.stack([nodes.real, nodes.imag], axis=-1)
    position[torn] = np.where(hidden[..., None], laid, position[torn])
    theta[torn] = np.where(stays, theta[torn], headings)
    return position, theta


def _laid(
    state: np.ndarray, arm: np.ndarray, connector: np.ndarray, geometry: Geometry, longer: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Return markers and how they move with the state, and connectors with their headings.

    Args:
        state: x, y, θ_1 and bends, shape (frames, 2 + N).
        arm: from a connector to its marker in the connector's frame, shape (markers,), m.
        connector: of each marker, from 0.
        geometry: of the robot.
        longer: as in `completed`.

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
    reach = arm * np.exp(1j * headings[:, connector])
    marks = nodes[:, connector] + reach
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
