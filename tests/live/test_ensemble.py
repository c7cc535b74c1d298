"""Properties of the Kalman filter, and agreement of the members with the plant."""

from __future__ import annotations

import numpy as np
import pytest

from srs_twin import AnalyticalSnake, Gait, load_robot
from srs_twin.live.ensemble import EnsembleFilter, ModelError, measurement_update
from srs_twin.live.member_dynamics import ValveInput

EXACT = ModelError(disturbance=0.0, pressure=0.0, position=0.0)


def air(plus: float, segments: int = 4) -> ValveInput:
    """Return an input whose + chambers fill for a share of the time; the − chambers vent."""
    duties = np.zeros((1, segments, 2))
    duties[..., 0] = plus
    return ValveInput(duties, np.full(segments, 48e3), np.zeros((segments, 2)))


def corrected(
    members: np.ndarray, measured: float, variance: float
) -> tuple[np.ndarray, float]:
    """Return members that a measurement of the first variable has corrected, and its residual."""
    result = members.copy()
    off = measurement_update(
        result,
        members[:, :1].copy(),
        np.array([measured]),
        np.array([variance]),
        np.ones((1, members.shape[1])),
        False,
    )
    return result, off[0]


def test_one_measurement_corrects_as_in_a_kalman_filter():
    rng = np.random.default_rng(3)
    members = rng.multivariate_normal(
        [0.3, -0.2], [[0.04, 0.03], [0.03, 0.09]], size=20_000
    )
    covariance = np.cov(members.T)
    mean = members.mean(axis=0)
    noise = 0.02
    measured = 0.5
    gain = covariance[:, 0] / (covariance[0, 0] + noise)
    kept, residual = corrected(members, measured, noise)
    assert residual == pytest.approx(
        (measured - mean[0]) / np.sqrt(covariance[0, 0] + noise)
    )
    assert kept.mean(axis=0) == pytest.approx(
        mean + gain * (measured - mean[0]), abs=1e-4
    )
    assert np.cov(kept.T) == pytest.approx(
        covariance - np.outer(gain, covariance[0]), abs=1e-4
    )


def test_chance_correlations_correct_little():
    rng = np.random.default_rng(4)
    moved = []
    for _ in range(200):
        members = rng.normal(size=(32, 2))
        after, _ = corrected(members, 1.0, 0.1)
        moved.append(np.abs(after - members).mean(axis=0))
    own, other = np.mean(moved, axis=0)
    assert other < 0.1 * own


def test_outliers_count_less():
    members = np.random.default_rng(5).normal(size=(200, 1))
    near, far = (corrected(members, measured, 0.1)[0] for measured in (3.0, 300.0))
    assert far.mean() < 20 * near.mean()


@pytest.mark.parametrize("robot", ["gen2", "gen4"])
def test_members_without_errors_follow_the_compliant_model(robot):
    spec = load_robot(robot)
    plant = AnalyticalSnake(
        spec,
        model="compliant",
        friction="wheel",
        load="instantaneous",
        inertia="connector",
        slip_speed=0.001,
        timestep=0.0025,
    )
    ensemble = EnsembleFilter(spec, members=2, error=EXACT)
    gait = Gait(1.25)
    gait.reset(spec, 0.02)
    for k in range(100):
        valves = gait.valves_at(0.02 * k)
        state = plant.step(valves)
        opens = ((valves if valves.ndim == 3 else valves[None]) + 1) / 2
        supply = np.full(spec.segments, spec.supply.nominal)
        ensemble.predict(ValveInput(opens, supply, np.zeros((spec.segments, 2))), 0.02)
    assert ensemble.mean("bend") == pytest.approx(state.bend, abs=2e-3)
    assert ensemble.mean("pressure") == pytest.approx(
        state.pressure.ravel(), rel=1e-6, abs=1.0
    )


def test_pressures_may_be_below_ambient():
    """A swinging body has enlarged a chamber to 12 kPa below ambient pressure."""
    spec = load_robot("gen2")
    ensemble = EnsembleFilter(spec, members=32)
    measured = np.full((spec.segments, 2), -12e3)
    for _ in range(10):
        ensemble.predict(air(0.0), 0.02)
        ensemble.update_pressures(measured)
    assert ensemble.mean("pressure") == pytest.approx(measured.ravel(), abs=1e3)


def test_first_frame_places_the_members():
    spec = load_robot("gen4")
    ensemble = EnsembleFilter(spec, members=32)
    poses = ensemble.poses().mean(axis=0)
    turn = 2.5
    c = np.cos(turn)
    s = np.sin(turn)
    seen = np.column_stack(
        [
            1 + c * poses[:, 0] - s * poses[:, 1],
            s * poses[:, 0] + c * poses[:, 1],
            poses[:, 2] + turn,
        ]
    )
    seen[1] = np.nan
    seen[3, 2] -= 2 * np.pi  # headings may be any number of turns apart
    for _ in range(10):
        ensemble.update_poses(seen)
    found = ensemble.poses().mean(axis=0)
    assert found[[0, 2, 3, 4], :2] == pytest.approx(seen[[0, 2, 3, 4], :2], abs=3e-3)
    assert ensemble.mean("heading") == pytest.approx(turn, abs=0.02)


@pytest.mark.parametrize("turn", [np.pi, -np.pi, 3 * np.pi])
def test_members_are_placed_on_the_same_turn(turn):
    ensemble = EnsembleFilter(load_robot("gen4"), members=32)
    ensemble.predict(air(0.0), 0.2)
    seen = ensemble.poses().mean(axis=0)
    seen = np.column_stack([-seen[:, :2], seen[:, 2] + turn])
    seen[1:] = (
        np.nan
    )  # the members differ in the heading of the head relative to the mean heading
    ensemble.update_poses(seen)
    assert ensemble.sd("heading") < 0.1
    assert np.cos(ensemble.mean("heading") - turn) == pytest.approx(1.0, abs=0.01)


def test_diverged_members_restart():
    ensemble = EnsembleFilter(load_robot("gen4"), members=8)
    ensemble.placed = True
    ensemble.members[:, ensemble.columns["motion"]] = np.nan
    for _ in range(3):
        ensemble.predict(air(0.0), 0.02)
    assert np.isfinite(ensemble.members).all()
    assert not ensemble.placed
    ensemble.members[:, ensemble.columns["motion"]] = np.nan
    assert np.isfinite(ensemble.copy(3).forecast([air(0.0)], 0.02)).all()


@pytest.mark.parametrize("robot", ["gen2", "gen4"])
def test_motion_by_bends_minimises_friction(robot):
    """Wheels slide more at any other pose near the resulting one."""
    spec = load_robot(robot)
    ensemble = EnsembleFilter(spec, members=8, error=EXACT)
    ensemble.members[:, ensemble.columns["bend"]] = [0.5, 0.1, -0.4, -0.2]
    ensemble.members[:, ensemble.columns["heading"]] = 0.7
    ensemble.odometry._draws[:] = 0.0
    begun = ensemble.members.copy()
    first = ensemble.poses()[0]

    def slides():
        x, y = (ensemble.poses()[0] - first)[:, :2].T
        c = np.cos(first[:, 2])
        s = np.sin(first[:, 2])
        ahead = c * x + s * y
        lateral = c * y - s * x
        return float(
            np.sum(spec.friction.mu_t * ahead**2 + spec.friction.mu_n * lateral**2)
        )

    for bent in 1e-3 * np.eye(4):
        ensemble.members[:] = begun
        ensemble.odometry._bends = begun[:, ensemble.columns["bend"]]
        ensemble.odometry._elapsed = 0.02
        ensemble.members[:, ensemble.columns["bend"]] += bent
        stays = slides()
        ensemble.apply_odometry()
        least = slides()
        assert least < 0.9 * stays
        for column, by in ((0, 1e-6), (1, 1e-6), (2, 1e-5)):
            for side in (-by, by):
                ensemble.members[:, column] += side
                assert slides() > least
                ensemble.members[:, column] -= side


def test_corrected_bends_do_not_move_the_body():
    """A model error and its correction enclose no area of bends."""
    spec = load_robot("gen4")
    ensemble = EnsembleFilter(spec, members=32, error=EXACT)
    bend = ensemble.columns["bend"]
    begun = ensemble.members.copy()
    for segments in ([0, 1], [2, 3]):
        ensemble.predict(air(1.0), 0.02)
        assert np.abs(ensemble.members[:, bend] - begun[:, bend]).max() > 1e-3
        ensemble.members[:, bend][:, segments] = begun[:, bend][:, segments]
    ensemble.members[:, bend] = begun[:, bend]
    ensemble.apply_odometry()
    assert ensemble.members[:, :3] == pytest.approx(begun[:, :3], abs=1e-12)


def test_repeated_odometry_changes_nothing():
    """A second call without a change of the bends has no effect."""
    spec = load_robot("gen4")
    once, twice = (EnsembleFilter(spec, members=32, error=EXACT) for _ in range(2))
    for ensemble in (once, twice):
        ensemble.odometry._draws[:] = 0.0
        ensemble.predict(air(1.0), 0.02)
        ensemble.members[:, ensemble.columns["bend"]] += [0.1, 0.0, -0.1, 0.0]
    twice.apply_odometry()
    went = twice.odometry.twist.copy()
    twice.apply_odometry()
    once.apply_odometry()
    assert np.abs(went).max() > 0
    assert twice.odometry.twist == pytest.approx(went)
    assert once.members[:, :3] == pytest.approx(twice.members[:, :3])
