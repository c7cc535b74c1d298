"""Locomotion fits: identifiable parameters for both plants, and parameters that cancel."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest
from recorded import motion
from synthetic_takes import Take, write_motive

from srs_twin import Gait, Trajectory, load_robot
from srs_twin.errors import InputError, UnknownNameError
from srs_twin.identification.estimate import Parameter
from srs_twin.identification.locomotion import (
    GaitRun,
    PlantModel,
    fit_locomotion,
    measured_length,
)
from srs_twin.identification.parameters import free_parameters, with_values
from srs_twin.recordings.recording import read_motion

SPEC = load_robot("gen2")
COMPLETE = PlantModel(settings={"friction": "wheel"})
COMPLIANT = PlantModel(settings={"model": "compliant", "friction": "wheel"})
TWIN = PlantModel("twin")


def runs(model, truth, gaits, *, seconds=3.0, noise=0.0) -> list[GaitRun]:
    """Return gait runs of a plant with hidden parameters."""
    hidden = with_values(SPEC, truth)
    fit = []
    for k, (frequency, offset) in enumerate(gaits):
        gait = Gait(frequency, offset)
        trajectory = model.simulate(_blank(gait, seconds), hidden)
        columns = dict(trajectory.columns)
        rng = np.random.default_rng(k)
        for name in ("com_x", "com_y", "heading", *(f"bend_{j}" for j in range(1, 5))):
            scale = noise * (1e-3 if name.startswith("com") else 1e-2)
            columns[name] = columns[name] + scale * rng.normal(size=len(trajectory))
        fit.append(
            GaitRun(
                Trajectory(columns, metadata=trajectory.metadata),
                gait,
                48e3,
                f"run_{k}",
            )
        )
    return fit


def _blank(gait, seconds):
    return GaitRun(Trajectory({"time": np.array([0.0, seconds])}), gait, 48e3, "blank")


@cache
def straight_and_curved() -> list[GaitRun]:
    truth = {
        "friction.mu_t": 0.055,
        "friction.mu_n": 0.48,
        "geometry.rigid_gap_m": 0.022,
    }
    return runs(COMPLETE, truth, [(2.0, 0.0), (1.5, 0.2), (1.6, -0.2)], seconds=2.0)


@pytest.mark.slow
@pytest.mark.parametrize(
    "compare_signals", [pytest.param("averages", marks=pytest.mark.slow), "shapes"]
)
def test_friction_and_gap_are_recovered_within_one_per_cent(compare_signals):
    fit = fit_locomotion(
        straight_and_curved(),
        SPEC,
        ["friction.mu_t", "friction.mu_n", "geometry.rigid_gap_m"],
        model=COMPLETE,
        compare_signals=compare_signals,
        starts=3 if compare_signals == "averages" else 1,
    )
    assert fit["friction.mu_t"].value == pytest.approx(0.055, rel=0.01)
    assert fit["friction.mu_n"].value == pytest.approx(0.48, rel=0.01)
    assert fit["geometry.rigid_gap_m"].value == pytest.approx(0.022, rel=0.01)
    assert all(parameter.verdict == "identified" for parameter in fit.parameters)


@pytest.mark.slow
def test_prescribed_bends_do_not_identify_mass_stiffness_or_damping():
    names = [
        "friction.mu_t",
        "mass.connectors_kg",
        "bending.stiffness_nm_per_rad",
        "bending.damping_time_s",
    ]
    fit = fit_locomotion(
        straight_and_curved()[:2],
        SPEC,
        names,
        model=COMPLETE,
        compare_signals="shapes",
        starts=1,
    )
    for name in names[1:]:
        assert fit[name].verdict == "not identifiable" and fit[name].value is None, name
    assert fit["friction.mu_t"].value is not None


@pytest.mark.slow
def test_the_tail_mass_is_identified_if_the_other_masses_are_known():
    """Only the common scale of the masses cancels."""
    data = runs(
        COMPLETE, {"mass.connectors_kg_5": 0.06}, [(2.0, 0.0), (1.5, 0.2)], seconds=2.0
    )
    fit = fit_locomotion(
        data,
        SPEC,
        ["mass.connectors_kg_5"],
        model=COMPLETE,
        compare_signals="shapes",
        starts=1,
    )
    assert fit["mass.connectors_kg_5"].value == pytest.approx(0.06, rel=0.01)
    everything = [f"mass.connectors_kg_{i}" for i in range(1, 6)]
    fit = fit_locomotion(
        data[:1], SPEC, everything, model=COMPLETE, compare_signals="shapes", starts=1
    )
    assert all(parameter.verdict == "not identifiable" for parameter in fit.parameters)
    assert any(
        np.ptp([row.get(name, 0.0) for name in everything]) < 0.3 for row in fit.cancels
    )


@pytest.mark.slow
def test_a_common_factor_of_mass_stiffness_and_damping_cancels():
    truth = {"bending.stiffness_nm_per_rad": 0.41, "bending.damping_time_s": 0.0025}
    data = runs(COMPLIANT, truth, [(2.0, 0.1)], seconds=0.7)
    fit = fit_locomotion(
        data,
        SPEC,
        [*truth, "mass.connectors_kg"],
        model=COMPLIANT,
        compare_signals="shapes",
        starts=1,
    )
    for name in ("bending.stiffness_nm_per_rad", "mass.connectors_kg"):
        assert (
            fit[name].verdict == "not identifiable" and "combination" in fit[name].why
        )
    assert fit["bending.damping_time_s"].value == pytest.approx(0.0025, rel=0.01)
    (row,) = fit.cancels
    assert row["mass.connectors_kg"] == pytest.approx(
        row["bending.stiffness_nm_per_rad"], abs=0.01
    )
    known_mass = fit_locomotion(
        data, SPEC, list(truth), model=COMPLIANT, compare_signals="shapes", starts=1
    )
    for name, value in truth.items():
        assert known_mass[name].value == pytest.approx(value, rel=0.01)
        assert known_mass[name].verdict == "identified"


def test_metrics_of_a_compliant_body_depend_smoothly_on_its_parameters():
    """The sum of many small changes is at most 1.05 times one large change (default tolerances: 1.27)."""
    spec = load_robot("gen4")
    gait = Gait(1.6, 0.2)
    ends = {
        "friction.mu_t": 0.04,
        "friction.mu_n": 0.026,
        "bending.stiffness_nm_per_rad": 0.028,
    }
    nominal = {
        parameter.name: parameter.start for parameter in free_parameters(spec, ends)
    }
    paths = []
    for fraction in np.linspace(-1.0, 1.0, 21):
        robot = with_values(
            spec,
            {name: nominal[name] * np.exp(fraction * z) for name, z in ends.items()},
        )
        paths.append(COMPLIANT.simulate(_blank(gait, 2.0), robot).com.ravel())
    steps = np.linalg.norm(np.diff(paths, axis=0), axis=1)
    assert steps.sum() < 1.15 * np.linalg.norm(paths[-1] - paths[0])


@pytest.mark.slow
def test_friction_of_the_twin_is_recovered():
    truth = {"friction.mu_t": 0.05, "bending.stiffness_nm_per_rad": 0.38}
    data = runs(TWIN, truth, [(2.0, 0.1)], seconds=1.0)
    fit = fit_locomotion(
        data, SPEC, list(truth), model=TWIN, compare_signals="shapes", starts=1
    )
    assert fit["friction.mu_t"].value == pytest.approx(0.05, rel=0.01)
    assert fit["bending.stiffness_nm_per_rad"].value == pytest.approx(0.38, rel=0.01)


@pytest.mark.slow
def test_stiffness_and_gap_of_the_twin_are_recovered_from_a_distant_start():
    """The start is 15 % off: bends guide the search, because path and heading are informative only nearby."""
    truth = {"bending.stiffness_nm_per_rad": 0.38, "geometry.rigid_gap_m": 0.022}
    data = runs(TWIN, truth, [(2.0, 0.1)], seconds=1.0)
    calls: list[int] = []
    fit = fit_locomotion(
        data,
        SPEC,
        list(truth),
        model=TWIN,
        compare_signals="shapes",
        starts=1,
        watch=lambda k, _: calls.append(k),
    )
    for name, value in truth.items():
        assert fit[name].value == pytest.approx(value, rel=0.01)
        assert fit[name].verdict == "identified"
    assert fit.converged and calls[-1] < 60


@pytest.mark.slow
def test_validation_runs_do_not_influence_the_fit():
    fitted = straight_and_curved()[:2]
    stored = straight_and_curved()[2:]
    names = ["friction.mu_t", "geometry.rigid_gap_m"]
    start = with_values(SPEC, {"friction.mu_n": 0.48})
    alone = fit_locomotion(fitted, start, names, model=COMPLETE, starts=1)
    beside = fit_locomotion(
        fitted, start, names, model=COMPLETE, validation=stored, starts=1
    )
    assert beside.parameters == alone.parameters
    assert 0 < beside.rms("validation") < 0.5
    with pytest.raises(InputError, match="the same data as run_0"):
        fit_locomotion(fitted, SPEC, names, model=COMPLETE, validation=fitted[:1])


@pytest.mark.slow
@pytest.mark.parametrize(("layout", "head"), [("pair", "snake:1a"), ("head", None)])
def test_the_gap_is_recovered_from_markers(tmp_path, layout, head):
    """Markers are reconstructed with a gap that is 4 mm off, then with the fitted one."""
    spec = with_values(SPEC, {"geometry.rigid_gap_m": 0.022})
    truth = SPEC.geometry.rigid_gap
    for _ in range(2):
        write_motive(motion(), Take(layout=layout, labeled=True), tmp_path / "take.csv")
        take = read_motion(tmp_path / "take.csv", spec, layout=layout, head=head)
        fit = measured_length([take], spec, ["friction.mu_t", "geometry.rigid_gap_m"])
        assert fit is not None and fit.value == pytest.approx(truth, abs=4e-4)
        spec = with_values(spec, {"geometry.rigid_gap_m": fit.value})
    assert fit.low <= truth <= fit.high and fit.verdict == "identified"
    assert "from the markers" in fit.why
    length = measured_length([take], spec, ["geometry.segment_length_m"])
    assert length is not None and length.value == pytest.approx(
        SPEC.geometry.segment_length, abs=3e-4
    )
    assert measured_length([take], spec, ["friction.mu_t"]) is None
    assert (
        measured_length(
            [take], spec, ["geometry.segment_length_m", "geometry.rigid_gap_m"]
        )
        is None
    )


@pytest.mark.slow
def test_measured_parameters_are_held_and_listed_in_the_estimate():
    gap = Parameter(
        "geometry.rigid_gap_m",
        "m",
        "identified",
        0.022,
        1e-4,
        0.0217,
        0.0223,
        "measured",
    )
    names = ["friction.mu_t", "friction.mu_n", "geometry.rigid_gap_m"]
    fit = fit_locomotion(
        straight_and_curved(),
        SPEC,
        names,
        model=COMPLETE,
        compare_signals="shapes",
        starts=1,
        known=[gap],
    )
    assert fit["geometry.rigid_gap_m"] == gap
    assert fit["friction.mu_t"].value == pytest.approx(0.055, rel=0.01)
    assert fit.correlation.shape == (3, 3) and (fit.correlation[2] == [0, 0, 1]).all()
    alone = fit_locomotion(
        straight_and_curved()[:1], SPEC, names[2:], model=COMPLETE, known=[gap]
    )
    assert alone.parameters == (gap,) and alone.rms("fit") is not None


def test_a_model_that_does_not_explain_a_walk_has_no_estimate():
    """`complete` has no compliance, so it cannot reproduce the curves of a compliant body."""
    data = runs(
        COMPLIANT, {"bending.stiffness_nm_per_rad": 0.3}, [(2.0, 0.2)], seconds=2.0
    )
    fit = fit_locomotion(
        data, SPEC, ["friction.mu_t"], model=COMPLETE, compare_signals="both", starts=1
    )
    assert fit["friction.mu_t"].verdict == "cannot tell"
    assert any("bend" in line for line in fit.misfit)


def test_unsuitable_walks_are_refused():
    data = straight_and_curved()[:1]
    with pytest.raises(InputError, match="2 samples cannot determine 2 parameters"):
        fit_locomotion(data, SPEC, ["friction.mu_t", "friction.mu_n"], model=COMPLETE)
    with pytest.raises(UnknownNameError, match="plant 'analytic'"):
        PlantModel("analytic")
    with pytest.raises(UnknownNameError, match="residual 'shape'.*did you mean shapes"):
        fit_locomotion(data, SPEC, ["friction.mu_t"], compare_signals="shape")
    short = GaitRun(
        runs(COMPLETE, {}, [(2.0, 0.0)], seconds=1.0)[0].trajectory,
        Gait(2.0),
        48e3,
        "short",
    )
    with pytest.raises(
        InputError, match="short: the speed cannot be averaged over gait periods"
    ):
        fit_locomotion([short], SPEC, ["friction.mu_t"], model=COMPLETE)
