"""Scenario files of a module on a bench: a good one, malformed ones, and any."""

from __future__ import annotations

from typing import Any

from hostile_yaml import edited
from hypothesis import strategies as st

from srs_twin.scenario.loading import parse_scenario
from srs_twin.scenario.scenario import Scenario

GOOD = b"""\
title: One module, a sine
robot: gen4_module
duration_s: 1
bench: true
supply: {pressure_kpa: 48.3}
valves: {layout: in_out}
sensor: {kind: hall, span_rad: 0.8, bits: 10}
controller: {kind: direct_smc, d_per_s: 20, reference: {kind: sine, amplitude_rad: 0.6, frequency_hz: 2}}
plants:
  analytical: {}
  twin: {timestep_s: 0.00025}
expect:
  - {metric: amplitude_rel, plant: twin, above: 0.5}
"""

_ITERATIVE = "controller: {kind: iterative_smc, carrier_hz: 60, reference:"
_DIRECT = "controller: {kind: direct_smc, d_per_s: 20, reference:"

MALFORMED = edited(GOOD, {
    "a bench that is text": (
        "bench: true", "bench: yes", ":4:8: bench: must be true or false, not text 'yes'"),
    "a start on a bench": (
        "bench: true", "bench: true\nstart: {}", ":5:1: start: a module on a bench starts at its clamp"),
    "friction on a bench": (
        "analytical: {}", "analytical: {friction: axis}",
        ":10:16: plants.analytical.friction: there is no floor on a bench"),
    "slip on a bench": (
        "analytical: {}", "analytical: {slip_speed_m_s: 0.01}", ":10:16: plants.analytical.slip_speed_m_s:"),
    "wheels on a bench": (
        "twin: {", "twin: {wheels: rolling, ", ":11:10: plants.twin.wheels: there is no floor on a bench"),
    "a yielding model on a bench": (
        "analytical: {}", "analytical: {model: compliant}", ":10:23: plants.analytical.model: compliant"),
    "an unknown layout": (
        "in_out", "5/2", ":6:18: valves.layout: must be one of 3/2, in_out, not text '5/2'"),
    "valves that cannot hold": (
        "in_out", "3/2", ":6:18: valves.layout: direct_smc drives valves of layout in_out, not 3/2; 3/2 va"),
    "valves that pulses do not drive": (
        _DIRECT, _ITERATIVE, ":6:18: valves.layout: iterative_smc drives valves of layout 3/2, not in_out"),
    "a controller of no kind": ("kind: direct_smc, ", "", ":8:13: controller.kind: missing; it says which"),
    "a controller of another kind": (
        "direct_smc", "direct_smd",
        ":8:20: controller.kind: must be one of gait, ilc, direct_smc, iterative_smc, hold_valves, replay"),
    "a controller that is a list": (
        GOOD.decode().splitlines()[7], "controller: [1]", ":8:13: controller: must be a block of keys"),
    "the carrier of another controller": (
        "d_per_s: 20", "carrier_hz: 60", ":8:32: controller.carrier_hz: unknown key"),
    "a gain of 0": (
        "d_per_s: 20", "d_per_s: 0", ":8:41: controller.d_per_s: must be a number from 0.001 to 1000, not 0"),
    "no reference": (
        "reference: {kind: sine, amplitude_rad: 0.6, frequency_hz: 2}", "cutoff_hz: 20",
        ":8:13: controller.reference: missing"),
    "a reference of another kind": (
        "kind: sine", "kind: sinus", ":8:63: controller.reference.kind: must be one of constant, step, sin"),
    "a key of another reference": (
        "frequency_hz: 2", "frequency_hz: 2, hold_s: 1", "controller.reference.hold_s: unknown key"),
    "a reference beyond the range": (
        "amplitude_rad: 0.6", "amplitude_rad: 0.9", ":8:56: controller.reference: the reference asks for 5"),
    "a right angle and more": (
        "amplitude_rad: 0.6", "amplitude_rad: 1.6", "must be a number from 0.001 to 1.5708, not 1.6"),
    "neither refused nor saturated": (
        "d_per_s: 20", "beyond_range: clip", ":8:46: controller.beyond_range: must be one of refuse, satur"),
    "a Hall sensor's key on an ideal one": (
        "kind: hall, span_rad: 0.8", "kind: ideal", ":7:9: sensor: bits requires kind: hall"),
    "a converter of no bits": (
        "bits: 10", "bits: 0", ":7:43: sensor.bits: must be a whole number from 1 to 32, not 0"),
    "a tick that is none of the time step's": (
        "0.00025}", "0.0003}", "plants.twin.tick_s: tick 0.001 s is no multiple of time step 0.0003 s"),
    "a metric of no run": (
        "amplitude_rel", "amplitude", ":13:14: expect[0].metric: unknown metric 'amplitude'"),
})  # fmt: skip


def _references() -> st.SearchStrategy[dict[str, Any]]:
    bend = st.floats(-0.7, 0.7)
    amplitude, frequency = st.floats(0.001, 0.5), st.floats(0.01, 50)
    waves = st.fixed_dictionaries(
        {"kind": st.sampled_from(["sine", "square"]), "amplitude_rad": amplitude, "frequency_hz": frequency},
        optional={"phase_rad": st.floats(-6.3, 6.3), "offset_rad": st.floats(-0.2, 0.2)},
    )
    return st.one_of(
        st.fixed_dictionaries({"kind": st.just("constant"), "bend_rad": st.floats(-1.5, 1.5)}),
        st.fixed_dictionaries(
            {"kind": st.just("step"), "bend_rad": bend}, optional={"time_s": st.floats(0, 9)}
        ),
        st.fixed_dictionaries(
            {
                "kind": st.just("staircase"),
                "bends_rad": st.lists(bend, min_size=1, max_size=9),
                "hold_s": st.floats(0.001, 9),
            }
        ),
        waves,
    )


@st.composite
def benches(draw: st.DrawFn) -> Scenario:
    """Return any scenario of the module."""
    kind = draw(st.sampled_from(["direct_smc", "iterative_smc", "hold_valves", "gait"]))
    controller: dict[str, Any] = {"kind": kind}
    if kind == "gait":
        controller["frequency_hz"] = draw(st.floats(0.01, 50))
    elif kind == "hold_valves":
        controller["plus"] = draw(st.sampled_from(["fill", "hold", "vent"]))
    else:
        controller |= {"reference": draw(_references()), "beyond_range": "saturate"}
    data: dict[str, Any] = {
        "robot": "gen4_module",
        "duration_s": draw(st.integers(1, 3600)),
        "bench": True,
        "controller": controller,
        "sensor": draw(
            st.sampled_from([
                {}, {"kind": "ideal"}, {"kind": "hall"}, {"kind": "hall", "span_rad": 0.8, "noise_uv": 0},
                {"kind": "hall", "distance_mm": 4.6, "orientation": "side", "bits": 12, "bias_v": -0.1},
            ])
        ),
        "plants": draw(
            st.sampled_from([{"analytical": {}}, {"twin": {}}, {"analytical": {}, "twin": {"tick_s": 0.002}}])
        ),
    }  # fmt: skip
    return parse_scenario(data, name="bench")
