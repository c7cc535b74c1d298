"""Cells, positions and line ends that mean missing data, and rates and quantities that are not guessed."""

from __future__ import annotations

import numpy as np
import pytest
from test_trajectory_formats import trc

from srs_twin import load_robot
from srs_twin.errors import InputError
from srs_twin.recordings.formats import read_markers
from srs_twin.recordings.inspection import inspect_file
from srs_twin.recordings.recording_map import NO_MAP, read_map
from srs_twin.recordings.signals.logs import read_valves


def csv(cells, separator=","):
    rows = [separator.join(["time", "a_x", "a_y", "a_z", "b_x", "b_y", "b_z"])]
    for k in range(20):
        b = cells if 5 <= k < 10 else [f"0.{k:02d}", "0.5", "0.03"]
        rows.append(separator.join([f"{k / 100}", "0.3", "0.2", "0.03", *b]))
    return "\n".join(rows) + "\n"


def points():
    """Return two markers, of which the second is missing on five frames, shape (20, 2, 3), m."""
    places = np.tile([[0.05, 0.001, 0.03], [0.02, 0.002, 0.03]], (20, 1, 1))
    places[:, 0, 0] += np.arange(20) / 1e3
    places[5:10, 1] = np.nan
    return places


def written(folder, name, text):
    path = folder / name
    path.write_bytes(text if isinstance(text, bytes) else text.encode())
    return path


def hidden(path):
    """Return the frames on which marker b is missing."""
    table = read_markers(path)
    return np.flatnonzero(np.isnan(table.points[:, 1, 0])).tolist()


@pytest.mark.parametrize(("blank", "separator"), [(" ", ","), ("   ", ";"), ("", "\t")])
def test_a_cell_of_spaces_is_empty(tmp_path, blank, separator):
    path = written(tmp_path, "a.csv", csv([blank] * 3, separator))
    assert hidden(path) == [5, 6, 7, 8, 9]
    path = written(tmp_path, "b.trc", trc(points(), missing=blank))
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
    table = read_markers(written(tmp_path, "a.trc", trc(points(), missing="0.000")))
    assert (np.isnan(table.points) == np.isnan(points())).all()
    assert any(
        "5 positions are exactly 0, 0, 0 and are read as missing" in note
        for note in table.corrections
    )


def test_odometry_may_begin_at_the_origin(tmp_path):
    rows = [f"{k / 10} {max(0.0, k - 5) / 10} 0 0 0 0 0 1" for k in range(20)]
    table = read_markers(written(tmp_path, "a.tum", "\n".join(rows) + "\n"))
    assert np.isfinite(table.points).all()


@pytest.mark.parametrize(
    ("old", "new"), [("PathFileType\t4", "PathFileType  4"), ("\r\n", "\r")]
)
def test_variants_of_trc_are_read(tmp_path, old, new):
    table = read_markers(written(tmp_path, "a.trc", trc(points()).replace(old, new)))
    assert table.labels == ("m0", "m1")
    assert table.points == pytest.approx(points(), abs=1e-9, nan_ok=True)


def test_utf_16_is_refused_with_its_reason(tmp_path):
    with pytest.raises(InputError, match="not UTF-8 text"):
        read_markers(written(tmp_path, "a.trc", trc(points()).encode("utf-16")))


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
    names = [f"s{k}" for k in range(8)]
    row = ",".join(["0.0", "22.0"] * 4)
    rows = [f"{k / 10},{row}\n" for k in range(10)]
    path = written(tmp_path, "log.csv", f"time,{','.join(names)}\n{''.join(rows)}")
    keys = [
        f"pressure_kpa_{side}_{j}" for j in range(1, 5) for side in ("plus", "minus")
    ]
    given = dict(zip(keys, names, strict=True))
    given["pressure_kpa_minus_2"] = {"column": "s3", "unit": "mbar"}
    known = read_map({"log": given})
    facts, _ = inspect_file(path, known, None)
    assert facts.signals[1].looks_like == "pressure, kPa: 22 to 22 kPa"
    assert facts.signals[3].looks_like == "pressure, mbar: 2.2 to 2.2 kPa"
    pressures = read_valves(path, load_robot("gen2"), known).values[0, :, 1]
    assert pressures == pytest.approx([22e3, 2.2e3, 22e3, 22e3])


def test_a_static_trc_has_y_up(tmp_path):
    """Without motion, OpenSim's convention decides."""
    place = np.random.default_rng(0).uniform(0.1, 1.8, (1, 6, 3))
    text = trc(np.repeat(place, 20, axis=0))
    facts, _ = inspect_file(written(tmp_path, "a.trc", text), NO_MAP, None)
    assert facts.up == "y"
