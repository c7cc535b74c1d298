"""Fits to speeds and radii at several offsets: a known law is recovered, and the shipped fits are current."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import offset_runs as module
import pytest
from offset_runs import OffsetRun, fit_offsets, offset_runs, predicted
from published_tables import published_runs
from table8_fit import (
    FITTED,
    LENGTH,
    STUDIES,
    drive_of,
    held_values,
    pairs_table,
    rows_table,
    shipped,
    values_of,
    values_table,
)

from srs_twin import load_robot
from srs_twin.errors import InputError
from srs_twin.identification.fit_file import fit_file
from srs_twin.identification.fitted_robot import robot_override
from srs_twin.identification.footprint import GaitSetup
from srs_twin.identification.parameters import with_values
from srs_twin.identification.paths import SteadyPath
from srs_twin.io.documents import dump_yaml, parse_yaml
from srs_twin.robot.file import resolve_robot

TRUTH = {"geometry.segment_length_m": 0.11, "friction.mu_t": 0.08, "modules.sensor_bias_rad": -0.02}
OFFSETS = (0.0, 0.3, -0.3)


def law(spec, offset):
    """Return a path by a test law without masses, in which only the ratio of frictions acts."""
    length, friction = spec.geometry.segment_length, spec.friction
    speed = 2 * length * (1 - 3 * friction.mu_t / friction.mu_n + 0.5 * offset**2)
    return SteadyPath(speed, (0.5 * offset - spec.modules.sensor_bias[0]) / length, 0, 0, 0, 0)


@pytest.fixture
def lawful(monkeypatch):
    """Replace the plants by the law; return a gait setup."""
    asked = []

    def told(drive, offsets, *, threads=None):
        asked.append(tuple(offsets))
        return [law(drive.spec, offset) for offset in offsets]

    monkeypatch.setattr(module, "predicted", told)
    return GaitSetup(load_robot("gen4"), 1.5, 131e3, "ilc", 0.7, "analytical"), asked


def measured(offsets, truth=TRUTH, noise=0.0):
    paths = [law(with_values(load_robot("gen4"), truth), offset) for offset in offsets]
    return [
        OffsetRun(offset, path.speed * (1 + noise * (-1) ** k), path.curvature)
        for k, (offset, path) in enumerate(zip(offsets, paths, strict=True))
    ]


def test_known_values_are_recovered_from_three_rows(lawful):
    fit = fit_offsets(measured(OFFSETS), lawful[0], TRUTH)
    for name, value in TRUTH.items():
        assert fit[name].value == pytest.approx(value, rel=1e-3), name
        assert fit[name].verdict == "identified"


def test_held_parameters_without_effect_are_reported_as_unidentifiable(lawful):
    besides = ("friction.mu_n", "mass.connectors_kg", "geometry.rigid_gap_m")
    fit = fit_offsets(measured(OFFSETS, noise=0.02), lawful[0], TRUTH, besides=besides)
    for name in besides:
        assert fit[name].verdict == "not identifiable" and fit[name].value is None
    assert "held at 0.57; beside geometry.segment_length_m" in fit["friction.mu_n"].why
    assert fit.held["friction.mu_n"] == 0.57
    assert fit.correlation.shape == (6, 6)


def test_held_parameters_with_an_effect_are_only_held(lawful):
    names = [name for name in TRUTH if name != "friction.mu_t"]
    runs = measured(OFFSETS, TRUTH | {"friction.mu_t": load_robot("gen4").friction.mu_t}, noise=0.001)
    fit = fit_offsets(runs, lawful[0], names, besides=["friction.mu_t"])
    assert [parameter.name for parameter in fit.parameters] == names
    assert list(fit.held) == ["friction.mu_t"]


def test_validation_rows_run_only_after_the_fit(lawful):
    drive, asked = lawful
    fit = fit_offsets(measured(OFFSETS), drive, TRUTH, validation=measured((0.1, -0.2)))
    assert set(asked[:-1]) == {OFFSETS} and asked[-1] == (0.1, -0.2)
    assert fit.rms("validation") < 0.01
    assert len(set(asked)) == 2


def test_parameters_that_cancel_have_no_value_and_the_fit_predicts_nothing(lawful):
    """Only the ratio of the coefficients acts: fit and validation agree, but neither is identified."""
    names = [*TRUTH, "friction.mu_n"]
    fit = fit_offsets(measured(OFFSETS), lawful[0], names, validation=measured((0.1, -0.2)))
    assert [fit[name].value for name in ("friction.mu_t", "friction.mu_n")] == [None, None]
    assert fit.rms("fit") < 0.01 and fit.rms("validation") < 0.01
    about = {"name": "x", "title": "x", "robot": "gen4", "method": "offsets", "command": "x", "versions": {}}
    data = [run.data_set("fit") for run in measured(OFFSETS)]
    assert fit_file(fit, **about, data=data).unidentified() == ["friction.mu_t", "friction.mu_n"]
    with pytest.raises(InputError, match=r"x: friction.mu_t, friction.mu_n has no value, .* fix one"):
        fit_file(fit, **about, data=data, averages={"offset 0": ({"speed_m_s": 0.1}, {"speed_m_s": 0.1})})


def test_an_offset_cannot_fit_and_validate(lawful):
    with pytest.raises(InputError, match="the same data as offset 0.3"):
        fit_offsets(measured(OFFSETS), lawful[0], TRUTH, validation=measured((0.3,)))
    with pytest.raises(InputError, match="give at least one"):
        fit_offsets([], lawful[0], TRUTH)


def test_radii_have_the_sign_of_their_offset():
    rows = published_runs()
    fitted = offset_runs([row for row in rows if row.offset in FITTED])
    for run in fitted:
        assert run.radius == pytest.approx({row.offset: row.radius_m for row in rows}[run.offset])
    assert [math.copysign(1, run.curvature) for run in fitted] == [-1, 1, -1]
    mirrored = [row.model_copy(update={"offset": -row.offset}) for row in rows if row.offset in FITTED]
    assert [run.curvature for run in offset_runs(mirrored)] == [-run.curvature for run in fitted]


FITS = shipped()


def numbers(fit):
    """Return the fitted and held values of a fit file, read as plain YAML."""
    return fit.held | {
        parameter.name: parameter.value for parameter in fit.parameters if parameter.value is not None
    }


def test_every_study_has_a_shipped_fit():
    assert list(FITS) == list(STUDIES)


@pytest.mark.parametrize("study", FITS)
def test_a_shipped_fit_lists_every_parameter_once(study):
    fit = FITS[study]
    assert set(TRUTH) <= numbers(fit).keys() and fit.unidentified() == []
    for name, value in held_values(study).items():
        assert fit.held[name] == value and f"{name} held" in fit.title
    assert numbers(FITS["twin"])[LENGTH] == numbers(FITS["analytical"])[LENGTH]


@pytest.mark.parametrize("study", FITS)
def test_shipped_fits_use_only_the_offsets_0_and_03(study):
    rows = {f"offset {row.offset:g}": row for row in published_runs()}
    fit = FITS[study]
    assert {data.name for data in fit.data} == set(rows)
    assert {data.name for data in fit.data if data.role == "fit"} == {"offset 0", "offset 0.3", "offset -0.3"}
    for data in fit.data:
        row = rows[data.name]
        assert data.measured["speed_m_s"] == row.speed_m_s
        assert abs(data.measured["curvature_per_m"]) == pytest.approx(1 / row.radius_m, rel=1e-5)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("study", "offset"),
    [
        ("analytical", -0.3),
        *(
            pytest.param(*case, marks=pytest.mark.slow)
            for case in (("analytical", 0.1), ("twin", 0.1), ("analytical_wave", -0.2))
        ),
    ],
)
def test_shipped_predictions_are_reproduced_by_the_plants(study, offset):
    fit, drive = FITS[study], drive_of(study)
    moved = replace(drive, spec=with_values(drive.spec, numbers(fit)))
    (path,) = predicted(moved, [offset], threads=1)
    speed, radius = values_of(fit, "predicted")[offset]
    assert path.speed == pytest.approx(speed, rel=0.01)
    assert 1 / abs(path.curvature) == pytest.approx(radius, rel=0.01)


@pytest.mark.parametrize("study", FITS)
def test_a_shipped_fit_can_be_applied_to_its_robot(study):
    fit = FITS[study]
    document = parse_yaml(dump_yaml({"robot": robot_override(fit)}), "scenario.yaml")
    file = resolve_robot(document, document.data["robot"], prefix=("robot",))
    document.raise_problems()
    expected = with_values(load_robot("gen4"), numbers(fit))
    assert file.spec().geometry.segment_length == pytest.approx(expected.geometry.segment_length)
    assert file.spec().friction.mu_t == pytest.approx(expected.friction.mu_t)
    status = {"found": "calibrated", "held": "estimated"}
    length = file.records()["geometry.segment_length_m"]
    assert length.status == status["held" if held_values(study) else "found"]
    assert file.spec().modules.sensor_bias == pytest.approx(expected.modules.sensor_bias)


def test_the_page_shows_the_tables_of_the_shipped_fits():
    page = (Path(__file__).parents[2] / "docs/dissertation-data.md").read_text("utf-8")
    for shown in (values_table, rows_table, pairs_table):
        assert shown(FITS) in page, shown.__name__
