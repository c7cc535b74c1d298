"""A robot and its shadow in simulated time: what is estimated, predicted, named, kept over a restart;
steering."""

from __future__ import annotations

import copy
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from live_runs import (
    BREAKS_S,
    Run,
    followed_estimate,
    isolated,
    parts,
    recorded,
    shadowed,
    steered,
)
from subsets import first_by_default

from srs_twin import InputError, load_robot, load_scenario
from srs_twin.io.saved_state import SavedState
from srs_twin.live.clocks import ReorderBuffer
from srs_twin.live.fault_hypotheses import HYPOTHESES
from srs_twin.live.member_dynamics import MemberDynamics
from srs_twin.live.messages import BENDS, COMMAND, PRESSURES, Message
from srs_twin.live.shadow import Shadow, frames_of
from srs_twin.live.steering import (
    LEAST_MARGIN,
    PATIENCE_S,
    EstimateSteering,
    differences,
)

SETTLED_S = 5.0


def true_values(result, times):
    """Return true bends, position and heading at the given times, shape (times, segments + 3)."""
    truth = result["truth"]
    return np.stack(
        [np.interp(times, truth[:, 0], column) for column in truth[:, 1:].T], axis=1
    )


def errors(result):
    """Return errors and standard deviations of settled estimates, shape (times, segments + 3)."""
    estimate = result["estimate"]
    estimate = estimate[estimate[:, 0] > SETTLED_S]
    values, sd = np.split(estimate[:, 1:], 2, axis=1)
    return values - true_values(result, estimate[:, 0]), sd, values.shape[1] - 3


def rms(values):
    return float(np.sqrt(np.mean(np.square(values))))


@pytest.mark.nightly
@pytest.mark.parametrize("pneumatics", ["orifice", "lag"])
def test_errors_are_small_and_within_their_intervals(pneumatics):
    result = followed_estimate(Run(1, 12.0, pneumatics=pneumatics), members=24)
    error, sd, n = errors(result)
    filtered = result["filtered"][result["estimate"][:, 0] > SETTLED_S]
    times = filtered[:, 0]
    bends = filtered[:, 1:]
    assert rms(bends - true_values(result, times)[:, :n]) < 0.03
    # The estimate is predicted by 30 to 60 ms from the newest message. The model has
    # first-order chambers: it predicts most of the change of the bends, or all of it if
    # the robot has such chambers, too.
    change = bends - true_values(result, result["estimate"][:, 0])[-len(bends) :, :n]
    assert rms(error[:, :n]) < (rms(change) / 3 if pneumatics == "orifice" else 0.03)
    assert rms(np.hypot(*error[:, n : n + 2].T)) < 0.005
    # Where the prediction adds no error, its intervals are too wide: they include that
    # of the filter twice.
    most = 0.99 if pneumatics == "orifice" else 1.0
    for values in (slice(0, n), slice(n, n + 3)):
        assert 0.9 < np.mean(np.abs(error[:, values]) < 1.96 * sd[:, values]) <= most
    if pneumatics == "orifice":
        assert rms(result["known_gain"][0] / result["gain"] - 1) < 0.05


@pytest.mark.nightly
@pytest.mark.parametrize("rate", [5.0, 200.0])
def test_estimates_are_for_now_and_their_intervals_hold(rate):
    found = followed_estimate(Run(6, 12.0, rate_hz=rate, camera_hz=rate))
    assert found["estimate"][-1, 0] == found["truth"][-1, 0]
    error, sd, _ = errors(found)
    assert 0.9 < np.mean(np.abs(error) < 1.96 * sd) < 0.99


@pytest.mark.slow
def test_unknown_camera_noise_does_not_disturb_bends(monkeypatch):
    """Positions with a noise of 2 mm and headings with 0.1 rad, seven times what the filter assumes."""
    monkeypatch.setattr("srs_twin.live.emulator._CAMERA_NOISE_M", 0.002)
    result = followed_estimate(Run(1, 9.0), members=24)
    error, sd, n = errors(result)
    filtered = result["filtered"][result["filtered"][:, 0] > SETTLED_S]
    assert rms(filtered[:, 1:] - true_values(result, filtered[:, 0])[:, :n]) < 0.03
    assert np.mean(np.abs(error) < 1.96 * sd) > 0.9


def test_receive_detects_the_same_faults_as_update():
    recording = recorded(WALK)
    probability = []
    for method in ("receive", "update"):
        shadow = Shadow(load_robot("gen4"), members=4)
        for time, messages in recording.updates:
            getattr(shadow, method)(time, messages)
        probability.append(shadow.faults.probability)
    np.testing.assert_array_equal(*probability)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("seed", "kind"),
    [
        (3, "stuck_valve:{j}{side}=open"),
        (3, "dead_sensor:{j}=silent"),
        (3, "lost_marker:{j}"),
        (6, "leak:{j}{side}=slow"),
        (6, "leak:{j}{side}=fast"),
        (6006, "low_supply_pressure=half"),
    ],
)
def test_a_fault_is_named_in_time(seed, kind):
    (done,) = isolated((seed, "nominal", (kind,)))
    assert done["in_time"] and done["at"] > BREAKS_S, done
    assert not done["others"], done


@pytest.mark.slow
@pytest.mark.parametrize(
    "run",
    [Run(7, 10.0), Run(1, 6.0, robot="gen2", frequency=2.0)],
    ids=lambda r: r.robot,
)
def test_a_healthy_robot_is_accused_of_nothing_and_seen(run):
    """Generation 2 turns with up to 50 rad/s after a valve has switched."""
    for moment in shadowed(run, members=8):
        assert moment.estimate is None or moment.estimate.faults == ()
        assert moment.time <= 1.0 or not moment.estimate.lost


def test_measurements_beyond_50_hz_are_left_out(monkeypatch):
    shadow = Shadow(load_robot("gen4"), members=8)
    used = []
    monkeypatch.setattr(shadow, "_use", lambda time, messages: used.append(time))
    for k in range(200):
        time = 0.005 * k
        shadow.receive(time, [Message(BENDS, "robot", time, time, np.zeros(4))])
    assert len(used) > 40
    assert np.diff(used) == pytest.approx(0.02)


def test_commands_that_wait_already_bend_the_estimate():
    """Messages wait for others that were sent earlier; the estimate of now does not."""
    spec = load_robot("gen4")
    bends = []
    n = spec.segments
    for fills in (False, True):
        shadow = Shadow(spec, members=8)
        shadow.buffer = ReorderBuffer(hold_s=0.1)
        for k in range(60):
            time = 0.02 * k
            valves = np.full((n, 2), -1.0)
            valves[:, 0] = 1.0 if fills and k >= 55 else -1.0
            values = {BENDS: np.zeros(n), COMMAND: valves}
            found = shadow.update(
                time,
                [
                    Message(kind, kind, time, time, each)
                    for kind, each in values.items()
                ],
            )
        bends.append(found.bend)
    assert (bends[1] > bends[0] + 0.02).all()


WALK = Run(2, 1.5)


@pytest.fixture(scope="module")
def walk():
    """Return the last moment of a walk."""
    *_, moment = shadowed(WALK, members=8)
    return moment


@pytest.fixture
def shadow(walk):
    return copy.deepcopy(walk.shadow)


def test_an_estimate_agrees_with_the_truth(walk):
    """Tolerances are four standard deviations."""
    truth = recorded(WALK).truth
    found = walk.estimate
    assert found.time == truth[-1, 0]
    assert (np.abs(found.bend - truth[-1, 1:5]) < 4 * found.bend_sd).all()
    assert (np.abs(found.pose - truth[-1, 5:]) < 4 * found.pose_sd).all()
    assert found.bend_sd.max() < 0.25 and (found.pose_sd < [0.01, 0.01, 0.05]).all()
    x, y, _ = found.connectors.T
    assert np.mean([x, y], axis=1) == pytest.approx(found.pose[:2], abs=0.001)
    # A chord is a little shorter than the arc of a bent segment.
    pitch = load_robot("gen4").geometry.pitch
    assert np.hypot(np.diff(x), np.diff(y)) == pytest.approx(pitch, rel=0.03)


def test_an_estimate_whose_prediction_diverges_is_lost(walk, shadow, monkeypatch):
    assert not walk.estimate.lost
    monkeypatch.setattr(
        MemberDynamics,
        "bend",
        lambda _, pose, bend, *__: (bend, np.zeros(len(bend), dtype=bool)),
    )
    lost = shadow.update(walk.time + 0.01, []).lost
    assert lost == "motion capture has not seen the robot"


def test_silence_is_said_and_a_robot_that_restarts_has_no_fault(walk, shadow):
    """The robot rests after its restart, although its valves were open before."""
    found = shadow.update(walk.time + 3.0, [])
    assert found.lost == "no message from the robot"
    for k in range(60):
        arrived = walk.time + 5.0 + 0.02 * k
        values = {BENDS: np.zeros(4), PRESSURES: np.zeros((4, 2))}
        rest = [
            Message(kind, "gen4", 40 + arrived, arrived + 0.001, each)
            for kind, each in values.items()
        ]
        found = shadow.update(arrived + 0.002, rest)
    assert np.abs(found.bend).max() < 0.1
    assert found.faults == () and shadow.interruptions == 1
    assert found.lost != "no message from the robot"


@pytest.mark.slow
def test_what_was_learnt_survives_a_restart(tmp_path):
    kind = "stuck_valve:{j}{side}=closed"
    fault, part, _ = parts(kind, 4)
    for moment in shadowed(Run(4, 8.0, fault=f"{fault}@{BREAKS_S}"), members=8):
        shadow = moment.shadow
    shadow.save().write(tmp_path / "state.npz")
    new = Shadow(load_robot("gen4"), members=8)
    new.restore(SavedState.read(tmp_path / "state.npz"))
    assert new.faults.detected_faults == shadow.faults.detected_faults
    assert part == f"segment {next(iter(new.faults.detected_faults))}"
    weights = (each.ensemble.odometry.connection.weights for each in (new, shadow))
    assert (
        np.array_equal(*weights) and shadow.ensemble.odometry.connection.weights.any()
    )
    assert new.faults.parameters()["gain"][0] == pytest.approx(
        shadow.faults.parameters()["gain"][0]
    )
    with pytest.raises(InputError, match="the saved state has other settings"):
        Shadow(load_robot("gen2"), members=8).restore(
            SavedState.read(tmp_path / "state.npz")
        )


def test_bodies_have_names():
    assert frames_of(["head=1", "Rigid Body 3=5"], 5) == {"head": 1, "Rigid Body 3": 5}
    for wrong in ("head", "head=0", "head=6", "=1"):
        with pytest.raises(InputError, match="write BODY=CONNECTOR"):
            frames_of([wrong], 5)


def test_steerings_refuse_the_scenario_of_another_robot():
    shadow = Shadow(load_robot("gen2"), members=8)
    text = (
        r"follow_gen4_a is for robot 'gen4', not for 'gen2'; the robots differ in"
        r" geometry.segment_length "
    )
    with pytest.raises(InputError, match=text + r"\(0.075 and 0.037\), .* and \d more"):
        EstimateSteering(load_scenario("follow_gen4_a"), shadow, 0.02)


def test_a_plan_without_margin_is_refused_unless_pressing_on():
    shadow = Shadow(load_robot("gen2"), members=8)
    for allow_zero_margin, least in ((False, LEAST_MARGIN), (True, 0.0)):
        assert (
            EstimateSteering(
                load_scenario("follow_orifice"),
                shadow,
                0.02,
                allow_zero_margin=allow_zero_margin,
            ).follower.min_margin_fraction
            == least
        )
    assert LEAST_MARGIN > 0


def test_heading_at_the_start_counts_modulo_whole_turns():
    shadow = Shadow(load_robot("gen2"), members=8)
    scenario = load_scenario("follow_orifice")
    x, y, heading = scenario.pose
    for turn, renewed in ((2 * np.pi, False), (-2 * np.pi, False), (np.pi, True)):
        steering = EstimateSteering(scenario, shadow, 0.02)
        reasons: list[str] = []
        steering.follower.request_replan = reasons.append
        steering._begin(SimpleNamespace(pose=(x, y, heading + turn)), shadow)
        assert bool(reasons) == renewed, turn


def test_robots_of_equal_parts_are_equal_whatever_their_names_and_modules():
    gen2 = load_robot("gen2")
    gen4 = load_robot("gen4")
    assert differences(replace(gen2, name="mine", title="My robot"), gen2) == []
    assert differences(load_scenario("follow_orifice").robot, gen2) == []
    assert differences(load_scenario("follow_gen4_a").robot, gen4) == []
    slower = replace(
        gen2, actuator=replace(gen2.actuator, tau_fill=2 * gen2.actuator.tau_fill)
    )
    assert [each.partition(" ")[0] for each in differences(gen2, slower)] == [
        "actuator.tau_fill"
    ]


@pytest.mark.slow
@pytest.mark.parametrize(
    "fault",
    first_by_default(
        2, ["", "leak:2+=slow@8", "dead_sensor:2=silent@8", "lost_marker:3@8"]
    ),
)
def test_a_robot_is_steered_to_the_goal(fault):
    run = Run(3, 60.0, robot="gen2", frequency=2.0, fault=fault)
    done = steered((run, "follow_orifice"))
    assert done["ending"] == "goal_reached", done
    assert done["clearance_m"] > 0


def test_a_robot_is_vented_once_its_position_has_been_uncertain_for_a_while(walk):
    scenario = load_scenario("follow_gen4_a")
    steering = EstimateSteering(scenario, Shadow(scenario.robot, members=8), 0.02)
    steering._steer = lambda *_: np.ones((4, 2))
    steering._steps = 1
    uncertain = replace(walk.estimate, pose_sd=np.array([0.02, 0.0, 0.0]), lost="")

    def vented_ticks(estimate, ticks: int) -> int:
        return sum(
            bool((steering.step(estimate, walk.shadow) == -1).all())
            for _ in range(ticks)
        )

    assert vented_ticks(uncertain, 10) == 0
    assert vented_ticks(uncertain, 5) == 5
    assert vented_ticks(replace(uncertain, pose_sd=np.zeros(3)), 1) == 0
    assert vented_ticks(uncertain, 10) == 0
    lost = replace(uncertain, lost="no message from the robot")
    ticks = round(PATIENCE_S / 0.02)
    assert vented_ticks(lost, ticks - 10) == ticks - 10 and not steering.finished
    assert vented_ticks(lost, 12) == 12 and steering.finished
    assert steering.summary()["ending"] == "estimate_lost"


def test_segments_with_stuck_valves_are_straight_and_steering_ends_without_air(
    walk, shadow
):
    steering = EstimateSteering(load_scenario("follow_gen4_a"), shadow, 0.02)
    reasons: list[str] = []
    steering.follower = SimpleNamespace(
        finished=False,
        step=lambda _: np.full((5, 4, 2), [1.0, 0.0]),
        events=list,
        request_replan=reasons.append,
    )
    steering._steps = 1
    names = ["", "stuck_valve +=open", "stuck_valve -=closed", ""]
    stuck = [[each.name for each in HYPOTHESES].index(name) for name in names]
    shadow.faults.most_likely = lambda: np.array(stuck)
    commands = [steering.step(walk.estimate, shadow) for _ in range(52)]
    # The robot rests for one second, while its pose is estimated.
    assert [(each == -1).all() for each in commands] == [True] * 49 + [False] * 3
    assert commands[-1].tolist() == [[1, 0.5], [1, 1], [0, 0], [1, 0.5]]
    assert reasons == ["fault"]
    shadow.faults.supply.pressure = 0.29 * shadow.faults.supply.nominal
    ended = []
    for _ in range(160):
        steering.step(walk.estimate, shadow)
        ended.append(steering.finished)
    assert ended.index(True) in (149, 150)  # three seconds
    assert steering.summary()["ending"] == "supply_empty"


@pytest.mark.slow
def test_a_robot_without_air_is_not_steered_for_long():
    run = Run(
        121, 20.0, fault="low_supply_pressure=empty@2", robot="gen2", frequency=2.0
    )
    told = steered((run, "follow_orifice"))
    assert told["ending"] == "supply_empty"
    assert told["time_s"] < 8.0
    assert told["clearance_m"] > 0
