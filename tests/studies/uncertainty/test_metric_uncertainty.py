"""Intervals of metrics, their errors and limits, for known functions of known distributions."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import truncnorm

from srs_twin.identification.priors import Prior, Priors
from srs_twin.robot.sourced import Uncertain
from srs_twin.scenario.loading import load_scenario
from srs_twin.studies.uncertainty.command import _print_result
from srs_twin.studies.uncertainty.metric_uncertainty import (
    MetricUncertainty,
    predict_twin,
    sampling_errors,
)
from srs_twin.studies.uncertainty.plots import draw_intervals
from srs_twin.studies.uncertainty.propagation import Propagation
from srs_twin.studies.uncertainty.study import UncertaintyStudy

SPEED = "com_speed_m_s"
Model = Callable[[np.ndarray], np.ndarray]


def study_of(
    dimensions: int, samples: int, *, value: float = 0.5, seed: int = 0
) -> UncertaintyStudy:
    """Return a study with uniform parameters from 0 to 1, whose value in the robot file is `value`."""
    uniform = Uncertain.model_validate({"kind": "uniform", "low": 0.0, "high": 1.0})
    item = tuple(
        Prior(f"friction.number_{i}", value, "1", uniform, (0.0, 1.0), "this test")
        for i in range(dimensions)
    )
    scenario = replace(load_scenario("gen2_straight"))
    return UncertaintyStudy(
        scenario,
        Priors(item, np.eye(dimensions)),
        ("analytical",),
        samples=samples,
        seed=seed,
    )


def result_of(study: UncertaintyStudy, model: Model) -> Propagation:
    """Return the result of a study whose speed is a known function, without time step error."""
    own = np.full((3, len(study.names)), 0.5)
    own[1:] = study.priors.parameters[0].value
    return Propagation(
        study, {"analytical": {SPEED: model(np.concatenate([study.fractions, own]))}}
    )


def spread_of(study: UncertaintyStudy, model: Model) -> MetricUncertainty:
    return result_of(study, model).plants["analytical"][SPEED]


def weighted(weights: np.ndarray) -> Model:
    """Return a weighted sum; its total indices are proportional to the squared weights."""
    return lambda fractions: fractions @ weights


@pytest.mark.parametrize("name", ["interval_50", "interval_95"])
def test_intervals_have_equal_tail_probabilities(name):
    spread = spread_of(study_of(1, 1024), lambda u: np.exp(3 * u[:, 0]))
    below, above = (
        np.log(spread.interval(name)) / 3
    )  # shares, by the inverse of the law
    outside = (1 - float(name[-2:]) / 100) / 2
    assert (below, 1 - above) == pytest.approx((outside, outside), abs=2 / 1024)


@pytest.mark.parametrize("power", [1, 2, -1])
def test_errors_of_both_ends_agree_with_order_statistics(power):
    """The standard error is √(p (1 − p) / n) divided by the density, which is known for u^k.

    The bootstrap's own relative error is m^(−1/4) with the m = 102 samples beyond an
    end (Hall and Martin 1988): 31 %, or 11 % in the mean of eight. Three such
    deviations are allowed.
    """
    rng = np.random.default_rng(0)
    ends = np.array([0.25, 0.75, 0.025, 0.975])
    result = [sampling_errors((0.1 + rng.random(4096)) ** power) for _ in range(8)]
    slope = np.abs(power * (0.1 + (ends if power > 0 else 1 - ends)) ** (power - 1.0))
    expected = np.sqrt(ends * (1 - ends) / 4096) * slope
    assert np.mean(result, axis=0) == pytest.approx(expected, rel=0.33)


def test_the_time_step_error_is_the_distance_to_the_limit():
    """Euler's method is applied to y' = −y up to t = 1."""
    coarse = (1 - 1 / 200) ** 200
    fine = (1 - 1 / 400) ** 400
    spread = replace(
        spread_of(study_of(1, 16), weighted(np.ones(1))),
        value=coarse,
        half_timestep=fine,
    )
    assert spread.numerical_error == pytest.approx(abs(coarse - np.exp(-1)), rel=0.01)


def test_both_error_components_are_stated_at_both_ends():
    spread = spread_of(study_of(1, 2048), weighted(np.ones(1)))
    spread = replace(spread, surrogate=np.full(4, 0.01))
    ends = np.array([0.25, 0.75, 0.025, 0.975])
    expected = np.hypot(
        np.sqrt(ends * (1 - ends) / 2048), 0.01
    )  # of a uniform distribution
    document = spread.document(("friction.number_0",))
    assert document["interval_50_error"] == pytest.approx(
        expected[:2].tolist(), rel=0.15
    )
    assert document["interval_95_error"] == pytest.approx(
        expected[2:].tolist(), rel=0.15
    )


def test_an_exact_surrogate_adds_no_error():
    fractions = study_of(2, 64).fractions
    noise = np.random.default_rng(0).normal(size=64)
    samples, surrogate = predict_twin(fractions, fractions[:, 0], noise[:32])
    assert np.isfinite(samples).sum() == 32
    assert not surrogate.any()


def test_the_surrogate_error_of_a_mean_shift_is_that_of_a_mean(monkeypatch):
    """The jackknife is exact here: s/√n at every end, because quantiles move with a shift."""

    def shifted(
        _: np.ndarray, cheap: np.ndarray, costly: np.ndarray, *chosen: None
    ) -> tuple[np.ndarray, None]:
        return cheap + np.mean(costly - cheap[: len(costly)]), None

    monkeypatch.setattr(
        "srs_twin.studies.uncertainty.metric_uncertainty.predict_high_fidelity", shifted
    )
    rng = np.random.default_rng(4)
    cheap = rng.normal(size=64)
    difference = rng.normal(size=8)
    _, surrogate = predict_twin(rng.random((64, 2)), cheap, cheap[:8] + difference)
    assert surrogate == pytest.approx(
        np.full(4, np.std(difference, ddof=1) / np.sqrt(8)), rel=1e-9
    )


WEIGHTS = 0.7 ** np.arange(4)


def test_few_samples_give_a_warning_with_the_reason_of_each_limit():
    skewed = result_of(study_of(4, 16), lambda u: np.exp(u @ WEIGHTS))
    text = " ".join(skewed.warnings)
    assert (
        "16 samples do not bound the 95 % interval. With a probability of 67 %" in text
    )
    assert "above 5 %, the width is uncertain by more than 14 %" in text
    assert (
        "above ±10 %, causes that differ by less than 14 % cannot be distinguished"
        in text
    )


def test_stated_ranges_of_ranks_contain_the_true_rank():
    """The range narrows with the number of samples."""
    wide = []
    for samples in (16, 256):
        held = []
        widths = []
        for seed in range(8):
            noise = np.random.default_rng(seed).normal(scale=0.1, size=samples + 3)
            spread = spread_of(
                study_of(4, samples, seed=seed),
                lambda u, noise=noise: u @ WEIGHTS + noise,
            )
            ranks = spread.indices.ranks()
            held += [
                best <= place <= worst
                for place, (best, worst) in enumerate(ranks, start=1)
            ]
            widths += [worst - best for best, worst in ranks]
        assert np.mean(held) > 0.95
        wide.append(np.mean(widths))
    assert wide[0] > 1 > wide[1]


def test_equal_parameters_have_tied_ranks():
    ranks = spread_of(
        study_of(4, 512), weighted(np.array([3.0, 1.0, 1.0, 1.0]))
    ).indices.ranks()
    assert ranks == [(1, 1), (2, 4), (2, 4), (2, 4)]


def test_sensitivities_and_measurements_of_a_linear_model(
    tmp_path, monkeypatch, capsys
):
    """A measurement with an error of ±10 % narrows the range of 3 u₁ + u₂."""
    result = result_of(study_of(2, 256), weighted(np.array([3.0, 1.0])))
    document = result.document()["plants"]["analytical"][SPEED]
    assert document["u_input"] == pytest.approx(np.sqrt(10 / 12), rel=0.01)
    for number, index in enumerate((0.9, 0.1)):
        row = document["sensitivity"][f"friction.number_{number}"]
        assert (row["first"], row["total"]) == pytest.approx((index, index))
    swings = [(swing.parameter, swing.low, swing.high) for swing in result.swings()]
    assert swings == [
        ("friction.number_0", pytest.approx(0.575), pytest.approx(3.425)),
        ("friction.number_1", pytest.approx(1.525), pytest.approx(2.475)),
    ]
    rng = np.random.default_rng(0)
    u, v = rng.random((2, 100_000))
    ranges = []
    for value in (0.1, 0.3, 0.5, 0.7, 0.9):
        sd = 0.1 / 1.96 * value
        ends = (-value / sd, (1 - value) / sd)
        measured = truncnorm.ppf(u, *ends, loc=value, scale=sd)
        ranges.append(np.quantile(3 * measured + v, [0.025, 0.975]))
    best = result.measure_next()[0]
    assert best.parameter == "friction.number_0"
    assert best.width == pytest.approx(np.mean(np.ptp(ranges, axis=1)), rel=0.02)
    assert best.interval_95 == pytest.approx(ranges[2], rel=0.01)
    now = np.quantile(3 * u + v, [0.025, 0.975])
    assert best.width_now == pytest.approx(np.ptp(now), rel=0.02)
    _print_result(result)
    assert (
        "measuring friction.number_0 to ±10 % would narrow the analytical's CoM speed"
        f" (m/s) from {best.width_now:.3g} to {best.width:.3g}\n"
    ) in capsys.readouterr().out
    monkeypatch.chdir(tmp_path)
    kept = json.loads(result.keep().read_text("utf-8"))
    (folder,) = (tmp_path / "calibration/intervals").iterdir()
    assert folder.name == "gen2_straight.json"
    assert kept["measure_next"][0]["width"] == float(f"{best.width:.6g}")


def test_the_value_at_the_medians_separates_the_parameters_from_nonlinearity():
    linear = spread_of(study_of(2, 256, value=0.0), weighted(np.array([3.0, 1.0])))
    assert linear.value == 0.0
    assert linear.at_medians == pytest.approx(2.0)
    assert linear.median == pytest.approx(linear.at_medians, abs=0.02)


@pytest.mark.parametrize("samples", [16, 512])
def test_the_plot_states_the_samples_and_hatches_unresolved_ranks(samples):
    result = result_of(study_of(3, samples), weighted(np.array([4.0, 2.0, 1.9])))
    document = result.document()
    figure = draw_intervals("Title", document)
    (label,) = figure.axes[0].get_yticklabels()
    assert label.get_text() == f"analytical\n{samples} samples"
    hatched = [bar.get_hatch() is not None for bar in figure.axes[1].patches][::-1]
    sensitivity = document["plants"]["analytical"][SPEED]["sensitivity"]
    ranks = [sensitivity[item["parameter"]]["rank"] for item in document["swings"]]
    assert hatched == [best < worst for best, worst in ranks]
    from_top = sorted(figure.texts, key=lambda text: -text.get_position()[1])
    shown = " ".join(text.get_text() for text in from_top)
    assert ("Warning: analytical, CoM speed (m/s): 16 samples" in shown) == (
        samples == 16
    )
    assert "Title" in shown
    # Text in a panel could cover its data; the figure is narrow enough for a telephone.
    assert not any(axes.texts or axes.get_legend() for axes in figure.axes)
    assert figure.get_figwidth() < 5
    drawn = [line.get_xdata() for line in figure.axes[0].lines]
    assert any(
        list(item) == document["plants"]["analytical"][SPEED]["interval_95"]
        for item in drawn
    )
