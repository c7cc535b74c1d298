"""Fits to speeds and radii at several offsets: a known law is recovered, the shipped fits are current."""

from __future__ import annotations

import math
from dataclasses import replace

import offset_runs as module
import pytest
from benchmark_runs import run_benchmark
from conftest import ROOT
from offset_runs import OffsetRun, fit_offsets, offset_runs, predicted
from published_tables import published_runs
from table8 import (
    FITTED,
    LENGTH,
    drive_of,
    held_values,
    shipped,
    values_of,
    with_averages,
)

from srs_twin import load_robot
from srs_twin.errors import InputError
from srs_twin.identification.fit_file import fit_file
from srs_twin.identification.footprint import GaitSetup
from srs_twin.identification.parameters import with_values
from srs_twin.identification.paths import SteadyPath

TRUTH = {
    "geometry.segment_length_m": 0.11,
    "friction.mu_t": 0.08,
    "modules.sensor_bias_rad": -0.02,
}
OFFSETS = (0.0, 0.3, -0.3)


def known_path(spec, offset):
    """Return a path of a massless model that depends on the ratio of the friction coefficients only."""
    length = spec.geometry.segment_length
    friction = spec.friction
    speed = 2 * length * (1 - 3 * friction.mu_t / friction.mu_n + 0.5 * offset**2)
    return SteadyPath(
        speed, (0.5 * offset - spec.modules.sensor_bias[0]) / length, 0, 0, 0, 0
    )


@pytest.fixture
def known_paths(monkeypatch):
    """Replace the plants by `known_path`, and return a drive."""
    asked = []

    def message(drive, offsets, *, threads=None):
        asked.append(tuple(offsets))
        return [known_path(drive.spec, offset) for offset in offsets]

    monkeypatch.setattr(module, "predicted", message)
    return GaitSetup(load_robot("gen4"), 1.5, 131e3, "ilc", 0.7, "analytical"), asked


def measured(offsets, truth=TRUTH, noise=0.0):
    paths = [
        known_path(with_values(load_robot("gen4"), truth), offset) for offset in offsets
    ]
    return [
        OffsetRun(offset, path.speed * (1 + noise * (-1) ** k), path.curvature)
        for k, (offset, path) in enumerate(zip(offsets, paths, strict=True))
    ]


def test_known_values_are_recovered_from_three_rows(known_paths):
    found = fit_offsets(measured(OFFSETS), known_paths[0], TRUTH)
    for name, value in TRUTH.items():
        assert found[name].value == pytest.approx(value, rel=1e-3), name
        assert found[name].verdict == "identified"


def test_what_is_held_is_said_to_be_unknowable_where_it_is(known_paths):
    besides = ("friction.mu_n", "mass.connectors_kg", "geometry.rigid_gap_m")
    found = fit_offsets(
        measured(OFFSETS, noise=0.02), known_paths[0], TRUTH, besides=besides
    )
    for name in besides:
        assert found[name].verdict == "not identifiable" and found[name].value is None
    assert (
        "held at 0.57; beside geometry.segment_length_m" in found["friction.mu_n"].why
    )
    assert found.held["friction.mu_n"] == 0.57
    assert found.correlation.shape == (6, 6)


def test_what_is_held_though_it_could_be_told_is_only_held(known_paths):
    names = [name for name in TRUTH if name != "friction.mu_t"]
    runs = measured(
        OFFSETS,
        TRUTH | {"friction.mu_t": load_robot("gen4").friction.mu_t},
        noise=0.001,
    )
    found = fit_offsets(runs, known_paths[0], names, besides=["friction.mu_t"])
    assert [item.name for item in found.parameters] == names
    assert list(found.held) == ["friction.mu_t"]


def test_rows_to_validate_with_are_not_run_before_the_end(known_paths):
    drive, asked = known_paths
    found = fit_offsets(
        measured(OFFSETS), drive, TRUTH, validation=measured((0.1, -0.2))
    )
    assert set(asked[:-1]) == {OFFSETS} and asked[-1] == (0.1, -0.2)
    assert found.rms("validation") < 0.01
    assert len(set(asked)) == 2


def test_what_cancels_has_no_number_and_nothing_is_predicted_with_the_robots_own(
    known_paths,
):
    """Of the friction only the ratio acts: fit and validation are both met, though neither is told."""
    names = [*TRUTH, "friction.mu_n"]
    found = fit_offsets(
        measured(OFFSETS), known_paths[0], names, validation=measured((0.1, -0.2))
    )
    assert [found[name].value for name in ("friction.mu_t", "friction.mu_n")] == [
        None,
        None,
    ]
    assert found.rms("fit") < 0.01 and found.rms("validation") < 0.01
    about = {
        "name": "x",
        "title": "x",
        "robot": "gen4",
        "method": "offsets",
        "command": "x",
        "versions": {},
    }
    data = [run.data_set("fit") for run in measured(OFFSETS)]
    fit = fit_file(found, **about, data=data)
    assert fit.unidentified() == ["friction.mu_t", "friction.mu_n"]
    with pytest.raises(
        InputError, match=r"x: friction.mu_t, friction.mu_n has no value, .* fix one"
    ):
        with_averages(fit, {})


def test_paths_have_the_sign_of_their_offset_and_0_that_of_the_fitted_rows():
    rows = published_runs()
    fitted = offset_runs([row for row in rows if row.offset in FITTED])
    for run in fitted:
        assert run.radius == pytest.approx(
            {row.offset: row.radius_m for row in rows}[run.offset]
        )
    assert [math.copysign(1, run.curvature) for run in fitted] == [-1, 1, -1]
    mirrored = [
        replace(row, offset=-row.offset) for row in rows if row.offset in FITTED
    ]
    assert [run.curvature for run in offset_runs(mirrored)] == [
        -run.curvature for run in fitted
    ]


FITS = shipped()


def numbers(fit):
    """Return what a fit's file states, found or held, without a look at how the package takes it."""
    return fit.held | {
        item.name: item.value for item in fit.parameters if item.value is not None
    }


@pytest.mark.parametrize("study", FITS)
def test_a_shipped_fit_states_each_unknown_once_found_or_held(study):
    fit = FITS[study]
    assert set(TRUTH) <= numbers(fit).keys() and fit.unidentified() == []
    for name, value in held_values(study).items():
        assert fit.held[name] == value and f"{name} held" in fit.title
    assert numbers(FITS["twin"])[LENGTH] == numbers(FITS["analytical"])[LENGTH]


@pytest.mark.parametrize("study", FITS)
def test_the_shipped_fits_have_seen_offsets_0_and_03_alone(study):
    rows = {f"offset {row.offset:g}": row for row in published_runs()}
    fit = FITS[study]
    assert {item.name for item in fit.data} == set(rows)
    assert {item.name for item in fit.data if item.role == "fit"} == {
        "offset 0",
        "offset 0.3",
        "offset -0.3",
    }
    for item in fit.data:
        row = rows[item.name]
        assert item.measured["speed_m_s"] == row.speed_m_s
        assert abs(item.measured["curvature_per_m"]) == pytest.approx(
            1 / row.radius_m, rel=1e-5
        )


@pytest.mark.slow
@pytest.mark.parametrize(
    ("study", "offset"),
    [
        ("analytical", -0.3),
        ("analytical", 0.1),
        ("twin", 0.1),
        ("analytical_wave", -0.2),
    ],
)
def test_the_shipped_predictions_are_what_the_plants_give(study, offset):
    fit = FITS[study]
    drive = drive_of(study)
    moved = replace(drive, spec=with_values(drive.spec, numbers(fit)))
    (path,) = predicted(moved, [offset], threads=1)
    speed, radius = values_of(fit, "predicted")[offset]
    assert path.speed == pytest.approx(speed, rel=0.01)
    assert 1 / abs(path.curvature) == pytest.approx(radius, rel=0.01)


@pytest.mark.slow
def test_the_page_shows_the_tables_of_the_shipped_fits():
    page = (ROOT / "docs/reproduction.md").read_text("utf-8")
    done = run_benchmark("table8_fit.py", "--show")
    assert done.returncode == 0, done.stderr
    tables = [
        part for part in done.stdout.strip().split("\n\n") if part.startswith("| ")
    ]
    assert len(tables) == 3
    for table in tables:
        assert table in page


def test_candidates_of_a_fit_share_their_numerical_settings():
    spec = load_robot("gen4")
    longer = with_values(spec, {"geometry.segment_length_m": 0.2})
    assert longer.scale == spec.scale != replace(longer).scale
