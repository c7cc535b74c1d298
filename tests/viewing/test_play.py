"""Keyboard control: effect of each key, real time with a simulated clock, errors without a display."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from snakes import robot

from srs_twin import Gait, TwinSnake, load_scenario, rollout
from srs_twin.trajectory import Event
from srs_twin.viewing.mujoco import live
from srs_twin.viewing.mujoco.live import LiveSnake, steer
from srs_twin.viewing.mujoco.stage import Skins
from srs_twin.viewing.plots.style import pressure_colors

SPEC = robot()


class FakeWindow:
    """Fake window that is open for some ticks, presses keys and records the displayed states.

    Attributes:
        delays: time that a picture takes to draw, s, keyed by the number of the picture.
    """

    def __init__(
        self,
        ticks: int,
        keys: dict[int, tuple[int, ...]] | None = None,
        delays: dict[int, float] | None = None,
    ) -> None:
        self.ticks = ticks
        self.keys = keys or {}
        self.delays = delays or {}
        self.shown = []
        self.time = FakeTime()

    def is_open(self) -> bool:
        for key in self.keys.get(len(self.shown), ()):
            self.snake.press(key)
        return len(self.shown) < self.ticks

    def show(self, snake: LiveSnake) -> None:
        self.shown.append(
            (float(snake.state.time), snake.command, snake.status_lines())
        )
        self.time.now += self.delays.get(len(self.shown), 0.0)

    def play(self, snake: LiveSnake | None = None) -> LiveSnake:
        """Play a robot, or the given snake, until the window is closed."""
        self.snake = snake or LiveSnake(SPEC)
        steer(self.snake, self, clock=self.time.clock, sleep=self.time.sleep)
        return self.snake


class FakeTime:
    """Simulated clock that advances only in `sleep` and while a picture is drawn."""

    def __init__(self) -> None:
        self.now = 100.0
        self.slept = []

    @property
    def passed(self) -> float:
        return self.now - 100.0

    def clock(self) -> float:
        return self.now

    def sleep(self, seconds: float) -> None:
        self.slept.append(seconds)
        self.now += seconds


@pytest.mark.parametrize(
    ("key", "name", "step"),
    [
        (live.LEFT, "offset", 0.05),
        (live.RIGHT, "offset", -0.05),
        (live.UP, "frequency", 0.1),
        (live.DOWN, "frequency", -0.1),
        (live.PAGE_UP, "pressure", 1035.0),
        (live.PAGE_DOWN, "pressure", -1035.0),
    ],
)
def test_key_changes_its_command_by_one_step_up_to_the_limit(key, name, step):
    snake = LiveSnake(SPEC)
    before = snake.command
    snake.press(key)
    snake.advance()
    assert getattr(snake.command, name) - getattr(before, name) == pytest.approx(step)
    others = {"offset", "frequency", "pressure"} - {name}
    assert all(
        getattr(snake.command, other) == getattr(before, other) for other in others
    )
    for _ in range(20):
        snake.press(key)
    snake.advance()
    assert getattr(snake.command, name) == getattr(snake.limits, name)[step > 0]


def test_left_key_turns_left_and_home_resets():
    window = FakeWindow(200, {0: (live.LEFT,) * 4, 1: (ord("Q"), 7), 199: (live.HOME,)})
    snake = window.play()
    offsets = [command.offset for _, command, _ in window.shown]
    assert offsets[:199] == [pytest.approx(0.2)] * 199 and offsets[199] == 0.0
    assert float(snake.state.heading) > 0.5
    speed = dict(snake.status_lines())["speed"]
    assert speed == f"{np.hypot(*snake.state.com_velocity):.3f} m/s" != "0.000 m/s"


def test_without_keys_the_twin_follows_the_gait():
    window = FakeWindow(100)
    snake = window.play()
    middle = window.shown[0][1]
    twin = TwinSnake(SPEC, supply_pa=middle.pressure)
    alone = rollout(twin, Gait(middle.frequency), 2.0)
    assert snake.state.com == pytest.approx(alone.com[-1], abs=1e-6)


def test_space_pauses_and_backspace_restarts():
    keys = {0: (live.UP,), 3: (live.SPACE,), 6: (live.SPACE,), 9: (live.BACKSPACE,)}
    window = FakeWindow(12, keys)
    window.play()
    ticks = [round(time / 0.02) for time, _, _ in window.shown]
    assert ticks == [1, 2, 3, 3, 3, 3, 4, 5, 6, 1, 2, 3]
    notes = [dict(lines)["time (space: pause)"] for _, _, lines in window.shown]
    assert (notes[4], notes[7]) == ("0.1 s, paused", "0.1 s")
    assert window.shown[8][1].frequency > window.shown[9][1].frequency


def test_lag_is_made_up_for_to_a_limit():
    window = FakeWindow(100, delays={10: 0.1, 40: 5.0})
    snake = window.play()
    # Of the 5 s that one picture took, all but the quarter that is caught up is lost,
    # on a raster of ticks.
    crawled = float(snake.state.time)
    lost = window.time.passed - crawled
    assert lost == pytest.approx(5.0 - live.MAX_LAG_S, abs=0.05)
    assert crawled == pytest.approx(2.0 + 0.1 + live.MAX_LAG_S, abs=0.05)
    assert np.min(window.time.slept) >= 0


def test_slow_pictures_do_not_slow_the_snake():
    window = FakeWindow(10, delays=dict.fromkeys(range(1, 11), 0.2))
    snake = window.play()
    assert float(snake.state.time) == pytest.approx(window.time.passed, abs=0.21)


def test_status_lines_have_units():
    status = dict(LiveSnake(SPEC).status_lines())
    assert status["frequency (up, down)"] == "1.50 Hz"
    assert status["pressure (page up, page down)"] == "48.3 kPa"
    assert (status["offset (left, right)"], status["speed"]) == ("+0.00", "0.000 m/s")


def test_a_scenario_is_played_as_it_runs():
    scenario = load_scenario("gen2_turn")
    window = FakeWindow(60)
    snake = window.play(LiveSnake(scenario=scenario))
    pair = scenario.build_plant("twin"), scenario.build_controller()
    ran = rollout(*pair, 1.2, seed=scenario.seed)
    assert snake.state.com == pytest.approx(ran.com[-1], abs=1e-9)
    assert window.shown[-1][2][0] == ("controller", "gait")


def test_first_steering_key_takes_over_until_a_restart():
    keys = {
        5: (live.SPACE, live.SPACE),
        10: (live.LEFT,),
        20: (live.HOME,),
        30: (live.BACKSPACE,),
    }
    window = FakeWindow(40, keys)
    snake = window.play(LiveSnake(scenario=load_scenario("gen2_turn")))
    by_keys = [dict(lines).get("offset (left, right)") for _, _, lines in window.shown]
    assert by_keys == [None] * 10 + ["+0.05"] * 10 + ["+0.00"] * 10 + [None] * 10
    # The air supply of the scenario bounds the pressure.
    assert snake.limits.pressure[1] == snake.scenario.supply_pa
    ticks = [round(time / 0.02) for time, _, _ in window.shown]
    assert ticks[-10:] == list(range(1, 11))


def test_controller_of_a_bench_cannot_be_replaced():
    snake = LiveSnake(scenario=load_scenario("module_step_direct"))
    snake.press(live.LEFT)
    snake.advance()
    labels = [label for label, _ in snake.status_lines()]
    assert labels[0] == "controller" and not any("steer" in label for label in labels)


def test_plan_and_goal_of_a_scenario_are_on_the_floor():
    snake = LiveSnake(scenario=load_scenario("follow_fig57"))
    path, edges, goal = snake.floor_lines
    assert [line.name for line in snake.floor_lines] == [
        "plan/path",
        "plan/edges",
        "plan/goal",
    ]
    wanted = snake.scenario.world.goal
    first = snake._controller.plan.segments[0]
    assert path.strips[0][0] == pytest.approx([first.start.x, first.start.y])
    assert np.hypot(*(path.strips[-1][-1] - [wanted.x, wanted.y])) <= wanted.radius
    ring = np.hypot(*(goal.strips[0] - [wanted.x, wanted.y]).T)
    assert ring == pytest.approx(wanted.radius)
    assert len(edges.strips) == 2 * len(path.strips)
    last = snake._controller.plan.segments[-1]
    row = snake.scenario.planner.problem.footprint.at(last.curvature)
    left = [-np.sin(last.start.heading), np.cos(last.start.heading)]
    sides = [(edge[0] - path.strips[-1][0]) @ left for edge in edges.strips[-2:]]
    assert sides == pytest.approx([row.left, -row.right])
    assert dict(snake.status_lines())["on the floor"] == "path, edges, goal"
    assert LiveSnake(scenario=load_scenario("gen2_turn")).floor_lines == []


def test_a_new_plan_replaces_the_lines_of_the_old_one(monkeypatch):
    snake = LiveSnake(scenario=load_scenario("follow_fig57"))
    before = snake.floor_lines
    follower = snake._controller
    shorter = replace(follower.plan, segments=follower.plan.segments[:1])
    follower.plans.append((0.02, shorter))
    event = Event(0.02, "new_plan", "a new plan")
    monkeypatch.setattr(follower, "events", lambda: [event])
    snake.advance()
    assert len(snake.floor_lines[0].strips) == 1 < len(before[0].strips)


def test_help_and_window_name_all_keys(srs_twin, tmp_path):
    text = " ".join(srs_twin("play", "--help", cwd=tmp_path).stdout.split())
    shown = " ".join(label for label, _ in LiveSnake(SPEC).status_lines())
    keys = "left, right, up, down, page up, page down, home, space, backspace"
    for key in keys.split(", "):
        assert key in text and key in shown, key


def test_an_unknown_robot_is_reported_before_a_missing_display(
    srs_twin, tmp_path, monkeypatch
):
    monkeypatch.setenv("DISPLAY", "")
    monkeypatch.setenv("WAYLAND_DISPLAY", "")
    for name, words in (
        ("gen5", "unknown scenario or robot 'gen5'; did you mean gen"),
        ("gen2", "no display was found: neither DISPLAY nor WAYLAND_DISPLAY is set"),
    ):
        done = srs_twin("play", name, cwd=tmp_path)
        assert (done.returncode, done.stdout) == (2, "")
        assert done.stderr.startswith(words) and done.stderr.count("\n") == 1
    assert list(tmp_path.iterdir()) == []


@pytest.mark.slow
def test_a_display_that_does_not_respond_is_reported(srs_twin_process, tmp_path):
    given = {"DISPLAY": ":4711", "WAYLAND_DISPLAY": ""}
    done = srs_twin_process("play", "gen2", cwd=tmp_path, **given)
    assert (done.returncode, done.stdout) == (2, "")
    assert done.stderr.startswith("the display :4711 does not respond")
    assert done.stderr.count("\n") == 1


def test_the_body_has_the_colours_of_its_pressures():
    snake = FakeWindow(20).play()
    physics = snake.twin.physics
    nominal = SPEC.supply.nominal
    skins = Skins(physics.model, SPEC.segments)
    skins.show(snake.state.pressure, nominal)
    difference = snake.state.pressure[:, 0] - snake.state.pressure[:, 1]
    assert np.ptp(difference) > 0.1 * nominal
    wanted = pressure_colors(difference, nominal) / 255
    for geoms, color in zip(skins.geoms, wanted, strict=True):
        assert geoms and np.allclose(physics.model.geom_rgba[geoms], color, atol=1e-6)
    beyond, ends = (
        pressure_colors(np.array(values), 2.0) for values in ([2.0, -3.0], [2.0, -2.0])
    )
    assert np.array_equal(beyond, ends)
