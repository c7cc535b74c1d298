"""Members beside a robot: what a Kalman filter must do, and that members move as the plant does."""

from __future__ import annotations

import numpy as np
import pytest

from srs_twin import AnalyticalSnake, Gait, load_robot
from srs_twin.live.ensemble import Air, Ensemble, Spreads
from srs_twin.live.ensemble_kernels import correct

ALONE = Spreads(
    gain=0.0,
    bias=0.0,
    tau=0.0,
    stiffness=0.0,
    friction=0.0,
    unexplained=0.0,
    pressure=0.0,
    drift=0.0,
    slip=0.0,
    turning=0.0,
)


def test_a_number_corrects_as_the_kalman_filter_does():
    rng = np.random.default_rng(3)
    members = rng.multivariate_normal([0.3, -0.2], [[0.04, 0.03], [0.03, 0.09]], size=20_000)
    covariance, mean = np.cov(members.T), members.mean(axis=0)
    noise, told = 0.02, 0.5
    gain = covariance[:, 0] / (covariance[0, 0] + noise)
    predicted = members[:, :1].copy()
    kept = members.copy()
    off = correct(kept, predicted, np.array([told]), np.array([noise]), np.ones((1, 2)), False)
    assert off[0] == pytest.approx((told - mean[0]) / np.sqrt(covariance[0, 0] + noise))
    assert kept.mean(axis=0) == pytest.approx(mean + gain * (told - mean[0]), abs=1e-4)
    assert np.cov(kept.T) == pytest.approx(covariance - np.outer(gain, covariance[0]), abs=1e-4)


def test_chance_correlations_correct_nothing():
    rng = np.random.default_rng(4)
    moved = []
    for _ in range(200):
        members = rng.normal(size=(32, 2))
        before = members.copy()
        correct(members, before[:, :1].copy(), np.array([1.0]), np.array([0.1]), np.ones((1, 2)), False)
        moved.append(np.abs(members - before).mean(axis=0))
    own, other = np.mean(moved, axis=0)
    assert other < 0.1 * own


def test_far_off_numbers_count_less():
    members = np.random.default_rng(5).normal(size=(200, 1))
    near, far = members.copy(), members.copy()
    for copy, told in ((near, 3.0), (far, 300.0)):
        correct(copy, copy.copy(), np.array([told]), np.array([0.1]), np.ones((1, 1)), False)
    assert far.mean() < 20 * near.mean()


@pytest.mark.parametrize("robot", ["gen2", "gen4"])
def test_members_without_spread_bend_as_the_compliant_model(robot):
    spec = load_robot(robot)
    plant = AnalyticalSnake(
        spec, model="compliant", friction="wheel", load="momentary", inertia="connector", slip_speed=0.001,
        timestep=0.0025,
    )  # fmt: skip
    ensemble, gait = Ensemble(spec, members=2, spreads=ALONE), Gait(1.25)
    gait.reset(spec, 0.02)
    for k in range(100):
        valves = gait.valves_at(0.02 * k)
        state = plant.step(valves)
        opens = ((valves if valves.ndim == 3 else valves[None]) + 1) / 2
        supply = np.full(spec.segments, spec.supply.nominal)
        ensemble.advance(Air(opens, supply, np.zeros((spec.segments, 2))), 0.02)
    assert ensemble.mean("bend") == pytest.approx(state.bend, abs=2e-3)
    assert ensemble.mean("pressure") == pytest.approx(state.pressure.ravel(), rel=1e-6, abs=1.0)


def test_chambers_that_are_pulled_open_suck():
    """A body that swings has been seen to bring a chamber 12 kPa below the surrounding air."""
    spec = load_robot("gen2")
    ensemble = Ensemble(spec, members=32)
    told = np.full((spec.segments, 2), -12e3)
    air = Air(np.zeros((1, spec.segments, 2)), np.full(spec.segments, 48e3), np.zeros((spec.segments, 2)))
    for _ in range(10):
        ensemble.advance(air, 0.02)
        ensemble.read_pressures(told)
    assert ensemble.mean("pressure") == pytest.approx(told.ravel(), abs=1e3)


def test_it_is_laid_where_it_is_seen():
    spec = load_robot("gen4")
    ensemble = Ensemble(spec, members=32)
    poses = ensemble.poses().mean(axis=0)
    turn = 2.5
    c, s = np.cos(turn), np.sin(turn)
    seen = np.column_stack(
        [1 + c * poses[:, 0] - s * poses[:, 1], s * poses[:, 0] + c * poses[:, 1], poses[:, 2] + turn]
    )
    seen[1] = np.nan
    seen[3, 2] -= 2 * np.pi  # headings come in whatever turn
    for _ in range(10):
        ensemble.read_poses(seen)
    found = ensemble.poses().mean(axis=0)
    assert found[[0, 2, 3, 4], :2] == pytest.approx(seen[[0, 2, 3, 4], :2], abs=3e-3)
    assert ensemble.mean("heading") == pytest.approx(turn, abs=0.02)


def test_members_that_all_diverge_begin_anew():
    ensemble = Ensemble(load_robot("gen4"), members=8)
    ensemble.placed = True
    ensemble.members[:, ensemble.rows["motion"]] = np.nan
    n = ensemble.spec.segments
    air = Air(np.zeros((1, n, 2)), np.full(n, 48e3), np.zeros((n, 2)))
    for _ in range(3):
        ensemble.advance(air, 0.02)
    assert np.isfinite(ensemble.members).all()
    assert not ensemble.placed
    ensemble.members[:, ensemble.rows["motion"]] = np.nan
    assert np.isfinite(ensemble.ahead(3)([air], 0.02)).all()


@pytest.mark.parametrize("robot", ["gen2", "gen4"])
def test_bodies_that_are_corrected_roll_the_way_of_least_friction(robot):
    """No place beside the one that they come to has wheels slide less."""
    spec = load_robot(robot)
    ensemble = Ensemble(spec, members=8, spreads=ALONE)
    ensemble.members[:, ensemble.rows["bend"]] = [0.5, 0.1, -0.4, -0.2]
    ensemble.members[:, ensemble.rows["heading"]] = 0.7
    ensemble._unlike[:] = 0.0
    begun, first = ensemble.members.copy(), ensemble.poses()[0]

    def slides():
        x, y = (ensemble.poses()[0] - first)[:, :2].T
        c, s = np.cos(first[:, 2]), np.sin(first[:, 2])
        ahead, aside = c * x + s * y, c * y - s * x
        return float(np.sum(spec.friction.mu_t * ahead**2 + spec.friction.mu_n * aside**2))

    for bent in 1e-3 * np.eye(4):
        ensemble.members[:] = begun
        ensemble._shape, ensemble._bent_for = begun[:, ensemble.rows["bend"]], 0.02
        ensemble.members[:, ensemble.rows["bend"]] += bent
        stays = slides()
        ensemble.roll()
        least = slides()
        assert least < 0.9 * stays
        for column, by in ((0, 1e-6), (1, 1e-6), (2, 1e-5)):
            for side in (-by, by):
                ensemble.members[:, column] += side
                assert slides() > least
                ensemble.members[:, column] -= side


def test_what_a_reading_takes_back_carries_nothing():
    """A model that errs every time and is corrected every time has not gone round a loop."""
    spec = load_robot("gen4")
    ensemble = Ensemble(spec, members=32, spreads=ALONE)
    air = Air(np.ones((1, 4, 2)) * [1.0, 0.0], np.full(4, 48e3), np.zeros((4, 2)))
    bend, begun = ensemble.rows["bend"], ensemble.members.copy()
    for segments in ([0, 1], [2, 3]):
        ensemble.advance(air, 0.02)
        assert np.abs(ensemble.members[:, bend] - begun[:, bend]).max() > 1e-3
        ensemble.members[:, bend][:, segments] = begun[:, bend][:, segments]
    ensemble.members[:, bend] = begun[:, bend]
    ensemble.roll()
    assert ensemble.members[:, :3] == pytest.approx(begun[:, :3], abs=1e-12)


def test_bodies_go_by_what_is_known_of_their_bends_in_the_end():
    """However often it is said meanwhile how they are bent."""
    spec = load_robot("gen4")
    once, twice = (Ensemble(spec, members=32, spreads=ALONE) for _ in range(2))
    air = Air(np.ones((1, 4, 2)) * [1.0, 0.0], np.full(4, 48e3), np.zeros((4, 2)))
    for ensemble in (once, twice):
        ensemble._unlike[:] = 0.0
        ensemble.advance(air, 0.02)
        ensemble.members[:, ensemble.rows["bend"]] += [0.1, 0.0, -0.1, 0.0]
    twice.roll()
    went = twice.twist.copy()
    twice.roll()
    once.roll()
    assert np.abs(went).max() > 0
    assert twice.twist == pytest.approx(went)
    assert once.members[:, :3] == pytest.approx(twice.members[:, :3])
