"""Follower on a unicycle: convergence with delay and noise, new plans and endings."""

from __future__ import annotations

import math
from collections import deque
from dataclasses import replace

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from unicycle import Unicycle, Wheel

from srs_twin import InputError
from srs_twin.comparison.sampling import rms
from srs_twin.control.reference import Constant
from srs_twin.control.smc import IterativeSMC
from srs_twin.planning.camera import Camera, CameraFrames, PeriodMean
from srs_twin.planning.follower import ENDINGS, Conditions, Follower
from srs_twin.planning.footprint import Footprint
from srs_twin.planning.path import PathPoint, ReferencePath, path_from_arcs
from srs_twin.planning.problem import Plan, PlanOutcome
from srs_twin.planning.steering import (
    PathTracking,
    Predictor,
    Steering,
    SteeringInput,
    WaypointSteering,
)
from srs_twin.robot.file import load_robot
from srs_twin.robot.world import Circle, Goal, Pose, World

ORIGIN = Pose(0.0, 0.0, 0.0)
CLEAR = Camera()
BODY = Footprint.box(0.1, 0.0, speed=0.2, curvature=5.0)
SETTLE = 0.05
STRAIGHT = ((0.0, 3.0),)
WINDING = ((2.0, 0.4), (-3.0, 0.5), (0.0, 0.3), (3.5, 0.4), (-2.0, 0.5))


def as_told(offset):
    return 5.0 / 0.3 * offset


def a_plan(pieces=STRAIGHT, start=ORIGIN):
    return Plan(PlanOutcome.FOUND, "given", path_from_arcs(start, list(pieces), BODY))


def ours():
    return PathTracking(BODY, 0.15, SETTLE)


def follower_of(
    gait,
    plan,
    conditions,
    *,
    steering=None,
    radius=0.05,
    goal=None,
    margin=0.0,
    **options,
):
    end = plan.end or Pose(1.0, 0.0, 0.0)
    return Follower(
        gait,
        steering or ours(),
        plan,
        goal or Goal(end.x, end.y, None, radius),
        BODY,
        conditions,
        body=BODY.reduced(margin=margin),
        **options,
    )


def follow(
    plan,
    *,
    start=(0.0, 0.0, 0.0),
    camera=CLEAR,
    delay=0.0,
    duration=30.0,
    seed=0,
    max_cross_track_error=None,
    max_replans=3,
    curvature_at=as_told,
    late=0.0,
    lag=0.0,
    lead_in=0.0,
    snake=(),
    **options,
):
    """Return the follower, the snake and its path, shape (samples, 4): time, x, y, heading without
    oscillation.

    Frames are late by `late` (s); the follower compensates `lag` of that.
    """
    wheel = Wheel()
    conditions = Conditions(
        camera, delay, SETTLE, max_cross_track_error, max_replans, lead_in, lag
    )
    follower = follower_of(wheel, plan, conditions, **options)
    plant = Unicycle(wheel, curvature_at, **dict(snake))
    state = plant.reset(pose=start)
    follower.reset(plant.spec, plant.tick, seed=seed)
    way = [(0.0, *start)]
    states = deque([state], maxlen=1 + round(late / plant.tick))
    for _ in range(round(duration / plant.tick)):
        valves = follower.step(replace(states[0], time=state.time))
        if follower.finished:
            break
        state = plant.step(valves)
        states.append(state)
        way.append((plant.time, plant.x, plant.y, plant.heading))
    return follower, plant, np.array(way)


def beside(plan, way, since=0.0):
    return ReferencePath(plan.segments).coordinates(way[way[:, 0] >= since, 1:3])[1]


def rms_beside(plan, way):
    return rms(beside(plan, way))


def test_follower_converges_to_a_straight_path():
    plan = a_plan()
    follower, _, way = follow(plan, start=(0.0, 0.1, 0.0))
    assert follower.ending == "goal_reached"
    assert np.abs(beside(plan, way, since=7.0)).max() < 1e-3
    assert math.hypot(way[-1, 1] - 3.0, way[-1, 2]) < 0.01


@pytest.mark.parametrize(
    ("camera", "delay", "error"),
    [(CLEAR, 0.0, 0.008), (Camera(60.0, 0.002, 0.02), 0.1, 0.012)],
)
def test_a_winding_path_is_followed_within_millimetres(camera, delay, error):
    plan = a_plan(WINDING)
    follower, _, way = follow(plan, camera=camera, delay=delay)
    assert follower.ending == "goal_reached"
    assert rms_beside(plan, way) < error


def test_late_frames_are_compensated():
    plan = a_plan(WINDING)
    beside_by = {}
    for lag in (0.0, 0.16):
        _, _, way = follow(
            plan, late=0.16, lag=lag, steering=PathTracking(BODY, 0.1, SETTLE)
        )
        beside_by[lag] = rms_beside(plan, way)
    assert beside_by[0.16] < 0.005 and beside_by[0.0] > 0.01


@pytest.mark.parametrize(
    ("gain", "drift", "speed"), [(0.6, 0.5, 0.3), (1.6, -0.5, 0.12)]
)
def test_snake_that_differs_from_its_footprint_converges(gain, drift, speed):
    plan = a_plan(((0.0, 8.0),))
    _, _, way = follow(
        plan,
        start=(0.0, 0.1, 0.5),
        curvature_at=lambda offset: gain * as_told(offset) + drift,
        snake={"speed": speed},
        delay=0.1,
        duration=6.0 / speed,
    )
    assert np.abs(beside(plan, way, since=4.0 / speed)).max() < 0.01


@pytest.mark.parametrize(
    "make_steering", [ours, lambda: WaypointSteering(0.6, 0.2, 0.2)]
)
def test_mirrored_paths_are_followed_symmetrically(make_steering):
    ways = []
    for side in (1.0, -1.0):
        plan = a_plan(tuple((side * k, length) for k, length in WINDING))
        steering = make_steering()
        snake = {"wag": side * 0.3}
        _, _, way = follow(plan, steering=steering, snake=snake, delay=0.1)
        ways.append(way * (1, 1, side, side))
    assert ways[0] == pytest.approx(ways[1], abs=1e-9)


def test_path_tracking_is_a_critically_damped_law():
    """n'' = −2 n'/L − n/L² for small errors, in addition to the curvature of the path."""
    length = 0.15
    law = PathTracking(BODY, length, 0.0)
    law.begin(ReferencePath(a_plan(((2.0, 1.0),)).segments))
    for n, error in ((0.01, 0.0), (0.0, 0.02), (-0.01, 0.01)):
        place = PathPoint(0.5, n, 1.0, 2.0)
        pose = Pose(0.0, 0.0, 1.0 + error)
        offset = law.offset(SteeringInput(pose, place, 2.0, 0.5, 0.8))
        wanted = 2.0 / (1 - 2.0 * n) - 2 * error / length - n / length**2
        assert 0.8 * as_told(offset) + 0.5 == pytest.approx(wanted)
    solved = solve_ivp(
        lambda s, y: [y[1], -2 * y[1] / length - y[0] / length**2],
        (0.0, 0.3),
        [0.05, -0.1],
        rtol=1e-9,
    )
    expected = law.predict_cross_track(0.05, -0.1, 0.3)
    assert expected == pytest.approx(solved.y[0, -1], abs=1e-6)


def test_waypoint_steering_turns_in_proportion_to_the_bearing_error():
    law = WaypointSteering(0.6, 0.2, 0.05)
    law.begin(ReferencePath(a_plan().segments))
    seen = SteeringInput(Pose(0.0, 0.1, 0.2), PathPoint(0.0, 0.1, 0.0, 0.0), 0.0, 0.0)
    assert law.offset(seen) == pytest.approx(0.6 * (math.atan2(-0.1, 0.2) - 0.2))


def test_waypoint_steering_visits_all_nodes_and_arrives():
    steering = WaypointSteering(0.6, 0.2, 0.2)
    plan = a_plan(WINDING)
    follower, _, way = follow(plan, steering=steering, radius=0.1)
    assert follower.ending == "goal_reached"
    assert steering.node == math.ceil(plan.length / 0.2 - 1e-9) - 1
    assert rms_beside(plan, way) > 2 * rms_beside(plan, follow(plan)[2])


def test_offset_takes_effect_after_the_delay_and_stays_in_bounds():
    follower, plant, _ = follow(a_plan(), start=(0.0, 0.3, 0.0), delay=0.1)
    first = next(time for time, offset in plant.offsets if offset != 0)
    assert first == pytest.approx(0.1, abs=plant.tick / 2)
    assert max(abs(offset) for _, offset in plant.offsets) == pytest.approx(0.3)


class Watcher(Steering):
    """Alternate turns by time, and record the poses of the input."""

    predicts = True

    def __init__(self):
        self.poses = []

    def begin(self, route):
        pass

    def offset(self, seen):
        self.poses.append(seen.pose)
        return 0.2 if len(self.poses) % 120 < 60 else -0.2


def test_steering_receives_the_pose_at_which_its_command_takes_effect():
    """Also while earlier commands are still delayed."""
    steering = Watcher()
    delay = 0.3
    _, plant, way = follow(a_plan(), steering=steering, delay=delay, duration=8.0)
    ahead = round(delay / plant.tick)
    given = np.array([(pose.x, pose.y) for pose in steering.poses])[:-ahead]
    apart = np.hypot(*(given - way[ahead : ahead + len(given), 1:3]).T)
    settled = slice(round(1.0 / plant.tick), None)
    assert np.hypot(*np.diff(way[settled, 1:3], axis=0).T).sum() > 1.0
    assert apart[settled].max() < 0.01


def predicted(curvature_at, commanded, frames, **snake):
    """Return the predictor of a snake, and its predictions, means and true positions.

    Commands take effect 0.1 s after they are given; `commanded` is a function of the
    number of the frame.
    """
    predictor = Predictor(BODY, 0.5, 0.1, SETTLE)
    mean = PeriodMean(0.5)
    wheel = Wheel()
    plant = Unicycle(wheel, curvature_at, **snake)
    state = plant.reset()
    camera = CameraFrames(Camera(), 0)
    orders = deque()
    rows = []
    for frame in range(frames):
        time = float(state.time)
        mean.add(time, camera.capture(state))
        predictor.command(time, commanded(frame))
        orders.append((time + 0.1, commanded(frame)))
        predictor.measure(time, mean.time, mean.pose, whole=mean.complete)
        seen = predictor.predict(mean.time, mean.pose, time)
        rows.append([(*seen,)[:2], (*mean.pose,)[:2], (plant.x, plant.y)])
        while orders[0][0] <= time + 1e-9:
            wheel.offset = orders.popleft()[1]
        state = plant.step(None)
    return predictor, *np.moveaxis(rows, 1, 0)


def test_prediction_is_better_than_the_last_frame():
    """On a circle the prediction from a mean half a period old is the actual pose."""
    predictor, seen, mean, true = predicted(as_told, lambda frame: 0.2, 400)
    assert np.hypot(*(seen - true)[100:].T).max() < 0.003
    assert np.hypot(*(mean - true)[100:].T).min() > 0.04
    assert predictor.speed == pytest.approx(0.2, rel=0.02)
    # On one circle gain and disturbance are not distinguishable, but their sum is.
    assert predictor.turning == pytest.approx(as_told(0.2), abs=0.05)


def test_gain_and_disturbance_of_turning_are_estimated_and_reset():
    """A snake with a turning gain of 0.7 and a disturbance of 0.4 1/m."""
    predictor, *_ = predicted(
        lambda offset: 0.7 * as_told(offset) + 0.4,
        lambda frame: (-0.1, 0.2)[frame // 75 % 2],
        1500,
    )
    assert predictor.gain == pytest.approx(0.7, abs=0.1)
    assert predictor.disturbance == pytest.approx(0.4, abs=0.15)
    predictor.reset_turning()
    assert (predictor.gain, predictor.disturbance) == (1.0, 0.0)


def test_turning_is_estimated_by_a_kalman_filter_within_limits():
    """Standard deviations of the disturbance are fractions of the tightest curvature, 5 1/m."""
    predictor = Predictor(BODY, 0.5, 0.1, SETTLE)
    variance = np.array([1.0**2 + 0.5**2, 0.3**2 + 0.1**2])
    weights = variance * (1.0, 2.0) / (variance @ (1.0, 2.0**2) + 0.1**2)
    for measured, expected in (
        (2.5, (0.5 * weights[0], 1 + 0.5 * weights[1])),
        (1e3, (2.5, 2.5)),
        (-1e3, (-2.5, 0.4)),
    ):
        predictor.reset_turning()
        predictor._update_turning(measured, 2.0, 1.0)  # noqa: SLF001
        found = predictor.disturbance, predictor.gain
        assert found == pytest.approx(expected)


def test_estimated_speed_is_at_least_a_fifth_of_the_expected_speed():
    predictor, *_ = predicted(as_told, lambda frame: 0.0, 120, stops=1.0)
    assert predictor.speed == pytest.approx(0.2 * 0.2) and predictor.moved < 1e-9


def test_period_mean_removes_the_gait_and_is_exact_on_lines():
    """The measured heading jumps by a full turn within the last period."""
    mean = PeriodMean(0.5)
    for k in range(200):
        t = k / 60
        wag = 0.4 * math.sin(2 * math.pi * 2 * t + 1)
        heading = math.remainder(1.5 + 0.5 * t + wag, 2 * math.pi)
        mean.add(t, Pose(0.2 * t, -0.1 * t, heading))
    last = 199 / 60
    assert mean.complete and mean.time == pytest.approx(last - 0.25)
    assert mean.pose.x == pytest.approx(0.2 * (last - 0.25), abs=1e-4)
    assert mean.pose.y == pytest.approx(-0.1 * (last - 0.25), abs=1e-4)
    assert mean.pose.heading == pytest.approx(1.5 + 0.5 * (last - 0.25), abs=2e-3)


def camera_frames(seed, rate=30.0):
    """Return the frames of a camera that sees a snake at rest for 100 s."""
    camera = CameraFrames(Camera(rate, 0.01, 0.1), seed)
    state = Unicycle(Wheel(), as_told, wag=0.0).reset()
    every_tick = (camera.capture(replace(state, time=k / 50)) for k in range(5000))
    return np.array([(*frame,) for frame in every_tick if frame is not None])


def test_frames_come_at_their_rate_and_repeat_for_a_seed():
    first = camera_frames(1)
    assert len(first) == pytest.approx(100 * 30, abs=1)
    assert (first == camera_frames(1)).all() and (first != camera_frames(2)).all()
    assert len(camera_frames(1, rate=1000.0)) == 5000


def test_camera_noise_of_x_y_and_heading_has_its_size_and_is_independent():
    """Tolerances are seven standard errors of a standard deviation and five of a correlation for 3000
    frames."""
    noise = camera_frames(1)
    assert noise.std(axis=0) == pytest.approx([0.01, 0.01, 0.1], rel=0.1)
    assert np.abs(noise.mean(axis=0)).max() < 0.1 * 0.1
    assert np.abs(np.corrcoef(noise.T) - np.eye(3)).max() < 0.1
    from_frame_to_frame = np.corrcoef(noise[:-1].T, noise[1:].T)[:3, 3:]
    assert np.abs(from_frame_to_frame).max() < 0.1


def test_missing_plan_ends_the_run_with_the_planners_reason():
    follower, _, way = follow(Plan(PlanOutcome.NOT_FOUND, "every arc is blocked"))
    assert follower.finished and follower.ending == "no_plan" and len(way) == 1
    (event,) = follower.events()
    assert (event.kind, event.text) == ("no_plan", "every arc is blocked")
    assert follower.describe()["following"]["plans"][0]["outcome"] == "not_found"


def test_a_snake_that_stops_is_stuck():
    follower, _, way = follow(a_plan(), snake={"stops": 3.0})
    assert follower.ending == "stuck"
    assert 3.0 + 0.5 * 6 < way[-1, 0] < 3.0 + 0.5 * 8


def blind(offset):
    """Snake that turns regardless of its commands."""
    return 2.0


BESIDE = World((Circle(2.0, 0.25, 0.15),))
"""Obstacle 50 mm from the body on a straight path; this is the whole margin of the plan."""


def drifting(**options):
    """Return the follower of a snake that drifts towards the obstacle, with a law too weak."""
    follower, _, _ = follow(
        a_plan(),
        steering=WaypointSteering(0.3, 0.2, 0.1),
        curvature_at=lambda offset: as_told(offset) + 0.7,
        max_cross_track_error=1.0,
        world=BESIDE,
        margin=0.05,
        **options,
    )
    return follower


class Planner:
    """Planner that finds a plan with up to a fraction of the margin, and records its requests."""

    def __init__(self, largest, pieces=((-3.0, 0.2), (3.0, 0.2), (0.0, 1.0))):
        self.largest = largest
        self.pieces = pieces
        self.asked = []

    def __call__(self, pose, fraction):
        self.asked.append((pose, fraction))
        if fraction > self.largest:
            raise InputError(
                "start: the footprint of the straight body touches obstacle 1"
            )
        return a_plan(self.pieces, start=pose)


def test_new_plan_is_requested_before_the_body_reaches_an_obstacle():
    planner = Planner(0.75)
    event = drifting(replan=planner).events()[0]
    (first, fraction), again = planner.asked[:2]
    assert fraction == 1.0 and again == (first, 0.75)
    assert 1.0 < first.x < 2.0 and 0 < first.y < 0.05
    assert event.kind == "replanned"
    assert event.text == "new plan 1, 1.4 m (close, 75% of the margin)"


def test_no_plan_is_requested_near_an_obstacle_that_the_body_may_touch():
    planner = Planner(1.0)
    drifting(replan=planner, allows_contact=True)
    assert planner.asked == []


def test_run_ends_without_the_required_margin():
    planner = Planner(0.25)
    follower = drifting(replan=planner, min_margin_fraction=0.5)
    assert min(fraction for _, fraction in planner.asked) == 0.5
    assert follower.ending == "no_room"
    assert follower.events()[-1].text.startswith(
        "no path with the required margin: close; start: "
    )
    assert "25% of the margin" in drifting(replan=planner).events()[0].text


@pytest.mark.parametrize(("least", "kind"), [(0.0, "no_new_plan"), (0.5, "no_room")])
def test_run_with_a_required_margin_ends_near_an_obstacle_when_no_plan_is_left(
    least, kind
):
    events = drifting(max_replans=0, replan=Planner(1.0), min_margin_fraction=least)
    kinds = [each.kind for each in events.events()]
    assert kind in kinds and kinds.count("no_room") == (least > 0)


def test_straying_requests_new_plans_up_to_the_limit():
    planner = Planner(1.0, STRAIGHT)
    follower, _, _ = follow(
        a_plan(),
        curvature_at=blind,
        max_cross_track_error=0.1,
        max_replans=2,
        replan=planner,
    )
    assert follower.ending == "strayed" and len(planner.asked) == 2
    kinds = [event.kind for event in follower.events()]
    assert kinds == ["replanned", "replanned", "strayed"]
    times = [time for time, _ in follower.plans]
    assert times == sorted(times) and len(times) == 3


def test_plan_at_the_end_of_the_lead_in_does_not_count_towards_the_limit():
    planner = Planner(1.0, STRAIGHT)
    follower, _, _ = follow(
        a_plan(),
        curvature_at=blind,
        max_cross_track_error=0.1,
        max_replans=1,
        lead_in=0.15,
        replan=planner,
    )
    first, second, last = follower.events()
    assert first.text.endswith("(run_up)") and second.text.endswith("(strayed)")
    assert last.kind == "strayed" and len(planner.asked) == 2
    assert planner.asked[0][0].x == pytest.approx(0.15, abs=0.01)


def test_no_plan_is_requested_on_the_path_or_without_a_margin():
    for margin in (0.05, 0.0):
        follower, _, _ = follow(
            a_plan(),
            max_cross_track_error=1.0,
            replan=refuse,
            world=BESIDE,
            margin=margin,
        )
        assert follower.ending == "goal_reached" and [
            e.kind for e in follower.events()
        ] == ["goal_reached"]


def refuse(pose, _fraction):
    raise InputError(
        "start (1, 2): the footprint of the straight body touches obstacle 1"
    )


def test_old_plan_is_kept_if_there_is_no_new_one():
    follower, _, way = follow(
        a_plan(),
        curvature_at=blind,
        max_cross_track_error=0.1,
        replan=refuse,
        max_replans=2,
    )
    assert follower.ending == "strayed" and len(follower.plans) == 1
    events = follower.events()
    assert [event.kind for event in events] == ["no_new_plan", "no_new_plan", "strayed"]
    assert events[0].text.endswith("touches obstacle 1")
    assert events[1].time - events[0].time == pytest.approx(1.0, abs=0.03)
    # One that finds back in the meantime arrives.
    follower, _, _ = follow(
        a_plan(), start=(0.0, 0.2, 0.4), max_cross_track_error=0.15, replan=refuse
    )
    assert (
        follower.ending == "goal_reached" and follower.events()[0].kind == "no_new_plan"
    )


def test_goal_away_from_the_path_is_missed_for_a_stated_reason():
    for replan, reason in ((None, ""), (refuse, "; no new plan: start (1, 2): ")):
        follower, _, _ = follow(
            a_plan(), goal=Goal(3.0, 0.4, None, 0.05), replan=replan
        )
        assert follower.ending == "goal_missed"
        text = follower.events()[-1].text
        assert text.startswith(ENDINGS["goal_missed"] + reason)


class Later:
    """Future that is done when it is polled for the tenth time."""

    def __init__(self, job):
        self.job = job
        self.asked = 0

    def done(self):
        self.asked += 1
        return self.asked == 10

    def result(self):
        return self.job()


def test_old_plan_is_followed_until_another_thread_returns_a_new_one():
    """One push off its path makes the snake follow a new path."""
    jobs = []

    def submit(job):
        jobs.append(Later(job))
        return jobs[-1]

    fast, slow = (
        follow(
            a_plan(),
            start=(0.0, 0.2, 0.4),
            max_cross_track_error=0.15,
            replan=lambda pose, _: a_plan(start=pose),
            submit=submitted,
            goal=Goal(1.5, 0.0, None, 5.0),
        )[0]
        for submitted in (None, submit)
    )
    assert slow.ending == fast.ending == "goal_reached" and len(jobs) == 1
    _, (at_once, first) = fast.plans
    _, (later, second) = slow.plans
    assert later == pytest.approx(at_once + 10 * Unicycle.tick)
    assert second.segments[0].start == first.segments[0].start


def test_a_controller_without_an_offset_is_refused():
    with pytest.raises(
        InputError, match="'iterative_smc' has no steering offset; use gait or ilc"
    ):
        follower_of(IterativeSMC(Constant(0.1)), a_plan(), Conditions(CLEAR))


@pytest.mark.parametrize("side", [1.0, -1.0])
@pytest.mark.parametrize(
    ("ahead", "beside", "close"),
    # The snake is 0.2 m beside the path and returns to it within about 0.2 m.
    [(0.1, 0.16, True), (0.02, 0.288, False), (0.4, 0.25, False), (0.4, 0.05, True)],
)
def test_the_expected_return_to_the_path_is_checked(ahead, beside, close, side):
    wheel = Wheel()
    follower = follower_of(
        wheel,
        a_plan(),
        Conditions(CLEAR, 0.0, SETTLE),
        world=World((Circle(ahead, side * beside, 0.02),)),
        margin=0.05,
    )
    follower.reset(load_robot("gen2"), Unicycle(wheel, as_told).tick, seed=0)
    here = Pose(0.0, side * 0.2, 0.0)
    point = follower._locate(here)  # noqa: SLF001
    assert follower._approaches_obstacle(here, point) is close  # noqa: SLF001


def test_reset_restores_all_settings():
    """Two runs of one follower are equal, also with noise."""
    wheel = Wheel()
    noisy = Conditions(Camera(60.0, 0.002, 0.02))
    follower = follower_of(wheel, a_plan(WINDING), noisy)
    ways = []
    for _ in range(2):
        plant = Unicycle(wheel, as_told)
        state = plant.reset()
        follower.reset(load_robot("gen2"), plant.tick, seed=0)
        for _ in range(200):
            state = plant.step(follower.step(state))
        ways.append((plant.x, plant.y, follower.signals()["offset_commanded"]))
    assert ways[0] == ways[1]
