"""A robot and its shadow in simulated time: what is estimated, predicted, named, kept over a restart;
steering."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from live_runs import BREAKS_S, Run, followed_estimate, isolated, parts, shadowed, steered

from srs_twin import InputError, load_robot, load_scenario
from srs_twin.io.saved_state import SavedState
from srs_twin.live.helm import LEAST_MARGIN, Helm, differences
from srs_twin.live.messages import BENDS, Message
from srs_twin.live.shadow import Shadow, frames_of


def off_by(found):
    """Return what estimates from 5 s on are off by, and their standard deviations: bends, place, heading."""
    truth, estimate = found["truth"], found["estimate"]
    n = truth.shape[1] - 4
    true = np.stack([np.interp(estimate[:, 0], truth[:, 0], truth[:, k]) for k in range(1, n + 4)], axis=1)
    late = estimate[:, 0] > 5
    return (estimate[:, 1 : n + 4] - true)[late], estimate[late, n + 4 :], n


@pytest.mark.slow
def test_bends_and_pose_are_known_and_their_intervals_hold():
    found = followed_estimate(Run(1, 12.0), members=24)
    off, sd, n = off_by(found)
    assert np.sqrt(np.mean(off[:, :n] ** 2)) < 0.03
    assert np.sqrt(np.mean((off[:, n : n + 2] ** 2).sum(axis=1))) < 0.005
    for some in (slice(0, n), slice(n, n + 3)):
        assert 0.9 < np.mean(np.abs(off[:, some]) < 1.96 * sd[:, some]) < 0.99
    assert np.sqrt(np.mean((found["known_gain"][0] / found["gain"] - 1) ** 2)) < 0.05


@pytest.mark.slow
def test_cameras_may_be_worse_than_expected(monkeypatch):
    """Places off by 2 mm and headings by 0.1 rad, which nobody said."""
    monkeypatch.setattr("srs_twin.live.emulator._CAMERA_NOISE_M", 0.002)
    off, sd, n = off_by(followed_estimate(Run(1, 9.0), members=24))
    assert np.sqrt(np.mean(off[:, :n] ** 2)) < 0.03
    assert 0.9 < np.mean(np.abs(off) < 1.96 * sd)


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["stuck_valve:{j}{side}=open", "dead_sensor:{j}=silent", "lost_marker:{j}"])
def test_a_fault_is_named(kind):
    done = isolated((kind, 3, True))
    assert done["among"], done
    assert done["at"] > BREAKS_S
    assert not done["others"], done


@pytest.mark.parametrize(
    "run",
    [
        pytest.param(Run(7, 10.0), marks=pytest.mark.slow, id="gen4"),
        pytest.param(Run(1, 6.0, robot="gen2", frequency=2.0), id="gen2"),
    ],
)
def test_a_healthy_robot_is_accused_of_nothing(run):
    for moment in shadowed(run, members=8):
        assert moment.estimate is None or moment.estimate.faults == ()


def test_silence_is_said_and_survived():
    run = Run(2, 4.0)
    for moment in shadowed(run, members=8):
        shadow = moment.shadow
    found = shadow.take(moment.time + 3.0, [])
    assert found.lost == "the robot says nothing"
    n = run.emulated().segments
    back = [Message(BENDS, run.robot, 40 + moment.time + 5.0, moment.time + 5.001, np.zeros(n))]
    assert np.isfinite(shadow.take(moment.time + 5.1, back).bend).all()


@pytest.mark.slow
def test_what_was_learnt_survives_a_restart(tmp_path):
    kind = "stuck_valve:{j}{side}=closed"
    fault, part, _ = parts(kind, 4)
    for moment in shadowed(Run(4, 8.0, fault=f"{fault}@{BREAKS_S}"), members=8):
        shadow = moment.shadow
    shadow.save().write(tmp_path / "state.npz")
    new = Shadow(load_robot("gen4"), members=8)
    new.restore(SavedState.read(tmp_path / "state.npz"))
    assert new.bank.named == shadow.bank.named
    assert part == f"segment {next(iter(new.bank.named))}"
    weights = (each.ensemble.connection.weights for each in (new, shadow))
    assert np.array_equal(*weights) and shadow.ensemble.connection.weights.any()
    assert new.ensemble.parameters()["gain"][0] == pytest.approx(shadow.ensemble.parameters()["gain"][0])
    with pytest.raises(InputError, match="the saved state has other settings"):
        Shadow(load_robot("gen2"), members=8).restore(SavedState.read(tmp_path / "state.npz"))


def test_bodies_have_names():
    assert frames_of(["head=1", "Rigid Body 3=5"], 5) == {"head": 1, "Rigid Body 3": 5}
    for wrong in ("head", "head=0", "head=6", "=1"):
        with pytest.raises(InputError, match="names no body"):
            frames_of([wrong], 5)


def test_helms_refuse_what_cannot_be_steered():
    shadow = Shadow(load_robot("gen2"), members=8)
    with pytest.raises(InputError, match="it follows no plan"):
        Helm(load_scenario("gen2_straight"), shadow, 0.02)
    text = r"follow_gen4_a is for robot 'gen4', not for 'gen2'; they differ in geometry.segment_length "
    with pytest.raises(InputError, match=text + r"\(0.075 and 0.037\), .* and \d more"):
        Helm(load_scenario("follow_gen4_a"), shadow, 0.02)


def test_a_plan_without_margin_is_refused_unless_pressing_on():
    shadow = Shadow(load_robot("gen2"), members=8)
    for press_on, least in ((False, LEAST_MARGIN), (True, 0.0)):
        assert (
            Helm(load_scenario("follow_orifice"), shadow, 0.02, press_on=press_on).follower.least_margin
            == least
        )
    assert LEAST_MARGIN > 0


def test_robots_of_equal_parts_are_equal_whatever_their_names_and_modules():
    gen2, gen4 = load_robot("gen2"), load_robot("gen4")
    assert differences(replace(gen2, name="mine", title="My robot"), gen2) == []
    assert differences(load_scenario("follow_orifice").robot, gen2) == []
    assert differences(load_scenario("follow_gen4_a").robot, gen4) == []
    slower = replace(gen2, actuator=replace(gen2.actuator, tau_fill=2 * gen2.actuator.tau_fill))
    assert [each.partition(" ")[0] for each in differences(gen2, slower)] == ["actuator.tau_fill"]


@pytest.mark.slow
@pytest.mark.parametrize("fault", ["", "dead_sensor:2=silent@8", "lost_marker:3@8", "leak:2+=slow@8"])
def test_a_robot_is_steered_to_the_goal(fault):
    run = Run(3, 60.0, robot="gen2", frequency=2.0, fault=fault)
    done = steered((run, "follow_orifice"))
    assert done["ending"] == "goal_reached", done
    assert done["clearance_m"] > 0


def test_a_robot_that_is_lost_is_vented():
    run = Run(5, 9.0, robot="gen2", frequency=2.0, cameras_s=4.0, loss=0.0)
    done = steered((run, "follow_orifice"))
    assert done["ending"] in ("stopped", "estimate_lost")
    assert done["clearance_m"] > 0


@pytest.mark.slow
def test_a_robot_without_air_is_not_steered_for_long():
    run = Run(121, 20.0, fault="starved=empty@2", robot="gen2", frequency=2.0)
    told = steered((run, "follow_orifice"))
    assert told["ending"] == "supply_empty"
    assert told["time_s"] < 8.0
    assert told["clearance_m"] > 0
