"""Sampling of sweeps: grids, lists, Latin hypercubes and Sobol sequences."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, strategies as st

from srs_twin.errors import InputError
from srs_twin.studies.sweep.points import RangeFile, SamplingFile, sample

pytestmark = pytest.mark.fast

GRID = SamplingFile()
LIST = SamplingFile(kind="list")


def spread(low, high, count=None, scale="linear"):
    return RangeFile.model_validate(
        {"from": low, "to": high, "count": count, "scale": scale}
    )


def test_a_grid_has_every_combination_once():
    points = sample({"a": [1, 2, 3], "b": ["x", "y"]}, GRID)
    assert len(points) == 6 and set(points) == {(a, b) for a in (1, 2, 3) for b in "xy"}


def test_ranges_have_both_ends_and_even_steps():
    linear = [point[0] for point in sample({"a": spread(1, 3, 5)}, GRID)]
    assert linear == [1.0, 1.5, 2.0, 2.5, 3.0]
    log = np.array([point[0] for point in sample({"a": spread(1, 16, 5, "log")}, GRID)])
    assert log == pytest.approx([1, 2, 4, 8, 16])


def test_lists_are_combined_element_by_element():
    assert sample({"a": [1, 2], "b": [3, 4]}, LIST) == [(1, 3), (2, 4)]
    with pytest.raises(InputError, match="a 2, b 3"):
        sample({"a": [1, 2], "b": [3, 4, 5]}, LIST)


@given(st.integers(1, 60), st.integers(0, 2**32 - 1))
def test_latin_hypercube_has_one_point_in_every_stratum(count, seed):
    box = {"a": spread(-1, 1), "b": spread(1, 100, scale="log")}
    points = np.array(
        sample(box, SamplingFile(kind="latin_hypercube", count=count, seed=seed))
    )
    linear = (points[:, 0] + 1) / 2
    log = np.log(points[:, 1]) / np.log(100)
    for column in (linear, log):
        assert sorted(np.floor(column * count * (1 - 1e-12)).astype(int)) == list(
            range(count)
        )


@given(st.integers(2, 7), st.integers(0, 2**32 - 1))
def test_sobol_is_balanced(power, seed):
    """Every elementary interval of a digital net in base 2 holds the same number of points: here quarters."""
    points = np.array(
        sample(
            {"a": spread(0, 1), "b": spread(0, 1)},
            SamplingFile(kind="sobol", count=2**power, seed=seed),
        )
    )
    quarters = np.bincount((points < 0.5) @ [1, 2])
    assert quarters.tolist() == [2 ** (power - 2)] * 4


def test_samples_use_all_values_of_a_list_equally_often():
    points = sample(
        {"a": ["x", "y", "z"], "b": spread(1, 5)},
        SamplingFile(kind="latin_hypercube", count=30, seed=1),
        ["b"],
    )
    assert {repr(point[1]) for point in points} == set("12345")
    assert {name: [point[0] for point in points].count(name) for name in "xyz"} == {
        "x": 10,
        "y": 10,
        "z": 10,
    }


@pytest.mark.parametrize("scale", ["linear", "log"])
def test_whole_numbers_have_the_density_of_their_scale(scale):
    box = {"a": spread(0.5, 4.5, scale=scale)}
    hypercube = SamplingFile(kind="latin_hypercube", count=1000, seed=1)
    drawn = [point[0] for point in sample(box, hypercube, ["a"])]
    edges = np.arange(1, 6) if scale == "linear" else np.log(np.arange(1, 6))
    shares = np.diff(edges) / (edges[-1] - edges[0])
    counts = [drawn.count(k) for k in range(1, 5)]
    # Each end of an interval may lie anywhere in one of the 1000 strata.
    assert counts == pytest.approx(1000 * shares, abs=2)


def test_a_range_needs_a_whole_number_if_the_field_does():
    hypercube = SamplingFile(kind="latin_hypercube", count=3, seed=1)
    with pytest.raises(InputError, match="a: there is no whole number between 1.2"):
        sample({"a": spread(1.2, 1.4)}, hypercube, ["a"])


def test_the_same_seed_gives_the_same_points():
    box = {"a": spread(0, 1), "b": spread(0, 1)}
    first, again, other = (
        sample(box, SamplingFile(kind="sobol", count=8, seed=seed))
        for seed in (3, 3, 4)
    )
    assert first == again != other
