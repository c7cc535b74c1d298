r"""Least-squares fit of the pose, bends and segment lengths in each frame.

**Model.** A *station* is a numbered point along the body. Even stations are the
connectors, starting with 0 at the head, and odd stations are the middles of the
segments. A marker m at station k has the position

$$ p_m = P_k + a_m\,e^{i\theta_k}, $$

where a_m is the offset of the marker in the frame of the station. Complex numbers
represent points in the plane. An arc of length ℓ_j and bend q_j joins adjacent
connectors, with half of the rigid gap g at each end:

$$ P_{j+1} = P_j - e^{i\theta_j}\Bigl(\tfrac g2 + \ell_j E(q_j) + \tfrac g2 e^{-iq_j}\Bigr),
   \qquad E(\varphi) = \int_0^1 e^{-i\varphi u}\,du, \qquad \theta_{j+1} = \theta_j - q_j. $$

**Estimation.** The state (x, y, θ_1, q, ℓ) of each frame minimises

$$ \sum_m \frac{|p_m - \hat p_m|^2}{\sigma^2} + \sum_j \frac{(\ell_j - \bar\ell_j)^2}{\sigma_\ell^2}
   + \frac{\varepsilon^2}{\sigma_\varepsilon^2} + \sum_j \frac{(q_j - \hat
   q_j)^2}{\sigma_q^2}. $$

The Gauss-Newton method finds the minimum, and the inverse of the Gauss-Newton matrix
gives the standard errors. The last term is included only in frames with hidden markers,
where it keeps the bends close to a spline through the other frames. The term with the
alternating bend ε is included only if the segment lengths are assumed to be constant
(see `shape`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from srs_twin.errors import InputError
from srs_twin.robot.geometry import half_angle_terms
from srs_twin.robot.spec import Geometry

SIDE_DIRECTIONS = {"": 0, "ahead": 1, "behind": -1, "left": 1j, "right": -1j}
"""Direction from a station to a marker on each side, in the frame of the station."""

_MAX_PAIR_ANGLE = np.radians(25.0)
"""Maximum angle of a marker pair to the body axis or its normal, rad."""
_BEND_STD = 0.15
"""Standard deviation σ_q of bends from the spline if markers are hidden, rad."""
_HIDDEN_STD = 1e-2
"""Assumed standard deviation of the interpolated position of a hidden marker, m."""
_FLAT_PRIOR_STD = 1e3
"""Prior standard deviation of headings and bends to avoid singular matrices, rad."""
_MAX_ANGLE_STEP = 0.3
"""Maximum change of heading and bends in a Gauss-Newton step, rad."""
_MAX_STEPS = 15
_CONVERGED_STEP = 1e-5
"""Convergence tolerance of the Gauss-Newton step, rad and m."""
_MAX_LENGTH = 1e3
"""Maximum segment length, which limits a fit that diverges, m."""
_ALTERNATING_STARTS = np.linspace(-0.6, 0.6, 13)
"""Trial values of the alternating bend ε, rad."""
_SWAP_NOISE = 4.0
"""Ratio of marker residual to noise above which a swap within a pair is tested."""


class _Kinematics(NamedTuple):
    marker: np.ndarray
    jacobian: np.ndarray
    connector: np.ndarray
    heading: np.ndarray


@dataclass(frozen=True)
class MarkerPlacement:
    """Placement of the markers on the body.

    Attributes:
        station: station number of each marker, shape (markers,).
        offset: complex offset of each marker in the frame of its station, m, shape
            (markers,).
    """

    station: np.ndarray
    offset: np.ndarray
    geometry: Geometry

    def kinematics(self, state: np.ndarray) -> _Kinematics:
        """Return marker positions with Jacobians, and connector positions and headings.

        `state` contains x, y and θ_1 of the first connector, the bends and the segment
        lengths, shape (frames, 3 + 2 segments).
        """
        count = self.geometry.connectors - 1
        # The middle station divides every segment into two halves. Half of the rigid
        # gap lies in front of the first half, and half lies behind the second half.
        turn, length = np.split(np.repeat(state[:, 3:] / 2, 2, axis=1), 2, axis=1)
        before, after = (
            np.tile(ends, count) * self.geometry.rigid_gap / 2
            for ends in ([1, 0], [0, 1])
        )
        theta = state[:, 2:3] - np.pad(np.cumsum(turn, axis=1), ((0, 0), (1, 0)))
        direction = np.exp(1j * theta)
        rotation = np.exp(-1j * turn)
        front_direction = direction[:, :-1]
        arc, arc_derivative = _mean_direction(turn)
        span = front_direction * (before + length * arc + after * rotation)
        station = (
            state[:, :1]
            + 1j * state[:, 1:2]
            - np.pad(np.cumsum(span, axis=1), ((0, 0), (1, 0)))
        )
        marker = station[:, self.station] + self.offset * direction[:, self.station]
        jacobian = np.empty((*marker.shape, state.shape[1]), dtype=complex)
        jacobian[..., 0] = 1
        jacobian[..., 1] = 1j
        jacobian[..., 2] = 1j * (marker - station[:, :1])
        # Bending a half segment changes the chord of this half and rotates all stations
        # behind the half about its rear end. Lengthening the half displaces these
        # stations.
        moved = self.station[:, None] > np.arange(2 * count)
        chord_derivative = front_direction * (
            length * arc_derivative - 1j * after * rotation
        )
        by_turn = -chord_derivative[:, None] - 1j * (
            marker[..., None] - station[:, None, 1:]
        )
        by_length = -(front_direction * arc)[:, None]
        for k, by_half in ((3, by_turn), (3 + count, by_length)):
            derivative = np.where(moved, by_half, 0)
            jacobian[..., k : k + count] = (
                derivative[..., ::2] + derivative[..., 1::2]
            ) / 2
        return _Kinematics(marker, jacobian, station[:, ::2], theta[:, ::2])


def _mean_direction(turn: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return E(φ) and dE/dφ for a bend φ (rad)."""
    cosine, sine, arc, derivative, _ = half_angle_terms(turn)
    rotation = cosine - 1j * sine
    return arc * rotation, (derivative - 0.5j * arc) * rotation


def marker_offsets(
    points: np.ndarray,
    missing: np.ndarray,
    places: Sequence[tuple[int, str]],
    names: Sequence[str],
) -> np.ndarray:
    """Return the complex offsets of markers from their stations, m, shape (markers,).

    A single marker at a station has an offset of 0. Two markers without a stated side
    are assumed to lie symmetrically about the station, along or across the body. Two
    markers with the same name represent a rigid body, and the line between them may
    have any direction. The positions of hidden markers in `points` must be
    interpolated.
    """
    offsets = np.zeros(len(places), dtype=complex)
    position = points @ [1, 1j]
    station = np.array([place for place, _ in places])
    members = [
        np.flatnonzero(station == value).tolist() for value in np.unique(station)
    ]
    centres = [position[:, group].mean(axis=1) for group in members]
    for k, group in enumerate(members):
        if len(group) == 1:
            continue
        if len(group) > 2:
            listed = ", ".join(names[marker] for marker in group)
            raise InputError(
                f"{len(group)} markers are assigned to one place on the body"
                f" ({listed}), but at most two are allowed"
            )
        a, b = group
        line = position[:, a] - position[:, b]
        distance = float(np.median(np.abs(line)))
        sides = [SIDE_DIRECTIONS[places[marker][1]] for marker in group]
        if any(sides):
            if sides[0] == sides[1]:
                raise InputError(
                    f"{names[a]} and {names[b]} are on the same side of one connector;"
                    " place the two markers on different sides"
                )
            side_distance = abs(sides[0] - sides[1]) if all(sides) else 1
            offsets[group] = [distance * side / side_distance for side in sides]
            continue
        # The argument of this complex ratio is the angle between the marker pair and
        # the line through the adjacent stations.
        ratio = line / (centres[max(k - 1, 0)] - centres[min(k + 1, len(centres) - 1)])
        visible = ~missing[:, group].any(axis=1)
        ratio = ratio[visible] if visible.any() else ratio
        angle = float(np.angle(np.exp(1j * np.angle(ratio)).mean()))
        if names[a] != names[b]:
            quarter = np.pi / 2 * np.rint(angle / (np.pi / 2))
            if abs(angle - quarter) > _MAX_PAIR_ANGLE:
                raise InputError(
                    f"the line from {names[a]} to {names[b]} makes an angle of"
                    f" {np.degrees(angle):.0f}° with the body; place the two markers"
                    " along the body or across it"
                )
            angle = quarter
        offsets[group] = distance / 2 * np.exp(1j * angle) * np.array([1, -1])
    return offsets


@dataclass
class StatePrior:
    """Marker noise and prior distribution of the state.

    Attributes:
        noise: standard deviation σ of the noise in a marker coordinate, m.
        length_mean: mean segment lengths, m, shape (segments,).
        alternating_std: standard deviation σ_ε of the alternating bend ε, rad, or None
            if the markers determine ε.
    """

    noise: float
    length_mean: np.ndarray
    length_std: float
    alternating_std: float | None

    @property
    def bends(self) -> slice:
        """Slice that selects the bends in the state."""
        return slice(3, 3 + len(self.length_mean))

    @property
    def lengths(self) -> slice:
        """Slice that selects the segment lengths in the state."""
        return slice(3 + len(self.length_mean), None)

    @property
    def alternating_weights(self) -> np.ndarray:
        """Derivatives of ε with respect to the bends q, shape (segments,)."""
        count = len(self.length_mean)
        return np.asarray((-1.0) ** np.arange(count) / (2 * count))

    def information(self) -> np.ndarray:
        """Return the information matrix of the prior distribution."""
        count = len(self.length_mean)
        matrix = np.diag(
            np.repeat(
                [0.0, _FLAT_PRIOR_STD**-2, self.length_std**-2], [2, 1 + count, count]
            )
        )
        if self.alternating_std is not None:
            weights = self.alternating_weights
            matrix[self.bends, self.bends] += (
                np.outer(weights, weights) / self.alternating_std**2
            )
        return matrix


@dataclass(frozen=True)
class FrameFit:
    """Fit results for several frames.

    Attributes:
        covariance: inverse of the Gauss-Newton matrix, shape (frames, 3 + 2 segments, 3
            + 2 segments).
        distance: distances of the markers from their fitted positions, m, shape
            (frames, markers).
        chi2: sum of the squared normalised marker residuals over all frames.
    """

    state: np.ndarray
    covariance: np.ndarray
    distance: np.ndarray
    cost: np.ndarray
    chi2: float
    freedom: float

    def error(self, components: slice) -> np.ndarray:
        """Return standard errors of state components, shape (frames, components)."""
        return np.asarray(
            np.sqrt(np.diagonal(self.covariance, axis1=1, axis2=2)[:, components])
        )


def fit_frames(
    state: np.ndarray,
    measured: np.ndarray,
    placement: MarkerPlacement,
    prior: StatePrior,
    missing: np.ndarray | None = None,
) -> FrameFit:
    """Fit the state of each frame by the Gauss-Newton method.

    Args:
        state: initial states, shape (frames, 3 + 2 segments). In frames with hidden
            markers, the fit keeps the bends close to the initial bends q̂.
        measured: complex marker positions, m, shape (frames, markers). The positions of
            hidden markers are interpolated.
        placement: placement of the markers on the body.
        prior: prior distribution of the state.
        missing: mask of hidden markers, shape (frames, markers), or None if all markers
            are visible.
    """
    count = len(prior.length_mean)
    width = state.shape[1]
    information = prior.information()
    prior_mean = np.zeros_like(state)
    prior_mean[:, prior.lengths] = prior.length_mean
    weight = np.full(measured.shape, prior.noise**-2)
    if missing is not None:
        weight[missing] = _HIDDEN_STD**-2
        information[prior.bends, prior.bends] += _BEND_STD**-2 * np.eye(count)
        prior_mean[:, prior.bends] = state[:, prior.bends]
    state, active = state.copy(), np.arange(len(state))
    max_step = np.repeat([np.inf, _MAX_ANGLE_STEP, np.inf], [2, 1 + count, count])
    bound = np.repeat([np.inf, 2 * np.pi, _MAX_LENGTH], [3, count, count])
    data = np.empty((len(state), width, width))
    residual = np.empty(measured.shape, dtype=complex)
    for _ in range(_MAX_STEPS):
        body = placement.kinematics(state[active])
        residual[active] = difference = measured[active] - body.marker
        weighted = (body.jacobian.conj() * weight[active][..., None]).transpose(0, 2, 1)
        data[active] = inner = (weighted @ body.jacobian).real
        gradient = (weighted @ difference[..., None])[..., 0].real
        gradient = gradient + (prior_mean - state)[active] @ information
        step = np.linalg.solve(inner + information, gradient[..., None])[..., 0]
        step = np.clip(step, -max_step, max_step)
        state[active] = np.clip(state[active] + step, -bound, bound)
        active = active[np.abs(step).max(axis=1) > _CONVERGED_STEP]
        if not active.size:
            break
    covariance = np.linalg.inv(data + information)
    # This trace is the effective number of parameters that the markers determine.
    parameters = np.einsum("fuv,fvu->", covariance, data)
    squares = weight * np.abs(residual) ** 2
    deviation = prior_mean - state
    cost = squares.sum(axis=1) + np.einsum(
        "fu,uv,fv->f", deviation, information, deviation
    )
    chi2 = float(squares.sum())
    freedom = float(2 * squares.size - parameters)
    return FrameFit(state, covariance, np.abs(residual), cost, chi2, freedom)


def fit_incomplete_frames(
    state: np.ndarray,
    measured: np.ndarray,
    missing: np.ndarray,
    placement: MarkerPlacement,
    prior: StatePrior,
) -> FrameFit:
    """Fit the states of frames with hidden markers.

    If only one marker of a pair is visible, the tracking may have confused the two
    markers. In frames with a large residual, both assignments are fitted, and the fit
    with the smaller cost is returned.
    """
    best = fit_frames(state, measured, placement, prior, missing)
    for station in np.unique(placement.station):
        pair = np.flatnonzero(placement.station == station)
        if len(pair) != 2 or placement.offset[pair].sum() != 0:
            continue
        poor = (np.where(missing, 0.0, best.distance) > _SWAP_NOISE * prior.noise).any(
            axis=1
        )
        rows = np.flatnonzero(poor & (missing[:, pair].sum(axis=1) == 1))
        swapped = np.arange(len(placement.station))
        swapped[pair] = pair[::-1]
        other = fit_frames(
            state[rows],
            measured[rows][:, swapped],
            placement,
            prior,
            missing[rows][:, swapped],
        )
        better = other.cost < best.cost[rows]
        for name in ("state", "covariance", "distance", "cost"):
            getattr(best, name)[rows[better]] = getattr(other, name)[better]
    return best


def initial_states(
    measured: np.ndarray, placement: MarkerPlacement, prior: StatePrior
) -> np.ndarray:
    """Return approximate states from which the fit starts.

    The headings are interpolated along the body between the directions of marker pairs
    and of lines through adjacent stations.
    """
    from scipy.interpolate import make_interp_spline

    if prior.alternating_std is not None:
        return _fixed_length_states(measured, placement, prior)
    stations = np.unique(placement.station)
    directions = list[tuple[float, np.ndarray]]()
    centre = np.empty((len(measured), len(stations)), dtype=complex)
    for k, station in enumerate(stations):
        members = np.flatnonzero(placement.station == station)
        offset = placement.offset[members]
        direction = np.zeros(len(measured))
        if len(members) == 2:
            line = (measured[:, members[0]] - measured[:, members[1]]) / (
                offset[0] - offset[1]
            )
            direction = line / np.maximum(np.abs(line), 1e-12)
            directions.append((float(station), np.angle(direction)))
        centre[:, k] = (measured[:, members] - offset * direction[:, None]).mean(axis=1)
    between = (stations[1:] + stations[:-1]) / 2
    directions += zip(between.tolist(), np.angle(-np.diff(centre).T), strict=True)
    positions, angles = zip(*sorted(directions, key=lambda item: item[0]), strict=True)
    heading = make_interp_spline(positions, np.unwrap(angles, axis=0), k=1)
    theta = heading(2 * np.arange(len(prior.length_mean) + 1)).T
    origin = np.zeros((len(measured), 2))
    length = np.full(
        (len(measured), len(prior.length_mean)), placement.geometry.segment_length
    )
    state = np.column_stack([origin, theta[:, 0], -np.diff(theta), length])
    shift = (measured - placement.kinematics(state).marker).mean(axis=1)
    state[:, 0] = shift.real
    state[:, 1] = shift.imag
    return state


def _fixed_length_states(
    measured: np.ndarray, placement: MarkerPlacement, prior: StatePrior
) -> np.ndarray:
    """Return approximate states for constant lengths, with ε from a coarse grid search.

    Each connector has one marker. By symmetry, the direction α_j of the line between
    two adjacent connectors is the mean of their headings, so θ_{j+1} = 2α_j − θ_j.
    """
    count = len(prior.length_mean)
    order = np.argsort(placement.station)
    sign = (-1.0) ** np.arange(count + 1)
    span = -np.diff(measured[:, order], axis=1)
    assert span.shape[1] == count and prior.alternating_std is not None, (
        "one marker at each connector"
    )
    alpha = np.unwrap(np.angle(span), axis=1)
    # The value (−1)^j θ_j changes by −2 (−1)^j α_j from one connector to the next.
    alternating = np.cumsum(
        np.column_stack([alpha[:, 0], -2 * sign[:-1] * alpha]), axis=1
    )
    bend = -np.diff(sign * alternating)
    # The mean of (−1)^j q_j is ±2 ε.
    mean = (bend * sign[:-1]).mean(axis=1, keepdims=True)
    epsilon = _ALTERNATING_STARTS[:, None, None]
    bends = bend - sign[:-1] * (mean - 2 * epsilon)
    gaps = placement.geometry.rigid_gap * np.cos(bends / 2)
    chord = prior.length_mean * np.abs(_mean_direction(bends)[0]) + gaps
    error = (chord - np.abs(span)) ** 2
    costs = error.sum(axis=2) / (2 * prior.noise**2 + prior.length_std**2)
    costs += (epsilon[:, 0] / prior.alternating_std) ** 2
    best = np.argmin(costs, axis=0)
    first = measured[:, order[0]]
    heading = alpha[:, 0] - mean[:, 0] / 2 + _ALTERNATING_STARTS[best]
    bend = bends[best, np.arange(len(measured))]
    length = np.tile(prior.length_mean, (len(measured), 1))
    return np.column_stack([first.real, first.imag, heading, bend, length])
