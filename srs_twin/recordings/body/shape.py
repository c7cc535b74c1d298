"""Estimation of bends, segment lengths and standard errors from marker positions.

**Lengths.** If the markers determine the bends without an assumption on the segment
lengths, the lengths are free parameters. Their means and their standard deviation σ_ℓ
are estimated by expectation-maximisation. One marker per connector does not determine
the alternating bend ε in q_j = q_j⁰ + 2(−1)^{j−1} ε, as adjacent headings may turn
oppositely. In this case, the segment lengths are assumed to be constant, which
determines ε with low accuracy if the body is nearly straight. Recordings with one
marker per connector are rejected if the body stretches.

**Noise.** The noise σ in a marker coordinate is estimated from high-order differences
over time, which suppress the motion. If the markers are redundant, σ is computed from
the fit residual, which also includes deviations of the segments from arcs.
"""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from enum import Enum
from math import comb

import numpy as np

from srs_twin.compute.workers import processor_count
from srs_twin.recordings.body.frame_fit import (
    FrameFit,
    MarkerPlacement,
    StatePrior,
    fit_frames,
    fit_incomplete_frames,
    initial_states,
)
from srs_twin.recordings.body.tracking import sample_frames
from srs_twin.robot.spec import Geometry

_MIN_NOISE = 1e-7
"""Lower bound on the noise σ, m, for simulated recordings without noise."""
_DEFAULT_NOISE = 5e-4
"""Noise σ assumed for a recording that is too short for an estimate, m."""
_MAX_DIFFERENCE_ORDER = 8
_NOISE_FRAMES = 20_000
_MIN_REDUNDANCY = 0.3
"""Minimum number of redundant coordinates per frame for a noise estimate."""
_MIN_MOTION_RATIO = 0.5
"""Ratio of residual to noise below which the noise estimate includes motion."""

_INITIAL_LENGTH_STD = 0.1
"""Initial value of the standard deviation σ_ℓ, relative to the segment length."""
_INITIAL_ALTERNATING_STD = 0.3
"""Initial value of the standard deviation σ_ε, rad."""
_EM_FRAMES = 400
_EM_ITERATIONS = 12

_MAX_BEND_STD = 0.15
"""Maximum standard error of a bend that counts as determined, rad."""
_TEST_NOISE = 2e-4
"""Noise assumed in `length_model`, m."""
_FREE_LENGTH_STD = 0.3
"""Standard deviation of free lengths in `length_model`, relative to the length."""
_FIXED_LENGTH_STD = 0.01
"""Standard deviation of constant lengths in `length_model`, relative to the length."""

_CHUNK_FRAMES = 2048

_OUTLIER_NOISE = 8.0
"""Minimum distance of an outlier from its fitted position, divided by the noise."""
_MAX_OUTLIERS = 0.01
"""Maximum fraction of outliers, above which the model is probably wrong."""
_MIN_OUTLIER_DISTANCE = 1e-4
"""Minimum distance of an outlier from its fitted position, m."""


class LengthModel(Enum):
    """Assumption on the segment lengths."""

    FREE = "free"
    """Segment lengths may vary, because markers alone determine bends."""
    FIXED = "fixed"
    """Segment lengths are constant, because markers alone do not determine bends."""


@dataclass(frozen=True)
class BodyShape:
    """Shape of the body over time.

    Attributes:
        connector: complex connector positions, m, shape (frames, N).
        theta: unwrapped connector headings, rad, shape (frames, N).
        bend_error: standard errors of the bends, rad, shape (frames, segments).
        length: arc lengths of the segments, m, shape (frames, segments).
        noise: standard deviation σ of the noise in a marker coordinate, m.
        residual: RMS distance of the visible markers from the body, m, shape (frames,).
        missing: mask of hidden markers and outliers, shape (frames, markers).
    """

    connector: np.ndarray
    theta: np.ndarray
    bend_error: np.ndarray
    length: np.ndarray
    length_std: float
    noise: float
    residual: np.ndarray
    missing: np.ndarray

    @property
    def bend(self) -> np.ndarray:
        """Bends q_j = θ_j − θ_{j+1}, shape (frames, segments), rad."""
        return np.asarray(self.theta[:, :-1] - self.theta[:, 1:])


def length_model(
    station: np.ndarray, offset: np.ndarray, geometry: Geometry
) -> LengthModel | None:
    """Return the weakest length assumption with which the markers determine the bends.

    The test uses the standard errors of the bends in one typical shape. The result is
    None if no assumption is sufficient.
    """
    placement = MarkerPlacement(station, offset, geometry)
    count = geometry.connectors - 1
    bends = 0.8 * np.cos(np.pi / 2 * np.arange(count) + 0.4)
    lengths = np.full(count, geometry.segment_length)
    state = np.concatenate([np.zeros(3), bends, lengths])[None]
    jacobian = placement.kinematics(state).jacobian[0]
    data = (jacobian.conj().T @ jacobian).real / _TEST_NOISE**2
    # Constant lengths of fewer than three segments may not determine the sign of ε.
    one_per_connector = count > 2 and sorted(station) == list(
        range(0, 2 * count + 1, 2)
    )
    stds = {LengthModel.FREE: _FREE_LENGTH_STD}
    if one_per_connector:
        stds[LengthModel.FIXED] = _FIXED_LENGTH_STD
    for model, std in stds.items():
        prior = StatePrior(_TEST_NOISE, lengths, std * geometry.segment_length, None)
        matrix = data + prior.information()
        if np.linalg.matrix_rank(matrix, tol=1e-3, hermitian=True) < len(data):
            continue
        error = np.sqrt(np.diag(np.linalg.inv(matrix))[prior.bends])
        if error.max() < _MAX_BEND_STD:
            return model
    return None


def marker_noise(points: np.ndarray) -> float:
    """Estimate the standard deviation of the noise in a marker coordinate, m.

    The n-th differences of white noise with a variance of σ² have a variance of
    C(2n, n) σ², where C is the binomial coefficient. Motion increases the estimate of
    σ, mainly at low orders n, so the smallest estimate over all orders is returned.
    Each estimate is based on a median, which is robust to outliers. Positions of hidden
    markers in `points` (m) are NaN.
    """
    estimates = []
    for order in range(1, min(_MAX_DIFFERENCE_ORDER, len(points) - 2) + 1):
        difference = np.diff(points, order, axis=0)
        known = np.abs(difference[np.isfinite(difference)])
        if known.size >= 50:
            # The factor 1.4826 converts the median magnitude of normally distributed
            # values to their standard deviation.
            estimates.append(
                1.4826 * np.median(known) / np.sqrt(comb(2 * order, order))
            )
    return max(float(min(estimates, default=_DEFAULT_NOISE)), _MIN_NOISE)


def fit_shape(
    time: np.ndarray,
    points: np.ndarray,
    missing: np.ndarray,
    placement: MarkerPlacement,
    model: LengthModel,
) -> BodyShape:
    """Fit the body shape to marker positions (m).

    The positions of hidden markers must be interpolated.
    """
    measured = points @ [1, 1j]
    missing = missing.copy()
    first = slice(0, _NOISE_FRAMES)
    noise = marker_noise(np.where(missing[first, :, None], np.nan, points[first]))
    complete = np.flatnonzero(~missing.any(axis=1))
    if len(complete) < 4:
        # The bend spline needs some frames without hidden markers. If too few frames
        # are complete, the interpolated positions are treated as measured positions.
        complete = np.arange(len(time))
        missing = np.zeros_like(missing)
    sampled = complete[sample_frames(len(complete), _EM_FRAMES)]
    prior = _estimated_prior(measured[sampled], placement, model, noise)
    fits = _RecordingFits(len(time), measured.shape[1], prior)

    def fit_complete(rows: np.ndarray) -> FrameFit:
        return fit_frames(
            initial_states(measured[rows], placement, prior),
            measured[rows],
            placement,
            prior,
        )

    chi2, freedom = fits.update(complete, fit_complete)
    scale = 1.0
    if freedom > _MIN_REDUNDANCY * len(complete):
        scale = float(np.sqrt(chi2 / freedom))
    if prior.alternating_std is not None:
        # With constant lengths, the fit has little redundancy, so a small residual must
        # not reduce the standard errors.
        scale = max(scale, 1.0)
    outlier = fits.distance[complete] > max(
        _OUTLIER_NOISE * prior.noise * scale, _MIN_OUTLIER_DISTANCE
    )
    if outlier.mean() < _MAX_OUTLIERS:
        missing[complete] |= outlier
    incomplete = np.asarray(missing.any(axis=1))
    if incomplete.any() and (~incomplete).sum() >= 4:
        _interpolate_states(time, fits.state, incomplete, prior.bends)

        def fit_incomplete(rows: np.ndarray) -> FrameFit:
            return fit_incomplete_frames(
                fits.state[rows], measured[rows], missing[rows], placement, prior
            )

        fits.update(np.flatnonzero(incomplete), fit_incomplete)
    return _body_shape(fits, missing, placement.geometry, prior, scale)


def _interpolate_states(
    time: np.ndarray, state: np.ndarray, incomplete: np.ndarray, bends: slice
) -> None:
    from scipy.interpolate import CubicSpline

    good = np.flatnonzero(~incomplete)
    state[good, 2] = np.unwrap(state[good, 2])
    state[incomplete] = CubicSpline(time[good], state[good])(time[incomplete])
    state[incomplete, bends] = np.clip(state[incomplete, bends], -np.pi, np.pi)


def _body_shape(
    fits: _RecordingFits,
    missing: np.ndarray,
    geometry: Geometry,
    prior: StatePrior,
    scale: float,
) -> BodyShape:
    fits.state[:, 2] = np.unwrap(fits.state[:, 2])
    body = MarkerPlacement(np.zeros(0, dtype=int), np.zeros(0), geometry).kinematics(
        fits.state
    )
    squares = np.ma.masked_array(fits.distance**2, missing).mean(axis=1)
    return BodyShape(
        body.connector,
        body.heading,
        bend_error=fits.bend_error * scale,
        length=fits.state[:, prior.lengths],
        length_std=prior.length_std,
        noise=prior.noise * scale,
        residual=np.sqrt(squares.filled(0.0)),
        missing=missing,
    )


class _RecordingFits:
    def __init__(self, frames: int, markers: int, prior: StatePrior) -> None:
        segments = len(prior.length_mean)
        self._bends = prior.bends
        self.state = np.empty((frames, 3 + 2 * segments))
        self.bend_error = np.empty((frames, segments))
        self.distance = np.empty((frames, markers))

    def update(
        self, frames: np.ndarray, fit: Callable[[np.ndarray], FrameFit]
    ) -> np.ndarray:
        def work(rows: np.ndarray) -> tuple[float, float]:
            fitted = fit(rows)
            self.state[rows] = fitted.state
            self.distance[rows] = fitted.distance
            self.bend_error[rows] = fitted.error(self._bends)
            return fitted.chi2, fitted.freedom

        chunks = np.split(frames, range(_CHUNK_FRAMES, len(frames), _CHUNK_FRAMES))
        with ThreadPoolExecutor(processor_count()) as pool:
            return np.asarray(np.sum([*pool.map(work, chunks)], axis=0))


def _estimated_prior(
    measured: np.ndarray, placement: MarkerPlacement, model: LengthModel, noise: float
) -> StatePrior:
    straight = placement.geometry.segment_length
    segments = placement.geometry.connectors - 1
    fixed = model is LengthModel.FIXED
    alternating_std = _INITIAL_ALTERNATING_STD if fixed else None
    prior = StatePrior(
        noise,
        np.full(segments, straight),
        _INITIAL_LENGTH_STD * straight,
        alternating_std,
    )
    weights = prior.alternating_weights
    start = initial_states(measured, placement, prior)
    for iteration in range(_EM_ITERATIONS):
        fit = fit_frames(start, measured, placement, prior)
        length = fit.state[:, prior.lengths]
        variance = fit.error(prior.lengths) ** 2
        if fixed:
            prior.length_mean = np.median(length, axis=0)
        else:
            prior.length_mean = length.mean(axis=0)
        # The spread of the fitted lengths does not include their standard errors, so
        # the variances of the fit are added.
        prior.length_std = float(
            np.sqrt(((length - prior.length_mean) ** 2 + variance).mean())
        )
        if fixed:
            epsilon = fit.state[:, prior.bends] @ weights
            bend_covariance = fit.covariance[:, prior.bends, prior.bends]
            epsilon_variance = np.einsum(
                "u,fuv,v->f", weights, bend_covariance, weights
            )
            prior.alternating_std = float(
                np.sqrt((epsilon**2 + epsilon_variance).mean())
            )
        if fit.freedom > _MIN_REDUNDANCY * len(measured):
            scale = float(np.sqrt(fit.chi2 / fit.freedom))
            # With constant lengths, the noise and the variation of the lengths have
            # nearly equal effects on the residual. The noise is therefore updated only
            # in the second half of the iterations, and only if a small residual shows
            # that the noise includes motion.
            if not fixed or (
                scale < _MIN_MOTION_RATIO and 2 * iteration >= _EM_ITERATIONS
            ):
                prior.noise = max(prior.noise * scale, _MIN_NOISE)
        # With constant lengths, a new prior may change the best ε, so the grid is
        # searched again.
        start = fit.state
        if fixed:
            start = initial_states(measured, placement, prior)
    return prior
