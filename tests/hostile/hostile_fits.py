"""Fit files and static tables that contradict themselves; good ones are made by hand."""

# ruff: noqa: E501 - one malformed file a line, as a table

from __future__ import annotations

from pathlib import Path

import numpy as np
from harness import Malformed
from hostile_yaml import edited
from hypothesis import strategies as st

from srs_twin import load_robot
from srs_twin.identification.actuator import StaticTable, read_static_table
from srs_twin.identification.estimate import FitEstimate, Parameter
from srs_twin.identification.fit_file import DataSet, FitFile, fit_file

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

FIT_MALFORMED: tuple[Malformed, ...] = edited(
    FIT,
    {
        "a number of what is not identifiable": ("not identifiable, why", "not identifiable, value: 0.1, why", "parameters[2].value: a parameter that is not identifiable has no value"),
        "no number of what is identified": ("value: 0.0966, ", "", "parameters[0].verdict: identified, but value is missing"),
        "half an interval": (", high: 0.0977", "", "parameters[0].verdict: identified, but high is missing"),
        "a value beyond its interval": ("value: 0.0966", "value: 0.2", ":12:66: parameters[0].value: must be between low and high, 0.0955 and 0.0977"),
        "an interval the wrong way round": ("low: 0.4, high: 0.9", "low: 0.9, high: 0.4", "parameters[1].value: must lie between"),
        "a verdict of one's own": ("verdict: identified", "verdict: certain", "parameters[0].verdict: must be one of identified, weakly identified, cannot tell, not identifiable, not text 'certain'"),
        "a parameter that no robot has": ("friction.mu_t", "friction.mu_x", "parameters[0].name: "),
        "a parameter without a number": ("connectors_kg_5, unit", "connectors_kg_0, unit", "parameters[2].name: "),
        "one parameter twice": ("friction.mu_n", "friction.mu_t", "parameters: friction.mu_t is listed 2 times"),
        "another unit": ('mu_t, unit: "1"', "mu_t, unit: N", "parameters[0].unit: must be 1, not N"),
        "the same data in both roles": ("b" * 64, "a" * 64, ":8:3: data: later.csv: the same data as pulls.csv"),
        "a role of one's own": ("role: validation", "role: test", "data[1].role: must be one of fit, validation, not text 'test'"),
        "nothing fitted": ("role: fit", "role: validation", "data: no data of role fit"),
        "a short hash": ("a" * 64, "a" * 63, "data[0].sha256: "),
        "a hash in capitals": ("a" * 64, "A" * 64, "data[0].sha256: "),
        "half a stretch": (", to_s: 5.0", "", "data[1]: from_s and to_s belong together"),
        "a stretch backwards": ("to_s: 5.0", "to_s: -5.0", "data[1].to_s: must be 0 or more"),
        "a correlation above 1": ("0.2, 1.0]]", "1.5, 1.0]]", "correlation[1][0]: must be a number from -1 to 1"),
        "a correlation that is not symmetric": ("0.2, 1.0]]", "0.3, 1.0]]", "correlation[1][0]: must be 0.2, as the matrix is symmetric"),
        "a correlation with itself of a half": ("[[1.0, 0.2]", "[[0.5, 0.2]", "correlation[0][0]: must be 1 on the diagonal"),
        "a correlation of another size": ("[[1.0, 0.2], [0.2, 1.0]]", "[[1.0]]", "correlation: must have 2 rows of 2"),
        "a negative error": ("standard_error: 0.1", "standard_error: -0.1", "parameters[1].standard_error: must be a number from 0"),
        "infinitely sure": ("standard_error: 0.1", "standard_error: .inf", "parameters[1].standard_error: must be a number from 0"),
        "yes, it converged": ("converged: true", "converged: yes", "quality.converged: must be true or false, not text 'yes'"),
        "no parameters": ("verdict: identified, value", "verdict: identified, valeu", "parameters[0].valeu: unknown key; did you mean value?"),
    },
)  # fmt: skip

SPEC = load_robot("gen4_module")
TABLE = b"pressure_plus_1_kpa,pressure_minus_1_kpa,bend_1_deg\n" + b"".join(
    b"%d,0,%d.5\n" % (5 * k, 5 * k) for k in range(8)
)

TABLE_MALFORMED: tuple[Malformed, ...] = (
    Malformed("words", b"just text\n", ":1: no column 'bend_1'"),
    Malformed("no bends", TABLE.replace(b"bend_1", b"bent_1"), ":1: no column 'bend_1'"),
    Malformed("a segment too many", TABLE.replace(b"bend_1", b"bend_2"), ":1:3: bend_2_deg: gen4_module has segments 1 to 1"),
    Malformed("an unknown unit", TABLE.replace(b"kpa", b"ata", 1), ":1:1: pressure_plus_1_ata: unit 'ata' is not known"),
    Malformed("a word", TABLE.replace(b"10,0", b"ten,0"), ":4:1: 'ten' is no number"),
    Malformed("a row without pressure", TABLE.replace(b"10,0", b",0"), ": pressures from -2e+06 to 2e+06 Pa are wanted, in every row"),
    Malformed("degrees as radians", TABLE.replace(b"_deg", b""), ": bends up to 6.28 rad are wanted; is the unit right (bend_1_deg)?"),
    Malformed("a header only", TABLE.split(b"\n")[0] + b"\n", ""),
)  # fmt: skip


def table(path: Path) -> StaticTable:
    """Read a table of one module."""
    return read_static_table(path, SPEC)


def same_tables(one: StaticTable, other: StaticTable) -> bool:
    """Say whether two tables hold the same bits."""
    return one.bend.tobytes() == other.bend.tobytes() and one.pressure.tobytes() == other.pressure.tobytes()


@st.composite
def fits(draw: st.DrawFn) -> FitFile:
    """Return any fit."""
    text = st.text(st.characters(codec="utf-8", exclude_categories=["Cc"]), min_size=1, max_size=40)
    names = draw(
        st.lists(
            st.sampled_from(["friction.mu_t", "friction.mu_n", "modules.gain_plus_3"]),
            min_size=1,
            unique=True,
        )
    )
    parameters = []
    for name in names:
        if draw(st.booleans()):
            parameters.append(Parameter(name, "1", "not identifiable", why=draw(text)))
            continue
        low, value, high = sorted(draw(st.tuples(*[st.floats(1e-9, 1e9)] * 3)))
        verdict = draw(st.sampled_from(["identified", "weakly identified"]))
        parameters.append(
            Parameter(name, "1", verdict, value, draw(st.floats(0, 1e9)), low, high, draw(text))
        )
    count = len(names)
    correlation = np.full((count, count), draw(st.floats(-1, 1)))
    np.fill_diagonal(correlation, 1.0)
    data = [
        DataSet(
            draw(text),
            f"{k:064x}",
            "fit" if k == 0 else draw(st.sampled_from(["fit", "validation"])),
            draw(st.integers(0, 10**9)),
        )
        for k in range(draw(st.integers(1, 4)))
    ]
    return fit_file(
        FitEstimate(tuple(parameters), correlation, samples=draw(st.integers(0, 10**9)), held={"mass_kg": draw(st.floats(-1e9, 1e9))}),
        name="any", title=draw(text), robot=draw(text), method="pulls", command=draw(text),
        versions={"srs_twin": draw(text)}, data=data,
    )  # fmt: skip
