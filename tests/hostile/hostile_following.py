"""Scenario files of planning and following: a good one, malformed ones, and any."""

# ruff: noqa: E501 - one malformed file a line, as a table
from __future__ import annotations

from typing import Any

from hostile_yaml import edited
from hypothesis import strategies as st

from srs_twin.scenario.loading import parse_scenario
from srs_twin.scenario.scenario import Scenario

GOOD = b"""\
title: A way among circles
robot: gen2
duration_s: 2
seed: 3
world:
  goal: {x_m: 1.0, y_m: 0.2, heading_rad: 0.5, heading_tolerance_rad: 0.1, radius_m: 0.05}
  polygons: [{corners_m: [[0.5, 0.5], [0.6, 0.5], [0.6, 0.6]]}]
  random: {count: 2, area: {x_m: [0.4, 0.6], y_m: [-0.8, -0.4]}, radius_m: [0.02, 0.05], gap_m: 0.05}
planner: {kind: best_first, footprint: gen2_section52, turn_share: 0.8, margin_m: 0.02, nodes: 5000}
controller:
  kind: follow
  follower: path
  gait: {kind: gait, frequency_hz: 2.0}
  delay_s: 0.1
  camera: {rate_hz: 60, position_noise_m: 0.001}
  lookahead_m: 0.15
plants:
  analytical: {}
expect:
  - {metric: plan_found, plant: analytical, above: 1}
"""

MALFORMED = edited(GOOD, {
    "a footprint that is a device": (
        "footprint: gen2_section52", "footprint: /dev/zero", "planner.footprint: /dev/zero: not a regular file"),
    "a footprint that is none": (
        "footprint: gen2_section52", "footprint: gen2", "planner.footprint: unknown footprint 'gen2'"),
    "no footprint": ("footprint: gen2_section52, ", "", "planner.footprint: missing"),
    "no planner of that name": (
        "kind: best_first", "kind: best", "planner.kind: must be one of best_first, greedy, ompl, given"),
    "greedy with what another planner takes": (
        "kind: best_first", "kind: greedy", "planner.nodes: unknown key; known here: footprint, turn_share"),
    "a budget of nothing": ("nodes: 5000", "nodes: 0", "planner.nodes: must be a whole number from 1"),
    "a budget without end": ("nodes: 5000", "seconds: .inf", "planner.seconds: "),
    "edges beyond the centre of the turn": (
        "margin_m: 0.02", "margin_m: 0.5", "planner: footprint gen2_section52: left: 0.517 m reaches the centre"),
    "more than all turns": ("turn_share: 0.8", "turn_share: 1.1", "planner.turn_share: must be a number from 0.05"),
    "a camera that sees nothing": ("rate_hz: 60", "rate_hz: 0", "controller.camera.rate_hz: must be a number from 5"),
    "noise below nothing": (
        "position_noise_m: 0.001", "position_noise_m: -1", "controller.camera.position_noise_m: must be a number"),
    "a command from the future": ("delay_s: 0.1", "delay_s: -0.1", "controller.delay_s: must be a number from 0"),
    "an offset of its own": (
        "frequency_hz: 2.0", "frequency_hz: 2.0, offset: 0.1", "controller: the follower sets the offset"),
    "nothing that can be steered": (
        "gait: {kind: gait, frequency_hz: 2.0}", "gait: {kind: hold_valves}",
        "controller.gait.kind: must be one of gait, ilc"),
    "a follower in a follower": (
        "gait: {kind: gait, frequency_hz: 2.0}", "gait: {kind: follow}",
        "controller.gait.kind: must be one of gait, ilc"),
    "a key of the other follower": (
        "follower: path", "follower: bearing", "controller: lookahead_m requires follower: path"),
    "another key of the other follower": (
        "lookahead_m: 0.15", "near_m: 0.15", "controller: near_m requires follower: bearing"),
    "sides that cross": (
        "[0.6, 0.5], [0.6, 0.6]", "[0.6, 0.6], [0.6, 0.5], [0.5, 0.6]",
        "world.polygons[0].corners_m: these corners do not bound an area"),
    "a polygon of two corners": (", [0.6, 0.6]", "", "world.polygons[0].corners_m: "),
    "a corner in space": ("[0.6, 0.6]", "[0.6, 0.6, 0.1]", "world.polygons[0].corners_m[2]"),
    "a corner that is not a number": ("[0.6, 0.6]", "[0.6, .nan]", "world.polygons[0].corners_m[2]"),
    "circles that do not fit": ("count: 2", "count: 900", "world.random: 900 circles do not fit"),
    "radii the wrong way round": (
        "radius_m: [0.02, 0.05]", "radius_m: [0.05, 0.02]", "world.random.radius_m: the smallest radius comes first"),
    "nineteen of eighteen sites": (
        "count: 2", "kind: fig54, count: 19", "world.random: 19 obstacles cannot be drawn from 18 sites"),
    "nowhere to go": (
        "  goal: {x_m: 1.0, y_m: 0.2, heading_rad: 0.5, heading_tolerance_rad: 0.1, radius_m: 0.05}\n", "",
        "planner: kind: best_first needs world.goal"),
})  # fmt: skip


@st.composite
def followers(draw: st.DrawFn) -> Scenario:
    """Return any scenario that plans and follows."""
    follower = draw(st.sampled_from(["bearing", "path"]))
    number = st.floats(0.001, 100)
    of_each = {"bearing": ("gain_per_rad", "node_m", "near_m"), "path": ("lookahead_m", "settle_m")}
    gait = draw(st.sampled_from([
        {"kind": "gait", "frequency_hz": 2.0}, {"kind": "ilc", "frequency_hz": 1.5, "target_rad": 0.7},
    ]))  # fmt: skip
    controller: dict[str, Any] = {
        "kind": "follow", "follower": follower, "gait": gait, "delay_s": draw(st.floats(0, 10)),
        "camera": {"rate_hz": draw(st.floats(5, 1000)), "heading_noise_rad": draw(st.floats(0, 3))},
        "replans": draw(st.integers(0, 1000)),
    } | {name: draw(number) for name in of_each[follower] if draw(st.booleans())}  # fmt: skip
    common = {"footprint": draw(st.sampled_from(["gen4_table9", "gen4_table8"])), "turn_share": 0.7}
    planner = draw(
        st.sampled_from(
            [
                {"kind": "best_first", "levels": 2, "weight": 1.5, "improve": True, "run_up_m": 0.2},
                {"kind": "greedy", "primitives": {"count": 5, "turn_rad": 0.3, "length_m": 0.4}},
                {"kind": "ompl", "seconds": 0.2},
                {"kind": "given", "turns_rad": [0.2, -0.3, 0.0], "step_m": 0.5},
            ]
        )
    )
    world: dict[str, Any] = {
        "goal": {"x_m": draw(st.floats(-1000, 1000)), "y_m": 0.0},
        "obstacles": [{"x_m": 1.0, "y_m": draw(st.floats(-5, 5)), "radius_m": 0.1}],
    }
    if draw(st.booleans()):
        world["random"] = draw(st.sampled_from([
            {"kind": "fig54", "count": 5}, {"count": 3, "area": {"x_m": [5, 9], "y_m": [5, 9]}, "seed": 7},
        ]))  # fmt: skip
    return parse_scenario(
        {
            "robot": "gen4", "duration_s": draw(st.integers(1, 3600)), "seed": draw(st.integers(0, 2**31)),
            "controller": controller, "planner": planner | common, "world": world, "plants": {"analytical": {}},
        },
        name="following",
    )  # fmt: skip
