"""Scenario files of iterative learning: a good one, malformed ones, and any."""

from __future__ import annotations

from typing import Any

from hostile_yaml import edited
from hypothesis import strategies as st

from srs_twin.scenario.loading import parse_scenario
from srs_twin.scenario.scenario import Scenario

GOOD = b"""\
title: Four modules that learn
robot: gen4
duration_s: 2
supply: {pressure_kpa: 131}
controller: {kind: ilc, frequency_hz: 2.0, offset: 0.3, target_rad: 0.7, k_per_rad: 0.3, carrier_hz: 60}
plants:
  analytical: {}
expect:
  - {metric: periods_to_converge, plant: analytical, below: 12}
"""

MALFORMED = edited(GOOD, {
    "an offset without targets": (
        "offset: 0.3", "offset: 0.31", ":5:52: controller.offset: must be a number from -0.3 to 0.3"),
    "two targets": (
        "offset: 0.3", "target: smallest", ":5:13: controller: give either target or target_rad"),
    "a target of another name": (
        "target_rad: 0.7", "target: largest", "controller.target: must be smallest, not text 'largest'"),
    "a target of nothing": (
        "target_rad: 0.7", "target_rad: 0", "controller.target_rad: must be a number from 0.01 to 1.5708"),
    "a target without a unit": (
        "target_rad: 0.7", "target: 0.7", "controller.target: must be smallest, not 0.7"),
    "a gain that unlearns": (
        "k_per_rad: 0.3", "k_per_rad: -0.3", "controller.k_per_rad: must be a number from 0.0001 to 100"),
    "no free period": (
        "k_per_rad: 0.3", "free_periods: 0", "controller.free_periods: must be a whole number from 1"),
    "half a free period": (
        "k_per_rad: 0.3", "free_periods: 1.5", "controller.free_periods: must be a whole number from 1 to"),
    "a carrier as slow as the gait": (
        "carrier_hz: 60", "carrier_hz: 2", "needs a carrier_hz of at least 16"),
    "something else on a fault": (
        "k_per_rad: 0.3", "on_fault: ignore", "controller.on_fault: must be one of go_on, stop, not text"),
    "valves that hold": (
        "duration_s: 2", "duration_s: 2\nvalves: {layout: in_out}", "valves.layout: ilc drives valves of"),
    "a reference to follow": (
        "k_per_rad: 0.3", "reference: {kind: constant, bend_rad: 0.1}", "controller.reference: unknown key"),
})  # fmt: skip


@st.composite
def learners(draw: st.DrawFn) -> Scenario:
    """Return any scenario of iterative learning."""
    controller: dict[str, Any] = {
        "kind": "ilc",
        "frequency_hz": draw(st.floats(0.01, 6.0)),
        "offset": draw(st.floats(-0.3, 0.3)),
        "k_per_rad": draw(st.floats(1e-4, 100)),
        "free_periods": draw(st.integers(1, 1000)),
        "carrier_hz": draw(st.floats(50, 1000)),
        "on_fault": draw(st.sampled_from(["go_on", "stop"])),
    } | draw(
        st.sampled_from(
            [{}, {"target": "smallest"}, {"target_rad": 0.4}, {"phase_rad": 1.0, "phase_step_rad": 2}]
        )
    )
    return parse_scenario(
        {
            "robot": "gen4",
            "duration_s": draw(st.integers(1, 3600)),
            "supply": {"pressure_kpa": draw(st.floats(0.1, 131))},
            "controller": controller,
            "plants": draw(
                st.sampled_from([{"analytical": {}}, {"analytical": {}, "twin": {"tick_s": 0.005}}])
            ),
        },
        name="learning",
    )
