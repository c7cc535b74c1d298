"""Model discrepancy: a known missing effect, and data that the model explains."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from scipy import stats
from snakes import robot

from srs_twin import AnalyticalSnake, Gait, rollout
from srs_twin.comparison.metrics import plant_metrics
from srs_twin.studies.uncertainty.discrepancy import Discrepancy

GRID = np.linspace(0.02, 0.14, 49)
SETTINGS = np.array([(f, p) for f in (1.0, 1.5, 2.0) for p in (41.0, 48.0, 55.0)])
SCALED = (SETTINGS - [1.5, 48.0]) / [0.5, 7.0]
MU_T = 0.045
NOISE = 0.002


@cache
def speeds(mu_t: float, model: str = "complete") -> np.ndarray:
    """Return the speeds of generation 2 at all settings, m/s."""
    spec = robot()
    spec = replace(spec, friction=replace(spec.friction, mu_t=mu_t))
    runs = [
        rollout(AnalyticalSnake(spec, model=model, supply_pa=1000 * p), Gait(f), 5.0)
        for f, p in SETTINGS
    ]
    return np.array([plant_metrics(run)["com_speed_m_s"] for run in runs])


@cache
def predicted() -> np.ndarray:
    """Return the speeds of a model with stiff bends at all settings, for each coefficient of the grid."""
    few = np.linspace(GRID[0], GRID[-1], 9)
    rows = np.array([speeds(float(mu)) for mu in few])
    return np.stack([np.interp(GRID, few, column) for column in rows.T], axis=1)


def fit(model: str, size: float, seed: int, stored: np.ndarray) -> Discrepancy:
    measured = speeds(MU_T, model) + NOISE * np.random.default_rng(seed).normal(
        size=len(SETTINGS)
    )
    return Discrepancy(
        SCALED[stored], measured[stored], predicted()[:, stored], NOISE, size, 1.5
    )


def interval(result: Discrepancy) -> tuple[float, float]:
    low, high = np.interp([0.025, 0.975], np.cumsum(result.weights), GRID)
    return float(low), float(high)


def test_a_missing_effect_biases_a_fit_unless_a_discrepancy_is_included():
    """Compliance is mistaken for friction with a narrow posterior; a discrepancy widens it."""
    everything = np.ones(len(SETTINGS), dtype=bool)
    held = {
        size: [interval(fit("compliant", size, seed, everything)) for seed in range(10)]
        for size in (1e-6, 0.03)
    }
    assert sum(low <= MU_T <= high for low, high in held[1e-6]) == 0
    assert sum(low <= MU_T <= high for low, high in held[0.03]) >= 9


def test_predictions_with_a_discrepancy_cover_settings_between_the_data():
    stored = np.arange(len(SETTINGS)) % 3 != 1
    truth = speeds(MU_T, "compliant")[~stored]
    held = []
    bare = []
    for seed in range(10):
        for size, to in ((0.03, held), (1e-6, bare)):
            drawn = fit("compliant", size, seed, stored).draw(
                SCALED[~stored], predicted()[:, ~stored], seed
            )
            low, high = np.quantile(drawn, [0.025, 0.975], axis=0)
            to += list((low <= truth) & (truth <= high))
    assert np.mean(held) >= 0.9
    assert np.mean(bare) <= 0.7


def test_explained_data_give_a_fit_without_a_discrepancy():
    result = fit("complete", 1e-6, 3, np.ones(len(SETTINGS), dtype=bool))
    difference = (result.measured - predicted()) / NOISE
    plain = np.exp(-(difference**2).sum(axis=1) / 2)
    assert result.weights == pytest.approx(plain / plain.sum(), abs=1e-4)


@pytest.mark.slow
def test_ranks_of_true_parameters_in_their_posteriors_are_uniform():
    """Simulation-based calibration (Talts et al. 2018) with parameters drawn from the priors."""
    rng = np.random.default_rng(0)
    ranks = []
    prior = np.exp(-((np.log(GRID / 0.06) / 0.3) ** 2) / 2) / GRID
    for _ in range(200):
        mu_t = float(
            rng.choice(GRID, p=prior / prior.sum())
            + (GRID[1] - GRID[0]) * (rng.random() - 0.5)
        )
        size = 0.02 * 2 ** rng.standard_normal()
        length = 1.5 * 2 ** rng.standard_normal()
        far = ((SCALED[:, None] - SCALED[None]) ** 2).sum(axis=-1)
        drift = np.linalg.cholesky(
            size**2 * np.exp(-far / (2 * length**2)) + 1e-10 * np.eye(len(far))
        )
        measured = (
            speeds(mu_t)
            + drift @ rng.standard_normal(len(far))
            + NOISE * rng.standard_normal(len(far))
        )
        result = Discrepancy(SCALED, measured, predicted(), NOISE, 0.02, 1.5, prior)
        ranks.append(
            np.interp(mu_t, GRID, np.cumsum(result.weights) - result.weights / 2)
        )
    counts, _ = np.histogram(ranks, bins=10, range=(0.0, 1.0))
    assert stats.chisquare(counts).pvalue > 0.01, counts
