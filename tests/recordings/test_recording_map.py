"""Recording maps: names, units and places; rigid bodies; bodies with few segments."""

from __future__ import annotations

import re

import numpy as np
import pytest
from recorded import NOISE, RATE, SPEC, csv_text, motion, recorded, true_at
from snakes import chain
from synthetic_takes import Take, markers, stretched

from srs_twin import AnalyticalSnake, Gait, InputError, rollout
from srs_twin.recordings.commands import TableOptions
from srs_twin.recordings.inspection import inspect
from srs_twin.recordings.recording import read_motion
from srs_twin.recordings.recording_map import RecordingMap, given_map, read_map
from srs_twin.recordings.signals.logs import read_valves


def written(path, names, points, *, time=True, scale=1.0):
    """Write a CSV file with the columns NAME_x and NAME_y for each marker."""
    columns = [f"{name}_{axis}" for name in names for axis in "xy"]
    rows = points.reshape(len(points), -1) * scale
    if time:
        rows = np.column_stack([np.arange(len(points)) / RATE, rows])
        columns.insert(0, "Time (s)")
    path.write_text(csv_text(columns, rows))
    return path


def noisy(points):
    return points + NOISE * np.random.default_rng(0).standard_normal(points.shape)


def test_functions_accept_the_path_of_a_map(tmp_path):
    known = recorded(tmp_path, Take(), map=RecordingMap(up="y")).trajectory
    take = tmp_path / "take.csv"
    path = tmp_path / "lab.yaml"
    path.write_text("up: y\n")
    for given in (path, str(path), {"up": "y"}):
        found = read_motion(take, SPEC, map=given).trajectory
        assert np.array_equal(found.stack("bend"), known.stack("bend"))
    with pytest.raises(InputError, match="map 3 is not allowed; it must be the path"):
        read_motion(take, SPEC, map=3)


def test_markers_are_assigned_by_a_map(tmp_path):
    """The map gives names, unit and rate, for a mix of connectors and middles that is no layout."""
    truth = stretched(motion(), 0.2)
    every = markers(truth, Take(layout="head_middles"))
    chosen = [0, 1, 2, 4, 5, 6, 7, 8, 9]  # without the first connector's successor
    names = ["front", "base", "m1", "m2", "k3", "m3", "k4", "m4", "tip"]
    lamp = np.full((len(every), 1, 2), 3.0)
    path = written(
        tmp_path / "led.csv",
        [*names, "lamp"],
        np.concatenate([noisy(every[:, chosen]), lamp], axis=1),
        time=False,
        scale=1e3,
    )
    given = read_map(
        {
            "units": "mm",
            "rate_hz": RATE,
            "markers": {
                "front": {"connector": 1, "side": "ahead"},
                "base": {"connector": 1},
                **{f"m{k}": {"middle": k} for k in range(1, 5)},
                "k3": {"connector": 3},
                "k4": {"connector": 4},
                "tip": {"connector": 5},
                "lamp": "ignore",
            },
        }
    )
    found = read_motion(path, SPEC, map=given)
    error = found.trajectory.stack("bend") - true_at(found.trajectory, truth).stack(
        "bend"
    )
    stated = found.trajectory.stack("bend_error")
    assert len(found.trajectory) == len(truth)
    assert np.sqrt((error**2).mean()) < 0.03
    assert 0.93 < (np.abs(error) < 1.96 * stated).mean() < 0.97
    assert (
        np.abs(found.trajectory.stack("length") - truth.stack("length")).mean() < 1e-3
    )
    (varying,) = (each for each in found.summary.corrections if "lengths vary" in each)
    percent = [float(number) for number in re.findall(r"[-+]\d+", varying)]
    ends = np.quantile(truth.stack("length"), [0.02, 0.98], axis=0).T.ravel()
    assert percent == pytest.approx(
        100 * (ends / SPEC.geometry.segment_length - 1), abs=2
    )
    for note in (
        "1 markers are ignored according to the map",
        "times computed from row numbers at 100 frames per second",
    ):
        assert note in found.summary.corrections
    assert found.trajectory.time == pytest.approx(truth.time)


@pytest.mark.default_cases(1)
@pytest.mark.parametrize("layout", ["head_middles", "middles", "pair"])
def test_layout_of_markers_on_segments_that_stretch_is_detected(tmp_path, layout):
    truth = stretched(motion(), 0.25)
    found = recorded(tmp_path, Take(layout=layout), truth)
    error = found.trajectory.stack("bend") - truth.stack("bend")
    within = np.abs(error) < 1.96 * found.trajectory.stack("bend_error")
    assert found.summary.markers.layout == layout
    assert 0.93 < within.mean() < 0.975
    assert 0.9 < found.summary.markers.noise_m / NOISE < 1.1


def test_one_marker_per_connector_is_refused_for_a_body_that_stretches(tmp_path):
    with pytest.raises(
        InputError, match="lengths vary by .* put a second marker on the head"
    ):
        recorded(tmp_path, Take(layout="single"), stretched(motion(), 0.25))
    recorded(tmp_path, Take(layout="head"), stretched(motion(), 0.25))


@pytest.mark.default_cases(2)
@pytest.mark.parametrize(
    ("segments", "layout"),
    [(1, "head"), (1, "middles"), (1, "pair"), (2, "middles"), (2, "head")],
)
def test_bodies_of_one_and_two_segments_are_read(tmp_path, segments, layout):
    spec = chain((0.03,) * (segments + 1))
    truth = rollout(
        AnalyticalSnake(spec, supply_pa=48e3), Gait(1.0, 0.1), 4.0, record_hz=RATE
    )
    names = [f"m{k}" for k in range(markers(truth, Take(layout=layout)).shape[1])]
    path = written(
        tmp_path / "few.csv", names, noisy(markers(truth, Take(layout=layout)))
    )
    found = read_motion(path, spec, layout=layout, head="m0").trajectory
    error = found.stack("bend") - truth.stack("bend")
    assert 0.92 < (np.abs(error) < 1.96 * found.stack("bend_error")).mean() < 0.98


def test_insufficient_markers_are_refused_and_the_remedy_works(tmp_path):
    truth = motion()
    every = noisy(markers(truth, Take(layout="head")))
    path = written(tmp_path / "x.csv", [f"m{k}" for k in range(6)], every)
    some = {f"m{k}": {"connector": k} for k in (1, 2, 3, 5)}
    with pytest.raises(
        InputError,
        match=(
            "do not determine the bends of 4 segments; use one marker per connector"
            " and a second"
        ),
    ):
        read_motion(path, SPEC, map=read_map({"markers": some}))
    whole = some | {"m4": {"connector": 4}, "m0": {"connector": 1, "side": "ahead"}}
    read_motion(path, SPEC, map=read_map({"markers": whole}))


@pytest.mark.parametrize(
    ("data", "said"),
    [
        (
            {"markers": {"m0": {"connector": 1, "middle": 1}}},
            "markers.m0: give either `connector` or `middle`",
        ),
        ({"markers": {"m0": {"connector": 0}}}, "markers.m0"),
        (
            {"units": "inch"},
            "units: must be one of m, cm, mm, in, ft, px, not text 'inch'",
        ),
        (
            {"log": {"x": "a"}},
            "log.x: unknown key; the section `log` has the keys time, carrier_hz",
        ),
        ({"log": {"carrier_hz": "30"}}, "log.carrier_hz: the value must be a number"),
        ({"log": {"valve_pls_1": "a"}}, "unknown key; did you mean valve_plus_1"),
        (
            {"markers": {"m0": {"connectr": 1}}},
            "map: markers.m0.connectr: unknown key; did you mean connector?",
        ),
        ({"marker": {}}, "marker: unknown key; did you mean markers?"),
    ],
)
def test_errors_of_a_map_name_their_place(data, said):
    with pytest.raises(InputError) as caught:
        read_map(data)
    assert said in str(caught.value)
    assert "\n" not in str(caught.value)


def test_unknown_names_suggest_a_similar_one(tmp_path):
    path = written(tmp_path / "x.csv", ["base", "tip"], noisy(motion().position[:, :2]))
    places = {"markers": {"bse": {"connector": 1}}}
    for read in (
        lambda: read_motion(path, SPEC, map=places),
        lambda: inspect(path, map=places),
    ):
        with pytest.raises(
            InputError, match=r"x\.csv: unknown marker 'bse'; did you mean"
        ):
            read()
    columns = RecordingMap(log={"valve_plus_1": "bse_x"})
    with pytest.raises(InputError, match=r"x\.csv:1: unknown column 'bse_x'; did you"):
        read_valves(path, SPEC, columns)


def test_options_have_precedence_over_the_map_file(tmp_path):
    path = tmp_path / "map.yaml"
    path.write_text("units: mm\nmarkers: {tip: {connector: 5}}\n")
    found = read_map(
        given_map(
            str(path),
            {"units": "cm", "rate_hz": None},
            ["base=connector 1 ahead", "lamp=ignore"],
        )
    )
    assert found.units == "cm"
    assert found.rate_hz is None
    assert found.markers["base"].station == (0, "ahead")
    assert found.markers["tip"].station == (8, "")
    assert found.markers["lamp"] == "ignore"
    for place in ("base:1", "base=connector 0"):
        with pytest.raises(
            InputError, match=f"--marker '{place}' is not allowed; use NAME=connector 1"
        ):
            given_map(None, {}, [place])
    with pytest.raises(InputError, match="--rate: rate_hz: must be a number above 0"):
        TableOptions(rate_hz=0).map_data()
    assert given_map(None, {"units": None}, []) == {}


def test_logs_with_other_column_names_are_read(tmp_path):
    names = [f"{kind}{j}" for j in range(4) for kind in ("p", "q")]
    rows = [[100 * k, *(10.0 * k + j for j in range(8))] for k in range(5)]
    path = tmp_path / "x.csv"
    path.write_text(csv_text(["t_ms", *names], rows))
    log = {
        f"setpoint_kpa_{side}_{j + 1}": f"{kind}{j}"
        for j in range(4)
        for side, kind in (("plus", "p"), ("minus", "q"))
    }
    found = read_valves(path, SPEC, RecordingMap(log=log))
    assert found.kind == "pressure"
    assert found.time == pytest.approx([0, 0.1, 0.2, 0.3, 0.4])
    assert found.values[2, 1] == pytest.approx([22e3, 23e3])
    assert "set points are assumed to be the chamber pressures" in found.corrections


@pytest.mark.parametrize("apart", [0.0268, 0.0275, 0.029])
def test_pairs_with_equal_distances_are_resolved_by_their_order(tmp_path, apart):
    found = recorded(tmp_path, Take(layout="pair", apart=apart, labeled=True))
    assert found.summary.markers.layout == "pair"
    assert np.abs(found.trajectory.stack("bend") - motion().stack("bend")).max() < 0.06


def test_options_of_a_map_are_given_as_text():
    """A list of columns is split at commas, and separators have names."""
    given = given_map(
        None, {"columns": "time, x ,y", "separator": "\t", "decimal": None}, []
    )
    assert given == {"columns": ["time", "x", "y"], "separator": "tab"}
    assert given_map(None, {"separator": " "}, []) == {"separator": "space"}
    assert given_map(None, {"separator": ";"}, []) == {"separator": ";"}
