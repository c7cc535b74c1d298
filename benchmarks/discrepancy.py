r"""Predictions of each row of Table 8 from the other rows, with model and discrepancy.

    uv run python benchmarks/discrepancy.py

The model predictions m are those of the committed baseline. Their systematic error is a
Gaussian process (Kennedy and O'Hagan 2001),

$$ y_i = m_i + \delta(x_i) + \varepsilon_i, \qquad
\delta \sim \mathcal{GP}\bigl(0,\ s^2 e^{-(x - x')^2 / 2\ell^2}\bigr), \qquad
\varepsilon \sim \mathcal N(0, \sigma^2), $$

with s and ℓ on grids of log-normal priors: medians of a fifth of the published mean and
of 0.2 in the offset, and a factor 2 as one standard deviation. The noise is 5 % of the
mean, the scatter between mirrored offsets in Table 8.
"""

from __future__ import annotations

import re
from itertools import product

import numpy as np

from srs_twin.reproduction.claims import load_claims
from srs_twin.reproduction.verdicts import load_baseline

SIZE = 0.2
LENGTH = 0.2
NOISE = 0.05
FACTORS = np.array([1 / 3, 1 / np.sqrt(3), 1.0, np.sqrt(3), 3.0])
WEIGHTS = np.exp(-(np.log(FACTORS) ** 2) / (2 * np.log(2.0) ** 2))
DRAWS = 4000


def kernel(x: np.ndarray, y: np.ndarray, size: float, length: float) -> np.ndarray:
    """Return the covariance of the discrepancy between two sets of offsets."""
    squared = (x[:, None] - y[None]) ** 2
    return np.asarray(size**2 * np.exp(-squared / (2 * length**2)))


def draw_discrepancy(
    x: np.ndarray, error: np.ndarray, at: float, scale: float, seed: int
) -> np.ndarray:
    """Return draws of a measurement minus its model at an offset.

    Args:
        x: other offsets, shape (n,).
        error: measurement minus model there, shape (n,).
        at: offset of the prediction.
        scale: published mean.
        seed: random seed.
    """
    rng = np.random.default_rng(seed)
    log_posterior = []
    moments = []
    for (a, prior_a), (b, prior_b) in product(
        zip(FACTORS, WEIGHTS, strict=True), repeat=2
    ):
        size = SIZE * scale * a
        length = LENGTH * b
        covariance = kernel(x, x, size, length)
        covariance += (NOISE * scale) ** 2 * np.eye(len(x))
        weights = np.linalg.solve(covariance, error)
        log_determinant = np.linalg.slogdet(covariance)[1]
        log_prior = np.log(prior_a * prior_b)
        log_posterior.append(log_prior - (error @ weights + log_determinant) / 2)
        cross = kernel(np.array([at]), x, size, length)[0]
        explained = cross @ np.linalg.solve(covariance, cross)
        moments.append((cross @ weights, size**2 - explained + (NOISE * scale) ** 2))
    posterior = np.exp(np.array(log_posterior) - max(log_posterior))
    which = rng.choice(len(posterior), DRAWS, p=posterior / posterior.sum())
    mean, variance = np.array(moments)[which].T
    return rng.normal(mean, np.sqrt(variance))


def rows_of(quantity: str, plant: str) -> np.ndarray:
    """Return offset, published value and prediction of each row of Table 8, shape (3, 7)."""
    kept = load_baseline().outcomes
    rows = []
    for claim in load_claims():
        result = re.fullmatch(rf"table8\.{quantity}\.([pm]?)(\d+)", claim.id)
        if result is None or claim.value is None:
            continue
        offset = float(result[2]) / 10 * (-1 if result[1] == "m" else 1)
        value = kept[claim.id][plant].value
        if quantity == "radius":
            # Curvature also has a constant term: straight walks are curved. At offset 0
            # the table has no side; the fit assumes the right side.
            side = -1 if offset == 0 else 1
            rows.append((offset, side / claim.value, side / value))
        else:
            rows.append((offset, claim.value, value))
    return np.array(sorted(rows)).T


def main() -> None:
    """Print a table."""
    print(
        "| quantity | plant | rms of the model | rms with discrepancy | rows within 95"
        " % | mean width |"
    )
    print("|---|---|---|---|---|---|")
    for name, quantity in (("speed", "speed"), ("curvature", "radius")):
        for plant in ("analytical", "twin"):
            offset, measured, model = rows_of(quantity, plant)
            scale = float(np.abs(measured).mean())
            error = measured - model
            intervals = []
            for i, at in enumerate(offset):
                rest = np.arange(len(offset)) != i
                drawn = draw_discrepancy(offset[rest], error[rest], at, scale, i)
                intervals.append(np.quantile(model[i] + drawn, [0.025, 0.5, 0.975]))
            low, middle, high = np.transpose(intervals)
            held = int(((low <= measured) & (measured <= high)).sum())
            before, after = (
                100 * np.sqrt(np.mean((value - measured) ** 2)) / scale
                for value in (model, middle)
            )
            width = 100 * np.mean(high - low) / scale
            print(
                f"| {name} | {plant} | {before:.0f} % | {after:.0f} % |"
                f" {held} of {len(offset)} | {width:.0f} % |"
            )


if __name__ == "__main__":
    main()
