"""Units of logs and markers in headers and maps: each is read correctly or refused."""

from __future__ import annotations

import json
import re
from functools import partial

import numpy as np
import pytest
from mcap.writer import Writer
from recorded import csv_text
from scipy import constants

from srs_twin import InputError, load_robot
from srs_twin.recordings.facts import in_words
from srs_twin.recordings.formats import read_markers
from srs_twin.recordings.formats.base import Unstated
from srs_twin.recordings.inspection import inspect_file
from srs_twin.recordings.recording_map import NO_MAP, RecordingMap, read_map
from srs_twin.recordings.signals.logs import read_bends, read_valves
from srs_twin.recordings.signals.units import (
    ANGLES,
    LENGTHS,
    PRESSURES,
    TIMES,
    is_absolute,
    is_clock,
    looks_absolute,
    stated_unit,
)

pytestmark = pytest.mark.fast

MODULE = load_robot("gen4_module")
RAW = np.array([0.0, 0.25, 1.0, 0.5])  # in the unit of a column


def log(folder, header, values=RAW, time=None):
    """Write a log of time, P1 and P2."""
    values = np.asarray(values)
    time = 0.1 * np.arange(len(values)) if time is None else time
    path = folder / "log.csv"
    rows = np.column_stack([time, values, 0 * values])
    path.write_text(csv_text([header], rows), encoding="utf-8")
    return path


def mapped(**keys):
    return read_map({"log": keys})


# Names of columns that state each unit; the last ones state none that is known.
PRESSURE_NAMES = {
    "": ["pressure", "Pa", "P1 ()"],
    "Pa": ["P1 (Pa)", "p1_pa", "PRESSURE_1_PA", "P1 (N/m²)"],
    "kPa": [
        "p_kPa",
        "P1kPa",
        "pressureKPa",
        "P1 (KPA)",
        "P1\u00a0(kPa)",
        "P1 (kPa gauge)",
        "P1 (Kilopascals)",
        "Pa (kPa)",
        "Pa_1 (kPa)",
    ],
    "bar": [
        "P1 [ Bar ]",
        "P1 {bar}",
        "P1(BAR)",
        "P1 bar",
        "P1/bar",
        "P1, barg",
        "P_bar_1",
        "PressureBar",
        "P1 (left) [bar]",
        "P0 bar [bar]",
    ],
    "MPa": ["P1_MPa", "P1 (N/mm^2)", "P1 N/mm2"],
    "mPa": ["P1 (mPa)"],
    "mbar": ["P1 (mbar)"],
    "hPa": ["P1 (hPa)"],
    "psi": ["P1 (PSI)", "P1_psig"],
    "atm": ["P1 (atm)"],
    "mmHg": ["P1 (Torr)"],
    None: [
        "P1 (mpa)",
        "Mpa_1",
        "P1 (Mbar)",
        "P1 (10 kPa)",
        "P1 (V)",
        "P1 (mH2O)",
        "P1 (deg)",
        "P_bar_kPa",
        "pressure_Pa (kPa)",
    ],
}
TIME_NAMES = {
    "": ["time", "t", "%time", "time since start"],
    "s": ["seconds", "Timestamp (sec)"],
    "ms": [
        "timeMs",
        "TIME_MS",
        "time\u00a0[ms]",
        "Time/ms",
        "absolute time_ms",
        "millis",
    ],
    "us": ["t[us]", "t (µs)", "t (μs)", "micros"],
    "ns": ["timestamp [nanoseconds]"],
    "min": ["time (min)"],
    None: ["time_ms (s)"],
}
ANGLE_NAMES = {
    "": ["bend_1"],
    "rad": ["bend_1_rad"],
    "mrad": ["bend_1 (mrad)"],
    "deg": ["bend_1_degrees", "bend (°)"],
    None: ["gyro (deg/s)"],
}


@pytest.mark.parametrize(
    ("units", "names"),
    [(PRESSURES, PRESSURE_NAMES), (TIMES, TIME_NAMES), (ANGLES, ANGLE_NAMES)],
)
def test_units_in_column_names(units, names):
    found = {name: stated_unit(name, units) for each in names.values() for name in each}
    assert found == {name: unit for unit, each in names.items() for name in each}


def test_units_have_the_factors_of_nist():
    pascals = {
        "Pa": 1,
        "hPa": 1e2,
        "mbar": 1e2,
        "kPa": 1e3,
        "bar": constants.bar,
        "MPa": 1e6,
        "mPa": 1e-3,
        "psi": constants.psi,
        "atm": constants.atm,
        "mmHg": constants.mmHg,
        "cmH2O": 10 * constants.g,
        "kgf/cm2": 1e4 * constants.g,
    }
    assert pytest.approx(pascals, rel=1e-6) == PRESSURES
    seconds = {"s": 1, "ms": 1e-3, "us": 1e-6, "ns": 1e-9, "min": constants.minute}
    assert pytest.approx(seconds) == TIMES
    assert pytest.approx({"rad": 1, "deg": constants.degree, "mrad": 1e-3}) == ANGLES
    metres = {"m": 1, "cm": 1e-2, "mm": 1e-3, "um": 1e-6}
    metres |= {"in": constants.inch, "ft": constants.foot}
    assert pytest.approx(metres) == LENGTHS


@pytest.mark.parametrize(
    ("key", "header", "pascals", "noted"),
    [
        ("pressure_Pa_plus_1", "P1 (MPa)", 1e6, True),
        ("pressure_kpa_plus_1", "P1, barg", 1e5, True),
        ("setpoint_psi_plus_1", "P1_psi", constants.psi, False),
    ],
)
def test_unit_in_the_header_has_precedence_over_the_key(
    tmp_path, key, header, pascals, noted
):
    path = log(tmp_path, f'time,"{header}",P2')
    given = mapped(**{key: header, key.replace("plus", "minus"): "P2"})
    found = read_valves(path, MODULE, given)
    assert found.values[:, 0, 0] == pytest.approx(pascals * RAW, rel=1e-6)
    assert any("as its name states" in note for note in found.corrections) == noted


def test_an_unknown_unit_is_refused_unless_the_map_gives_it(tmp_path):
    path = log(tmp_path, "time,P1 (mpa),P2")
    keys = {"pressure_kpa_minus_1": "P2"}
    with pytest.raises(
        InputError, match="the unit of the column .* is not known .*give it in the map"
    ):
        read_valves(path, MODULE, mapped(pressure_kpa_plus_1="P1 (mpa)", **keys))
    column = {"column": "P1 (mpa)", "unit": "mbar"}
    given = mapped(pressure_kpa_plus_1=column, **keys)
    assert read_valves(path, MODULE, given).values[2, 0, 0] == 100.0


@pytest.mark.parametrize(
    ("unit", "key", "factor"),
    [
        ("bar", "pressure_kpa_plus_1", 1e5),
        ("PSI", "pressure_plus_1", 6894.757),
        ("", "pressure_mbar_plus_1", 1e2),
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
    path.write_text("tip_x [cm],tip_y [cm],time\n" + "1,2,0\n" * 3)
    with pytest.raises(
        InputError,
        match=(
            r"'tip_x \[cm\]' is in cm according to its name, but in mm according to"
            r" the map or --units"
        ),
    ):
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


@pytest.mark.parametrize(
    ("name", "factor"),
    [("%time", 1), ("timeMs", 1e-3), ("timestamp_ns", 1e-9), ("time (min)", 60)],
)
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


@pytest.mark.parametrize(
    ("header", "keys", "factor"),
    [
        ("bend_1", {}, 1),
        ("bend_1_deg", {}, constants.degree),
        ("flex (mrad)", {"bend_1": "flex (mrad)"}, 1e-3),
        ("flex", {"bend_1": {"column": "flex", "unit": "°"}}, constants.degree),
        ("flex", {"bend_deg_1": "flex"}, constants.degree),
    ],
)
def test_unit_of_bends(tmp_path, header, keys, factor):
    raw = np.sin(np.arange(30))
    path = tmp_path / "bends.csv"
    path.write_text(csv_text(["time", header], np.column_stack([np.arange(30), raw])))
    found = read_bends(path, MODULE, longest_gap_s=0.2, map=mapped(**keys))
    assert found.trajectory["bend_1"] == pytest.approx(factor * raw, abs=1e-8)


ABSOLUTE = [
    "P_kPa_a",
    "P_kPa_a_1",
    "PSIA",
    "BARA",
    "P1 psiA",
    "P1 (psia)",
    "P1 (bar(a))",
    "P1 kPa (a)",
    "P1_mbara",
    "P1 (kPa abs)",
    "P0 kPa (abs)",
    "Pabs_kPa",
    "pAbs (kPa)",
    "pressureAbs_kPa",
    "PABS_KPA",
    "P_ABS_KPA",
    "P1abs (kPa)",
    "P0_kPaAbs",
    "P0_barabs",
    "pressureabs (kPa)",
    "absolute pressure (kPa)",
]
GAUGE = [
    "Labs_kPa",
    "tabs_kPa",
    "slabs (kPa)",
    "LABS (kPa)",
    "absorber_kPa",
    "P_kPa_A",
    "P_kPa_air",
    "P_bar_a1",
    "Pa_1 (kPa)",
]


def test_absolute_pressures_are_known_by_name():
    assert [
        name for name in ABSOLUTE + GAUGE if is_absolute(name, PRESSURES)
    ] == ABSOLUTE
    for name in ABSOLUTE:
        assert stated_unit(name, PRESSURES) is None, name
    for name in GAUGE:
        assert stated_unit(name, PRESSURES), name


def test_names_of_time_columns():
    times = [name for names in TIME_NAMES.values() for name in names]
    for name in (*times, "field.header.stamp", "#timestamp [ns]", "timeStamp"):
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


def test_pressures_near_those_of_the_air_look_absolute():
    found = [looks_absolute(np.array([low, 2e5])) for low in (69e3, 7e4, 1.1e5, 111e3)]
    assert found == [False, True, True, False]


@pytest.mark.parametrize("kpa", [-110.0, 2000.0])
def test_impossible_gauge_pressures_are_refused(tmp_path, kpa):
    header = "time,pressure_plus_1_kpa,pressure_minus_1_kpa"
    path = log(tmp_path, header, [0.0, kpa])
    assert read_valves(path, MODULE).values[1, 0, 0] == 1e3 * kpa
    path = log(tmp_path, header, [0.0, 1.01 * kpa])
    said = (
        rf"log.csv:3:2: .* {1.01e3 * kpa:g} Pa is not allowed; .* -110000 and 2e\+06 Pa"
    )
    with pytest.raises(InputError, match=said.replace("e+", r"e\+")):
        read_valves(path, MODULE)


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
    for line in (
        "400 rows, 100 rows per second, 3.99 s",
        "P1: unknown, 0 to 30, 1 openings per second (needs a map)",
        "note: a log of 3 signals, time in ms",
    ):
        assert line in in_words(facts)
    given = mapped(time="millis", pressure_kpa_plus_1="P1", pressure_kpa_minus_1="P2")
    assert read_valves(path, MODULE, given).time[-1] == pytest.approx(3.99)


@pytest.fixture(scope="module")
def bag(tmp_path_factory):
    """Return a bag whose topic /p contains arrays of two numbers as JSON."""
    path = tmp_path_factory.mktemp("bag") / "log.mcap"
    with path.open("wb") as stream:
        writer = Writer(stream)
        writer.start()
        schema = writer.register_schema("p", "jsonschema", b"{}")
        channel = writer.register_channel("/p", "json", schema)
        for k, value in enumerate(RAW):
            message = json.dumps({"data": [value, 0.0]}).encode()
            writer.add_message(channel, k * 10**8, message, k * 10**8)
        writer.finish()
    return path


@pytest.mark.parametrize(
    ("key", "plus", "factor"),
    [
        ("kpa_plus_1", {"column": "/p.data[0]", "unit": "bar"}, 1e5),
        ("plus_1", {"column": "/p.data[0]", "unit": "mbar"}, 1e2),
        ("MPa_plus_1", "/p.data[0]", 1e6),
    ],
)
def test_signals_of_a_bag_have_the_unit_of_the_map(bag, key, plus, factor):
    keys = {f"pressure_{key}": plus, "pressure_kpa_minus_1": "/p.data[1]"}
    found = read_valves(bag, MODULE, mapped(**keys))
    assert found.values[:, 0, 0] == pytest.approx(factor * RAW)


def test_a_signal_of_a_bag_without_a_unit_is_refused(bag):
    given = mapped(pressure_plus_1="/p.data[0]", pressure_minus_1="/p.data[1]")
    with pytest.raises(
        InputError, match=r"unit of the column '/p.data\[0\]' is not known"
    ):
        read_valves(bag, MODULE, given)
