"""Sweep files: a good one with published values, and malformed ones."""

from __future__ import annotations

from hostile_yaml import edited

GOOD = b"""\
title: Speed over frequency
scenario: gen2_straight
plants: [analytical]
periods: 8
fixed: {record_hz: 50}
vary:
  controller.frequency_hz: {from: 0.5, to: 3.0, count: 6}
  supply.pressure_kpa: [20.0, 30.0]
plots:
  - {kind: contour, x: controller.frequency_hz, y: supply.pressure_kpa, metric: com_speed_m_s}
beside:
  source: Fig. 0
  note: Read off the axes.
  at: {controller.frequency_hz: [0.5, 1], supply.pressure_kpa: [20, 30]}
  metrics: {com_speed_m_s: [0.1, null], yaw_rate_rad_s: [0, 0.5]}
"""

MALFORMED = edited(GOOD, {
    "published nowhere": ("source: Fig. 0", "note2: x", ":12:3: beside.source: missing; it must be text"),
    "published by nobody": ("source: Fig. 0", "source: ''", ":12:11: beside.source: must be text of 1 to 60"),
    "published in a book": ("Fig. 0", "F" * 61, ":12:11: beside.source: must be text of 1 to 60 characters"),
    "published at no field": (
        "at: {controller.frequency_hz: [0.5, 1], supply.pressure_kpa: [20, 30]}", "at: {}",
        ":14:7: beside.at: must be a block of keys"),
    "published at what is not varied": (
        "supply.pressure_kpa: [20, 30]}", "supply.presure_kpa: [20, 30]}",
        ":14:43: beside.at.supply.presure_kpa: is not varied; did you mean supply.pressure_kpa?"),
    "published at a text": (
        "[20, 30]", "[20, high]", ":14:69: beside.at.supply.pressure_kpa[1]: supply.pressure_kpa never is"),
    "published at true": ("[20, 30]", "[20, true]", "supply.pressure_kpa never is True; it is varied over"),
    "published at nothing": ("[20, 30]", "[20, null]", ":14:69: beside.at.supply.pressure_kpa[1]: must be"),
    "published at a list": ("[20, 30]", "[[20], 30]", ":14:65: beside.at.supply.pressure_kpa[0]: must be"),
    "a place too few": (
        "[20, 30]", "[20]",
        ":14:64: beside.at.supply.pressure_kpa: has 1 values, but controller.frequency_hz has 2"),
    "a place twice": (
        "at: {controller.frequency_hz: [0.5, 1], supply.pressure_kpa: [20, 30]}",
        "at: {controller.frequency_hz: [1, 1.0]}",
        ":14:7: beside.at: controller.frequency_hz 1 is given twice"),
    "a value too many": (
        "[0.1, null]", "[0.1, null, 3]",
        ":15:28: beside.metrics.com_speed_m_s: has 3 values, but controller.frequency_hz has 2"),
    "a metric nobody knows": (
        "com_speed_m_s: [", "com_sped_m_s: [", "unknown metric 'com_sped_m_s'; did you mean com_speed_m_s"),
    "a metric of the comparison": (
        "yaw_rate_rad_s: [", "com_speed_rel: [", ":15:41: beside.metrics.com_speed_rel: unknown metric"),
    "a metric that is no column": (
        "plots:", "metrics: [com_speed_m_s]\nplots:",
        ":16:41: beside.metrics.yaw_rate_rad_s: is not among the sweep's metrics; add it there"),
    "a published text": (
        "[0.1, null]", "[0.1, fast]", ":15:34: beside.metrics.com_speed_m_s[1]: must be a number from"),
    "a published infinity": ("[0.1, null]", "[0.1, .inf]", ":15:34: beside.metrics.com_speed_m_s[1]: must"),
    "a published truth": ("[0.1, null]", "[true, null]", ":15:29: beside.metrics.com_speed_m_s[0]: must be"),
    "no metrics": (
        "metrics: {com_speed_m_s: [0.1, null], yaw_rate_rad_s: [0, 0.5]}", "metrics: {}",
        ":15:12: beside.metrics: must be a block of keys"),
    "more than one source": ("beside:\n", "beside:\n  - 1\n", "not YAML"),
    "only words": ("note: Read off the axes.", "note: [a]", ":13:9: beside.note: must be text of 1 to 1000"),
})  # fmt: skip
