"""Least squares: known values are recovered, intervals agree with theory, verdicts follow the data."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st
from scipy import stats

from srs_twin.errors import InputError
from srs_twin.identification.estimate import Parameter, Residual, correlation_time
from srs_twin.identification.least_squares import SearchOptions, least_squares
from srs_twin.identification.parameters import FreeParameter

pytestmark = pytest.mark.fast

TIME = np.linspace(0.0, 1.0, 60)


def unknown(
    name: str, start: float, scale: float | None = 1.0, low: float = -50.0
) -> FreeParameter:
    return FreeParameter(name, "1", start, low if scale else 1e-3, 50.0, scale)


def line(measured: np.ndarray, noise: float = 1.0):
    """Return the residuals of a straight line."""
    return lambda v: [Residual("line", "1", measured - v["a"] - v["b"] * TIME, noise)]


def ar1(rng: np.random.Generator, count: int, rho: float) -> np.ndarray:
    """Return AR(1) noise of unit variance with lag-1 correlation ρ."""
    noise = rng.normal(size=count)
    for k in range(1, count):
        noise[k] = rho * noise[k - 1] + math.sqrt(1 - rho**2) * noise[k]
    return noise


@given(
    st.floats(-20, 20),
    st.floats(-20, 20),
    st.integers(0, 1000),
    st.floats(1e-3, 0.05),
    st.floats(0.1, 10),
)
@settings(max_examples=30)
def test_a_straight_line_fit_agrees_with_the_closed_form(a, b, seed, noise, scale):
    """Values and standard errors agree for any weight of the residuals."""
    measured = a + b * TIME + noise * np.random.default_rng(seed).normal(size=len(TIME))
    result = least_squares(
        line(measured, scale), [unknown("a", 0.0), unknown("b", 0.0)]
    )
    fit = stats.linregress(TIME, measured)
    assert result["a"].value == pytest.approx(fit.intercept, abs=1e-7)
    assert result["b"].value == pytest.approx(fit.slope, abs=1e-7)
    # Seemingly correlated noise widens the interval; nothing narrows it.
    grown = math.sqrt(result.samples / result.independent)
    freedom = (result.samples - 2) / (result.independent - 2) / grown**2
    assert result["b"].standard_error == pytest.approx(
        fit.stderr * grown * math.sqrt(freedom), rel=1e-4
    )
    assert result.correlation[0, 1] == pytest.approx(-math.sqrt(3) / 2, abs=0.02)


def test_estimates_are_deterministic():
    measured = 3 + 2 * TIME + np.random.default_rng(0).normal(size=len(TIME))
    unknowns = [unknown("a", 0.0), unknown("b", 0.0)]
    one, other = (least_squares(line(measured), unknowns, starts=3) for _ in range(2))
    assert one.parameters == other.parameters


@pytest.mark.parametrize("rho", [0.0, 0.8])
def test_intervals_cover_the_truth(rho):
    """40 repetitions with 95 %: fewer than 33 hits have a probability of 1 in 1,000."""
    hits = np.zeros(2)
    for seed in range(40):
        time = np.linspace(0.0, 1.0, 300)
        measured = 1.0 + 0.5 * time + 0.1 * ar1(np.random.default_rng(seed), 300, rho)
        fit = least_squares(
            lambda v, t=time, m=measured: [
                Residual("x", "1", m - v["a"] - v["b"] * t, 0.1)
            ],
            [unknown("a", 0.0), unknown("b", 0.0)],
        )
        for k, truth in enumerate((1.0, 0.5)):
            parameter = fit.parameters[k]
            # Weak ones have an interval too; a slope of 0.5 with an error beyond 1
            # would have none.
            assert parameter.low is not None and parameter.high is not None
            hits[k] += parameter.low <= truth <= parameter.high
    assert stats.binom.cdf(32, 40, 0.95) < 1e-3
    assert (hits >= 33).all(), hits


@pytest.mark.parametrize("rho", [0.0, 0.5, 0.9])
def test_correlation_time_of_a_known_process(rho):
    """For an AR(1) process it is (1 + ρ)/(1 − ρ)."""
    rng = np.random.default_rng(5)
    fit = np.mean([correlation_time([ar1(rng, 4000, rho)]) for _ in range(10)])
    assert fit == pytest.approx((1 + rho) / (1 - rho), rel=0.15)


def test_short_series_are_treated_as_independent():
    assert correlation_time([np.ones(10), np.arange(5.0)]) == 1.0
    assert correlation_time([np.zeros(100)]) == 1.0


def test_factors_of_a_product_are_not_identifiable_and_have_no_value():
    measured = 6.0 * TIME
    fit = least_squares(
        lambda v: [
            Residual("x", "1", measured - v["m"] * v["k"] * TIME + 0 * v["c"], 0.01)
        ],
        [unknown("m", 1.0, None), unknown("k", 2.0, None), unknown("c", 1.0, None)],
    )
    for name in ("m", "k", "c"):
        assert fit[name].verdict == "not identifiable"
        assert (
            fit[name].value is None
            and fit[name].standard_error is None
            and fit[name].low is None
        )
    assert (
        "combination of it with k" in fit["m"].why and "m" not in fit["c"].why.split()
    )
    assert fit["c"].why == "the residuals do not depend on it"
    product = next(row for row in fit.cancels if "m" in row)
    assert product["m"] == pytest.approx(-product["k"]) and "c" not in product
    assert fit.values == {}


def test_other_parameters_are_identified_although_some_cancel():
    measured = 6.0 * TIME + 0.5
    fit = least_squares(
        lambda v: [
            Residual("x", "1", measured - v["m"] * v["k"] * TIME - v["a"], 0.01)
        ],
        [unknown("m", 1.0, None), unknown("k", 2.0, None), unknown("a", 0.0)],
    )
    assert fit["a"].verdict == "identified" and fit["a"].value == pytest.approx(
        0.5, abs=1e-6
    )
    assert np.isnan(fit.correlation[0]).all() and fit.correlation[2, 2] == 1.0


@pytest.mark.parametrize(
    ("noise", "verdict"),
    [(1e-3, "identified"), (1.0, "weakly identified"), (30.0, "not identifiable")],
)
def test_the_verdict_follows_the_noise(noise, verdict):
    measured = 2.0 + noise * np.random.default_rng(3).normal(size=len(TIME))
    fit = least_squares(
        lambda v: [Residual("x", "1", measured - v["a"], noise)], [unknown("a", 1.0)]
    )
    assert fit["a"].verdict == verdict


def test_an_estimate_at_its_bound_has_no_value():
    fit = least_squares(
        lambda v: [Residual("x", "1", -3.0 - v["a"] + 0.1 * np.sin(40 * TIME), 0.1)],
        [unknown("a", 1.0, low=0.0)],
    )
    assert fit["a"].verdict == "not identifiable"
    assert "at the lower bound, 0 1, or beyond" in fit["a"].why


@pytest.mark.parametrize("lacks", [False, True])
def test_a_model_without_an_effect_in_the_data_has_no_estimate(lacks):
    """The residuals decide, not the formal error: a line is fitted to a curve, and to a line."""
    rng = np.random.default_rng(3)

    def residuals(v):
        curve = 2 + v["b"] * TIME
        seen = 2 + 3 * TIME + (8 * np.maximum(TIME - 0.5, 0.0) ** 2 if lacks else 0.0)
        return [
            Residual(f"walk {name}", "m", seen + noise[name] - curve, 0.1)
            for name in noise
        ]

    noise = {name: 0.1 * rng.normal(size=len(TIME)) for name in ("path_x", "path_y")}
    fit = least_squares(residuals, [unknown("b", 0.0)])
    if not lacks:
        assert fit["b"].verdict == "identified" and fit.misfit == ()
        return
    assert fit["b"].verdict == "cannot tell" and fit["b"].value is not None
    assert "spread about the best value under a wrong model" in fit["b"].why
    assert (
        fit.misfit[0]
        == "the model does not explain the data; these intervals do not hold"
    )
    assert fit.misfit[1].startswith("residuals of path: ") and fit.misfit[1].endswith(
        "growing with time"
    )
    assert fit.misfit[0] in fit.text()


def test_one_unexplained_kind_of_signal_is_enough():
    """A few samples of one kind would vanish in a mean over many samples of another."""
    noise = np.random.default_rng(0).normal(size=(8, len(TIME)))

    def residuals(v):
        bends = [
            Residual(f"walk bend_{j}", "rad", v["a"] + part, 1.0)
            for j, part in enumerate(noise, 1)
        ]
        return [
            *bends,
            Residual("walk yaw_rate", "rad/s", np.array([v["a"] + 4.0]), 1.0),
        ]

    fit = least_squares(residuals, [unknown("a", 0.0)])
    assert fit.residual_scale < 1.2 and fit["a"].verdict == "cannot tell"
    assert fit.misfit[1].startswith("residuals of yaw_rate: 4")


@pytest.mark.parametrize("bias", [0.0, 0.05, 0.3])
def test_a_reference_fit_adds_the_model_error_to_the_intervals(bias):
    """With a reference whose slope is b + bias, the variance grows by bias² and the value is unchanged."""
    measured = 2 * TIME + 0.01 * np.random.default_rng(0).normal(size=len(TIME))
    one = [unknown("b", 0.0)]
    residuals = lambda v: [Residual("line", "1", measured - v["b"] * TIME, 0.01)]  # noqa: E731
    alone = least_squares(residuals, one)["b"]
    fit = least_squares(residuals, one, refit=lambda v: {"b": v["b"] + bias})["b"]
    assert fit.value == alone.value
    assert fit.standard_error == pytest.approx(
        math.hypot(alone.standard_error, bias), rel=1e-6
    )
    assert fit.verdict == ("weakly identified" if bias > 0.1 else "identified")
    assert ("model error" in fit.why) == (bias > 0)


@pytest.mark.parametrize("derivative", [-0.7, 0.0, 0.5])
def test_the_bias_is_evaluated_at_the_true_value(derivative):
    """Five searches converge to the bias at the truth, 0.05; after two with slope −0.7 it would be 0.026."""
    true = 2.0
    bias = 0.05
    at = lambda b: bias + derivative * (b - true)  # noqa: E731
    measured = (true + at(true)) * TIME + 1e-3 * np.random.default_rng(0).normal(
        size=len(TIME)
    )
    residuals = lambda v: [Residual("line", "1", measured - v["b"] * TIME, 1e-3)]  # noqa: E731
    fit = least_squares(
        residuals, [unknown("b", 0.0)], refit=lambda v: {"b": v["b"] + at(v["b"])}
    )["b"]
    # Each search multiplies the error of the bias by |slope|.
    assert fit.standard_error == pytest.approx(
        bias, abs=bias * abs(derivative) ** 5 + 2e-3
    )
    assert fit.low < true < fit.high


def test_two_equally_good_minima_are_reported():
    measured = 4.0 + 0.01 * np.random.default_rng(0).normal(size=len(TIME))
    fit = least_squares(
        lambda v: [Residual("x", "1", measured - v["a"] ** 2, 0.01)],
        [unknown("a", 0.3)],
        starts=6,
    )
    assert fit["a"].verdict == "weakly identified" and "another start" in fit["a"].why
    assert abs(fit["a"].value) == pytest.approx(2.0, abs=0.01)


def test_validation_data_do_not_influence_the_fit():
    measured = 2.0 + 0 * TIME
    alone = least_squares(
        lambda v: [Residual("x", "1", measured - v["a"], 1.0)], [unknown("a", 0.0)]
    )
    beside = least_squares(
        lambda v: [
            Residual("x", "1", measured - v["a"], 1.0),
            Residual("y", "1", 9.0 + measured - v["a"], 1.0, "validation"),
        ],
        [unknown("a", 0.0)],
    )
    assert beside.parameters == alone.parameters
    assert (
        beside.rms("validation") == pytest.approx(9.0, abs=1e-6)
        and alone.rms("validation") is None
    )


def test_unsuitable_residuals_are_refused():
    with pytest.raises(InputError, match="60 samples cannot determine 60 parameters"):
        least_squares(
            lambda v: [Residual("x", "1", TIME, 1.0)],
            [unknown(f"a{k}", 0.0) for k in range(60)],
        )
    with pytest.raises(InputError, match="not finite at the start of the search"):
        least_squares(
            lambda v: [Residual("x", "1", TIME * np.nan, 1.0)], [unknown("a", 0.0)]
        )
    with pytest.raises(InputError, match="at least one free parameter"):
        least_squares(lambda v: [Residual("x", "1", TIME, 1.0)], [])
    with pytest.raises(InputError, match="must have no value"):
        Parameter("a", "1", "not identifiable", 1.0, 1.0, 1.0, 1.0)
    with pytest.raises(InputError, match="verdict 'identified' must have value"):
        Parameter("a", "1", "identified", 1.0)


def _wrapped(steepness: float, calls: list[float]):
    """Return residuals of a line with slope a = 2 and of an oscillation whose phase depends on a."""

    def residuals(values):
        a = values["a"]
        calls.append(a)
        turns = np.exp(1j * steepness * (a - 2.0)) - 1.0
        return [
            Residual("even", "1", (2.0 - a) * np.ones(5), 0.1),
            Residual("turning", "1", np.tile([turns.real, turns.imag], 10), 1e-2),
        ]

    return residuals


def test_a_guide_leads_past_local_minima():
    start = [unknown("a", 0.0)]
    astray = least_squares(_wrapped(20.0, []), start)
    assert abs(astray["a"].value - 2.0) > 0.2
    led = least_squares(
        _wrapped(20.0, []),
        start,
        options=SearchOptions(
            coarse_step=1e-3, first_stage=lambda residual: residual.name == "even"
        ),
    )
    assert led["a"].value == pytest.approx(2.0, abs=1e-9)


def test_parameters_without_a_guide_keep_their_start():
    def residuals(values):
        return [
            Residual("led", "1", np.full(5, values["a"] - 1.0), 0.1),
            Residual("rest", "1", np.full(5, values["b"] - 3.0), 0.1),
        ]

    led: list[float] = []

    def watched(values):
        led.append(values["b"])
        return residuals(values)

    fit = least_squares(
        watched,
        [unknown("a", 0.0), unknown("b", 0.5)],
        options=SearchOptions(first_stage=lambda residual: residual.name == "led"),
    )
    assert fit["b"].value == pytest.approx(3.0) and fit["a"].value == pytest.approx(1.0)
    assert np.abs(np.array(led[:8]) - 0.5).max() < 1e-3


def test_a_search_ends_after_its_runs_or_at_the_minimum():
    calls: list[float] = []
    spent = least_squares(
        _wrapped(20.0, calls), [unknown("a", 0.0)], options=SearchOptions(max_runs=4)
    )
    # Four of the search, one before it to check the data, and five for identifiability.
    assert not spent.converged and len(calls) <= 1 + 4 + 5
    calls.clear()
    enough = least_squares(
        _wrapped(0.1, calls), [unknown("a", 0.0)], options=SearchOptions(target_rms=0.5)
    )
    assert enough.converged
    exact: list[float] = []
    least_squares(_wrapped(0.1, exact), [unknown("a", 0.0)])
    assert len(calls) < len(exact)


def test_ripple_within_the_interval_does_not_prevent_identification():
    """The ripple is far below the noise but steep, so that small difference steps see only the ripple."""
    measured = 2.0 * TIME + 0.1 * np.random.default_rng(1).normal(size=len(TIME))

    def residuals(values):
        ripple = 0.02 * np.sin(2e3 * values["a"] + 37.0 * np.arange(len(TIME)))
        return [Residual("line", "1", measured - values["a"] * TIME - ripple, 0.1)]

    near = [unknown("a", 2.0)]
    small = least_squares(residuals, near, options=SearchOptions(step=1e-3))
    assert small["a"].verdict == "not identifiable"
    fit = least_squares(
        residuals, near, options=SearchOptions(step=1e-3, identifiability_step=0.3)
    )
    assert fit["a"].verdict == "identified"
    error = 0.1 / np.linalg.norm(TIME)
    assert 0.5 * error < fit["a"].standard_error < 2 * error
    assert abs(fit["a"].value - 2.0) < 4 * error
