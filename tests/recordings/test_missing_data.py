"""Cells, positions and line ends that mean missing data, and rates and quantities that are not guessed."""

from __future__ import annotations

import numpy as np
import pytest

from srs_twin import load_robot
from srs_twin.errors import InputError
from srs_twin.recordings.formats import read_markers
from srs_twin.recordings.inspection import inspect_file
from srs_twin.recordings.recording_map import NO_MAP, RecordingMap
from srs_twin.recordings.signals.logs import read_valves

TRC = (
    "PathFileType\t4\t(X/Y/Z)\tx.trc\n"
    "DataRate\tNumFrames\tNumMarkers\tUnits\n"
    "100\t20\t2\tmm\n"
    "Frame#\tTime\ta\t\t\tb\t\t\n"
    "\t\tX1\tY1\tZ1\tX2\tY2\tZ2\n"
)


def trc(cells=None, *, ends="", first="PathFileType\t4"):
    """Return a TRC file whose marker b has the given cells on the frames 5 to 9."""
    rows = []
    for k in range(20):
        b = cells if cells is not None and 5 <= k < 10 else f"{k}\t2\t30"
        rows.append(f"{k + 1}\t{k / 100}\t{k + 50}\t1\t30\t{b}{ends}")
    return TRC.replace("PathFileType\t4", first) + "\n".join(rows) + "\n"


def csv(cells, separator=","):
    rows = [separator.join(["time", "a_x", "a_y", "a_z", "b_x", "b_y", "b_z"])]
    for k in range(20):
        b = cells if 5 <= k < 10 else [f"0.{k:02d}", "0.5", "0.03"]
        rows.append(separator.join([f"{k / 100}", "0.3", "0.2", "0.03", *b]))
    return "\n".join(rows) + "\n"


def written(folder, name, text):
    path = folder / name
    path.write_bytes(text if isinstance(text, bytes) else text.encode())
    return path


def hidden(path):
    """Return the frames on which marker b is missing."""
    table = read_markers(path)
    return np.flatnonzero(np.isnan(table.points[:, 1, 0])).tolist()


@pytest.mark.default_cases(3)
@pytest.mark.parametrize("blank", [" ", "   ", ""])
@pytest.mark.parametrize("separator", [",", ";", "\t"])
def test_a_cell_of_spaces_is_empty(tmp_path, blank, separator):
    path = written(tmp_path, "a.csv", csv([blank] * 3, separator))
    assert hidden(path) == [5, 6, 7, 8, 9]
    path = written(tmp_path, "b.trc", trc("\t".join([blank] * 3)))
    assert hidden(path) == [5, 6, 7, 8, 9]


def test_a_cell_of_spaces_in_a_log_is_empty(tmp_path):
    rows = [f"{k / 100},{' ' if k == 3 else 0.5}" for k in range(10)]
    path = written(tmp_path, "log.csv", "time,force\n" + "\n".join(rows) + "\n")
    facts, _ = inspect_file(path, NO_MAP, None)
    assert facts.signals[0].looks_like == "unknown" and facts.signals[0].low == 0.5


def test_text_among_spaces_is_still_refused(tmp_path):
    path = written(tmp_path, "a.csv", csv([" ", " x ", " "]))
    with pytest.raises(InputError, match=r"a\.csv:7:6: 'x' is not a number"):
        read_markers(path)


def test_repeated_zeros_are_a_hidden_marker(tmp_path):
    table = read_markers(written(tmp_path, "a.trc", trc("0.000\t0.0\t0")))
    assert (
        np.isnan(table.points[5:10, 1]).all() and np.isfinite(table.points[:, 0]).all()
    )
    assert any(
        "5 positions are exactly 0, 0, 0 and are read as missing" in note
        for note in table.corrections
    )


def test_odometry_may_begin_at_the_origin(tmp_path):
    rows = [f"{k / 10} {max(0.0, k - 5) / 10} 0 0 0 0 0 1" for k in range(20)]
    table = read_markers(written(tmp_path, "a.tum", "\n".join(rows) + "\n"))
    assert np.isfinite(table.points).all()


@pytest.mark.default_cases(2)
@pytest.mark.parametrize(
    "text",
    [
        trc(first="PathFileType  4"),
        trc(ends="\t\t"),
        trc().replace("\n", "\r"),
        trc().replace("\n", "\r\n"),
        TRC + "\n" + trc().removeprefix(TRC),
    ],
    ids=["spaces", "trailing tabs", "CR", "CRLF", "blank line"],
)
def test_variants_of_trc_are_read(tmp_path, text):
    table = read_markers(written(tmp_path, "a.trc", text))
    assert table.labels == ("a", "b") and table.points.shape == (20, 2, 3)
    assert table.points[:, 0, 0] == pytest.approx((50 + np.arange(20)) / 1e3)


def test_utf_16_is_refused_with_its_reason(tmp_path):
    with pytest.raises(InputError, match="not UTF-8 text"):
        read_markers(written(tmp_path, "a.trc", trc().encode("utf-16")))


def test_times_of_tum_since_1970_begin_at_0(tmp_path):
    start = 1_700_000_000
    rows = [f"{start + k / 10:.1f} {k / 10} 0 0 0 0 0 1" for k in range(20)]
    table = read_markers(written(tmp_path, "a.tum", "\n".join(rows) + "\n"))
    assert table.time == pytest.approx(np.arange(20) / 10, abs=1e-6)
    assert table.epoch_ns == start * 10**9


def test_the_rate_of_an_uneven_log_is_rows_per_time(tmp_path):
    """Rows come in bursts: the median step says nothing about the rate."""
    time = np.concatenate([0.1 * k + 8e-5 * np.arange(30) for k in range(50)])
    time[31] = time[30]
    rows = [f"{value:.6f},1.5" for value in time]
    path = written(tmp_path, "log.csv", "time,force\n" + "\n".join(rows) + "\n")
    facts, _ = inspect_file(path, NO_MAP, None)
    assert facts.rate_hz == pytest.approx((len(time) - 1) / np.ptp(time))
    assert facts.repeated_times == 1


def test_a_velocity_is_no_position(tmp_path):
    rows = [f"{k / 20},0.1,0,0,0,0,0.2" for k in range(40)]
    head = "time,linear.x,linear.y,linear.z,angular.x,angular.y,angular.z\n"
    path = written(tmp_path, "twist.csv", head + "\n".join(rows) + "\n")
    facts, _ = inspect_file(path, NO_MAP, None)
    assert facts.content == "log"
    assert {signal.looks_like for signal in facts.signals} == {"unknown"}


def test_a_map_settles_unknown_signals(tmp_path):
    rows = [f"{k / 10}," + ",".join(["0.0", "22.0"] * 4) for k in range(10)]
    names = [f"s{k}" for k in range(8)]
    path = written(
        tmp_path, "log.csv", "time," + ",".join(names) + "\n" + "\n".join(rows) + "\n"
    )
    keys = [
        f"pressure_kpa_{side}_{j}" for j in range(1, 5) for side in ("plus", "minus")
    ]
    known = RecordingMap(log=dict(zip(keys, names, strict=True)))
    facts, _ = inspect_file(path, known, None)
    assert facts.signals[1].looks_like == "pressure, kPa: 22 to 22 kPa"
    assert read_valves(path, load_robot("gen2"), known).values.max() == pytest.approx(
        22e3
    )


def test_a_static_trc_has_y_up(tmp_path):
    """Without motion, OpenSim's convention decides."""
    place = np.random.default_rng(0).uniform(0.1, 1.8, (6, 3))
    head = TRC.replace(
        "\ta\t\t\tb\t\t\n", "".join(f"\tm{k}\t\t" for k in range(6)) + "\n"
    )
    cells = "\t".join(f"{value:.1f}" for value in 1e3 * place.ravel())
    text = head + "".join(f"{k + 1}\t{k / 100}\t{cells}\n" for k in range(20))
    facts, _ = inspect_file(written(tmp_path, "a.trc", text), NO_MAP, None)
    assert facts.up == "y"
