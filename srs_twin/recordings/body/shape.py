r"""The body that explains markers: places, headings, bends, lengths of segments, and standard errors.

A *station* is a place along the body: 0, 2, 4, … are the connectors, head first, 1, 3, … the middles of the
segments between them. A marker m at station k lies at

$$ p_m = P_k + a_m\,e^{i\theta_k}, $$

with its arm a_m in the station's frame. Connectors follow each other by arcs of length ℓ_j and bend q_j with
half of the rigid gap g at both ends,

$$ P_{j+1} = P_j - e^{i\theta_j}\Bigl(\tfrac g2 + \ell_j E(q_j) + \tfrac g2 e^{-iq_j}\Bigr),
   \qquad E(\varphi) = \int_0^1 e^{-i\varphi u}\,du, \qquad \theta_{j+1} = \theta_j - q_j, $$

points being complex numbers. Each frame's state (x, y, θ_1, q, ℓ) is the least of

$$ \sum_m \frac{|p_m - \hat p_m|^2}{\sigma^2} + \sum_j \frac{(\ell_j - \bar\ell_j)^2}{\sigma_\ell^2}
   + \frac{\varepsilon^2}{\sigma_\varepsilon^2} + \sum_j \frac{(q_j - \hat q_j)^2}{\sigma_q^2}, $$

by Newton's method (Gauss's matrix); the inverse of that matrix gives the errors. The last sum holds frames on
which a marker was not seen near the bends of a spline through the others.

**Lengths.** Where markers alone determine the bends, lengths are free (σ_ℓ as they vary in this take, found
with their means by expectation-maximisation). One marker at each connector leaves one number ε a frame open,
by which neighbouring headings may turn in opposite senses, q_j = q_j⁰ + 2(−1)^{j−1} ε: only lengths that
stay the same tell it, and near a straight body little. A body that stretches is refused there.

**Noise** σ is what differences of high order leave of the markers' ways, in which the motion vanishes;
where markers say things twice, it is what the body leaves of them, which counts segments that bend otherwise
than in arcs.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from math import comb

import numpy as np

from srs_twin.compute.workers import processor_count
from srs_twin.errors import InputError
from srs_twin.recordings.body.tracking import some_frames
from srs_twin.robot.geometry import half_angle_terms
from srs_twin.robot.spec import Geometry

SIDES = {"": 0, "ahead": 1, "behind": -1, "left": 1j, "right": -1j}
"""Where beside its station a marker lies → the direction there, in the station's frame."""

BENDS = 0.15
"""σ_q, rad."""

HIDDEN = 1e-2
"""Assumed error of a marker that was interpolated, m."""

_LEAST_NOISE = 1e-7  # m
_VAGUE = 1e3  # rad, of headings and bends: no knowledge, but no singular matrix
_STRETCH = 0.1  # of a segment's length: σ_ℓ before anything is known
_LOOSE, _OPEN = 0.3, 0.3  # of a length; σ_ε, rad: before anything is known
_TOLD = 0.15  # rad: standard error of a bend at 0.2 mm of noise, where markers determine it
_TURNS = 0.3  # largest change in a step, rad
_STEPS, _CLOSE = 15, 1e-5  # rad, m: the step after it is smaller by far
_NOISE_FROM = 20_000  # frames that tell the noise
_CHUNK = 2048  # frames at a time
_SAMPLED, _ROUNDS = 400, 12
_REDUNDANT = 0.3  # numbers a frame that markers say twice: fewer do not tell their noise
_STARTS = np.linspace(-0.6, 0.6, 13)
_HIGHEST = 8  # order of differences
_ODD, _RARE = 8.0, 0.01  # times the noise, share: farther from the body so few samples are no markers of it
_LONGEST = 1e3  # m: farther no marker is read
_NEAR = 1e-4  # m: nearer to the body than this no marker is odd
_STRANGE = 4.0  # times the noise: from here on another explanation is looked for
_MOTION = 0.5  # times the noise by differences: where the body leaves less, they hold motion
_ASKEW = np.radians(25.0)


@dataclass(frozen=True)
class Marks:
    """Where markers are on the body.

    Attributes:
        station: of each, shape (markers,).
        arm: from its station, in the station's frame, shape (markers,), complex, m.
        geometry: of the robot.
    """

    station: np.ndarray
    arm: np.ndarray
    geometry: Geometry

    def places(self, state: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Return markers, how they move with the state, connectors and their headings.

        Args:
            state: x, y, θ_1, bends, lengths, shape (frames, 3 + 2 segments).

        Returns:
            (frames, markers), (frames, markers, 3 + 2 segments), (frames, N), all complex, (frames, N).
        """
        count = self.geometry.connectors - 1
        # Half segments: each ends at a station. The gap is before the first and behind the second.
        turn, length = np.split(np.repeat(state[:, 3:] / 2, 2, axis=1), 2, axis=1)
        before, after = (np.tile(each, count) * self.geometry.rigid_gap / 2 for each in ([1, 0], [0, 1]))
        theta = state[:, 2:3] - np.pad(np.cumsum(turn, axis=1), ((0, 0), (1, 0)))
        facing, back = np.exp(1j * theta), np.exp(-1j * turn)
        ahead = facing[:, :-1]
        arc, arc_slope = _mean_direction(turn)
        span = ahead * (before + length * arc + after * back)
        place = state[:, :1] + 1j * state[:, 1:2] - np.pad(np.cumsum(span, axis=1), ((0, 0), (1, 0)))
        mark = place[:, self.station] + self.arm * facing[:, self.station]
        lever = np.empty((*mark.shape, state.shape[1]), dtype=complex)
        lever[..., 0], lever[..., 1], lever[..., 2] = 1, 1j, 1j * (mark - place[:, :1])
        # What a half segment moves: the stations behind it.
        moved = self.station[:, None] > np.arange(2 * count)
        along = ahead * (length * arc_slope - 1j * after * back)
        by_turn = -along[:, None] - 1j * (mark[..., None] - place[:, None, 1:])
        for k, halves in ((3, by_turn), (3 + count, -(ahead * arc)[:, None])):
            halves = np.where(moved, halves, 0)
            lever[..., k : k + count] = (halves[..., ::2] + halves[..., 1::2]) / 2
        return mark, lever, place[:, ::2], theta[:, ::2]


def _mean_direction(turn: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return E and dE/dφ of an arc that turns by φ, rad."""
    cosine, sine, arc, slope, _ = half_angle_terms(turn)
    back = cosine - 1j * sine
    return arc * back, (slope - 0.5j * arc) * back


@dataclass(frozen=True)
class Shape:
    """The body over time.

    Attributes:
        node: connectors, shape (frames, N), complex, m.
        theta: their headings, unwrapped, shape (frames, N), rad.
        bend_error: standard errors of the bends, shape (frames, segments), rad.
        length: of the segments' arcs, shape (frames, segments), m.
        length_spread: σ_ℓ, m.
        noise: σ of a marker's coordinate, m.
        residual: root mean square of the seen markers' distances from the body, shape (frames,), m.
        missing: which markers were not seen, or lay too far from the body, shape (frames, markers).
    """

    node: np.ndarray
    theta: np.ndarray
    bend_error: np.ndarray
    length: np.ndarray
    length_spread: float
    noise: float
    residual: np.ndarray
    missing: np.ndarray


@dataclass
class _Prior:
    """Noise of the markers, means and spread of the lengths (m), and σ_ε (rad; None: ε is measured)."""

    noise: float
    mean: np.ndarray
    spread: float
    open: float | None

    @property
    def swing(self) -> np.ndarray:
        """Derivatives of ε with respect to the bends, shape (segments,)."""
        count = len(self.mean)
        return np.asarray((-1.0) ** np.arange(count) / (2 * count))

    def information(self) -> np.ndarray:
        """Return the matrix over the state."""
        count = len(self.mean)
        matrix = np.diag(np.repeat([0.0, _VAGUE**-2, self.spread**-2], [2, 1 + count, count]))
        if self.open is not None:
            matrix[3 : 3 + count, 3 : 3 + count] += np.outer(self.swing, self.swing) / self.open**2
        return matrix


def determined(station: np.ndarray, arm: np.ndarray, geometry: Geometry) -> str:
    """Say what markers at these stations determine.

    Args:
        station: shape (markers,).
        arm: shape (markers,), complex, m.
        geometry: of the robot.

    Returns:
        "free": the bends, whatever the lengths; "fixed": the bends if lengths stay the same; "" neither.
    """
    marks, count = Marks(station, arm, geometry), geometry.connectors - 1
    state = np.zeros((1, 3 + 2 * count))
    state[0, 3 : 3 + count] = 0.8 * np.cos(np.pi / 2 * np.arange(count) + 0.4)
    state[0, 3 + count :] = geometry.segment_length
    _, lever, _, _ = marks.places(state)
    data = (lever[0].conj().T @ lever[0]).real / 2e-4**2
    for answer, spread in (("free", _LOOSE), ("fixed", 0.01)):
        prior = _Prior(2e-4, state[0, 3 + count :], spread * geometry.segment_length, None)
        matrix = data + prior.information()
        if np.linalg.matrix_rank(matrix, tol=1e-3, hermitian=True) < len(data):
            continue
        error = np.sqrt(np.diag(np.linalg.inv(matrix))[3 : 3 + count])
        # With lengths alone the sign of an open number is found from several segments at once.
        several = count > 2 and sorted(station) == list(range(0, 2 * count + 1, 2))
        if error.max() < _TOLD and (answer == "free" or several):
            return answer
    return ""


def noise_of(points: np.ndarray) -> float:
    """Return the standard deviation of a coordinate's noise, m.

    Args:
        points: NaN where a marker was not seen, shape (frames, markers, 2), m.
    """
    found = []
    for order in range(1, min(_HIGHEST, len(points) - 2) + 1):
        change = np.diff(points, order, axis=0)
        known = np.abs(change[np.isfinite(change)])
        if known.size >= 50:
            found.append(1.4826 * np.median(known) / np.sqrt(comb(2 * order, order)))
    return max(float(min(found, default=5e-4)), _LEAST_NOISE)


def fit_shape(time: np.ndarray, points: np.ndarray, missing: np.ndarray, marks: Marks, way: str) -> Shape:
    """Find the body that explains markers.

    Args:
        time: shape (frames,), s.
        points: interpolated where a marker was not seen, shape (frames, markers, 2), m.
        missing: where that is, shape (frames, markers).
        marks: where the markers are on the body.
        way: "free" or "fixed", see `determined`.
    """
    seen, missing = points @ [1, 1j], missing.copy()
    straight, alike = marks.geometry.segment_length, np.ones(marks.geometry.connectors - 1)
    known = slice(0, _NOISE_FROM)
    noise = noise_of(np.where(missing[known, :, None], np.nan, points[known]))
    prior = _Prior(noise, straight * alike, _STRETCH * straight, None if way == "free" else _OPEN)
    whole = np.flatnonzero(~missing.any(axis=1))
    if len(whole) < 4:
        whole, missing = np.arange(len(time)), np.zeros_like(missing)
    _learn(seen[whole[some_frames(len(whole), _SAMPLED)]], marks, prior)
    bends = slice(3, 3 + len(alike))
    state, error = np.empty((len(time), 3 + 2 * len(alike))), np.empty((len(time), len(alike)))
    away = np.empty(seen.shape)

    def explain(frames: np.ndarray, fit: Callable[[np.ndarray], _Fitted]) -> np.ndarray:
        """Fill in the frames on all processors, as NumPy's loops hold no lock; return the sum of chi."""

        def work(rows: np.ndarray) -> np.ndarray:
            fitted = fit(rows)
            state[rows], error[rows], away[rows] = fitted.state, fitted.error(bends), fitted.away
            return fitted.chi

        with ThreadPoolExecutor(processor_count()) as pool:
            return np.sum([*pool.map(work, np.split(frames, range(_CHUNK, len(frames), _CHUNK)))], axis=0)

    chi, redundant = explain(
        whole, lambda rows: _fit(_start(seen[rows], marks, prior), seen[rows], marks, prior)
    )
    scale = float(np.sqrt(chi / redundant)) if redundant > _REDUNDANT * len(whole) else 1.0
    if prior.open is not None:
        scale = max(scale, 1.0)
    odd = away[whole] > max(_ODD * prior.noise * scale, _NEAR)
    if odd.mean() < _RARE:
        missing[whole] |= odd
    good, torn = (np.flatnonzero(each) for each in (~missing.any(axis=1), missing.any(axis=1)))
    if torn.size and len(good) >= 4:
        from scipy.interpolate import CubicSpline

        state[good, 2] = np.unwrap(state[good, 2])
        state[torn] = CubicSpline(time[good], state[good])(time[torn])
        state[torn, bends] = np.clip(state[torn, bends], -np.pi, np.pi)
        explain(torn, lambda rows: _fit_torn(state[rows], seen[rows], missing[rows], marks, prior))
    state[:, 2] = np.unwrap(state[:, 2])
    _, _, node, theta = Marks(np.zeros(0, dtype=int), np.zeros(0), marks.geometry).places(state)
    residual = np.sqrt(np.ma.masked_array(away**2, missing).mean(axis=1).filled(0.0))
    length, noise = state[:, bends.stop :], prior.noise * scale
    return Shape(node, theta, error * scale, length, prior.spread, noise, residual, missing)


@dataclass(frozen=True)
class _Fitted:
    """States of frames, the inverse of the matrix they were found with, and what is left of the markers."""

    state: np.ndarray
    inverse: np.ndarray
    away: np.ndarray
    cost: np.ndarray
    chi: np.ndarray

    def error(self, which: slice) -> np.ndarray:
        return np.asarray(np.sqrt(np.diagonal(self.inverse, axis1=1, axis2=2)[:, which]))


def _fit(
    state: np.ndarray, seen: np.ndarray, marks: Marks, prior: _Prior, missing: np.ndarray | None = None
) -> _Fitted:
    """Return the states that explain frames.

    Args:
        state: to start from, shape (frames, 3 + 2 segments).
        seen: markers, shape (frames, markers), complex, m.
        marks: where they are on the body.
        prior: of what they do not tell.
        missing: markers that were interpolated, shape (frames, markers); the bends are then held near those
            of `state`, q̂. None: all were seen.
    """
    count, width = len(prior.mean), state.shape[1]
    matrix, aim = prior.information(), np.zeros_like(state)
    aim[:, 3 + count :] = prior.mean
    weight = np.full(seen.shape, prior.noise**-2)
    if missing is not None:
        weight[missing] = HIDDEN**-2
        held = np.arange(3, 3 + count)
        matrix[held, held] += BENDS**-2
        aim[:, held] = state[:, held]
    state, moving = state.copy(), np.arange(len(state))
    limit = np.repeat([np.inf, _TURNS, np.inf], [2, 1 + count, count])
    bound = np.repeat([np.inf, 2 * np.pi, _LONGEST], [3, count, count])
    data, away = np.empty((len(state), width, width)), np.empty(seen.shape, dtype=complex)
    for _ in range(_STEPS):
        mark, lever, _, _ = marks.places(state[moving])
        away[moving] = left = seen[moving] - mark
        weighed = (lever.conj() * weight[moving][..., None]).transpose(0, 2, 1)
        data[moving] = inner = (weighed @ lever).real
        right = (weighed @ left[..., None])[..., 0].real + (aim - state)[moving] @ matrix
        step = np.clip(np.linalg.solve(inner + matrix, right[..., None])[..., 0], -limit, limit)
        # Explanations that are wrong lead anywhere.
        state[moving] = np.clip(state[moving] + step, -bound, bound)
        moving = moving[np.abs(step).max(axis=1) > _CLOSE]
        if not moving.size:
            break
    inverse = np.linalg.inv(data + matrix)
    used = np.einsum("fuv,fvu->", inverse, data)
    missed = weight * np.abs(away) ** 2
    off = aim - state
    cost = missed.sum(axis=1) + np.einsum("fu,uv,fv->f", off, matrix, off)
    return _Fitted(state, inverse, np.abs(away), cost, np.array([missed.sum(), 2 * missed.size - used]))


def _fit_torn(
    state: np.ndarray, seen: np.ndarray, missing: np.ndarray, marks: Marks, prior: _Prior
) -> _Fitted:
    """Return the states of frames in which markers were not seen; arguments as `_fit`.

    Which of a pair was seen alone, its followed way may tell wrongly: what costs less is taken.
    """
    best = _fit(state, seen, marks, prior, missing)
    for station in np.unique(marks.station):
        pair = np.flatnonzero(marks.station == station)
        if len(pair) != 2 or marks.arm[pair].sum() != 0:
            continue
        odd = (np.where(missing, 0.0, best.away) > _STRANGE * prior.noise).any(axis=1)
        rows = np.flatnonzero(odd & (missing[:, pair].sum(axis=1) == 1))
        swapped = np.arange(len(marks.station))
        swapped[pair] = pair[::-1]
        other = _fit(state[rows], seen[rows][:, swapped], marks, prior, missing[rows][:, swapped])
        won = other.cost < best.cost[rows]
        for name in ("state", "inverse", "away", "cost"):
            getattr(best, name)[rows[won]] = getattr(other, name)[won]
    return best


def _start(seen: np.ndarray, marks: Marks, prior: _Prior) -> np.ndarray:
    """Return states near frames: headings between the directions from station to station."""
    from scipy.interpolate import make_interp_spline

    if prior.open is not None:
        return _start_fixed(seen, marks, prior)
    stations, headings = np.unique(marks.station), list[tuple[float, np.ndarray]]()
    centre = np.empty((len(seen), len(stations)), dtype=complex)
    for k, station in enumerate(stations):
        which = np.flatnonzero(marks.station == station)
        arm, facing = marks.arm[which], np.zeros(len(seen))
        if len(which) == 2:
            line = (seen[:, which[0]] - seen[:, which[1]]) / (arm[0] - arm[1])
            facing = line / np.maximum(np.abs(line), 1e-12)
            headings.append((float(station), np.angle(facing)))
        centre[:, k] = (seen[:, which] - arm * facing[:, None]).mean(axis=1)
    between = (stations[1:] + stations[:-1]) / 2
    headings += zip(between.tolist(), np.angle(-np.diff(centre).T), strict=True)
    at, angles = zip(*sorted(headings, key=lambda each: each[0]), strict=True)
    heading = make_interp_spline(at, np.unwrap(angles, axis=0), k=1)  # beyond the last two goes on straight
    theta = heading(2 * np.arange(len(prior.mean) + 1)).T
    place, length = (
        np.zeros((len(seen), 2)),
        np.full((len(seen), len(prior.mean)), marks.geometry.segment_length),
    )
    state = np.column_stack([place, theta[:, 0], -np.diff(theta), length])
    shift = (seen - marks.places(state)[0]).mean(axis=1)
    state[:, 0], state[:, 1] = shift.real, shift.imag
    return state


def _learn(seen: np.ndarray, marks: Marks, prior: _Prior) -> None:
    """Find noise, means and spread of the lengths, and σ_ε, by expectation-maximisation on some frames."""
    count, swing, start = len(prior.mean), prior.swing, _start(seen, marks, prior)
    for turn in range(_ROUNDS):
        fitted = _fit(start, seen, marks, prior)
        length = fitted.state[:, 3 + count :]
        variance = fitted.error(slice(3 + count, None)) ** 2
        prior.mean = np.median(length, axis=0) if prior.open is not None else length.mean(axis=0)
        prior.spread = float(np.sqrt(((length - prior.mean) ** 2 + variance).mean()))
        if prior.open is not None:
            epsilon = fitted.state[:, 3 : 3 + count] @ swing
            spread = np.einsum("u,fuv,v->f", swing, fitted.inverse[:, 3 : 3 + count, 3 : 3 + count], swing)
            prior.open = float(np.sqrt((epsilon**2 + spread).mean()))
        if fitted.chi[1] > _REDUNDANT * len(seen):
            scale = float(np.sqrt(fitted.chi[0] / fitted.chi[1]))
            # Noise and lengths that vary are hardly told apart; but that differences saw the motion is seen.
            if prior.open is None or (scale < _MOTION and 2 * turn >= _ROUNDS):
                prior.noise = max(prior.noise * scale, _LEAST_NOISE)
        start = fitted.state if prior.open is None else _start(seen, marks, prior)


def _start_fixed(seen: np.ndarray, marks: Marks, prior: _Prior) -> np.ndarray:
    """Return states with the ε that the lengths between connectors fit best, of a coarse grid.

    Each connector has one marker. Its heading mirrors that before it in the line between the two:
    θ_{j+1} = 2α_j − θ_j.
    """
    count, order = len(prior.mean), np.argsort(marks.station)
    sign, span = (-1.0) ** np.arange(count + 1), -np.diff(seen[:, order], axis=1)
    assert span.shape[1] == count and prior.open is not None, "one marker at each connector"
    alpha = np.unwrap(np.angle(span), axis=1)
    # (−1)^j θ_j changes by −2 (−1)^j α_j from connector to connector.
    turned = np.cumsum(np.column_stack([alpha[:, 0], -2 * sign[:-1] * alpha]), axis=1)
    bend = -np.diff(sign * turned)
    swing = (bend * sign[:-1]).mean(axis=1, keepdims=True)
    costs, bends = [], [bend - sign[:-1] * (swing - 2 * epsilon) for epsilon in _STARTS]
    for epsilon, turn in zip(_STARTS, bends, strict=True):
        length = prior.mean * np.abs(_mean_direction(turn)[0]) + marks.geometry.rigid_gap * np.cos(turn / 2)
        missed = ((length - np.abs(span)) ** 2).sum(axis=1) / (2 * prior.noise**2 + prior.spread**2)
        costs.append(missed + (epsilon / prior.open) ** 2)
    best = np.argmin(costs, axis=0)
    first, heading = seen[:, order[0]], alpha[:, 0] - swing[:, 0] / 2 + _STARTS[best]
    bend = np.stack(bends)[best, np.arange(len(seen))]
    length = np.tile(prior.mean, (len(seen), 1))
    return np.column_stack([first.real, first.imag, heading, bend, length])


def marker_arms(
    points: np.ndarray, missing: np.ndarray, places: Sequence[tuple[int, str]], names: Sequence[str]
) -> np.ndarray:
    """Return the arms of markers, shape (markers,), complex, m.

    A marker alone at its station has no arm. Two without a side lie on both sides of it, along or across the
    body; two of one name, as of a rigid body with its rotation, in any direction.

    Args:
        points: interpolated where a marker was not seen, shape (frames, markers, 2), m.
        missing: where that is, shape (frames, markers).
        places: station and side of each marker.
        names: of each.

    Raises:
        InputError: more than two at a station, one side twice, or a pair askew.
    """
    arms, place = np.zeros(len(places), dtype=complex), points @ [1, 1j]
    station = np.array([each for each, _ in places])
    members = [np.flatnonzero(station == each).tolist() for each in np.unique(station)]
    centres = [place[:, which].mean(axis=1) for which in members]
    for k, which in enumerate(members):
        if len(which) == 1:
            continue
        if len(which) > 2:
            listed = ", ".join(names[each] for each in which)
            raise InputError(
                f"{len(which)} markers at one place of the body ({listed}); at most two are used"
            )
        a, b = which
        line = place[:, a] - place[:, b]
        apart = float(np.median(np.abs(line)))
        sides = [SIDES[places[each][1]] for each in which]
        if any(sides):
            if sides[0] == sides[1]:
                raise InputError(f"{names[a]} and {names[b]} are on the same side of one connector")
            wide = abs(sides[0] - sides[1]) if all(sides) else 1
            arms[which] = [apart * side / wide for side in sides]
            continue
        turn = line / (centres[max(k - 1, 0)] - centres[min(k + 1, len(centres) - 1)])
        both = ~missing[:, which].any(axis=1)
        turn = turn[both] if both.any() else turn
        angle = float(np.angle(np.exp(1j * np.angle(turn)).mean()))
        if names[a] != names[b]:
            quarter = np.pi / 2 * np.rint(angle / (np.pi / 2))
            if abs(angle - quarter) > _ASKEW:
                raise InputError(
                    f"{names[a]} and {names[b]} lie {np.degrees(angle):.0f}° from the body; along it or "
                    "across it is wanted"
                )
            angle = quarter
        arms[which] = apart / 2 * np.exp(1j * angle) * np.array([1, -1])
    return arms
