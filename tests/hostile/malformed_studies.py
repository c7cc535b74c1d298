"""Sweep files and fit files, and malformed versions of each."""

# ruff: noqa: E501 - one malformed file per line, as a table
from __future__ import annotations

from malformed_yaml import edited

SWEEP = b"""\
title: Speed over frequency
scenario: gen2_straight
plants: [analytical]
periods: 8
fixed: {record_hz: 50}
vary:
  controller.frequency_hz: {from: 0.5, to: 3.0, count: 6}
  supply.pressure_kpa: [20.0, 30.0]
plots:
  - {kind: line, x: controller.frequency_hz, metric: com_speed_m_s, by: supply.pressure_kpa}
"""

FIT = f"""\
name: pulls
title: Spring car, first floor
robot: gen1
method: pulls
command: srs-twin calibrate friction pulls.csv
versions: {{srs_twin: 0.1.0, numpy: 2.4.6}}
data:
  - {{name: pulls.csv, sha256: {"a" * 64}, role: fit, samples: 20}}
  - {{name: later.csv, sha256: {"b" * 64}, role: validation, samples: 10, from_s: 0.0, to_s: 5.0}}
held: {{mass_kg: 1.0}}
parameters:
  - {{name: friction.mu_t, unit: "1", verdict: identified, value: 0.0966, standard_error: 0.0005, low: 0.0955, high: 0.0977}}
  - {{name: friction.mu_n, unit: "1", verdict: weakly identified, value: 0.68, standard_error: 0.1, low: 0.4, high: 0.9, why: few}}
  - {{name: mass.connectors_kg_5, unit: kg, verdict: not identifiable, why: nothing depends on it}}
correlation: [[1.0, 0.2], [0.2, 1.0]]
cancels: [{{mass.connectors_kg_5: 1.0}}]
quality: {{samples: 20, independent_samples: 20.0, rms: 1.0, converged: true}}
""".encode()

SWEEP_MALFORMED = edited(
    SWEEP,
    [
        (
            "plots:",
            "beside: {source: Fig. 0}\nplots:",
            ":9:1: beside: unknown key: it was retired; `srs-twin reproduce`",
        ),
        (
            "kind: line",
            "kind: contour",
            "'contour': it was retired; use the kind `line`",
        ),
        ("plots:\n", "plots:\n  x: 1\n", "not YAML"),
    ],
)

FIT_MALFORMED = edited(
    FIT,
    [
        (
            "not identifiable, why",
            "not identifiable, value: 0.1, why",
            "parameters[2].value: a parameter that is not identifiable must not have"
            " a value",
        ),
        (
            "value: 0.0966, ",
            "",
            "parameters[0].verdict: the parameter has the verdict 'identified', but"
            " `value` is missing",
        ),
        (
            ", high: 0.0977",
            "",
            "parameters[0].verdict: the parameter has the verdict 'identified', but"
            " `high` is missing",
        ),
        (
            "value: 0.0966",
            "value: 0.2",
            (
                ":12:66: parameters[0].value: must be between `low` and `high`, which"
                " are 0.0955 and 0.0977"
            ),
        ),
        (
            "low: 0.4, high: 0.9",
            "low: 0.9, high: 0.4",
            "parameters[1].value: must be between",
        ),
        (
            "verdict: identified",
            "verdict: certain",
            (
                "parameters[0].verdict: must be one of identified, weakly identified,"
                " cannot tell, not identifiable, not text 'certain'"
            ),
        ),
        ("friction.mu_t", "friction.mu_x", "parameters[0].name: "),
        ("connectors_kg_5, unit", "connectors_kg_0, unit", "parameters[2].name: "),
        (
            "friction.mu_n",
            "friction.mu_t",
            "parameters: the parameter friction.mu_t is listed 2 times; list it once",
        ),
        ('mu_t, unit: "1"', "mu_t, unit: N", "parameters[0].unit: must be 1, not N"),
        (
            "role: validation",
            "role: test",
            "data[1].role: must be one of fit, validation, not text 'test'",
        ),
        ("role: fit", "role: validation", "data: no data set has the role `fit`"),
        ("a" * 64, "a" * 63, "data[0].sha256: "),
        (", to_s: 5.0", "", "data[1]: `from_s` and `to_s` belong together"),
        (
            "to_s: 5.0",
            "to_s: -5.0",
            "data[1].to_s: must be at least 0, the value of `from_s`",
        ),
        (
            "0.2, 1.0]]",
            "1.5, 1.0]]",
            "correlation[1][0]: must be a number from -1 to 1",
        ),
        (
            "0.2, 1.0]]",
            "0.3, 1.0]]",
            "correlation[1][0]: must be 0.2, because a correlation matrix is symmetric",
        ),
        (
            "[[1.0, 0.2]",
            "[[0.5, 0.2]",
            "correlation[0][0]: must be 1, because it is on the diagonal",
        ),
        ("[[1.0, 0.2], [0.2, 1.0]]", "[[1.0]]", "correlation: must be a 2 × 2 matrix"),
        (
            "standard_error: 0.1",
            "standard_error: -0.1",
            "parameters[1].standard_error: must be a number from 0",
        ),
        (
            "converged: true",
            "converged: yes",
            "quality.converged: must be true or false, not text 'yes'",
        ),
        (
            "verdict: identified, value",
            "verdict: identified, valeu",
            "parameters[0].valeu: unknown key; did you mean value?",
        ),
    ],
)
