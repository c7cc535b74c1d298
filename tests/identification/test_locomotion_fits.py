"""Locomotion fits: identifiable parameters for both plants, and parameters that cancel."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest
from recorded import motion
from synthetic import moved
from synthetic_takes import Take, write_motive

from srs_twin import Gait, Trajectory, load_robot
from srs_twin.errors import InputError, UnknownNameError
from srs_twin.identification.estimate import FitEstimate, Parameter
from srs_twin.identification.locomotion import (
    GaitRun,
    PlantModel,
    fit_locomotion,
    measured_length,
    signals,
)
from srs_twin.identification.parameters import (
    free_parameters,
    parameter_unit,
    with_values,
)
from srs_twin.recordings.recording import read_motion

SPEC = load_robot("gen2")
COMPLETE = PlantModel(settings={"friction": "wheel"})
COMPLIANT = PlantModel(settings={"model": "compliant", "friction": "wheel"})
TWIN = PlantModel("twin")
TRUTH = {"friction.mu_t": 0.055, "friction.mu_n": 0.48, "geometry.rigid_gap_m": 0.022}


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
    return runs(COMPLETE, TRUTH, [(2.0, 0.0), (1.5, 0.2), (1.6, -0.2)], seconds=2.0)


@pytest.mark.slow
@pytest.mark.parametrize("compare_signals", ["averages", "shapes"])
def test_friction_and_gap_are_recovered_within_one_per_cent(compare_signals):
    fit = fit_locomotion(
        straight_and_curved(),
        SPEC,
        TRUTH,
        model=COMPLETE,
        compare_signals=compare_signals,
        starts=3 if compare_signals == "averages" else 1,
    )
    for name, value in TRUTH.items():
        assert fit[name].value == pytest.approx(value, rel=0.01)
        assert fit[name].verdict == "identified"


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


def known(name: str, value: float) -> Parameter:
    """Return a parameter that was measured beforehand."""
    unit = parameter_unit(name)
    return Parameter(name, unit, "identified", value, 1e-4, value, value, "measured")


def test_residuals_of_the_true_robot_vanish():
    """All parameters are known, so that the walk is simulated once and nothing is fitted."""

    def fitted(values: dict[str, float]) -> FitEstimate:
        return fit_locomotion(
            straight_and_curved()[1:2],
            SPEC,
            TRUTH,
            model=COMPLETE,
            compare_signals="both",
            known=[known(name, value) for name, value in values.items()],
        )

    fit = fitted(TRUTH)
    assert fit.values == TRUTH and fit.rms("fit") < 0.01
    scales = {
        residual.name: (residual.scale, residual.unit) for residual in fit.residuals
    }
    assert scales == {
        "run_1 speed": (0.002, "m/s"),
        "run_1 yaw_rate": (0.01, "rad/s"),
        "run_1 path_x": (0.002, "m"),
        "run_1 path_y": (0.002, "m"),
        "run_1 heading": (0.02, "rad"),
        **{f"run_1 bend_{j}": (0.02, "rad") for j in range(1, 5)},
    }
    assert fitted(TRUTH | {"friction.mu_t": 0.1}).rms("fit") > 1


def test_shapes_do_not_depend_on_the_place_of_the_start():
    run = straight_and_curved()[1].trajectory
    elsewhere = signals(moved(run, 1.0, -2.0, 0.8), run, "shapes", "x")
    for name, values in signals(run, None, "shapes", "x").items():
        assert elsewhere[name] == pytest.approx(values, abs=1e-9), name


@pytest.mark.slow
def test_measured_parameters_are_held_and_another_robot_only_validates():
    gap = known("geometry.rigid_gap_m", 0.022)
    another = TRUTH | {"friction.mu_t": 0.1}
    fit = fit_locomotion(
        straight_and_curved()[:2],
        SPEC,
        TRUTH,
        model=COMPLETE,
        compare_signals="shapes",
        starts=1,
        known=[gap],
        validation=runs(COMPLETE, another, [(1.6, -0.2)], seconds=2.0),
    )
    assert fit["geometry.rigid_gap_m"] == gap
    assert fit.rms("validation") > 1
    assert fit["friction.mu_t"].value == pytest.approx(0.055, rel=0.01)
    assert fit.correlation.shape == (3, 3) and (fit.correlation[2] == [0, 0, 1]).all()


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
