"""Units of logs and markers in headers and maps: each is read correctly or refused."""

from __future__ import annotations

import json
import re
from functools import partial

import numpy as np
import pytest
from snakes import chain

from srs_twin import InputError, load_robot
from srs_twin.recordings.facts import in_words
from srs_twin.recordings.formats import read_markers
from srs_twin.recordings.formats.base import Unstated
from srs_twin.recordings.inspection import inspect_file
from srs_twin.recordings.recording_map import NO_MAP, RecordingMap, read_map
from srs_twin.recordings.signals.logs import read_bends, read_valves
from srs_twin.recordings.signals.units import (
    ANGLES,
    PRESSURES,
    TIMES,
    is_absolute,
    is_clock,
    stated_unit,
    symbol,
)
from srs_twin.recordings.takes import RecordingReader

pytestmark = pytest.mark.fast

MODULE = load_robot("gen4_module")
RAW = np.array([0.0, 0.25, 1.0, 0.5])  # in the unit of a column


def log(folder, header, values=RAW, time=None):
    """Write a log of time, P1 and P2."""
    time = 0.1 * np.arange(len(values)) if time is None else time
    path = folder / "log.csv"
    rows = "".join(
        f"{t!r},{v!r},0\n"
        for t, v in zip(map(float, time), map(float, values), strict=True)
    )
    path.write_text(header + "\n" + rows, encoding="utf-8")
    return path


def mapped(**keys):
    return read_map({"log": keys})


# NIST SP 811, independent of the table in the package.
PASCALS = {
    "Pa": 1,
    "hPa": 1e2,
    "mbar": 1e2,
    "kPa": 1e3,
    "bar": 1e5,
    "MPa": 1e6,
    "mPa": 1e-3,
    "psi": 6894.757,
    "atm": 101325,
    "mmHg": 133.3224,
}
HEADERS = {
    "P1 (bar)": "bar",
    "P1 [bar]": "bar",
    "P1 {bar}": "bar",
    "P1(BAR)": "bar",
    "P1 [ Bar ]": "bar",
    "P1_bar": "bar",
    "P1 bar": "bar",
    "P1/bar": "bar",
    "P1, barg": None,
    "P_bar_1": "bar",
    "P1 (barg)": "bar",
    "p_kPa": "kPa",
    "pressureKPa": "kPa",
    "P1kPa": "kPa",
    "P1 (kPa)": "kPa",
    "P1 (KPA)": "kPa",
    "P1\u00a0(kPa)": "kPa",
    "P1 (MPa)": "MPa",
    "P1_MPa": "MPa",
    "P1 (mPa)": "mPa",
    "P1 (N/mm²)": "MPa",
    "P1 (N/mm^2)": "MPa",
    "P1 N/mm2": "MPa",
    "P1 (N/m²)": "Pa",
    "P1 (mbar)": "mbar",
    "p_mbar": "mbar",
    "P1 (hPa)": "hPa",
    "P1 (psi)": "psi",
    "P1 (PSI)": "psi",
    "P1_psig": "psi",
    "P1 (atm)": "atm",
    "P1 (Torr)": "mmHg",
    "P1 (mmHg)": "mmHg",
    "P1 (Pa)": "Pa",
    "p1_pa": "Pa",
    "P1 (kPa gauge)": "kPa",
}


@pytest.mark.default_cases(9)
@pytest.mark.parametrize(("header", "unit"), HEADERS.items())
@pytest.mark.parametrize(
    "key", ["pressure_Pa_plus_1", "pressure_kpa_plus_1", "setpoint_psi_plus_1"]
)
def test_unit_in_the_header_has_precedence_over_the_key(tmp_path, header, unit, key):
    unit = unit or "bar"
    quoted = f'"{header}"' if "," in header else header
    scale = min(1.0, 1e6 / PASCALS[unit])
    path = log(tmp_path, f"time,{quoted},P2", RAW * scale)
    given = mapped(**{key: header, key.replace("plus", "minus"): "P2"})
    found = read_valves(path, MODULE, given)
    expected = PASCALS[unit] * scale * RAW
    assert found.values[:, 0, 0] == pytest.approx(expected, rel=1e-6)
    default = {"kpa": 1e3, "psi": 6894.757, "Pa": 1}[key.split("_")[1]]
    assert any("as its name states" in note for note in found.corrections) == (
        PASCALS[unit] != default
    )


@pytest.mark.default_cases(6)
@pytest.mark.parametrize(
    "header",
    [
        "P1 (bara)",
        "P1 (psia)",
        "P1 (kPa abs)",
        "P1 (mpa)",
        "P1 (Mbar)",
        "P1 (10 kPa)",
        "P1 (V)",
        "P1 (counts)",
        "P1 (mH2O)",
        "P1 (deg)",
        "P1_mpa",
        "P_bar_kPa",
    ],
)
def test_unknown_and_ambiguous_units_are_refused(tmp_path, header):
    path = log(tmp_path, f"time,{header},P2")
    with pytest.raises(
        InputError, match="the unit of the column .* is not known .*give it in the map"
    ):
        read_valves(
            path, MODULE, mapped(pressure_kpa_plus_1=header, pressure_kpa_minus_1="P2")
        )
    given = mapped(
        pressure_kpa_plus_1={"column": header, "unit": "mbar"},
        pressure_kpa_minus_1="P2",
    )
    assert read_valves(path, MODULE, given).values[2, 0, 0] == 100.0


@pytest.mark.parametrize(
    ("unit", "key", "factor"),
    [
        ("bar", "pressure_kpa_plus_1", 1e5),
        ("kPa", "pressure_plus_1", 1e3),
        ("PSI", "pressure_plus_1", 6894.757),
        ("MPa", "pressure_kpa_plus_1", 1e6),
        ("", "pressure_kpa_plus_1", 1e3),
        ("", "pressure_mbar_plus_1", 1e2),
        ("", "pressure_Pa_plus_1", 1.0),
        ("", "pressure_hpa_plus_1", 1e2),
        ("", "pressure_MPa_plus_1", 1e6),
    ],
)
def test_map_gives_the_unit_that_the_header_lacks(tmp_path, unit, key, factor):
    column = {"column": "P1", "unit": unit} if unit else "P1"
    found = read_valves(
        log(tmp_path, "time,P1,P2"),
        MODULE,
        mapped(**{key: column, "pressure_Pa_minus_1": "P2"}),
    )
    assert found.values[:, 0, 0] == pytest.approx(factor * RAW)


@pytest.mark.parametrize("kind", ["pressure", "setpoint"])
def test_pressure_without_a_stated_unit_is_refused(tmp_path, kind):
    given = mapped(**{f"{kind}_plus_1": "P1", f"{kind}_kpa_minus_1": "P2"})
    with pytest.raises(
        InputError,
        match=r"log.csv:1:2: the unit of the column 'P1' is not known .*give it",
    ):
        read_valves(log(tmp_path, "time,P1,P2"), MODULE, given)


@pytest.mark.parametrize(
    ("read", "names"),
    [
        (read_valves, "pressure_plus_1 (kPa),pressure_minus_1"),
        (read_valves, "duty_plus_1 (%),duty_minus_1"),
        (partial(read_bends, longest_gap_s=0.2), "bend_1_deg,bend_2"),
        (lambda path, _: read_markers(path), "x_1_mm,y_1"),
        (lambda path, _: read_markers(path), "tip_x (cm),tip_y"),
    ],
)
def test_a_unit_on_some_columns_only_is_refused(tmp_path, read, names):
    first, second = names.split(",")
    said = f"log.csv:1:3: the column '{second}' has no unit, but '{first}' is in"
    with pytest.raises(InputError, match=re.escape(said)):
        read(log(tmp_path, f"time,{names}"), MODULE)


def test_conflict_of_header_and_map_names_both_units(tmp_path):
    path = log(tmp_path, "time,P1 (bar),P2")
    given = mapped(
        pressure_plus_1={"column": "P1 (bar)", "unit": "kpa"}, pressure_Pa_minus_1="P2"
    )
    with pytest.raises(
        InputError,
        match=r":1:2: the unit of the column 'P1 \(bar\)' is bar according to its"
        r" name, but kPa according to the map",
    ):
        read_valves(path, MODULE, given)
    path.write_text("x_1 (cm),y_1 (cm),time\n" + "1,2,0\n" * 3)
    with pytest.raises(
        InputError,
        match=(
            r"'x_1 \(cm\)' is in cm according to its name, but in mm according to the"
            r" map or --units"
        ),
    ):
        read_markers(path, Unstated(unit="mm"))
    path.write_text("tip_x [cm],tip_y [cm],time\n" + "1,2,0\n" * 3)
    with pytest.raises(InputError, match="is in cm according to its name, but in mm"):
        read_markers(path, Unstated(unit="mm"))
    assert read_markers(path, Unstated(unit="cm")).points[0, 0].tolist() == [0.01, 0.02]


def test_chambers_called_pa_and_pb_have_no_unit(tmp_path):
    given = mapped(pressure_kpa_plus_1="PA", pressure_kpa_minus_1="PB")
    assert (
        read_valves(log(tmp_path, "time,PA,PB"), MODULE, given).values[2, 0, 0] == 1e3
    )


@pytest.mark.parametrize(
    ("data", "said"),
    [
        (
            {"pressure_plus_1": {"column": "P1", "unit": "mpa"}},
            "unknown unit 'mpa'; allowed units: Pa, kPa, bar",
        ),
        ({"pressure_mpa_plus_1": "P1"}, "unknown unit 'mpa'"),
        ({"valve_bar_plus_1": "P1"}, "unknown unit 'bar'; allowed units: none"),
        (
            {"time": {"column": "t", "unit": "kPa"}},
            "unknown unit 'kPa'; allowed units: s, ms",
        ),
        ({"ambient_kpa": "P1"}, "the value must be a number"),
        ({"pressure_plus_1": {"column": "P1", "units": "bar"}}, "units"),
    ],
)
def test_units_of_a_map_are_checked_before_a_file_is_read(data, said):
    with pytest.raises(InputError) as refused:
        read_map({"log": data})
    assert said in str(refused.value)


SECONDS = {
    "time": 1,
    "t": 1,
    "Time (s)": 1,
    "time_ms": 1e-3,
    "Time (ms)": 1e-3,
    "Time [ms]": 1e-3,
    "t[us]": 1e-6,
    "t (µs)": 1e-6,
    "t (μs)": 1e-6,
    "millis": 1e-3,
    "micros": 1e-6,
    "timestamp_ns": 1e-9,
    "timeMs": 1e-3,
    "Timestamp (sec)": 1,
    "Elapsed Time (ms)": 1e-3,
    "seconds": 1,
    "time (min)": 60,
    "TIME_MS": 1e-3,
    "time\u00a0[ms]": 1e-3,
    "timestamp [nanoseconds]": 1e-9,
    "Time/ms": 1e-3,
    "%time": 1,
}


@pytest.mark.default_cases(at=[0, 3, 6, 10, 14, 18, 21, 29])
@pytest.mark.parametrize(("name", "factor"), SECONDS.items())
@pytest.mark.parametrize("by_map", [False, True])
def test_unit_of_the_time(tmp_path, name, factor, by_map):
    path = log(
        tmp_path,
        f"{name},pressure_plus_1_kpa,pressure_minus_1_kpa",
        time=np.array([0.0, 1, 2, 4]),
    )
    found = read_valves(path, MODULE, mapped(time=name) if by_map else NO_MAP)
    assert found.time == pytest.approx(factor * np.array([0, 1, 2, 4]), rel=1e-12)


def test_unit_of_the_time_in_a_map(tmp_path):
    header = "clk,pressure_plus_1_kpa,pressure_minus_1_kpa"
    path = log(tmp_path, header, time=np.array([0.0, 10, 20, 30]))
    found = read_valves(path, MODULE, mapped(time={"column": "clk", "unit": "ms"}))
    assert found.time == pytest.approx([0, 0.01, 0.02, 0.03])
    with pytest.raises(
        InputError, match="is ms according to its name, but us according to the map"
    ):
        read_valves(
            log(tmp_path, header.replace("clk", "clk_ms")),
            MODULE,
            mapped(time={"column": "clk_ms", "unit": "us"}),
        )


RADIANS = {
    "": 1,
    "rad": 1,
    "deg": np.pi / 180,
    "mrad": 1e-3,
    "degrees": np.pi / 180,
    "°": np.pi / 180,
}


@pytest.mark.default_cases(at=[0, 4, 8, 17, 19, 27])
@pytest.mark.parametrize(("unit", "factor"), RADIANS.items())
@pytest.mark.parametrize("way", ["header", "brackets", "map", "map unit", "key"])
def test_unit_of_bends(tmp_path, unit, factor, way):
    raw = 0.5 * np.sin(np.arange(30)) / (factor if unit else 1)
    names = {
        "header": f"bend_1_{unit}" if unit and unit != "°" else "bend_1",
        "brackets": f"bend_1 ({unit or 'rad'})",
        "map": f"flex ({unit or 'rad'})",
        "map unit": "flex",
        "key": "flex",
    }
    if way == "header" and unit == "°":
        raw = np.sin(np.arange(30))
        factor = 1
    log_keys = {
        "map": {"bend_1": names[way]},
        "map unit": {"bend_1": {"column": "flex", "unit": unit or "rad"}},
        "key": {f"bend_{symbol(unit, ANGLES) or 'rad'}_1": "flex"},
    }
    path = tmp_path / "bends.csv"
    path.write_text(
        f"time,{names[way]}\n"
        + "".join(f"{0.01 * k:.2f},{v!r}\n" for k, v in enumerate(map(float, raw)))
    )
    found = read_bends(
        path, MODULE, longest_gap_s=0.2, map=mapped(**log_keys.get(way, {}))
    )
    assert found.trajectory["bend_1"] == pytest.approx(factor * raw, abs=1e-12)


@pytest.mark.parametrize(
    ("name", "units", "unit"),
    [
        ("timeMs", TIMES, "ms"),
        ("time since start", TIMES, ""),
        ("Pa", PRESSURES, ""),
        ("PRESSURE_1_PA", PRESSURES, "Pa"),
        ("P1 ()", PRESSURES, ""),
        ("P1 (left) [bar]", PRESSURES, "bar"),
        ("bend (°)", ANGLES, "deg"),
        ("gyro (deg/s)", ANGLES, None),
        ("pressure", PRESSURES, ""),
        ("PressureBar", PRESSURES, "bar"),
        ("Mpa_1", PRESSURES, None),
        ("P1 (Kilopascals)", PRESSURES, "kPa"),
        ("P0_kPa (bar)", PRESSURES, None),
        ("P0 bar [bar]", PRESSURES, "bar"),
        ("Pa (kPa)", PRESSURES, "kPa"),
        ("P0 kPa abs", PRESSURES, None),
        ("P0 kPa (abs)", PRESSURES, None),
        ("Pabs_kPa", PRESSURES, None),
        ("pAbs (kPa)", PRESSURES, None),
        ("PABS_KPA", PRESSURES, None),
        ("P1_psia", PRESSURES, None),
        ("absorber_kPa", PRESSURES, "kPa"),
        ("absolute time_ms", TIMES, "ms"),
        ("pressure_Pa (kPa)", PRESSURES, None),
        ("Pa_1 (kPa)", PRESSURES, "kPa"),
        ("time_ms (s)", TIMES, None),
    ],
)
def test_units_in_column_names(name, units, unit):
    assert stated_unit(name, units) == unit


@pytest.mark.parametrize(
    ("name", "absolute"),
    [
        ("P_kPa_a", True),
        ("P_kPa_a_1", True),
        ("PSIA", True),
        ("BARA", True),
        ("P1 psiA", True),
        ("P1 bar(a)", True),
        ("P1 (bar(a))", True),
        ("P1 kPa (a)", True),
        ("P1_mbara", True),
        ("Pabs_kPa", True),
        ("pabs_kPa", True),
        ("pAbs (kPa)", True),
        ("pressureAbs_kPa", True),
        ("PABS_KPA", True),
        ("P_ABS_KPA", True),
        ("P1abs (kPa)", True),
        ("P0_kPaAbs", True),
        ("P0_kPaabs", True),
        ("P0_barabs", True),
        ("pressureabs (kPa)", True),
        ("absolute pressure (kPa)", True),
        ("Labs_kPa", False),
        ("tabs_kPa", False),
        ("slabs (kPa)", False),
        ("LABS (kPa)", False),
        ("absorber_kPa", False),
        ("P_kPa_A", False),
        ("P_kPa_air", False),
        ("P_bar_a1", False),
        ("Pa_1 (kPa)", False),
    ],
)
def test_absolute_pressures_are_known_by_name(name, absolute):
    assert is_absolute(name, PRESSURES) == absolute
    if absolute:
        assert stated_unit(name, PRESSURES) is None


@pytest.mark.parametrize("name", ["Labs_kPa", "tabs_kPa", "slabs (kPa)"])
def test_names_that_contain_abs_state_their_unit(name):
    assert stated_unit(name, PRESSURES) == "kPa"


def test_names_of_time_columns():
    for name in (*SECONDS, "field.header.stamp", "#timestamp [ns]", "timeStamp"):
        assert is_clock(name.lstrip("#")), name
    for name in (
        "clock",
        "time_to_contact",
        "t1",
        "x",
        "s",
        "min",
        "bend_1",
        "P1 (ms)",
        "timer",
        "rate",
    ):
        assert not is_clock(name), name


def facts_of(path, text, **known):
    path.write_text(text)
    return inspect_file(path, RecordingMap(**known), None)[0]


@pytest.mark.parametrize(
    ("column", "values", "said"),
    [
        ("P1 (MPa)", [0.0, 0.03], "pressure, MPa: 0 to 30 kPa"),
        ("P1 (mbar)", [0.0, 300.0], "pressure, mbar: 0 to 30 kPa"),
        ("P1_psi", [0.0, 4.4], "pressure, psi: 0 to 30.3"),
        ("P1 (bar)", [0.0, 1.0], "pressure, bar: 0 to 100 kPa"),
        ("P1", [101.0, 131.0], "unknown"),
        ("bend_1_deg", [0.0, 1.0], "angle, deg"),
        ("pressure", [0.0, 0.3], "unknown"),
    ],
)
def test_inspect_prefers_units_in_the_header(tmp_path, column, values, said):
    rows = "".join(f"{k},{value}\n" for k, value in enumerate((*values, values[0])))
    facts = facts_of(tmp_path / "log.csv", f"time,{column}\n{rows}")
    assert facts.signals[0].looks_like.startswith(said)


def test_absolute_pressures_are_noted_and_converted(tmp_path):
    path = log(tmp_path, "time,pressure_plus_1_kpa,P2 (kPa)", 101.3 + 30 * RAW)
    path.write_text(path.read_text().replace(",0\n", ",101.3\n"))
    keys = {"pressure_minus_1": "P2 (kPa)"}
    hint = (
        r"the smallest pressure is 101.3 kPa. The pressures look absolute;"
        r" .*ambient_kpa: 101.3"
    )
    assert any(
        hint[:30] in note
        for note in read_valves(path, MODULE, mapped(**keys)).corrections
    )
    found = read_valves(path, MODULE, mapped(**keys, ambient_kpa=101.3))
    assert found.values[:, 0, 0] == pytest.approx(3e4 * RAW, abs=1e-6)
    assert found.values[:, 0, 1] == pytest.approx(0, abs=1e-6)
    assert (
        "the pressures are absolute, so 101.3 kPa were subtracted" in found.corrections
    )


def test_absolute_pressures_by_name_are_refused_with_the_remedy(tmp_path):
    path = log(tmp_path, "time,Pabs_kPa,P2 (kPa)", 101.3 + 30 * RAW)
    given = mapped(pressure_kpa_plus_1="Pabs_kPa", pressure_minus_1="P2 (kPa)")
    with pytest.raises(InputError, match="absolute pressure, so .* ambient_kpa: 101.3"):
        read_valves(path, MODULE, given)
    given.log["pressure_kpa_plus_1"] = {"column": "Pabs_kPa", "unit": "kPa"}
    for ambient in ({}, {"ambient_kpa": 101.3}):
        notes = read_valves(path, MODULE, mapped(**given.log, **ambient)).corrections
        noted = any("'Pabs_kPa' states an absolute pressure" in note for note in notes)
        assert noted == (not ambient)


def test_log_of_a_microcontroller(tmp_path):
    path = tmp_path / "log.csv"
    rows = "".join(
        f"{10 * k},{30 * (k // 50 % 2)},0,{512 + k % 7}\n" for k in range(400)
    )
    facts = facts_of(path, f"millis,P1,P2,flex\n{rows}")
    assert (facts.content, len(facts.signals), facts.rows) == ("log", 3, 400)
    assert facts.duration_s == pytest.approx(3.99) and facts.rate_hz == pytest.approx(
        100
    )
    assert "note: a log of 3 signals, time in ms" in in_words(facts)
    given = mapped(time="millis", pressure_kpa_plus_1="P1", pressure_kpa_minus_1="P2")
    assert read_valves(path, MODULE, given).time[-1] == pytest.approx(3.99)


def test_duties_in_per_cent_are_recognised_by_name(tmp_path):
    path = log(
        tmp_path,
        "time,duty_plus_1 (%),duty_minus_1 (%)",
        np.array([0.0, 0.5, 1.0, 0.0]),
    )
    found = read_valves(path, MODULE, read_map({"log": {"carrier_hz": 10.0}}))
    assert (
        found.at(np.arange(0.1005, 0.2, 0.001))[:, 0, 0] == 1
    ).sum() <= 1  # half a per cent


def test_signals_of_a_bag_have_the_unit_of_the_map(tmp_path):
    from mcap.writer import Writer

    path = tmp_path / "log.mcap"
    with path.open("wb") as stream:
        writer = Writer(stream)
        writer.start()
        channel = writer.register_channel(
            "/p", "json", writer.register_schema("p", "jsonschema", b"{}")
        )
        for k, value in enumerate(RAW):
            writer.add_message(
                channel,
                k * 10**8,
                json.dumps({"data": [value, 0.0]}).encode(),
                k * 10**8,
            )
        writer.finish()
    spec = chain((0.03, 0.03))
    for key, unit, factor in (
        ("kpa_", "bar", 1e5),
        ("kpa_", "", 1e3),
        ("", "mbar", 1e2),
        ("MPa_", "", 1e6),
    ):
        plus = {"column": "/p.data[0]", "unit": unit} if unit else "/p.data[0]"
        given = mapped(
            **{f"pressure_{key}plus_1": plus, "pressure_kpa_minus_1": "/p.data[1]"}
        )
        found = read_valves(path, spec, given)
        assert found.values[:, 0, 0] == pytest.approx(factor * RAW)
    given = mapped(pressure_plus_1="/p.data[0]", pressure_minus_1="/p.data[1]")
    with pytest.raises(
        InputError, match=r"unit of the column '/p.data\[0\]' is not known"
    ):
        read_valves(path, spec, given)


@pytest.mark.parametrize("names", ["P{} (bar)", "pressure_{}_1_bar"])
def test_bench_log_in_bar_contains_30_kpa(tmp_path, names):
    header = [
        names.format(side) for side in ((1, 2) if "P{}" in names else ("plus", "minus"))
    ]
    time = 0.01 * np.arange(200)
    rows = [f"{t:.2f},{10 * np.sin(6 * t):.4f},{0.3 * (t > 0.5):.3f},0\n" for t in time]
    path = tmp_path / "bar.csv"
    path.write_text(f"time,bend_1_deg,{','.join(header)}\n{''.join(rows)}")
    given = (
        mapped(pressure_kpa_plus_1=header[0], pressure_kpa_minus_1=header[1])
        if "P{}" in names
        else NO_MAP
    )
    found = RecordingReader(map=given).take(str(path), str(path), MODULE).trajectory
    assert (
        found["pressure_plus_1"][-1] == pytest.approx(3e4)
        and found["pressure_plus_1"][0] == 0
    )
    assert found["bend_1"].max() == pytest.approx(np.radians(10), rel=1e-3)
