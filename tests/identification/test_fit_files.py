"""Fit files: round trip, roles of the data, and application of a fit to a robot."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from functools import cache
from pathlib import Path
from types import MappingProxyType

import numpy as np
import pytest
from table8 import with_averages
from test_actuator_fits import MODULE, response

from srs_twin import load_robot
from srs_twin.errors import InputError, InputFileError
from srs_twin.identification.actuator import default_actuator_parameters, fit_actuator
from srs_twin.identification.estimate import FitEstimate, Parameter, Residual
from srs_twin.identification.fit_file import (
    DataSet,
    FitFile,
    fit_file,
    load_fit,
    write_fit,
)
from srs_twin.identification.fit_report import fit_report
from srs_twin.identification.fitted_robot import (
    apply_fit,
    fitted_robot,
    robot_override,
)
from srs_twin.identification.fitting import print_estimate
from srs_twin.identification.parameters import (
    free_parameters,
    parameter_names,
    parameter_unit,
    with_values,
)
from srs_twin.identification.priors import Priors
from srs_twin.io.documents import dump_yaml, parse_yaml
from srs_twin.robot.file import RobotFile, resolve_robot

ABOUT = {
    "name": "bench",
    "title": "One module",
    "robot": "gen4_module",
    "method": "actuator",
    "command": "srs-twin calibrate actuator step.csv",
    "versions": {"srs_twin": "0.1.0"},
}
DATA = [
    DataSet("a.csv", "a" * 64, "fit", 300),
    DataSet("b.csv", "b" * 64, "validation", 300, 0.0, 3.0),
]


@cache
def bench() -> FitFile:
    names = [*default_actuator_parameters(MODULE), "mass.connectors_kg_1"]
    fit = fit_actuator(
        [response(noise=0.005)],
        MODULE,
        names=names,
        validation=[response(noise=0.005, seed=7)],
    )
    return fit_file(fit, **ABOUT, data=DATA)


def gen2_fit(
    *parameters: Parameter, held: Mapping[str, float] = MappingProxyType({})
) -> FitFile:
    """Return a fit of generation 2 whose parameters are not correlated."""
    estimate = FitEstimate(parameters, np.eye(len(parameters)), held=held)
    return fit_file(estimate, **(ABOUT | {"robot": "gen2"}), data=DATA)


def test_a_fit_file_is_read_back(tmp_path: Path):
    fit = bench()
    path = write_fit(fit, tmp_path / "fits" / "bench.yaml")
    assert load_fit(path) == fit
    estimate = load_fit(path).estimate()
    assert estimate["actuator.tau_fill_s"].value == fit.parameters[0].value
    assert estimate["mass.connectors_kg_1"].value is None
    assert np.isnan(estimate.correlation[-1]).all()
    assert (np.diag(estimate.correlation)[:-1] == 1).all()
    lost = fit.model_dump(mode="json", exclude_none=True)["parameters"][-1]
    assert "value" not in dump_yaml(lost)


def resolved(block) -> RobotFile:
    """Return the robot of a scenario with a given robot block."""
    document = parse_yaml(dump_yaml({"robot": block}), "scenario.yaml")
    file = resolve_robot(document, document.data["robot"], prefix=("robot",))
    document.raise_problems()
    assert file is not None
    return file


def test_a_fit_is_applied_to_the_robot_of_a_scenario():
    fit = bench()
    robot = resolved(robot_override(fit)).spec()
    for parameter in fit.parameters:
        if parameter.value is not None:
            assert free_parameters(robot, [parameter.name])[0].start == pytest.approx(
                parameter.value, rel=1e-8
            ), parameter.name
    assert robot.mass == MODULE.mass
    assert robot.actuator.gain == pytest.approx(MODULE.actuator.gain)


@pytest.mark.default_cases(at=[0, 4, 5, 6, 9, 14, 17, 19, 26])
@pytest.mark.parametrize("name", parameter_names())
def test_every_parameter_reaches_the_robot(name):
    """Value, unit, status and source pass through the file, and nothing else changes."""
    spec = load_robot("gen2")
    limited = replace(spec, actuator=replace(spec.actuator, bend_limit=2.0))
    everything = [name.replace("_N", "_2") for name in parameter_names()]
    name = name.replace("_N", "_2")
    (start,) = free_parameters(limited, [name])
    value = start.start * 1.25 if start.scale is None else start.start + 0.01
    changed = with_values(limited, {name: value})
    for other in everything:
        if other.startswith("mass.") and name.startswith("mass."):
            continue
        (before,), (after,) = (
            free_parameters(robot, [other]) for robot in (limited, changed)
        )
        assert after.start == (pytest.approx(value) if other == name else before.start)
    result = Parameter(
        name,
        parameter_unit(name),
        "identified",
        value,
        0.001,
        value - 0.002,
        value + 0.002,
    )
    file = resolved(robot_override(gen2_fit(result)))
    assert free_parameters(file.spec(), [name])[0].start == pytest.approx(
        value, rel=1e-8
    )
    records = [r for r in file.records().values() if "fit bench" in r.source]
    assert records and all(record.status == "calibrated" for record in records)
    expected = with_values(spec, {name: value})
    assert file.spec().mass.connectors == pytest.approx(expected.mass.connectors)


def test_the_misfit_of_a_model_is_stored_in_the_file(tmp_path: Path):
    unsure = Parameter(
        "friction.mu_t", "1", "cannot tell", 0.05, 0.01, 0.03, 0.08, "spread"
    )
    left = Residual("walk.csv yaw_rate", "rad/s", np.array([0.05]), 0.01)
    estimate = FitEstimate((unsure,), np.eye(1), (left,), residual_scale=5.0)
    file = fit_file(estimate, **(ABOUT | {"robot": "gen2"}), data=DATA)
    again = load_fit(write_fit(file, tmp_path / "x.yaml"))
    assert again.parameters[0].verdict == "cannot tell"
    assert again.quality.misfit == [
        "the model does not explain the data; these intervals do not hold",
        "residuals of yaw_rate: 5 times the noise, most in walk.csv",
    ]
    assert robot_override(file)["friction"]["mu_t"]["value"] == 0.05
    with pytest.raises(InputError, match="the fit identifies no parameter"):
        robot_override(file, weak=False)


def test_numbers_of_a_fit_are_printed_and_reported(capsys):
    """Weighted residuals of 0.6, −0.8 and 0.5 have an RMS of 0.645."""
    folder = "far/" + 20 * "away"  # a path must not be wrapped
    stiffness = "bending.stiffness_nm_per_rad"
    parameters = (
        Parameter("friction.mu_t", "1", "identified", 0.051234, 0.0012, 0.048, 0.0545),
        Parameter(
            stiffness, "N*m/rad", "weakly identified", 0.4, 0.06, 0.3, 0.5, "why"
        ),
        Parameter("mass.connectors_kg", "kg", "not identifiable", why="no effect"),
    )
    correlation = np.full((3, 3), np.nan)
    correlation[:2, :2] = [[1.0, -0.63], [-0.63, 1.0]]
    residuals = (
        Residual(f"{folder} bend_1", "rad", np.array([0.03, -0.04]), 0.05),
        Residual("a.csv ratio", "1", np.array([1.0]), 2.0),
        Residual("b.csv bend_1", "rad", np.array([0.1]), 0.05, "validation"),
    )
    estimate = FitEstimate(
        parameters,
        correlation,
        residuals,
        ({"mass.connectors_kg": 0.707, stiffness: -0.708},),
        samples=3,
        independent=2.5,
        held={"friction.mu_n": 0.57},
        converged=False,
    )
    print_estimate(estimate)
    rows = [" ".join(line.split()) for line in capsys.readouterr().out.splitlines()]
    assert "friction.mu_t 0.051234 0.048 to 0.0545 1 identified" in rows
    assert rows[rows.index(f"{stiffness}: why") :] == [
        f"{stiffness}: why",
        "mass.connectors_kg: no effect",
        f"correlation -0.63: friction.mu_t, {stiffness}",
        f"unidentifiable direction: +0.71 mass.connectors_kg, -0.71 {stiffness}",
        "fit: residuals 0.645 times the expected noise",
        f"{folder} bend_1: 0.0354 rad RMS",
        "a.csv ratio: 1 RMS",
        "validation: residuals 2 times the expected noise",
        "b.csv bend_1: 0.1 rad RMS",
        "the search did not converge",
    ]
    assert estimate.text().splitlines() == [
        "friction.mu_t: 0.051234 ± 0.0012, 95 % 0.048 to 0.0545: identified",
        f"{stiffness}: 0.4 ± 0.06 N*m/rad, 95 % 0.3 to 0.5: weakly identified; why",
        "mass.connectors_kg: not identifiable; no effect",
    ]
    fit = fit_file(estimate, **(ABOUT | {"robot": "gen2"}), data=DATA)
    page = fit_report(fit, estimate)
    for text in (
        "RMS of the weighted residuals of the fit 0.645, of the validation data 2 (1 if"
        " they are as large as the expected noise); 3 samples, equivalent to 2.5"
        " independent samples.",
        "Residuals of b.csv (not used by the fit).",
        ">0.048 to 0.0545<",
        ">-0.63<",
        ">0.57<",
    ):
        assert text in page


def test_held_values_that_differ_from_the_robot_are_applied_with_the_fit():
    """A value fitted with a length of 0.2 m is invalid for a robot of another length."""
    result = Parameter("friction.mu_t", "1", "identified", 0.05, 0.001, 0.04, 0.06)
    spec = load_robot("gen2")
    held = {
        "geometry.segment_length_m": 0.2,
        "friction.mu_n": spec.friction.mu_n,
        "spin_fraction": 0.5,
    }
    fit = gen2_fit(result, held=held)
    block = robot_override(fit)
    assert set(block) == {"base", "friction", "geometry"} and set(
        block["friction"]
    ) == {"mu_t"}
    robot = resolved(block)
    expected = with_values(spec, held | {"friction.mu_t": 0.05})
    assert apply_fit(fit, spec) == expected
    assert replace(robot.spec(), title=spec.title) == expected
    length = robot.records()["geometry.segment_length_m"]
    assert length.status == "estimated" and "held in fit bench" in length.source


def test_a_fit_without_a_value_predicts_nothing(tmp_path: Path):
    lost = Parameter(
        "friction.mu_n", "1", "not identifiable", why="only the ratio acts"
    )
    fit = Parameter("friction.mu_t", "1", "identified", 0.05, 0.001, 0.04, 0.06)
    estimate = FitEstimate((fit, lost), np.eye(2), held={"friction.mu_n": 0.57})
    bare = fit_file(estimate, **(ABOUT | {"robot": "gen2", "data": DATA[:1]}))
    whole = with_averages(bare, {"a.csv": ({"speed": 1.0}, {"speed": 1.1})})
    path = write_fit(whole, tmp_path / "x.yaml")
    assert load_fit(path) == whole
    path.write_text(
        path.read_text().replace("  friction.mu_n: 0.57", "  friction.mu_x: 0.57")
    )
    with pytest.raises(
        InputFileError,
        match=r"x.yaml:\d+:\d+: .*although friction.mu_n has no value",
    ):
        load_fit(path)


def test_a_robot_with_random_gains_is_refused_as_base(tmp_path: Path):
    text = (
        Path(__file__).parents[2] / "calibration/robots/gen4_module.yaml"
    ).read_text()
    spread = '{gain_spread: {value: 0.1, unit: "1", status: estimated, source: x}}'
    (tmp_path / "drawn.yaml").write_text(text + f"\nmodules: {spread}\n")
    fit = Parameter("modules.gain_plus_1", "1", "identified", 1.1, 0.001, 1.0, 1.2)
    about = ABOUT | {"robot": str(tmp_path / "drawn.yaml")}
    with pytest.raises(InputError, match="draws these values at random"):
        robot_override(fit_file(FitEstimate((fit,), np.eye(1)), **about, data=DATA))


def test_the_format_refuses_shared_fit_and_validation_data(tmp_path: Path):
    fit = bench()
    same = [
        DataSet("a.csv", "a" * 64, "fit", 300),
        DataSet("again.csv", "a" * 64, "validation", 300),
    ]
    with pytest.raises(
        InputError, match="again.csv: this data set contains the same data as a.csv"
    ):
        fit_file(fit.estimate(), **ABOUT, data=same)
    path = tmp_path / "x.yaml"
    path.write_text(
        write_fit(fit, tmp_path / "y.yaml").read_text().replace("b" * 64, "a" * 64)
    )
    with pytest.raises(
        InputFileError,
        match=r"x.yaml:\d+:\d+: data: b.csv: this data set contains the same data",
    ):
        load_fit(path)
    halves = [replace(data, from_s=k, to_s=k + 1.0) for k, data in enumerate(same)]
    assert len(fit_file(fit.estimate(), **ABOUT, data=halves).data) == 2


def test_the_uncertainty_of_a_fit_is_stored_in_the_robot(tmp_path):
    """A 95 % interval is 3.92 standard deviations wide, here 0.0392 N for the drag.

    Correlations below 0.05 are omitted, and 0.99 is the largest.
    """
    names = ("friction.mu_t", "bending.stiffness_nm_per_rad", "friction.drag_n")
    ends = ((0.04, 0.06), (0.3, 0.5), (-0.0096, 0.0296))
    fit = [
        Parameter(
            name, parameter_unit(name), "identified", high - 0.01, 0.01, low, high
        )
        for name, (low, high) in zip(names, ends, strict=True)
    ]
    rows = [[1.0, 1.0, 0.049], [1.0, 1.0, -0.051], [0.049, -0.051, 1.0]]
    path = tmp_path / "mine.yaml"
    estimate = FitEstimate(tuple(fit), np.array(rows))
    write_fit(fit_file(estimate, **ABOUT | {"robot": "gen2"}, data=DATA), path)
    robot = fitted_robot([path], "mine")
    priors = Priors.from_robot(robot)
    places = [priors.paths.index(name) for name in names]
    assert priors.correlation[np.ix_(places, places)].tolist() == [
        [1.0, 0.99, 0.0],
        [0.99, 1.0, -0.051],
        [0.0, -0.051, 1.0],
    ]
    quantiles = priors.parameters[places[0]].quantile(np.array([0.025, 0.975]))
    assert quantiles[1] / quantiles[0] == pytest.approx(1.5, rel=1e-3)
    drag = robot.records()["friction.drag_n"]
    assert (drag.uncertain.kind, drag.uncertain.sd) == ("normal", pytest.approx(0.01))
    assert drag.source.endswith("friction.drag_n -0.0096 to 0.0296 (identified)")
