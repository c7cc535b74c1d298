"""Least squares: known numbers come back, intervals are those of theory, verdicts follow the data."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import stats

from srs_twin.errors import InputError
from srs_twin.identification.estimate import Parameter, Residual, correlation_time
from srs_twin.identification.least_squares import SearchOptions, least_squares
from srs_twin.identification.parameters import FreeParameter

pytestmark = pytest.mark.fast

TIME = np.linspace(0.0, 1.0, 60)


def unknown(name: str, start: float, scale: float | None = 1.0, low: float = -50.0) -> FreeParameter:
    return FreeParameter(name, "1", start, low if scale else 1e-3, 50.0, scale)


def line(measured: np.ndarray, noise: float = 1.0):
    """Return the residuals of a straight line."""
    return lambda v: [Residual("line", "1", measured - v["a"] - v["b"] * TIME, noise)]


def ar1(rng: np.random.Generator, count: int, rho: float) -> np.ndarray:
    """Return noise of unit variance in which a sample resembles the one before by ρ."""
    noise = rng.normal(size=count)
    for k in range(1, count):
        noise[k] = rho * noise[k - 1] + math.sqrt(1 - rho**2) * noise[k]
    return noise


@given(
    st.floats(-20, 20), st.floats(-20, 20), st.integers(0, 1000), st.floats(1e-3, 0.05), st.floats(0.1, 10)
)
@settings(max_examples=30)
def test_a_line_is_the_textbooks(a, b, seed, noise, scale):
    """Against the closed form: values and errors, whatever the weight of the residuals."""
    measured = a + b * TIME + noise * np.random.default_rng(seed).normal(size=len(TIME))
    found = least_squares(line(measured, scale), [unknown("a", 0.0), unknown("b", 0.0)])
    fit = stats.linregress(TIME, measured)
    assert found["a"].value == pytest.approx(fit.intercept, abs=1e-7)
    assert found["b"].value == pytest.approx(fit.slope, abs=1e-7)
    # Noise that happens to look correlated counts for less; it never counts for more.
    grown = math.sqrt(found.samples / found.independent)
    freedom = (found.samples - 2) / (found.independent - 2) / grown**2
    assert found["b"].standard_error == pytest.approx(fit.stderr * grown * math.sqrt(freedom), rel=1e-4)
    assert found.correlation[0, 1] == pytest.approx(-math.sqrt(3) / 2, abs=0.02)


def test_the_same_data_give_the_same_bits():
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
        found = least_squares(
            lambda v, t=time, m=measured: [Residual("x", "1", m - v["a"] - v["b"] * t, 0.1)],
            [unknown("a", 0.0), unknown("b", 0.0)],
        )
        for k, truth in enumerate((1.0, 0.5)):
            each = found.parameters[k]
            # Weak ones have an interval too; a slope of 0.5 with an error beyond 1 would have none.
            assert each.low is not None and each.high is not None
            hits[k] += each.low <= truth <= each.high
    assert stats.binom.cdf(32, 40, 0.95) < 1e-3
    assert (hits >= 33).all(), hits


@pytest.mark.parametrize("rho", [0.0, 0.5, 0.9])
def test_correlation_time_of_a_known_process(rho):
    """Of an AR(1) process it is (1 + ρ)/(1 − ρ)."""
    rng = np.random.default_rng(5)
    found = np.mean([correlation_time([ar1(rng, 4000, rho)]) for _ in range(10)])
    assert found == pytest.approx((1 + rho) / (1 - rho), rel=0.15)


def test_short_series_count_as_independent():
    assert correlation_time([np.ones(10), np.arange(5.0)]) == 1.0
    assert correlation_time([np.zeros(100)]) == 1.0


def test_what_only_acts_as_a_product_is_not_identifiable_and_has_no_number():
    measured = 6.0 * TIME
    found = least_squares(
        lambda v: [Residual("x", "1", measured - v["m"] * v["k"] * TIME + 0 * v["c"], 0.01)],
        [unknown("m", 1.0, None), unknown("k", 2.0, None), unknown("c", 1.0, None)],
    )
    for name in ("m", "k", "c"):
        assert found[name].verdict == "not identifiable"
        assert found[name].value is None and found[name].standard_error is None and found[name].low is None
    assert "combination of it with k" in found["m"].why and "m" not in found["c"].why.split()
    assert found["c"].why == "the residuals do not depend on it"
    product = next(row for row in found.cancels if "m" in row)
    assert product["m"] == pytest.approx(-product["k"]) and "c" not in product
    assert found.values == {}


def test_what_is_known_otherwise_is_identified_beside_what_cancels():
    measured = 6.0 * TIME + 0.5
    found = least_squares(
        lambda v: [Residual("x", "1", measured - v["m"] * v["k"] * TIME - v["a"], 0.01)],
        [unknown("m", 1.0, None), unknown("k", 2.0, None), unknown("a", 0.0)],
    )
    assert found["a"].verdict == "identified" and found["a"].value == pytest.approx(0.5, abs=1e-6)
    assert np.isnan(found.correlation[0]).all() and found.correlation[2, 2] == 1.0


@pytest.mark.parametrize(
    ("noise", "verdict"), [(1e-3, "identified"), (1.0, "weakly identified"), (30.0, "not identifiable")]
)
def test_the_verdict_follows_the_noise(noise, verdict):
    measured = 2.0 + noise * np.random.default_rng(3).normal(size=len(TIME))
    found = least_squares(lambda v: [Residual("x", "1", measured - v["a"], noise)], [unknown("a", 1.0)])
    assert found["a"].verdict == verdict


def test_what_the_data_want_beyond_its_bounds_has_no_number():
    found = least_squares(
        lambda v: [Residual("x", "1", -3.0 - v["a"] + 0.1 * np.sin(40 * TIME), 0.1)],
        [unknown("a", 1.0, low=0.0)],
    )
    assert found["a"].verdict == "not identifiable"
    assert "at the lower bound, 0 1, or beyond" in found["a"].why


@pytest.mark.parametrize("lacks", [False, True])
def test_a_model_that_lacks_an_effect_cannot_tell(lacks):
    """A line through what bends, and through a line: the residuals decide, not the formal error."""
    rng = np.random.default_rng(3)

    def residuals(v):
        curve = 2 + v["b"] * TIME
        seen = 2 + 3 * TIME + (8 * np.maximum(TIME - 0.5, 0.0) ** 2 if lacks else 0.0)
        return [Residual(f"walk {name}", "m", seen + noise[name] - curve, 0.1) for name in noise]

    noise = {name: 0.1 * rng.normal(size=len(TIME)) for name in ("path_x", "path_y")}
    found = least_squares(residuals, [unknown("b", 0.0)])
    if not lacks:
        assert found["b"].verdict == "identified" and found.misfit == ()
        return
    assert found["b"].verdict == "cannot tell" and found["b"].value is not None
    assert "spread about the best value under a wrong model" in found["b"].why
    assert found.misfit[0] == "the model does not explain the data; these intervals do not hold"
    assert found.misfit[1].startswith("residuals of path: ") and found.misfit[1].endswith("growing with time")
    assert found.misfit[0] in found.text()


def test_one_kind_of_signal_that_is_not_explained_is_enough():
    """Of many samples of one kind, few of another are lost in the mean."""
    noise = np.random.default_rng(0).normal(size=(8, len(TIME)))

    def residuals(v):
        bends = [Residual(f"walk bend_{j}", "rad", v["a"] + each, 1.0) for j, each in enumerate(noise, 1)]
        return [*bends, Residual("walk yaw_rate", "rad/s", np.array([v["a"] + 4.0]), 1.0)]

    found = least_squares(residuals, [unknown("a", 0.0)])
    assert found.residual_scale < 1.2 and found["a"].verdict == "cannot tell"
    assert found.misfit[1].startswith("residuals of yaw_rate: 4")


@pytest.mark.parametrize("bias", [0.0, 0.05, 0.3])
def test_a_reference_widens_intervals_by_the_error_of_the_model(bias):
    """A reference whose slope reads b + bias: the variance grows by bias², the value stays."""
    measured = 2 * TIME + 0.01 * np.random.default_rng(0).normal(size=len(TIME))
    one = [unknown("b", 0.0)]
    residuals = lambda v: [Residual("line", "1", measured - v["b"] * TIME, 0.01)]  # noqa: E731
    alone = least_squares(residuals, one)["b"]
    found = least_squares(residuals, one, refit=lambda v: {"b": v["b"] + bias})["b"]
    assert found.value == alone.value
    assert found.standard_error == pytest.approx(math.hypot(alone.standard_error, bias), rel=1e-6)
    assert found.verdict == ("weakly identified" if bias > 0.1 else "identified")
    assert ("model error" in found.why) == (bias > 0)


@pytest.mark.parametrize("slope", [-0.7, 0.0, 0.5])
def test_the_bias_is_that_at_the_true_value(slope):
    """Five searches approach the bias at the truth, 0.05; after two with slope −0.7 it would be 0.026."""
    true, bias = 2.0, 0.05
    at = lambda b: bias + slope * (b - true)  # noqa: E731
    measured = (true + at(true)) * TIME + 1e-3 * np.random.default_rng(0).normal(size=len(TIME))
    residuals = lambda v: [Residual("line", "1", measured - v["b"] * TIME, 1e-3)]  # noqa: E731
    found = least_squares(residuals, [unknown("b", 0.0)], refit=lambda v: {"b": v["b"] + at(v["b"])})["b"]
    # Each search leaves the share |slope| of the error of the bias.
    assert found.standard_error == pytest.approx(bias, abs=bias * abs(slope) ** 5 + 2e-3)
    assert found.low < true < found.high


def test_two_minima_that_fit_alike_are_told():
    measured = 4.0 + 0.01 * np.random.default_rng(0).normal(size=len(TIME))
    found = least_squares(
        lambda v: [Residual("x", "1", measured - v["a"] ** 2, 0.01)], [unknown("a", 0.3)], starts=6
    )
    assert found["a"].verdict == "weakly identified" and "another start" in found["a"].why
    assert abs(found["a"].value) == pytest.approx(2.0, abs=0.01)


def test_data_for_validation_have_no_say():
    measured = 2.0 + 0 * TIME
    alone = least_squares(lambda v: [Residual("x", "1", measured - v["a"], 1.0)], [unknown("a", 0.0)])
    beside = least_squares(
        lambda v: [
            Residual("x", "1", measured - v["a"], 1.0),
            Residual("y", "1", 9.0 + measured - v["a"], 1.0, "validation"),
        ],
        [unknown("a", 0.0)],
    )
    assert beside.parameters == alone.parameters
    assert beside.rms("validation") == pytest.approx(9.0, abs=1e-6) and alone.rms("validation") is None


def test_what_cannot_be_fitted_is_refused():
    with pytest.raises(InputError, match="60 samples cannot determine 60 parameters"):
        least_squares(lambda v: [Residual("x", "1", TIME, 1.0)], [unknown(f"a{k}", 0.0) for k in range(60)])
    with pytest.raises(InputError, match="not finite where the search starts"):
        least_squares(lambda v: [Residual("x", "1", TIME * np.nan, 1.0)], [unknown("a", 0.0)])
    with pytest.raises(InputError, match="at least one unknown"):
        least_squares(lambda v: [Residual("x", "1", TIME, 1.0)], [])
    with pytest.raises(InputError, match="it must have no numbers"):
        Parameter("a", "1", "not identifiable", 1.0, 1.0, 1.0, 1.0)
    with pytest.raises(InputError, match="it must have all"):
        Parameter("a", "1", "identified", 1.0)


def _wrapped(steepness: float, told: list[float]):
    """Return residuals of a number a = 2 that is told by a line, and sharper by what turns with it."""

    def residuals(values):
        a = values["a"]
        told.append(a)
        turns = np.exp(1j * steepness * (a - 2.0)) - 1.0
        return [
            Residual("even", "1", (2.0 - a) * np.ones(5), 0.1),
            Residual("turning", "1", np.tile([turns.real, turns.imag], 10), 1e-2),
        ]

    return residuals


def test_a_guide_leads_past_minima_that_are_not_the_least():
    start = [unknown("a", 0.0)]
    astray = least_squares(_wrapped(20.0, []), start)
    assert abs(astray["a"].value - 2.0) > 0.2
    led = least_squares(
        _wrapped(20.0, []),
        start,
        options=SearchOptions(coarse_step=1e-3, first_stage=lambda residual: residual.name == "even"),
    )
    assert led["a"].value == pytest.approx(2.0, abs=1e-9)


def test_what_a_guide_says_nothing_of_stays():
    def residuals(values):
        return [
            Residual("led", "1", np.full(5, values["a"] - 1.0), 0.1),
            Residual("rest", "1", np.full(5, values["b"] - 3.0), 0.1),
        ]

    led: list[float] = []

    def watched(values):
        led.append(values["b"])
        return residuals(values)

    found = least_squares(
        watched,
        [unknown("a", 0.0), unknown("b", 0.5)],
        options=SearchOptions(first_stage=lambda residual: residual.name == "led"),
    )
    assert found["b"].value == pytest.approx(3.0) and found["a"].value == pytest.approx(1.0)
    assert np.abs(np.array(led[:8]) - 0.5).max() < 1e-3


def test_a_search_ends_by_its_runs_or_where_nothing_is_left():
    told: list[float] = []
    spent = least_squares(_wrapped(20.0, told), [unknown("a", 0.0)], options=SearchOptions(max_runs=4))
    # Four, one before them to look at the data, and five for what the data tell.
    assert not spent.converged and len(told) <= 1 + 4 + 5
    told.clear()
    enough = least_squares(_wrapped(0.1, told), [unknown("a", 0.0)], options=SearchOptions(target_rms=0.5))
    assert enough.converged
    exact: list[float] = []
    least_squares(_wrapped(0.1, exact), [unknown("a", 0.0)])
    assert len(told) < len(exact)


def test_over_the_width_that_data_leave_open_ripple_is_no_doubt():
    """A line with a ripple far below its noise, but steep: derivatives of small steps are the ripple's."""
    measured = 2.0 * TIME + 0.1 * np.random.default_rng(1).normal(size=len(TIME))

    def residuals(values):
        ripple = 0.02 * np.sin(2e3 * values["a"] + 37.0 * np.arange(len(TIME)))
        return [Residual("line", "1", measured - values["a"] * TIME - ripple, 0.1)]

    near = [unknown("a", 2.0)]
    small = least_squares(residuals, near, options=SearchOptions(step=1e-3))
    assert small["a"].verdict == "not identifiable"
    found = least_squares(residuals, near, options=SearchOptions(step=1e-3, identifiability_step=0.3))
    assert found["a"].verdict == "identified"
    error = 0.1 / np.linalg.norm(TIME)
    assert 0.5 * error < found["a"].standard_error < 2 * error
    assert abs(found["a"].value - 2.0) < 4 * error
