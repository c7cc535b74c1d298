"""Plain tables of other programs: separators, decimal marks, comments, missing names, times since 1970."""

from __future__ import annotations

from dataclasses import replace
from decimal import Decimal
from io import StringIO

import numpy as np
import pandas as pd
import pytest
from recorded import SPEC, csv_text, motion, plain_csv, recorded, valve_csv
from synthetic_takes import Take

from srs_twin import InputError, load_robot
from srs_twin.cli import main
from srs_twin.recordings.formats import read_markers
from srs_twin.recordings.formats.base import Unstated, axis_columns
from srs_twin.recordings.inspection import inspect_file
from srs_twin.recordings.recorded_file import Dialect
from srs_twin.recordings.recording import read_motion
from srs_twin.recordings.recording_map import NO_MAP, read_map
from srs_twin.recordings.signals.clock import join
from srs_twin.recordings.signals.gaps import frame_grid
from srs_twin.recordings.signals.logs import read_valves

pytestmark = pytest.mark.fast

MODULE = load_robot("gen4_module")
FRAMES = 60
RATE = 100.0
TIME = np.arange(FRAMES) / RATE
ORIGIN_NS = 1_700_000_000_123_456_789
NAMES = [f"c{k}_{axis}" for k in range(1, 6) for axis in "xyz"]


def places():
    """Return five markers that crawl, shape (frames, 5, 3), m."""
    along = 0.09 * np.arange(5) + 0.04 * TIME[:, None]
    across = 0.05 * np.sin(12 * along - 6 * TIME[:, None])
    return np.stack([along, across, np.full_like(along, 0.03)], axis=-1)


def frame():
    return pd.DataFrame(places().reshape(FRAMES, -1), columns=NAMES)


def check(path, digits, scale=1.0, **given):
    """Compare a file with the motion: rate, duration, count, and positions to half the last digit."""
    table = read_markers(path, Unstated(**given))
    grid = frame_grid(table.time, table.points)
    assert len(table.time) == FRAMES and table.time[0] == 0
    assert 1 / grid.period == pytest.approx(RATE, rel=1e-4)
    assert table.time == pytest.approx(TIME, abs=1e-6)
    assert np.abs(table.points - places()).max() <= 0.5 * scale * 10.0**-digits + 1e-9
    return table


EPOCH_S = 1_700_000_000
NANOSECONDS = ORIGIN_NS + np.rint(1e9 * TIME).astype(np.int64)


@pytest.mark.parametrize(
    ("name", "time", "separator", "decimal", "epoch_ns"),
    [
        ("time", TIME, ",", ".", None),
        ("time_ms", np.rint(1e3 * TIME).astype(int), ";", ",", None),
        ("t [us]", np.rint(1e6 * TIME), "\t", ".", None),
        ("timestamp", EPOCH_S + TIME, ";", ".", EPOCH_S * 10**9),
        ("Time (ms)", 1e3 * EPOCH_S + np.rint(1e3 * TIME), "|", ".", EPOCH_S * 10**9),
        ("timestamp_ns", NANOSECONDS, "\t", ",", ORIGIN_NS),
        ("time", pd.to_datetime(NANOSECONDS, utc=True), ",", ".", ORIGIN_NS),
        ("time", pd.to_datetime(NANOSECONDS), ";", ",", ORIGIN_NS),
    ],
)
def test_tables_of_pandas_are_read(tmp_path, name, time, separator, decimal, epoch_ns):
    table = frame()
    table.insert(0, name, time)
    path = tmp_path / "x.csv"
    table.to_csv(path, sep=separator, decimal=decimal, float_format="%.9f")
    found = check(path, 9)
    assert found.epoch_ns == epoch_ns
    assert any("the times are in" in note for note in found.corrections) == (
        epoch_ns is not None
    )


@pytest.mark.parametrize(
    ("unit", "unit_ns"), [("s", 10**9), ("ms", 10**6), ("us", 10**3), ("ns", 1)]
)
def test_times_since_1970_keep_their_resolution(tmp_path, unit, unit_ns):
    """Steps of one unit in the last digit at 1.7e9 s are recovered exactly."""
    random = np.random.default_rng(1)
    steps_ns = np.cumsum(random.integers(9_900_000, 10_100_000, FRAMES))
    steps_ns -= steps_ns[0]
    table = frame()
    table.insert(
        0,
        f"timestamp_{unit}",
        [Decimal(ORIGIN_NS + int(step)) / unit_ns for step in steps_ns],
    )
    path = tmp_path / "x.csv"
    table.to_csv(path, index=False)
    found = read_markers(path)
    assert found.epoch_ns == ORIGIN_NS
    assert np.rint(found.time * 1e9).astype(int).tolist() == steps_ns.tolist()
    note = next(each for each in found.corrections if "1970" in each)
    assert note == (
        f"the times are in {unit} since 1970; 1700000000.123456789 s were subtracted"
    )


def text(separator=",", point=".", header=True, comments="", end="\n", bom=""):
    rows = [
        ",".join([f"{t:.3f}", *(f"{v:.6f}" for v in row)])
        for t, row in zip(TIME, places().reshape(FRAMES, -1), strict=True)
    ]
    lines = [",".join(["time", *NAMES])] if header else []
    body = end.join([*lines, *rows, ""])
    return (
        bom
        + comments
        + body.replace(",", "\0").replace(".", point).replace("\0", separator)
    )


COLUMNS = ("time", *NAMES)


@pytest.mark.parametrize(
    ("content", "dialect"),
    [
        (text(" \t "), {}),
        (text(";", ",", comments="sep=;\n"), {}),
        (text(";", ",", comments="# a; b\n\n"), {}),
        (text("\t", ",", end="\r\n", bom="\ufeff", comments="# x\r\n"), {}),
        (text(header=False), {"columns": COLUMNS}),
        (text(" ", ",", header=False), {"columns": COLUMNS}),
        (text(header=False, comments=f"# {','.join(COLUMNS)}\n"), {}),
        (text(), {"columns": COLUMNS}),
        (text("|", ","), {"separator": "|", "decimal": ","}),
        (
            text('","', ",")
            .replace("\n", '"\n"')
            .removesuffix('"')
            .replace("time", '"time', 1),
            {"decimal": ","},
        ),
    ],
    ids=range(10),
)
def test_layouts_are_detected_or_given(tmp_path, content, dialect):
    path = tmp_path / "x.csv"
    path.write_text(content, encoding="utf-8", newline="")
    check(path, 6, dialect=Dialect(**dialect))
    facts, _ = inspect_file(path, read_map(dialect), None)
    assert facts.frames == FRAMES and len(facts.markers) == 5


@pytest.mark.parametrize(
    ("content", "says"),
    [
        (
            text(header=False),
            ":1: the columns have no names, because the first line contains 16"
            " numbers; give --columns time,x_1,y_1,…",
        ),
        (
            text(comments="# a\n", header=False),
            ":2: the columns have no names, because the first line contains 16 numbers",
        ),
        (text(",", ","), ":2: the row has 32 cells, but the header has 16"),
        (
            "time;x_1;y_1\n" + "1,500;2,250;3,125\n" * 20,
            "may be decimal marks or thousands separators; give --decimal",
        ),
        (
            "time,x_1,y_1\n1,5;2,5;3,5\n",
            ":2: the row has 4 cells, but the header has 3",
        ),
        (text().replace("c2_x", "c1_x"), "two columns have the name 'c1_x'"),
        (
            text().replace("0.030000", '"0,030000"'),
            (
                "is not a number; give a number or leave the cell empty, or use"
                " --decimal ',' for"
            ),
        ),
    ],
    ids=range(7),
)
def test_ambiguous_tables_are_refused_with_a_remedy(tmp_path, content, says):
    path = tmp_path / "x.csv"
    path.write_text(content)
    with pytest.raises(InputError) as refused:
        read_markers(path)
    assert says in str(refused.value)


def test_layout_options_of_the_command(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "x.csv").write_text(text(";", ",", header=False))
    words = ["inspect", "x.csv", "--columns", ",".join(COLUMNS)]
    with pytest.raises(SystemExit) as left:
        main([*words, "--separator", ";", "--decimal", ","])
    said = capsys.readouterr().out
    assert left.value.code == 0 and "60 frames, 100 Hz" in said
    assert (
        "note: the cells are separated by semicolons, and decimal marks are commas"
    ) in said


def test_given_names_apply_only_to_files_without_names(tmp_path):
    path = tmp_path / "log.csv"
    path.write_text("time,valve_plus_1,valve_minus_1\n0,1,0\n1,0,1\n")
    found = read_valves(path, MODULE, read_map({"columns": ["time", "x_1", "y_1"]}))
    assert found.values[0, 0].tolist() == [1, -1]
    assert (
        "the file has column names, so the names in --columns or in the map are"
        " ignored" in found.corrections
    )


def test_rotations_and_rates_are_not_markers(tmp_path):
    for names in (
        "Rot {}",
        "acc_{}",
        "c1_acc2_{}",
        "gyro_{}",
        "q_{}",
        "imu.angular_velocity.{}",
        "orientation.{}",
        "vel_{}",
        "force_{}",
        "{}_acc",
        "linearAcceleration_{}",
        "c1 Euler {} (deg)",
        "v_{} (m/s)",
        "c1_{} [m s^-1]",
        "MagneticField_mag_{}",
        "q{}",
        "c9_{}_err",
    ):
        assert not axis_columns([names.format(axis) for axis in "xyz"]), names
    table = frame()
    table.insert(0, "time", TIME)
    more = ["c1_rot_x", "c1_rot_y", "c1_rot_z", "roll"]
    table[more] = 0.5
    path = tmp_path / "x.csv"
    table.to_csv(path, index=False, float_format="%.6f")
    found = check(path, 6)
    assert found.labels == tuple(f"c{k}" for k in range(1, 6))
    assert f"4 columns not used: {', '.join(more)}" in found.corrections


def test_a_position_with_two_units_needs_the_unit_of_the_map(tmp_path):
    rows = "".join(f"{k / 20},{k},0\n" for k in range(20))
    (tmp_path / "a.csv").write_text("time,x_1_mm (cm),y_1_mm\n" + rows)
    with pytest.raises(InputError, match=r"a.csv:1:2: .*two units, cm and mm"):
        read_markers(tmp_path / "a.csv")
    (tmp_path / "a.csv").write_text("time,x_1_mm (cm),y_1 (cm)\n" + rows)
    found = read_markers(tmp_path / "a.csv", Unstated(unit="cm"))
    assert found.points[1, 0].tolist() == [0.01, 0.0]


def test_markers_with_unusual_names_are_kept():
    names = [f"{name}_{axis}" for name in ("Motor", "rotor", "accu") for axis in "xy"]
    names += [
        "x_arm",
        "y_arm",
        "c1_xmm",
        "c1_ymm",
        "c2 X [cm]",
        "c2 Y [cm]",
        "c3[x] (mm)",
        "c3[y] (mm)",
    ]
    found = axis_columns(names)
    assert list(found) == ["Motor", "rotor", "accu", "arm", "c1", "c2", "c3"]
    assert [found[name]["x"].unit for name in ("arm", "c1", "c2", "c3")] == [
        "",
        "mm",
        "cm",
        "mm",
    ]


VALVES = "time,valve_plus_1,valve_minus_1\n"


@pytest.mark.parametrize(("unit", "name"), [(1, "time"), (10**6, "t_us")])
def test_logs_with_times_since_1970_are_read(tmp_path, unit, name):
    path = tmp_path / "log.csv"
    rows = [f"{(EPOCH_S + 0.5 * k) * unit:.1f},{k % 2},0\n" for k in range(9)]
    path.write_text(VALVES.replace("time", name) + "".join(rows))
    found = read_valves(path, MODULE)
    assert found.time == pytest.approx(0.5 * np.arange(9), abs=1e-9)
    assert found.epoch_ns == EPOCH_S * 10**9
    assert inspect_file(path, NO_MAP, None)[0].starts_s == EPOCH_S


def dated(folder, *zones):
    rows = (f"2026-03-01T12:00:0{k}.5{zone},1,0\n" for k, zone in enumerate(zones))
    (folder / "log.csv").write_text(VALVES + "".join(rows))
    return folder / "log.csv"


@pytest.mark.parametrize(
    ("zone", "hour"),
    [("", 12), ("Z", 12), ("+01:00", 11), ("-0530", 17.5), ("+01", 11)],
)
def test_dates_without_a_time_zone_are_in_utc(tmp_path, zone, hour):
    found = read_valves(dated(tmp_path, zone, zone, zone), MODULE)
    assert found.epoch_ns == (1_772_323_200 + 3600 * hour + 0.5) * 10**9
    assumed = "the times state no time zone, so UTC is assumed" in found.corrections
    assert assumed == (not zone)


@pytest.mark.parametrize(
    ("zones", "line"), [(["", "Z"], 3), (["Z", ""], 3), ([" AM", " AM"], 2)]
)
def test_dates_in_other_formats_are_refused(tmp_path, zones, line):
    said = rf"log.csv:{line}:1: '.*' is not a number or an allowed time; .* in none"
    with pytest.raises(InputError, match=said):
        read_valves(dated(tmp_path, *zones), MODULE)


def test_only_times_are_given_as_dates(tmp_path):
    (tmp_path / "log.csv").write_text(VALVES + "0,1,0\n1,state:on,0\n2,1,0\n")
    said = "log.csv:3:2: 'state:on' is not a number; give a number or leave the cell"
    with pytest.raises(InputError, match=said):
        read_valves(tmp_path / "log.csv", MODULE)


@pytest.mark.parametrize(
    "times",
    [
        [1.2e9 + 1e7 * k for k in range(20)],  # ns since a start
        [1.7e15 + 1e9 * k for k in range(20)],  # no unit fits
        [5e9 + k for k in range(20)],
        [1.7e12 + 100 * k for k in range(20)],  # ms since 1970, but not stated
    ],
)
def test_counters_are_not_times_since_1970(tmp_path, times):
    path = tmp_path / "log.csv"
    path.write_text(VALVES + "".join(f"{t:.0f},1,0\n" for t in times))
    with pytest.raises(
        InputError, match="their unit is probably not s; state the unit"
    ):
        read_valves(path, MODULE)


@pytest.fixture(scope="module")
def captured(tmp_path_factory):
    return recorded(tmp_path_factory.mktemp("take"), Take(layout="pair", lost=0.02))


def since_1970(start, end, origin):
    """Return a log of the valves of the motion with times since 1970."""
    head, *rows = valve_csv(motion(), start, end, 0.0).splitlines()
    cut = [row.split(",", 1) for row in rows]
    return "\n".join(
        [head, *(f"{origin + float(time):.3f},{rest}" for time, rest in cut), ""]
    )


def test_times_since_1970_in_both_files_give_the_offset(tmp_path, captured):
    path = tmp_path / "valves.csv"
    path.write_text(since_1970(1.0, 3.0, EPOCH_S))
    log = read_valves(path, SPEC)
    assert log.epoch_ns == (EPOCH_S + 1) * 10**9
    body = replace(captured, epoch_ns=EPOCH_S * 10**9)
    for offset, expected in ((None, 1.0), (0.0, 1.0), (-0.25, 0.75)):
        joined = join(body, log, SPEC, offset=offset)
        about = joined.trajectory.metadata["valve_log"]
        assert (
            about["offset_s"] == pytest.approx(expected, abs=1e-6)
            and not about["offset_estimated"]
        )
        assert any(
            "from times since 1970 in both files" in each
            for each in joined.summary.corrections
        )
    # The clocks differ by an hour, so the bends determine the offset.
    path.write_text(since_1970(0.0, 4.0, EPOCH_S + 3600))
    joined = join(body, read_valves(path, SPEC), SPEC)
    assert joined.trajectory.metadata["valve_log"]["offset_estimated"]
    assert any("differ by 3600 s" in each for each in joined.summary.corrections)


def test_epoch_of_a_motion_is_kept(tmp_path):
    path = tmp_path / "plain.csv"
    _, *names = plain_csv(motion()).partition("\n")[0].split(",")
    table = np.loadtxt(StringIO(plain_csv(motion())), delimiter=",", skiprows=1)
    table[:, 0] = np.rint(1e3 * table[:, 0]) + 1e3 * EPOCH_S
    path.write_text(csv_text(["time_ms", *names], table, 16))
    found = read_motion(path, SPEC)
    assert found.epoch_ns == EPOCH_S * 10**9
    assert found.trajectory.time[0] == pytest.approx(0)


def test_positions_in_pixels_need_a_scale(tmp_path):
    path = tmp_path / "video.csv"
    rows = "".join(f"{k / 50},{10 + k},20,{110 + k},20\n" for k in range(50))
    path.write_text("time,a_x,a_y,b_x,b_y\n" + rows)
    found = read_markers(path, Unstated(unit="px", scale_m=0.001))
    assert found.points[0].tolist() == [[0.01, 0.02], [0.11, 0.02]]
    with pytest.raises(
        InputError, match=r"video\.csv: the unit px needs the size of a pixel in m"
    ):
        read_markers(path, Unstated(unit="px"))


def test_a_cell_over_several_lines_is_refused_in_one_line(tmp_path):
    path = tmp_path / "take.csv"
    rows = '0.0,0,0,0.1,0\n0.1,"1\n0.2,0,0,0.1",0,0.1,0\n0.3,0,0,0.1,0\n'
    path.write_text(f"time,a_x,a_y,b_x,b_y\n{rows}")
    with pytest.raises(InputError, match="take.csv") as refused:
        read_markers(path)
    assert "\n" not in str(refused.value)
