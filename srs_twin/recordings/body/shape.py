r"""Least-squares shape of the body from markers: bends and segment lengths, with standard errors.

**Model.** A *station* is a point along the body: 0, 2, 4, … are the connectors, head first, and 1, 3, … are
the middles of the segments between them. A marker m at station k has the position

$$ p_m = P_k + a_m\,e^{i\theta_k}, $$

where a_m is its offset in the frame of the station. Points are complex numbers, which makes a rotation a
multiplication. Adjacent connectors are joined by an arc of length ℓ_j and bend q_j, with half of the rigid
gap g at both ends,

$$ P_{j+1} = P_j - e^{i\theta_j}\Bigl(\tfrac g2 + \ell_j E(q_j) + \tfrac g2 e^{-iq_j}\Bigr),
   \qquad E(\varphi) = \int_0^1 e^{-i\varphi u}\,du, \qquad \theta_{j+1} = \theta_j - q_j. $$

**Estimation.** The state (x, y, θ_1, q, ℓ) of each frame minimises

$$ \sum_m \frac{|p_m - \hat p_m|^2}{\sigma^2} + \sum_j \frac{(\ell_j - \bar\ell_j)^2}{\sigma_\ell^2}
   + \frac{\varepsilon^2}{\sigma_\varepsilon^2} + \sum_j \frac{(q_j - \hat q_j)^2}{\sigma_q^2}. $$

The Gauss-Newton method solves it, and the inverse of its matrix gives the standard errors. The last term
applies only to frames with hidden markers. It keeps the bends of these frames close to a spline through the
bends of the other frames.

**Lengths.** If the markers alone determine the bends, the lengths are free, with means and σ_ℓ estimated from
the recording by expectation-maximisation. With one marker per connector, one quantity ε per frame is not
observable: adjacent headings may turn in opposite directions, q_j = q_j⁰ + 2(−1)^{j−1} ε. Only constant
segment lengths determine ε, and near a straight body they determine it poorly. In this case, recordings of a
body that stretches are rejected.

**Noise.** σ is estimated from differences of high order of the marker positions, in which the motion
vanishes. With redundant markers it is the residual of the fit instead, which includes deviations of the
segments from arcs.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from enum import Enum
from math import comb
from typing import NamedTuple

import numpy as np

from srs_twin.compute.workers import processor_count
from srs_twin.errors import InputError
from srs_twin.recordings.body.tracking import sample_frames
from srs_twin.robot.geometry import half_angle_terms
from srs_twin.robot.spec import Geometry

SIDE_DIRECTIONS = {"": 0, "ahead": 1, "behind": -1, "left": 1j, "right": -1j}
"""Side of a station → direction from the station to the marker, in the frame of the station."""

_BEND_STD = 0.15
"""σ_q, deviation of the bends in frames with hidden markers from the spline, rad."""
_HIDDEN_STD = 1e-2
"""Assumed error of the interpolated position of a hidden marker, m."""

_MIN_NOISE = 1e-7
"""Smallest σ, m: recordings from simulations have no noise."""
_DEFAULT_NOISE = 5e-4
"""σ of a recording that is too short to estimate it, m."""
_MAX_DIFFERENCE_ORDER = 8
"""Highest order of the differences from which the noise is estimated."""
_NOISE_FRAMES = 20_000
"""Number of frames from which the noise is estimated."""
_MIN_REDUNDANCY = 0.3
"""Redundant coordinates per frame above which the residual of the fit determines the noise."""
_MIN_MOTION_RATIO = 0.5
"""Ratio of the residual of the fit to the noise from differences below which the differences contain motion,
1."""

_FLAT_PRIOR_STD = 1e3
"""Prior standard deviation of headings and bends, rad: so large that it only prevents singular matrices."""
_INITIAL_LENGTH_STD = 0.1
"""σ_ℓ before expectation-maximisation, relative to the segment length."""
_INITIAL_ALTERNATING_STD = 0.3
"""σ_ε before expectation-maximisation, rad."""
_EM_FRAMES = 400
"""Number of frames in the expectation-maximisation."""
_EM_ITERATIONS = 12
"""Iterations of the expectation-maximisation."""

_MAX_BEND_STD = 0.15
"""Largest standard error of a bend, rad, at which the markers determine the bends; for `_TEST_NOISE`."""
_TEST_NOISE = 2e-4
"""Noise that is assumed in the test of `length_model`, m."""
_FREE_LENGTH_STD = 0.3
"""σ_ℓ of free lengths in that test, relative to the segment length."""
_FIXED_LENGTH_STD = 0.01
"""σ_ℓ of fixed lengths in that test, relative to the segment length."""

_MAX_ANGLE_STEP = 0.3
"""Largest change of heading and bends in a Gauss-Newton step, rad."""
_MAX_STEPS = 15
"""Largest number of Gauss-Newton steps."""
_CONVERGED_STEP = 1e-5
"""Size of a step after which the iteration stops, rad and m: convergence is quadratic, so the next step would
be negligible."""
_MAX_LENGTH = 1e3
"""Bound of the segment lengths, m, because fits of wrong marker assignments may diverge."""
_CHUNK_FRAMES = 2048
"""Number of frames that are fitted at once."""
_ALTERNATING_STARTS = np.linspace(-0.6, 0.6, 13)
"""Initial values of ε, rad."""

_OUTLIER_NOISE = 8.0
"""Distance from the body, divided by the noise, above which a sample is an outlier."""
_MAX_OUTLIERS = 0.01
"""Largest fraction of outliers among the samples; a larger one means that the model does not fit."""
_MIN_OUTLIER_DISTANCE = 1e-4
"""Distance from the body below which samples are never outliers, m."""
_SWAP_NOISE = 4.0
"""Distance from the body, divided by the noise, above which a sample is tried as the other marker of its
pair."""
_MAX_PAIR_ANGLE = np.radians(25.0)
"""Largest angle of a pair of markers to the direction along or across the body."""


class LengthModel(Enum):
    """Assumption on the segment lengths under which the markers determine the bends."""

    FREE = "free"
    """Lengths may vary: the markers determine the bends for any lengths."""
    FIXED = "fixed"
    """Lengths are constant: only with this assumption do the markers determine the bends."""


class _Kinematics(NamedTuple):
    """Positions of markers and connectors for given states.

    Attributes:
        marker: positions of the markers, shape (frames, markers), complex, m.
        jacobian: their derivatives with respect to the state, shape (frames, markers, 3 + 2 segments),
            complex.
        connector: positions of the connectors, shape (frames, N), complex, m.
        heading: headings of the connectors, shape (frames, N), rad.
    """

    marker: np.ndarray
    jacobian: np.ndarray
    connector: np.ndarray
    heading: np.ndarray


@dataclass(frozen=True)
class MarkerPlacement:
    """Positions of markers on the body.

    Attributes:
        station: station of each marker, shape (markers,).
        offset: offset from the station in its frame, shape (markers,), complex, m.
        geometry: geometry of the robot.
    """

    station: np.ndarray
    offset: np.ndarray
    geometry: Geometry

    def kinematics(self, state: np.ndarray) -> _Kinematics:
        """Return positions, headings and the Jacobian of the markers.

        Args:
            state: x, y, θ_1, bends, lengths, shape (frames, 3 + 2 segments).
        """
        count = self.geometry.connectors - 1
        # Every segment is divided at its middle station into two halves. The rigid gap is before
        # the first half and behind the second one.
        turn, length = np.split(np.repeat(state[:, 3:] / 2, 2, axis=1), 2, axis=1)
        before, after = (np.tile(ends, count) * self.geometry.rigid_gap / 2 for ends in ([1, 0], [0, 1]))
        theta = state[:, 2:3] - np.pad(np.cumsum(turn, axis=1), ((0, 0), (1, 0)))
        direction, rotation = np.exp(1j * theta), np.exp(-1j * turn)
        front_direction = direction[:, :-1]
        arc, arc_slope = _mean_direction(turn)
        span = front_direction * (before + length * arc + after * rotation)
        station = state[:, :1] + 1j * state[:, 1:2] - np.pad(np.cumsum(span, axis=1), ((0, 0), (1, 0)))
        marker = station[:, self.station] + self.offset * direction[:, self.station]
        jacobian = np.empty((*marker.shape, state.shape[1]), dtype=complex)
        jacobian[..., 0], jacobian[..., 1], jacobian[..., 2] = 1, 1j, 1j * (marker - station[:, :1])
        # A half segment moves all stations behind it: its bend rotates them about its rear end and changes
        # its chord, and its length displaces them.
        moved = self.station[:, None] > np.arange(2 * count)
        chord_slope = front_direction * (length * arc_slope - 1j * after * rotation)
        by_turn = -chord_slope[:, None] - 1j * (marker[..., None] - station[:, None, 1:])
        by_length = -(front_direction * arc)[:, None]
        for k, derivative in ((3, by_turn), (3 + count, by_length)):
            derivative = np.where(moved, derivative, 0)
            # Both halves have half the bend and half the length of the segment.
            jacobian[..., k : k + count] = (derivative[..., ::2] + derivative[..., 1::2]) / 2
        return _Kinematics(marker, jacobian, station[:, ::2], theta[:, ::2])


def _mean_direction(turn: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return E(φ) and dE/dφ for an arc with the bend φ, rad."""
    cosine, sine, arc, slope, _ = half_angle_terms(turn)
    rotation = cosine - 1j * sine
    return arc * rotation, (slope - 0.5j * arc) * rotation


@dataclass(frozen=True)
class BodyShape:
    """Shape of the body over time.

    Attributes:
        connector: positions of the connectors, shape (frames, N), complex, m.
        theta: their headings, unwrapped, shape (frames, N), rad.
        bend_error: standard errors of the bends, shape (frames, segments), rad.
        length: arc lengths of the segments, shape (frames, segments), m.
        length_std: σ_ℓ, m.
        noise: standard deviation σ of a marker coordinate, m.
        residual: root mean square distance of the visible markers from the body, shape (frames,), m.
        missing: markers that were hidden or outliers, shape (frames, markers).
    """

    connector: np.ndarray
    theta: np.ndarray
    bend_error: np.ndarray
    length: np.ndarray
    length_std: float
    noise: float
    residual: np.ndarray
    missing: np.ndarray


@dataclass
class _Prior:
    """Noise of the markers and prior of the state.

    Attributes:
        noise: σ, m.
        length_mean: means of the lengths, shape (segments,), m.
        length_std: σ_ℓ, m.
        alternating_std: σ_ε, rad; None if the markers determine ε.
    """

    noise: float
    length_mean: np.ndarray
    length_std: float
    alternating_std: float | None

    @property
    def alternating_weights(self) -> np.ndarray:
        """Derivatives of ε with respect to the bends q, shape (segments,)."""
        count = len(self.length_mean)
        return np.asarray((-1.0) ** np.arange(count) / (2 * count))

    def information(self) -> np.ndarray:
        """Return the information matrix of the prior over the state."""
        count = len(self.length_mean)
        matrix = np.diag(np.repeat([0.0, _FLAT_PRIOR_STD**-2, self.length_std**-2], [2, 1 + count, count]))
        if self.alternating_std is not None:
            weights = self.alternating_weights
            matrix[3 : 3 + count, 3 : 3 + count] += np.outer(weights, weights) / self.alternating_std**2
        return matrix


def length_model(station: np.ndarray, offset: np.ndarray, geometry: Geometry) -> LengthModel | None:
    """Return the weakest assumption on the lengths under which markers determine the bends, or None.

    The standard errors of the bends are computed for one typical shape.

    Args:
        station: station of each marker, shape (markers,).
        offset: offset from the station, shape (markers,), complex, m.
        geometry: geometry of the robot.
    """
    placement, count = MarkerPlacement(station, offset, geometry), geometry.connectors - 1
    state = np.zeros((1, 3 + 2 * count))
    state[0, 3 : 3 + count] = 0.8 * np.cos(np.pi / 2 * np.arange(count) + 0.4)
    state[0, 3 + count :] = geometry.segment_length
    jacobian = placement.kinematics(state).jacobian[0]
    data = (jacobian.conj().T @ jacobian).real / _TEST_NOISE**2
    for model, std in ((LengthModel.FREE, _FREE_LENGTH_STD), (LengthModel.FIXED, _FIXED_LENGTH_STD)):
        prior = _Prior(_TEST_NOISE, state[0, 3 + count :], std * geometry.segment_length, None)
        matrix = data + prior.information()
        if np.linalg.matrix_rank(matrix, tol=1e-3, hermitian=True) < len(data):
            continue
        error = np.sqrt(np.diag(np.linalg.inv(matrix))[3 : 3 + count])
        # The length of one segment leaves the sign of ε open; the lengths of several segments determine it.
        one_per_connector = count > 2 and sorted(station) == list(range(0, 2 * count + 1, 2))
        if error.max() < _MAX_BEND_STD and (model is LengthModel.FREE or one_per_connector):
            return model
    return None


def marker_noise(points: np.ndarray) -> float:
    """Return the standard deviation of the noise of a coordinate, m.

    It is the smallest estimate from differences of several orders. White noise of variance σ² gives
    differences of order n with the variance σ² (2n over n). Motion increases the estimates, at higher orders
    less so. The median ignores outliers.

    Args:
        points: NaN where a marker is hidden, shape (frames, markers, 2), m.
    """
    estimates = []
    for order in range(1, min(_MAX_DIFFERENCE_ORDER, len(points) - 2) + 1):
        difference = np.diff(points, order, axis=0)
        known = np.abs(difference[np.isfinite(difference)])
        if known.size >= 50:
            # 1.4826 converts the median magnitude of normal values to their standard deviation.
            estimates.append(1.4826 * np.median(known) / np.sqrt(comb(2 * order, order)))
    return max(float(min(estimates, default=_DEFAULT_NOISE)), _MIN_NOISE)


def fit_shape(
    time: np.ndarray, points: np.ndarray, missing: np.ndarray, placement: MarkerPlacement, model: LengthModel
) -> BodyShape:
    """Fit the body shape to markers.

    Args:
        time: shape (frames,), s.
        points: interpolated where a marker is hidden, shape (frames, markers, 2), m.
        missing: hidden markers, shape (frames, markers).
        placement: positions of the markers on the body.
        model: assumption on the segment lengths, see `length_model`.
    """
    measured, missing = points @ [1, 1j], missing.copy()
    segments = placement.geometry.connectors - 1
    first = slice(0, _NOISE_FRAMES)
    noise = marker_noise(np.where(missing[first, :, None], np.nan, points[first]))
    prior = _initial_prior(noise, placement.geometry, model)
    complete = np.flatnonzero(~missing.any(axis=1))
    if len(complete) < 4:
        # A spline needs complete frames: use the interpolated positions of hidden markers on all frames.
        complete, missing = np.arange(len(time)), np.zeros_like(missing)
    _estimate_prior(measured[complete[sample_frames(len(complete), _EM_FRAMES)]], placement, prior)
    fits = _FrameFits(len(time), segments, measured.shape[1])

    def fit_complete(rows: np.ndarray) -> _Fit:
        return _fit(_initial_states(measured[rows], placement, prior), measured[rows], placement, prior)

    chi2, freedom = fits.update(complete, fit_complete)
    scale = float(np.sqrt(chi2 / freedom)) if freedom > _MIN_REDUNDANCY * len(complete) else 1.0
    if prior.alternating_std is not None:
        # With fixed lengths the fit has little redundancy: its residual may only increase the errors.
        scale = max(scale, 1.0)
    outlier = fits.distance[complete] > max(_OUTLIER_NOISE * prior.noise * scale, _MIN_OUTLIER_DISTANCE)
    if outlier.mean() < _MAX_OUTLIERS:
        missing[complete] |= outlier
    incomplete = np.asarray(missing.any(axis=1))
    if incomplete.any() and (~incomplete).sum() >= 4:
        _interpolate_states(time, fits.state, incomplete)

        def fit_incomplete(rows: np.ndarray) -> _Fit:
            return _fit_incomplete(fits.state[rows], measured[rows], missing[rows], placement, prior)

        fits.update(np.flatnonzero(incomplete), fit_incomplete)
    return _body_shape(fits, missing, placement.geometry, prior, scale)


def _initial_prior(noise: float, geometry: Geometry, model: LengthModel) -> _Prior:
    straight, ones = geometry.segment_length, np.ones(geometry.connectors - 1)
    alternating_std = None if model is LengthModel.FREE else _INITIAL_ALTERNATING_STD
    return _Prior(noise, straight * ones, _INITIAL_LENGTH_STD * straight, alternating_std)


def _interpolate_states(time: np.ndarray, state: np.ndarray, incomplete: np.ndarray) -> None:
    """Replace the states of incomplete frames by a spline through those of the other frames."""
    from scipy.interpolate import CubicSpline

    good = np.flatnonzero(~incomplete)
    bends = slice(3, 3 + (state.shape[1] - 3) // 2)
    state[good, 2] = np.unwrap(state[good, 2])
    state[incomplete] = CubicSpline(time[good], state[good])(time[incomplete])
    state[incomplete, bends] = np.clip(state[incomplete, bends], -np.pi, np.pi)


def _body_shape(
    fits: _FrameFits, missing: np.ndarray, geometry: Geometry, prior: _Prior, scale: float
) -> BodyShape:
    """Return the shape; `scale` corrects the standard errors from the assumed to the estimated noise."""
    fits.state[:, 2] = np.unwrap(fits.state[:, 2])
    body = MarkerPlacement(np.zeros(0, dtype=int), np.zeros(0), geometry).kinematics(fits.state)
    residual = np.sqrt(np.ma.masked_array(fits.distance**2, missing).mean(axis=1).filled(0.0))
    length, noise = fits.state[:, 3 + geometry.connectors - 1 :], prior.noise * scale
    error = fits.bend_error * scale
    return BodyShape(body.connector, body.heading, error, length, prior.length_std, noise, residual, missing)


class _ChiSquare(NamedTuple):
    """Sum of the squared normalised residuals of the markers, and its degrees of freedom."""

    chi2: float
    freedom: float


@dataclass(frozen=True)
class _Fit:
    """Fitted states of some frames.

    Attributes:
        state: shape (frames, 3 + 2 segments).
        covariance: inverse of the Gauss-Newton matrix, shape (frames, 3 + 2 segments, 3 + 2 segments).
        distance: distances of the markers from their fitted positions, shape (frames, markers), m.
        cost: minimised sum, shape (frames,).
        chi_square: χ² of all these frames.
    """

    state: np.ndarray
    covariance: np.ndarray
    distance: np.ndarray
    cost: np.ndarray
    chi_square: _ChiSquare

    def error(self, components: slice) -> np.ndarray:
        """Return the standard errors of some components of the state, shape (frames, components)."""
        return np.asarray(np.sqrt(np.diagonal(self.covariance, axis1=1, axis2=2)[:, components]))


class _FrameFits:
    """Fitted states of all frames of a recording.

    Attributes:
        state: shape (frames, 3 + 2 segments).
        bend_error: standard errors of the bends for the assumed noise, shape (frames, segments), rad.
        distance: distances of the markers from their fitted positions, shape (frames, markers), m.
    """

    def __init__(self, frames: int, segments: int, markers: int) -> None:
        self._bends = slice(3, 3 + segments)
        self.state = np.empty((frames, 3 + 2 * segments))
        self.bend_error = np.empty((frames, segments))
        self.distance = np.empty((frames, markers))

    def update(self, frames: np.ndarray, fit: Callable[[np.ndarray], _Fit]) -> np.ndarray:
        """Fit some frames in chunks and return the sum of their χ² and of their degrees of freedom.

        The chunks run in threads on all processors, because NumPy's loops release the interpreter lock.
        """

        def work(rows: np.ndarray) -> _ChiSquare:
            fitted = fit(rows)
            self.state[rows], self.distance[rows] = fitted.state, fitted.distance
            self.bend_error[rows] = fitted.error(self._bends)
            return fitted.chi_square

        chunks = np.split(frames, range(_CHUNK_FRAMES, len(frames), _CHUNK_FRAMES))
        with ThreadPoolExecutor(processor_count()) as pool:
            return np.asarray(np.sum([*pool.map(work, chunks)], axis=0))


def _fit(
    state: np.ndarray,
    measured: np.ndarray,
    placement: MarkerPlacement,
    prior: _Prior,
    missing: np.ndarray | None = None,
) -> _Fit:
    """Fit the states of frames by the Gauss-Newton method.

    Args:
        state: initial states, shape (frames, 3 + 2 segments).
        measured: positions of the markers, shape (frames, markers), complex, m.
        placement: positions of the markers on the body.
        prior: prior of the state.
        missing: markers with interpolated positions, shape (frames, markers); the bends are then kept close
            to those of the initial states, q̂. None if all markers are visible.
    """
    count, width = len(prior.length_mean), state.shape[1]
    information, prior_mean = prior.information(), np.zeros_like(state)
    prior_mean[:, 3 + count :] = prior.length_mean
    weight = np.full(measured.shape, prior.noise**-2)
    if missing is not None:
        weight[missing] = _HIDDEN_STD**-2
        bends = np.arange(3, 3 + count)
        information[bends, bends] += _BEND_STD**-2
        prior_mean[:, bends] = state[:, bends]
    # `active` are the frames that have not converged; finished frames need no further steps.
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
        # Wrong marker assignments may diverge; the bound keeps their numbers finite.
        state[active] = np.clip(state[active] + step, -bound, bound)
        active = active[np.abs(step).max(axis=1) > _CONVERGED_STEP]
        if not active.size:
            break
    covariance = np.linalg.inv(data + information)
    # Effective number of parameters that the markers determine; the prior determines the remaining ones.
    parameters = np.einsum("fuv,fvu->", covariance, data)
    squares = weight * np.abs(residual) ** 2
    deviation = prior_mean - state
    cost = squares.sum(axis=1) + np.einsum("fu,uv,fv->f", deviation, information, deviation)
    chi_square = _ChiSquare(squares.sum(), 2 * squares.size - parameters)
    return _Fit(state, covariance, np.abs(residual), cost, chi_square)


def _fit_incomplete(
    state: np.ndarray, measured: np.ndarray, missing: np.ndarray, placement: MarkerPlacement, prior: _Prior
) -> _Fit:
    """Fit the states of frames with hidden markers; the arguments are those of `_fit`.

    If only one marker of a pair is visible, tracking may have mistaken it for the other one. The assignment
    with the smaller cost is used.
    """
    best = _fit(state, measured, placement, prior, missing)
    for station in np.unique(placement.station):
        pair = np.flatnonzero(placement.station == station)
        if len(pair) != 2 or placement.offset[pair].sum() != 0:
            continue
        poor = (np.where(missing, 0.0, best.distance) > _SWAP_NOISE * prior.noise).any(axis=1)
        rows = np.flatnonzero(poor & (missing[:, pair].sum(axis=1) == 1))
        swapped = np.arange(len(placement.station))
        swapped[pair] = pair[::-1]
        other = _fit(state[rows], measured[rows][:, swapped], placement, prior, missing[rows][:, swapped])
        better = other.cost < best.cost[rows]
        for name in ("state", "covariance", "distance", "cost"):
            getattr(best, name)[rows[better]] = getattr(other, name)[better]
    return best


def _initial_states(measured: np.ndarray, placement: MarkerPlacement, prior: _Prior) -> np.ndarray:
    """Return approximate states of frames.

    Headings are interpolated along the body between the directions of marker pairs and the directions from
    one station to the next.
    """
    from scipy.interpolate import make_interp_spline

    if prior.alternating_std is not None:
        return _initial_states_fixed(measured, placement, prior)
    stations, directions = np.unique(placement.station), list[tuple[float, np.ndarray]]()
    centre = np.empty((len(measured), len(stations)), dtype=complex)
    for k, station in enumerate(stations):
        members = np.flatnonzero(placement.station == station)
        offset, direction = placement.offset[members], np.zeros(len(measured))
        if len(members) == 2:
            line = (measured[:, members[0]] - measured[:, members[1]]) / (offset[0] - offset[1])
            direction = line / np.maximum(np.abs(line), 1e-12)
            directions.append((float(station), np.angle(direction)))
        centre[:, k] = (measured[:, members] - offset * direction[:, None]).mean(axis=1)
    between = (stations[1:] + stations[:-1]) / 2
    directions += zip(between.tolist(), np.angle(-np.diff(centre).T), strict=True)
    positions, angles = zip(*sorted(directions, key=lambda item: item[0]), strict=True)
    # Beyond the first and the last direction, the linear spline is extrapolated.
    heading = make_interp_spline(positions, np.unwrap(angles, axis=0), k=1)
    theta = heading(2 * np.arange(len(prior.length_mean) + 1)).T
    origin = np.zeros((len(measured), 2))
    length = np.full((len(measured), len(prior.length_mean)), placement.geometry.segment_length)
    state = np.column_stack([origin, theta[:, 0], -np.diff(theta), length])
    shift = (measured - placement.kinematics(state).marker).mean(axis=1)
    state[:, 0], state[:, 1] = shift.real, shift.imag
    return state


def _estimate_prior(measured: np.ndarray, placement: MarkerPlacement, prior: _Prior) -> None:
    """Estimate noise, means and σ_ℓ of the lengths, and σ_ε, by expectation-maximisation on some frames."""
    count, weights = len(prior.length_mean), prior.alternating_weights
    start = _initial_states(measured, placement, prior)
    for iteration in range(_EM_ITERATIONS):
        fit = _fit(start, measured, placement, prior)
        length = fit.state[:, 3 + count :]
        variance = fit.error(slice(3 + count, None)) ** 2
        fixed = prior.alternating_std is not None
        prior.length_mean = np.median(length, axis=0) if fixed else length.mean(axis=0)
        prior.length_std = float(np.sqrt(((length - prior.length_mean) ** 2 + variance).mean()))
        if fixed:
            epsilon = fit.state[:, 3 : 3 + count] @ weights
            bend_covariance = fit.covariance[:, 3 : 3 + count, 3 : 3 + count]
            epsilon_variance = np.einsum("u,fuv,v->f", weights, bend_covariance, weights)
            prior.alternating_std = float(np.sqrt((epsilon**2 + epsilon_variance).mean()))
        chi2, freedom = fit.chi_square
        if freedom > _MIN_REDUNDANCY * len(measured):
            scale = float(np.sqrt(chi2 / freedom))
            # With fixed lengths, noise and length variation have nearly the same effect on the residual. The
            # noise is therefore updated only if the residual shows that the differences contain motion, and
            # only after the first iterations of the lengths.
            if not fixed or (scale < _MIN_MOTION_RATIO and 2 * iteration >= _EM_ITERATIONS):
                prior.noise = max(prior.noise * scale, _MIN_NOISE)
        # With fixed lengths a new prior may change which ε fits best, so start again from the coarse grid.
        start = _initial_states(measured, placement, prior) if fixed else fit.state


def _initial_states_fixed(measured: np.ndarray, placement: MarkerPlacement, prior: _Prior) -> np.ndarray:
    """Return approximate states, with ε from a coarse grid chosen by the fit of the lengths.

    Each connector has one marker. By symmetry, the direction α_j from one connector to the next is the mean
    of their headings, so each heading is the mirror image of the previous one: θ_{j+1} = 2α_j − θ_j.
    """
    count, order = len(prior.length_mean), np.argsort(placement.station)
    sign, span = (-1.0) ** np.arange(count + 1), -np.diff(measured[:, order], axis=1)
    assert span.shape[1] == count and prior.alternating_std is not None, "one marker at each connector"
    alpha = np.unwrap(np.angle(span), axis=1)
    # (−1)^j θ_j changes by −2 (−1)^j α_j from connector to connector.
    alternating = np.cumsum(np.column_stack([alpha[:, 0], -2 * sign[:-1] * alpha]), axis=1)
    bend = -np.diff(sign * alternating)
    # Mean alternating bend, 2 ε: replace it by each value of the grid.
    mean = (bend * sign[:-1]).mean(axis=1, keepdims=True)
    costs = []
    bends = [bend - sign[:-1] * (mean - 2 * epsilon) for epsilon in _ALTERNATING_STARTS]
    for epsilon, turn in zip(_ALTERNATING_STARTS, bends, strict=True):
        gaps = placement.geometry.rigid_gap * np.cos(turn / 2)
        chord = prior.length_mean * np.abs(_mean_direction(turn)[0]) + gaps
        error = (chord - np.abs(span)) ** 2
        cost = error.sum(axis=1) / (2 * prior.noise**2 + prior.length_std**2)
        costs.append(cost + (epsilon / prior.alternating_std) ** 2)
    best = np.argmin(costs, axis=0)
    first, heading = measured[:, order[0]], alpha[:, 0] - mean[:, 0] / 2 + _ALTERNATING_STARTS[best]
    bend = np.stack(bends)[best, np.arange(len(measured))]
    length = np.tile(prior.length_mean, (len(measured), 1))
    return np.column_stack([first.real, first.imag, heading, bend, length])


def marker_offsets(
    points: np.ndarray, missing: np.ndarray, places: Sequence[tuple[int, str]], names: Sequence[str]
) -> np.ndarray:
    """Return the offsets of markers from their stations, shape (markers,), complex, m.

    A single marker at a station has the offset 0. Two markers without a side are on both sides of the
    station, along or across the body. Two markers with the same name, which replace a rigid body, may have
    any direction.

    Args:
        points: interpolated where a marker is hidden, shape (frames, markers, 2), m.
        missing: hidden markers, shape (frames, markers).
        places: station and side of each marker.
        names: name of each marker.

    Raises:
        InputError: a station has more than two markers or two on the same side, or a pair is oblique to the
            body.
    """
    offsets, position = np.zeros(len(places), dtype=complex), points @ [1, 1j]
    station = np.array([place for place, _ in places])
    members = [np.flatnonzero(station == value).tolist() for value in np.unique(station)]
    centres = [position[:, group].mean(axis=1) for group in members]
    for k, group in enumerate(members):
        if len(group) == 1:
            continue
        if len(group) > 2:
            listed = ", ".join(names[marker] for marker in group)
            raise InputError(
                f"{len(group)} markers at one place of the body ({listed}); at most two are used"
            )
        a, b = group
        line = position[:, a] - position[:, b]
        distance = float(np.median(np.abs(line)))
        sides = [SIDE_DIRECTIONS[places[marker][1]] for marker in group]
        if any(sides):
            if sides[0] == sides[1]:
                raise InputError(f"{names[a]} and {names[b]} are on the same side of one connector")
            side_distance = abs(sides[0] - sides[1]) if all(sides) else 1
            offsets[group] = [distance * side / side_distance for side in sides]
            continue
        # Direction of the pair relative to the line between the adjacent stations.
        ratio = line / (centres[max(k - 1, 0)] - centres[min(k + 1, len(centres) - 1)])
        visible = ~missing[:, group].any(axis=1)
        ratio = ratio[visible] if visible.any() else ratio
        angle = float(np.angle(np.exp(1j * np.angle(ratio)).mean()))
        if names[a] != names[b]:
            quarter = np.pi / 2 * np.rint(angle / (np.pi / 2))
            if abs(angle - quarter) > _MAX_PAIR_ANGLE:
                raise InputError(
                    f"{names[a]} and {names[b]} are at {np.degrees(angle):.0f}° to the body; place a pair "
                    "along the body or across it"
                )
            angle = quarter
        offsets[group] = distance / 2 * np.exp(1j * angle) * np.array([1, -1])
    return offsets
