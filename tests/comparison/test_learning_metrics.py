"""Metrics of iterative learning for prescribed runs, and for simulated runs and their mirror images."""

from __future__ import annotations

import json
import math

import numpy as np
import pytest
from synthetic import (
    Snake,
    arc,
    mirrored,
    moved,
    numbered,
    with_columns,
    with_metadata,
)

from srs_twin import AnalyticalSnake, InputError, Trajectory, load_robot, rollout
from srs_twin.comparison.learning import (
    LEARNING_LIST_UNITS,
    LEARNING_UNITS,
    PeriodAmplitudes,
    learning_metrics,
)
from srs_twin.comparison.metrics import headline, plant_metrics
from srs_twin.control.learning import ILC
from srs_twin.studies.sweep.task import flat_metrics
from srs_twin.viewing.plots.runs import learning_plot

pytestmark = pytest.mark.fast

FREQUENCY = 2.0
SEGMENTS = 4
BEGINS = np.array([[0.0, 0.25], [0.125, -0.125], [0.25, 0.0], [-0.125, 0.125]])


def learnt(
    snake: Snake,
    amplitude: np.ndarray,
    *,
    target: tuple[float, float] = (0.7, 0.4),
    width: float | None = None,
) -> Trajectory:
    """Return a prescribed run whose sensors peaked at these amplitudes, shape (periods, segments, 2), rad.

    The bends themselves know nothing of it, so that amplitudes must come from the
    sensors.
    """
    run = snake.trajectory()
    measured_bend = np.zeros((len(run), SEGMENTS))
    duty = np.ones((len(run), SEGMENTS, 2))
    for n, periods in enumerate(amplitude):
        for j, sides in enumerate(periods):
            for side, peak in enumerate(sides):
                begin = BEGINS[j, side] + n / FREQUENCY
                own = (run.time > begin - 1e-6) & (run.time <= begin + 0.5 + 1e-6)
                middle = np.abs(run.time - begin - 0.25) < 0.02
                measured_bend[middle, j] = peak if side == 0 else -peak
                # A sample is taken at the end of its tick, so the samples of a period
                # begin after its start.
                duty[own, j, side] = 1.0 if n < 3 else 0.5 + 0.01 * n + 0.02 * j
    columns = {
        **numbered("measured_bend", measured_bend),
        **numbered("duty_plus", duty[..., 0]),
        **numbered("duty_minus", duty[..., 1]),
        **numbered("target_plus", np.full(measured_bend.shape, target[0])),
        **numbered("target_minus", np.full(measured_bend.shape, target[1])),
    }
    about = {"control": {"fill_begins_s": BEGINS.tolist()}, "body_width_m": width}
    return with_metadata(with_columns(run, **columns), **about)


def amplitudes(errors: list[float]) -> np.ndarray:
    """Return amplitudes by period whose errors, shared by all chambers, are these shares of the targets."""
    return np.array([[[0.7 * (1 + e), 0.4 * (1 + e)]] * SEGMENTS for e in errors])


FADING = [1.0, 1.0, 1.0, 0.5, 0.2, 0.1, 0.04, 0.02, 0.01, 0.0, 0.0]
RUN = Snake(speed=0.12, yaw_rate=0.3)


def test_amplitudes_and_duties_by_period():
    found = learning_metrics(learnt(RUN, amplitudes(FADING)))
    error = np.array(found["amplitude_error_rad"], dtype=float)
    assert error.shape == (11, SEGMENTS, 2)
    assert error == pytest.approx(np.array([0.7, 0.4]) - amplitudes(FADING))
    duty = np.array(found["duty"])
    assert duty[:, 2, 1] == pytest.approx(
        [1] * 3 + [0.54 + 0.01 * n for n in range(3, 11)]
    )
    assert found["duty_lowest"] == pytest.approx(0.6)
    assert found["duty_highest"] == pytest.approx(0.66)


def test_amplitudes_targets_and_duties_are_plotted_by_period():
    panels = learning_plot({"twin": learnt(RUN, amplitudes(FADING))}).axes
    bends, duties = panels[4:6]
    plus, target, minus, _ = (line.get_ydata() for line in bends.lines)
    assert plus == pytest.approx(0.7 * (1 + np.array(FADING)))
    assert minus == pytest.approx(0.4 * (1 + np.array(FADING)))
    assert target == pytest.approx(np.full(11, 0.7))
    for line in duties.lines:
        assert line.get_xdata().tolist() == list(range(1, 12))
        assert line.get_ydata()[-1] == pytest.approx(0.64)


@pytest.mark.parametrize(
    ("errors", "period"),
    [
        (FADING, 7.0),
        ([0.01] * 11, 1.0),
        ([0.0] * 10 + [0.06], None),
        ([0.06, 0.0, 0.06, 0.0] * 2 + [0] * 3, 8.0),
    ],
)
def test_convergence_requires_staying_within_the_tolerance(errors, period):
    found = learning_metrics(learnt(RUN, amplitudes(errors)))
    assert found["periods_to_converge"] == period
    assert found["amplitude_error_end_rad"] == pytest.approx(0.7 * errors[-1])
    assert found["amplitude_error_end_rel"] == pytest.approx(errors[-1])


def test_every_chamber_with_a_target_must_converge():
    missed = amplitudes(FADING)
    missed[:, 1, 0] = 2.0
    run = learnt(RUN, missed)
    found = learning_metrics(run)
    assert found["periods_to_converge"] is None
    assert found["amplitude_error_end_rad"] == pytest.approx(1.3)
    left_out = {
        name: np.full(len(run), math.nan)
        for name in ("target_plus_2", "target_minus_2")
    }
    found = learning_metrics(with_columns(run, **left_out))
    assert found["periods_to_converge"] == 7.0 and found["amplitude_error_rad"][5][
        1
    ] == [None, None]


def test_lost_readings_are_ignored():
    run = learnt(RUN, amplitudes(FADING))
    gone = with_columns(
        run, measured_bend_3=np.where(run.time > 3.0, math.nan, run["measured_bend_3"])
    )
    found = learning_metrics(gone)
    assert (
        found["periods_to_converge"] is None
        and found["amplitude_error_end_rad"] is None
    )
    json.dumps(found, allow_nan=False)


@pytest.mark.parametrize(("speed", "yaw_rate"), [(0.12, -0.3), (-0.1, 0.2), (0.1, 0.0)])
def test_path_metrics_recover_the_prescribed_circle(speed, yaw_rate):
    found = learning_metrics(
        learnt(Snake(speed=speed, yaw_rate=yaw_rate), amplitudes(FADING))
    )
    assert found["path_curvature_per_m"] == pytest.approx(
        yaw_rate / speed, abs=2e-3 * abs(yaw_rate / speed) + 1e-6
    )
    assert found["path_curvature_before_per_m"] == pytest.approx(
        found["path_curvature_per_m"], rel=1e-3, abs=1e-6
    )
    assert found["path_bend_per_m"] == abs(found["path_curvature_per_m"])
    turn = yaw_rate / FREQUENCY
    chord_per_arc = np.sinc(turn / (2 * math.pi))
    assert found["path_speed_m_s"] == pytest.approx(speed * chord_per_arc, rel=2e-3)
    assert found["heading_drift_rad"] == pytest.approx(turn, abs=1e-6)
    assert found["heading_drift_by_period_rad"] == pytest.approx([turn] * 12, abs=1e-6)
    if yaw_rate:
        assert found["path_radius_m"] == pytest.approx(speed / yaw_rate, rel=2e-3)
        assert found["path_radius_spread_rel"] == pytest.approx(0.0, abs=1e-3)
        assert found["path_bend_left_rel"] == pytest.approx(1.0, rel=1e-3)
    else:
        for name in ("path_radius_m", "path_radius_spread_rel", "path_bend_left_rel"):
            assert found[name] is None


@pytest.mark.parametrize(
    ("yaw_rate", "width"), [(0.4, 0.05), (-0.4, None), (0.0, 0.05)]
)
def test_box_edges_of_a_body_on_a_circle(yaw_rate, width):
    """A body that follows its path exactly covers only its width."""
    speed = 0.12
    snake = Snake(speed=speed, yaw_rate=yaw_rate, sway=(0.0, 0.0), heading_sway=0.0)
    run = learnt(snake, amplitudes(FADING), width=width)
    passes = run.time[:, None] + np.linspace(0.11, -0.11, 5) / speed
    angle = yaw_rate * passes
    position = arc(speed, yaw_rate, passes)
    # One connector is to the left of the path and determines the left edge.
    lateral = np.stack([-np.sin(angle[:, 2]), np.cos(angle[:, 2])], axis=-1)
    position[:, 2] += 0.03 * lateral
    run = with_columns(
        run,
        **numbered("x", position[..., 0]),
        **numbered("y", position[..., 1]),
        **numbered("connector_heading", angle),
    )
    half = (width or 0.0) / 2
    for seen in (run, moved(run, 2.0, -1.0, 2.5)):
        found = learning_metrics(seen)
        assert found["extent_left_m"] == pytest.approx(0.03 + half, abs=1e-6)
        assert found["extent_right_m"] == pytest.approx(half, abs=1e-6)


@pytest.fixture(scope="module")
def real() -> Trajectory:
    snake = AnalyticalSnake(
        load_robot("gen4"), supply_pa=131_000, tick=0.01, model="compliant"
    )
    return rollout(snake, ILC(1.0, 0.3, target=0.7), 14.0)


@pytest.mark.slow
def test_mirroring_swaps_the_sides(real):
    columns = dict(real.columns)
    for name in ("duty", "target"):
        for j in range(1, 5):
            columns[f"{name}_plus_{j}"] = real[f"{name}_minus_{j}"]
            columns[f"{name}_minus_{j}"] = real[f"{name}_plus_{j}"]
        columns |= numbered("measured_bend", -real.stack("measured_bend"))
    begins = np.array(real.metadata["control"]["fill_begins_s"])[:, ::-1]
    about = {"control": {"fill_begins_s": begins.tolist()}}
    ours = learning_metrics(real)
    theirs = learning_metrics(
        with_metadata(mirrored(with_columns(real, **columns)), **about)
    )
    for name in (
        "path_speed_m_s",
        "periods_to_converge",
        "amplitude_error_end_rad",
        "duty_lowest",
        "path_radius_spread_rel",
    ):
        assert theirs[name] == pytest.approx(ours[name], abs=1e-9), name
    for name in (
        "path_curvature_per_m",
        "path_curvature_before_per_m",
        "path_radius_m",
        "heading_drift_rad",
    ):
        assert theirs[name] == pytest.approx(-ours[name], rel=1e-6), name
    assert theirs["extent_left_m"] == pytest.approx(ours["extent_right_m"], abs=1e-9)


@pytest.mark.slow
def test_a_real_run_has_all_metrics(real):
    found = plant_metrics(real)
    # Equal modules have a straight path before learning, so no ratio of curvatures is
    # defined.
    assert {name for name in LEARNING_UNITS if found[name] is None} <= {
        "path_bend_left_rel"
    }
    assert found["periods_to_converge"] <= 12
    assert found["path_radius_m"] == pytest.approx(
        1 / found["path_curvature_per_m"], rel=1e-6
    )
    assert min(found["extent_left_m"], found["extent_right_m"]) > 0
    controller = PeriodAmplitudes.from_trajectory(real)
    assert controller.amplitude[-1, :, 0] == pytest.approx(
        real.stack("amplitude_plus")[-1], abs=0.02
    )


def test_an_open_loop_gait_has_no_learning_metrics():
    found = plant_metrics(RUN.trajectory())
    assert all(found[name] is None for name in (*LEARNING_UNITS, *LEARNING_LIST_UNITS))


def test_a_short_run_has_no_path_metrics():
    found = learning_metrics(learnt(Snake(duration=1.0), amplitudes([0.0])))
    assert (
        found["path_radius_m"] is None and found["path_curvature_before_per_m"] is None
    )


@pytest.mark.parametrize("begins", [None, [[0.0, 0.25]], [[math.nan, 0.0]] * 4])
def test_runs_without_fill_starts_are_refused(begins):
    run = with_metadata(
        learnt(RUN, amplitudes(FADING)), control={"fill_begins_s": begins}
    )
    with pytest.raises(
        InputError, match="add `gait_frequency_hz` and `control.fill_begins_s`"
    ):
        learning_metrics(run)


def test_a_sweep_has_a_column_for_every_number(real):
    flat = flat_metrics("twin", plant_metrics(real))
    found = learning_metrics(real)
    assert flat["twin.duty_minus_3_period_7"] == found["duty"][6][2][1]
    assert (
        flat["twin.heading_drift_by_period_rad_2"]
        == found["heading_drift_by_period_rad"][1]
    )
    assert (
        flat["twin.amplitude_error_rad_plus_1_period_2"]
        == found["amplitude_error_rad"][1][0][0]
    )
    assert flat["twin.valve_switches_plus_4"] == real.metadata["valve_switches"][3][0]
    assert all(value is None or isinstance(value, float) for value in flat.values())


def test_growth_uses_the_periods_before_the_first_update():
    rising = amplitudes([0.0, 0.2, 0.5, 0.1, 0.0, 0.0])
    assert learning_metrics(learnt(RUN, rising))[
        "amplitude_growth_rel"
    ] == pytest.approx(1.5, rel=1e-6)


def test_headline_says_what_learning_left_of_the_curvature():
    learnt_run = {
        "com_speed_m_s": 0.1,
        "periods_to_converge": 9.0,
        "path_curvature_before_per_m": -0.288,
        "path_curvature_per_m": 0.356,
    }
    said = headline({"plants": {"twin": learnt_run}})
    assert (
        "does not control the path, whose curvature changed from -0.29 to 0.36 1/m"
        in said
    )
    for missing in ("periods_to_converge", "path_curvature_per_m"):
        assert "Learning" not in headline(
            {"plants": {"twin": learnt_run | {missing: None}}}
        )
