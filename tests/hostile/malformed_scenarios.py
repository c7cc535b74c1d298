"""Scenario files of every kind, and malformed versions of each."""

# ruff: noqa: E501 - one malformed file per line, as a table
from __future__ import annotations

from malformed_yaml import edited

SCENARIO = b"""\
title: Generation 2, straight
robot: gen2
duration_s: 1
supply: {pressure_kpa: 48.3}
controller: {kind: gait, frequency_hz: 2.0, offset: 0.0}
world: {}
plants:
  analytical: {model: complete, friction: axis}
  twin: {wheels: rolling}
expect:
  - {metric: com_speed_m_s, plant: twin, near: 0.214, rel: 0.15, source: Table 10}
"""

BENCH = b"""\
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

LEARNING = b"""\
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

FOLLOWING = b"""\
title: A path among circles
robot: gen2
duration_s: 2
seed: 3
world:
  goal: {x_m: 1.0, y_m: 0.2, heading_rad: 0.5, heading_tolerance_rad: 0.1, radius_m: 0.05}
  polygons: [{corners_m: [[0.5, 0.5], [0.6, 0.5], [0.6, 0.6]]}]
  random: {count: 2, area: {x_m: [0.4, 0.6], y_m: [-0.8, -0.4]}, radius_m: [0.02, 0.05], gap_m: 0.05}
planner: {kind: best_first, footprint: gen2_section52, turn_fraction: 0.8, margin_m: 0.02, nodes: 5000}
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

BENCH_MALFORMED = edited(
    BENCH,
    [
        (
            "bench: true",
            "bench: yes",
            ":4:8: bench: must be true or false, not text 'yes'",
        ),
        (
            "bench: true",
            "bench: true\nstart: {}",
            ":5:1: start: a robot on a bench is clamped",
        ),
        (
            "analytical: {}",
            "analytical: {friction: axis}",
            ":10:16: plants.analytical.friction: this key describes the floor",
        ),
        (
            "analytical: {}",
            "analytical: {slip_speed_m_s: 0.01}",
            ":10:16: plants.analytical.slip_speed_m_s:",
        ),
        (
            "twin: {",
            "twin: {wheels: rolling, ",
            ":11:10: plants.twin.wheels: this key describes the floor",
        ),
        (
            "analytical: {}",
            "analytical: {model: compliant}",
            ":10:23: plants.analytical.model: model 'compliant' needs base 'free'",
        ),
        (
            "in_out",
            "5/2",
            ":6:18: valves.layout: must be one of 3/2, in_out, not text '5/2'",
        ),
        (
            "in_out",
            "3/2",
            (
                ":6:18: valves.layout: the controller `direct_smc` needs valves of"
                " layout in_out, not 3/2, because 3/2 va"
            ),
        ),
        (
            "{kind: direct_smc, d_per_s: 20,",
            "{kind: iterative_smc, carrier_hz: 60,",
            (
                ":6:18: valves.layout: the controller `iterative_smc` needs valves of"
                " layout 3/2, not in_out"
            ),
        ),
        ("kind: direct_smc, ", "", ":8:13: controller.kind: missing; it selects"),
        (
            "direct_smc",
            "direct_smd",
            (
                ":8:20: controller.kind: must be one of gait, ilc, direct_smc,"
                " iterative_smc, hold_valves, grasp, replay"
            ),
        ),
        (
            "direct_smc",
            "compliant_gait",
            (
                "not text 'compliant_gait': it was retired, because none of its"
                " reactions to contact clearly increased the speed"
            ),
        ),
        (
            BENCH.decode().splitlines()[7],
            "controller: [1]",
            ":8:13: controller: must be a block of keys",
        ),
        ("d_per_s: 20", "carrier_hz: 60", ":8:32: controller.carrier_hz: unknown key"),
        (
            "reference: {kind: sine, amplitude_rad: 0.6, frequency_hz: 2}",
            "cutoff_hz: 20",
            ":8:13: controller.reference: missing",
        ),
        (
            "kind: sine",
            "kind: sinus",
            ":8:63: controller.reference.kind: must be one of constant, step, sin",
        ),
        (
            "frequency_hz: 2",
            "frequency_hz: 2, hold_s: 1",
            "controller.reference.hold_s: unknown key",
        ),
        (
            "amplitude_rad: 0.6",
            "amplitude_rad: 0.9",
            ":8:56: controller.reference: the reference reaches 5",
        ),
        (
            "amplitude_rad: 0.6",
            "amplitude_rad: 1.6",
            "must be a number from 0.001 to 1.5708, not 1.6",
        ),
        (
            "d_per_s: 20",
            "beyond_range: clip",
            ":8:46: controller.beyond_range: must be one of refuse, satur",
        ),
        (
            "kind: hall, span_rad: 0.8",
            "kind: ideal",
            ":7:9: sensor: `bits` is allowed only with `kind: hall`; set",
        ),
        (
            "amplitude_rel",
            "amplitude",
            ":13:14: expect[0].metric: unknown metric 'amplitude'",
        ),
    ],
)

LEARNING_MALFORMED = edited(
    LEARNING,
    [
        (
            "offset: 0.3",
            "offset: 0.31",
            ":5:52: controller.offset: must be a number from -0.3 to 0.3",
        ),
        (
            "offset: 0.3",
            "target: smallest",
            ":5:13: controller: `target` and `target_rad` are both set",
        ),
        (
            "target_rad: 0.7",
            "target: largest",
            "controller.target: must be smallest, not text 'largest'",
        ),
        (
            "k_per_rad: 0.3",
            "free_periods: 1.5",
            "controller.free_periods: must be a whole number from 1 to",
        ),
        (
            "k_per_rad: 0.3",
            "on_fault: ignore",
            "controller.on_fault: must be one of go_on, stop, not text",
        ),
        (
            "duration_s: 2",
            "duration_s: 2\nvalves: {layout: in_out}",
            "valves.layout: the controller `ilc` needs valves of",
        ),
        (
            "k_per_rad: 0.3",
            "reference: {kind: constant, bend_rad: 0.1}",
            "controller.reference: unknown key",
        ),
        (
            "duration_s: 2",
            "duration_s: 2\nfaults:"
            "\n- {kind: stuck_valve, segment: 1, chamber: plus, stuck: open}"
            "\n- {kind: stuck_valve, segment: 1, chamber: plus, stuck: closed, from_s: 1}"
            "\n- {kind: stuck_valve, segment: 1, chamber: plus, stuck: open}",
            ":7:3: faults[2]: this fault hides an earlier entry (stuck closed from 1 s)",
        ),
    ],
)

FOLLOWING_MALFORMED = edited(
    FOLLOWING,
    [
        (
            "x_m: 1.0, y_m: 0.2",
            "x_m: 0.59, y_m: 0.52",
            ":6:15: world.goal.x_m: (0.59, 0.52) is not free because of polygon 1 (3 corners",
        ),
        (
            "footprint: gen2_section52",
            "footprint: /dev/zero",
            "planner.footprint: /dev/zero: this is not a regular file",
        ),
        (
            "footprint: gen2_section52",
            "footprint: gen2",
            "planner.footprint: unknown footprint 'gen2'",
        ),
        ("footprint: gen2_section52, ", "", "planner.footprint: missing"),
        (
            "kind: best_first",
            "kind: best",
            "planner.kind: must be one of best_first, given",
        ),
        (
            "kind: best_first",
            "kind: ompl",
            (
                "planner.kind: must be one of best_first, given, not text"
                " 'ompl': it was retired"
            ),
        ),
        (
            "kind: best_first",
            "kind: greedy",
            (
                "planner.kind: must be one of best_first, given, not text"
                " 'greedy': it was retired"
            ),
        ),
        (
            "kind: best_first",
            "kind: given, turns_rad: [0], step_m: 1",
            "planner.nodes: unknown key; allowed: footprint, turn_fraction",
        ),
        ("nodes: 5000", "seconds: .inf", "planner.seconds: "),
        (
            "margin_m: 0.02",
            "margin_m: 0.5",
            "planner: footprint gen2_section52: left: 0.517 m reaches the centre",
        ),
        (
            "frequency_hz: 2.0",
            "frequency_hz: 2.0, offset: 0.1",
            "controller: the follower itself sets the offset",
        ),
        (
            "gait: {kind: gait, frequency_hz: 2.0}",
            "gait: {kind: hold_valves}",
            "controller.gait.kind: must be one of gait, ilc",
        ),
        (
            "follower: path",
            "follower: bearing",
            "controller: `lookahead_m` is allowed only with `follower: path`",
        ),
        (
            "lookahead_m: 0.15",
            "near_m: 0.15",
            "controller: `near_m` is allowed only with `follower: bearing`",
        ),
        (
            "[0.6, 0.5], [0.6, 0.6]",
            "[0.6, 0.6], [0.6, 0.5], [0.5, 0.6]",
            "world.polygons[0].corners_m: the polygon has crossing or overlapping"
            " sides",
        ),
        (", [0.6, 0.6]", "", "world.polygons[0].corners_m: "),
        ("[0.6, 0.6]", "[0.6, 0.6, 0.1]", "world.polygons[0].corners_m[2]"),
        ("[0.6, 0.6]", "[0.6, .nan]", "world.polygons[0].corners_m[2]"),
        (
            "radius_m: [0.02, 0.05]",
            "radius_m: [0.05, 0.02]",
            "world.random.radius_m: the radii are not ascending",
        ),
        (
            "count: 2",
            "kind: fig54, count: 19",
            "world.random: 19 obstacles do not fit; Fig. 54 has only 18 sites",
        ),
        (
            (
                "  goal: {x_m: 1.0, y_m: 0.2, heading_rad: 0.5, heading_tolerance_rad:"
                " 0.1, radius_m: 0.05}\n"
            ),
            "",
            "planner: the planner `best_first` needs a goal",
        ),
    ],
)
