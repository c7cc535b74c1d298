"""Priors, surrogates and propagation, compared with known functions and brute force; the command."""

from __future__ import annotations

import json
import math
import re
from collections.abc import Callable, Iterable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy import stats

from srs_twin import Scenario, TwinSnake, rollout
from srs_twin.comparison.metrics import plant_metrics
from srs_twin.errors import InputError, InputFileError
from srs_twin.experiment import stored_intervals
from srs_twin.identification.priors import Priors
from srs_twin.io.documents import Document, dump_yaml
from srs_twin.io.validation import validate
from srs_twin.robot.file import RobotFile, load_robot_file
from srs_twin.scenario.loading import load_scenario
from srs_twin.studies.sweep.execution import OpenSweep, local
from srs_twin.studies.uncertainty.command import _print_result
from srs_twin.studies.uncertainty.plots import draw_intervals
from srs_twin.studies.uncertainty.propagation import (
    REFERENCE_ROWS,
    Propagation,
    propagate,
)
from srs_twin.studies.uncertainty.study import LEAD, SEGMENTS, UncertaintyStudy
from srs_twin.studies.uncertainty.surrogates import (
    GaussianProcess,
    PolynomialChaos,
    predict_high_fidelity,
)

FRACTIONS = (np.arange(4000) + 0.5) / 4000


def robot(**uncertain: dict[str, Any]) -> RobotFile:
    """Return generation 2 with only the given parameters uncertain: section__key={...}."""
    data = load_robot_file("gen2").model_dump(mode="json")
    for section in data.values():
        for record in section.values() if isinstance(section, dict) else ():
            if isinstance(record, dict):
                record.pop("uncertain", None)
    for path, spread in uncertain.items():
        section, key = path.split("__")
        data[section][key]["uncertain"] = spread
    return RobotFile.model_validate(data)


def study_of(
    scenario: Scenario, *, plants: tuple[str, ...] = ("analytical",), **settings: Any
) -> UncertaintyStudy:
    """Return a study of the uncertain parameters of a scenario's robot."""
    file = RobotFile.model_validate(scenario.document["robot"])
    return UncertaintyStudy(scenario, Priors.from_robot(file), plants, **settings)


@pytest.mark.parametrize(
    ("spread", "expected"),
    [
        ({"kind": "normal", "sd": 0.004}, stats.norm(0.043, 0.004)),
        (
            {"kind": "normal", "sd": 0.05},
            stats.truncnorm(-0.043 / 0.05, 9.957 / 0.05, loc=0.043, scale=0.05),
        ),
        (
            {"kind": "lognormal", "factor": 1.5},
            stats.lognorm(math.log(1.5), scale=0.043),
        ),
        ({"kind": "uniform", "low": 0.03, "high": 0.05}, stats.uniform(0.03, 0.02)),
    ],
)
def test_samples_have_the_distribution_of_the_file(spread, expected):
    (prior,) = Priors.from_robot(robot(friction__mu_t=spread)).parameters
    assert prior.quantile(FRACTIONS) == pytest.approx(expected.ppf(FRACTIONS), rel=1e-9)


def test_samples_have_the_correlation_of_the_file():
    file = robot(
        friction__mu_t={"kind": "normal", "sd": 0.002},
        bending__stiffness_nm_per_rad={"kind": "normal", "sd": 0.02},
        geometry__half_track_m={"kind": "uniform", "low": 0.01, "high": 0.02},
    )
    paths = ("friction.mu_t", "bending.stiffness_nm_per_rad")
    data = file.model_dump(mode="json") | {
        "correlated": [{"of": list(paths), "r": -0.7}]
    }
    priors = Priors.from_robot(RobotFile.model_validate(data))
    drawn = np.corrcoef(priors.quantile(stats.qmc.Sobol(3, rng=0).random(4096)).T)
    i, j = (priors.paths.index(path) for path in paths)
    k = 3 - i - j
    assert drawn[i, j] == pytest.approx(-0.7, abs=0.01)
    assert abs(drawn[i, k]) < 0.01


@pytest.mark.parametrize(
    ("spread", "message"),
    [
        (
            {"kind": "normal", "factor": 2.0},
            "the distribution `normal` needs sd, but factor was given",
        ),
        (
            {"kind": "uniform", "low": 0.05, "high": 0.04},
            "`low` 0.05 must be below `high` 0.04",
        ),
        (
            {"kind": "uniform", "low": 0.05, "high": 0.06},
            "the number 0.043 lies outside the uniform range from 0.05 to 0.06",
        ),
        (
            {"kind": "uniform", "low": -1.0, "high": 0.06},
            "the range from -1 to 0.06 exceeds the allowed range from 0 to 10",
        ),
        ({"kind": "normel", "sd": 1.0}, "normal"),
    ],
)
def test_invalid_distributions_are_refused_with_their_location(spread, message):
    data = robot().model_dump(mode="json")
    data["friction"]["mu_t"]["uncertain"] = spread
    document = Document("mine.yaml", data)
    validate(RobotFile, document, data)
    with pytest.raises(InputFileError, match="friction.mu_t.uncertain") as caught:
        document.raise_problems()
    assert message in str(caught.value)


@pytest.mark.parametrize(
    ("name", "pressure_kpa", "volume_ml"),
    [
        ("gen1", 31.0, 15.0),
        ("gen2", 48.3, 45.0),
        ("gen3", 48.3, 45.0),
        ("gen4", 62.1, 70.0),
    ],
)
def test_shipped_stiffness_stores_a_quarter_to_all_of_the_work_of_the_air(
    name, pressure_kpa, volume_ml
):
    record = load_robot_file(name).records()["bending.stiffness_nm_per_rad"]
    bound = pressure_kpa * 1e3 * volume_ml * 1e-6 / (math.pi / 2) ** 2
    ends = [record.uncertain.low, record.value, record.uncertain.high]
    assert ends == pytest.approx(
        [bound / 4, bound / 2, bound], rel=0.01
    )  # two printed digits


@pytest.mark.default_cases(2)
@pytest.mark.parametrize("name", ["gen1", "gen2", "gen3", "gen4"])
def test_no_shipped_robot_has_uncertain_drag(name):
    record = load_robot_file(name).records().get("friction.drag_n")
    assert record is None or (record.value == 0 and record.uncertain is None)


def test_a_robot_without_uncertain_parameters_is_refused():
    with pytest.raises(InputError, match="the robot file has no uncertain values"):
        Priors.from_robot(robot())


def test_a_set_parameter_is_not_uncertain():
    result = load_scenario("gen2_straight", set={"robot.friction.mu_t": 0.05})
    assert "uncertain" not in result.document["robot"]["friction"]["mu_t"]
    assert "uncertain" in result.document["robot"]["friction"]["mu_n"]


def test_errors_of_indices_cover_their_sampling_error():
    main = np.array([2.15, 1.0, 0.15]) ** 2
    interaction = 0.3**2 / 12 * np.array([1, 0, 1])
    expected = np.array([main, main + interaction]) / (main.sum() + 0.3**2 / 12)
    held = []
    for seed in range(20):
        u = stats.qmc.Sobol(3, rng=seed).random(64)
        y = 2 * u[:, 0] + u[:, 1] + 0.3 * u[:, 0] * u[:, 2]
        exact = PolynomialChaos.fit(u, y[:, None])
        assert exact.indices[..., 0] == pytest.approx(expected, abs=1e-9)
        noise = 0.05 * np.random.default_rng(seed).normal(size=64)
        result = PolynomialChaos.fit(u, (y + noise)[:, None])
        error = np.abs(result.indices[..., 0] - expected)
        held.append(error <= result.index_half_width[..., 0])
    assert np.mean(held) >= 0.9


def test_a_gaussian_process_without_a_smooth_part_is_ridge_regression():
    """The posterior of the weights of 1 and h is known for a prior variance b² and a noise variance n²."""
    rng = np.random.default_rng(5)
    x = rng.normal(size=(7, 2))
    y = 3 + rng.normal(size=7)
    new = rng.normal(size=(4, 2))
    b = 0.7
    n = 0.9
    process = GaussianProcess(x, y, log_hyperparameters=np.log([1e-9, b, n, 1.0, 1.0]))
    known, study_ = (np.column_stack([np.ones(len(item)), item]) for item in (x, new))
    precision = known.T @ known / n**2 + np.eye(3) / b**2
    assert process.at(new) == pytest.approx(
        study_ @ np.linalg.solve(precision, known.T @ y) / n**2, rel=1e-6
    )
    expected = study_ @ np.linalg.inv(precision) @ study_.T
    assert process.covariance(new) == pytest.approx(expected, rel=1e-6, abs=1e-8)


def test_few_high_fidelity_runs_correct_a_low_fidelity_model():
    """Quantiles of 2,048 samples from 64 high-fidelity runs are within 3 % of the interval."""

    def cheap(u: np.ndarray) -> np.ndarray:
        return np.asarray(np.exp(u[:, 0]) + u[:, 1] * u[:, 2] + 0.2 * u[:, 3])

    def costly(u: np.ndarray) -> np.ndarray:
        return np.asarray(
            0.8 * cheap(u) + 0.3 * np.sin(3 * u[:, 1]) + 0.1 * u[:, 4] * u[:, 0]
        )

    fractions = stats.qmc.Sobol(5, rng=3).random(2048)
    result, _ = predict_high_fidelity(
        fractions, cheap(fractions), costly(fractions[:64])
    )
    ends, expected = (
        np.quantile(item, [0.025, 0.975]) for item in (result, costly(fractions))
    )
    assert np.abs(ends - expected).max() < 0.03 * np.ptp(expected)
    assert result == pytest.approx(costly(fractions), abs=0.05)
    alone = np.quantile(costly(fractions[:64]), [0.025, 0.975])
    assert np.abs(ends - expected).max() < 0.5 * np.abs(alone - expected).max()


@pytest.fixture
def short(tmp_path) -> Callable[..., Path]:
    """Return a function that writes a short scenario with two uncertain parameters and an expectation."""

    def make(**changes: Any) -> Path:
        data: dict[str, Any] = {
            "title": "Short",
            "robot": (
                robot(
                    friction__mu_t={"kind": "uniform", "low": 0.03, "high": 0.06},
                    bending__stiffness_nm_per_rad={"kind": "lognormal", "factor": 1.3},
                ).model_dump(mode="json", exclude_none=True)
            ),
            "duration_s": 2.0,
            "controller": {"kind": "gait", "frequency_hz": 2.0, "offset": 0.0},
            "plants": {"analytical": {"model": "compliant", "friction": "wheel"}},
            "expect": [
                {
                    "metric": "com_speed_m_s",
                    "plant": "analytical",
                    "published": 0.19,
                    "within": "interval_95",
                }
            ],
        } | changes
        path = tmp_path / "short.yaml"
        path.write_text(dump_yaml(data), "utf-8")
        return path

    return make


@pytest.mark.slow
def test_expectations_use_stored_intervals_until_the_scenario_changes(
    srs_twin, short, tmp_path
):
    path = short()
    without = srs_twin("run", str(path), "--check", cwd=tmp_path)
    assert without.returncode == 0
    assert (
        "no interval is stored" in without.stdout
        and "expectations: 1 not judged" in without.stderr
    )
    done = srs_twin(
        "uncertainty",
        str(path),
        "--samples",
        "64",
        "--workers",
        "1",
        "--write",
        "--json",
        cwd=tmp_path,
    )
    assert done.returncode == 0, done.stderr
    result = json.loads(done.stdout)
    speed = result["plants"]["analytical"]["com_speed_m_s"]
    low, high = speed["interval_95"]
    stored = json.loads(
        (tmp_path / "calibration/intervals/short.json").read_text("utf-8")
    )
    assert stored["plants"]["analytical"]["com_speed_m_s"][
        "interval_95"
    ] == pytest.approx([low, high], rel=1e-5)
    options = ("run", str(path), "--check", "--json", "--junit", "r.xml")
    for changed in ((), ("--seed", "1")):
        judged = srs_twin(*options, *changed, cwd=tmp_path)
        (row,) = json.loads(judged.stdout)["expectations"]
        states = {"within": "met", "undecided": "not_judged", "outside": "missed"}
        assert row["state"] == states[speed["verdict"]]
        assert judged.returncode == (1 if row["state"] == "missed" else 0)
        assert ("<failure" in (tmp_path / "r.xml").read_text("utf-8")) == (
            row["state"] == "missed"
        )
    assert row["error"] == pytest.approx(row["value"] - 0.19)
    # Another law, seen in the value; another scenario.
    stored["plants"]["analytical"]["com_speed_m_s"]["value"] += 0.011 * (high - low)
    (tmp_path / "calibration/intervals/short.json").write_text(
        json.dumps(stored), "utf-8"
    )
    moved = srs_twin("run", str(path), "--check", cwd=tmp_path)
    short(controller={"kind": "gait", "frequency_hz": 2.0, "offset": 0.1})
    stale = srs_twin("run", str(path), "--check", cwd=tmp_path)
    for item, why in (
        (moved, "the stored interval was computed for the value "),
        (stale, "for another robot or scenario"),
    ):
        assert item.returncode == 0
        assert (
            why in (message := " ".join(item.stdout.split()))
            and "not judged" in message
        )
        assert "srs-twin uncertainty" in message.replace("srs- twin", "srs-twin")


def segments_of_gen2() -> list[tuple[float, float, float]]:
    """Return stiffness (N·m/rad), damping time and time step (s) of nine robots.

    The 95 % intervals: uniform from 0.22 to 0.88 N·m/rad; lognormal with median 1.22 ms
    and factor 1.6.
    """
    stiffnesses = (0.44, 0.22 + 0.025 * 0.66, 0.22 + 0.975 * 0.66)
    times = (2.14e-3, 1.22e-3 * 1.6**-1.96, 1.22e-3 * 1.6**1.96)
    return [
        (stiffness, time, 0.5e-3 if time < 1e-3 else 1e-3)
        for stiffness in stiffnesses
        for time in times
    ]


def test_segments_vary_over_their_95_per_cent_intervals():
    scenario = load_scenario("gen2_straight")
    study = study_of(scenario, plants=("analytical", "twin"), samples=16)
    sweep = study.sweep(SEGMENTS)
    columns = [
        sweep.fields.index(name)
        for name in (
            "robot.bending.stiffness_nm_per_rad",
            "robot.bending.damping_time_s",
            "plants.twin.timestep_s",
        )
    ]
    rows = np.array(sweep.values)[:, columns]
    assert rows == pytest.approx(np.array(segments_of_gen2()), rel=1e-4)
    rows = np.array(study.sweep("twin").values)[:, columns]
    # A step is at most 1.5 times the damping time.
    steps = [0.5e-3 if time < 1e-3 / 1.5 else 1e-3 for time in rows[:16, 1]]
    assert rows[:, 2].tolist() == [*steps, 1e-3, 1e-3, 0.5e-3] and len({*steps}) == 2


@pytest.mark.slow
def test_stored_range_over_the_segments_is_that_of_other_robots():
    scenario = load_scenario("gen2_straight")
    spec = scenario.robot
    speeds = []
    for stiffness, time, step in segments_of_gen2():
        bending = replace(spec.bending, stiffness=stiffness, damping_time=time)
        twin = TwinSnake(
            replace(spec, bending=bending), supply_pa=scenario.supply_pa, timestep=step
        )
        run = rollout(twin, scenario.build_controller(), scenario.duration)
        speeds.append(plant_metrics(run)["com_speed_m_s"])
    stored = stored_intervals(scenario)["segments"]
    # The ends above are rounded. Close to a resonance this rounding changes the speed
    # by up to 2 %.
    assert stored["damping"] == pytest.approx(
        [min(speeds[:3]), max(speeds[:3])], rel=0.005
    )
    assert stored["stiffness_and_damping"] == pytest.approx(
        [min(speeds), max(speeds)], rel=0.02
    )


def test_a_second_start_repeats_no_run_and_prints_the_same(short, tmp_path):
    study = study_of(load_scenario(short()), samples=32)
    first = propagate(study, tmp_path / "out", local(1)).document()
    seen: list[tuple[str, int]] = []

    def progress(part: str, total: int, row: object) -> None:
        seen.append((part, total))

    second = propagate(study, tmp_path / "out", local(1), progress).document()
    assert seen == []
    assert first == second


def test_a_result_is_invalidated_before_its_rows_change(short, tmp_path, monkeypatch):
    """A process killed in between leaves no intervals.json next to tables of other samples."""
    scenario = load_scenario(short())
    folder = tmp_path / "out"
    marked = []
    finish = OpenSweep.finish

    def watched(opened):
        marked.append((folder / "intervals.json").exists())
        return finish(opened)

    monkeypatch.setattr(OpenSweep, "finish", watched)
    for samples, changed in ((17, False), (17, False), (16, True)):
        propagate(
            study_of(scenario, samples=samples),
            folder,
            local(1),
            changed=changed,
        )
        (folder / "intervals.json").write_text("{}")
    assert marked == [False, True, False]


@pytest.mark.slow
def test_the_command_prints_samples_and_errors(srs_twin, short, tmp_path):
    options = ("uncertainty", str(short()), "--samples", "16", "--workers", "1")
    shown = srs_twin(*options, cwd=tmp_path)
    assert shown.returncode == 0
    assert "± at 95 %: standard errors of the two ends" in shown.stdout
    document = json.loads(srs_twin(*options, "--json", cwd=tmp_path).stdout)
    assert "more --samples or --twin reduce these errors" in shown.stderr
    for text in document["warnings"]:
        assert f"warning: {text}\n" in shown.stderr
    speed = document["plants"]["analytical"]["com_speed_m_s"]
    assert (speed["samples"], speed["runs"]) == (16, 16)
    quiet = srs_twin(*options, "--quiet", cwd=tmp_path)
    assert (quiet.stdout, quiet.stderr) == ("", "")


def test_the_command_says_why_no_measurement_is_recommended(capsys):
    scenario = load_scenario("gen2_straight")
    study = study_of(scenario, samples=32, discrete_choices={LEAD: (0.0, 0.1)})
    fractions = np.full((2, len(study.names)), [[0.1], [0.9]])
    assert study.snapped(fractions)[:, -1].tolist() == [0.25, 0.75]
    leads = [row[-2] for row in study.sweep("analytical").values[:32]]
    assert leads == [0.0 if u < 0.5 else 0.1 for u in study.fractions[:, -1]]
    noise = np.random.default_rng(0).normal(0.2, 0.01, 32 + REFERENCE_ROWS)
    noise[-REFERENCE_ROWS + 1] = 0.2
    noise[:3] = np.nan
    known = noise[3:-REFERENCE_ROWS]
    segments = {"com_speed_m_s": np.array([0.2, 0.1, 0.25, *[0.3] * 5, 0.05])}
    rows = {"analytical": {"com_speed_m_s": noise}, SEGMENTS: segments}
    result = Propagation(study, rows)
    assert not result.measure_next() and result.failed == {"analytical": 3}
    _print_result(result)
    shown = capsys.readouterr().out
    low, first, third, high = np.quantile(known, [0.025, 0.25, 0.75, 0.975])
    assert re.search(
        rf"CoM speed \(m/s\) +0.2 +{first:.3g}–{third:.3g} +{low:.3g}–{high:.3g} ",
        shown,
    )
    assert "analytical, 29 samples" in shown and "without a result: 3 of" in shown
    for varied, ends in (
        ("stiffness and damping", "0.05 to 0.3"),
        ("damping", "0.1 to 0.25"),
    ):
        assert f"with {varied} at the file's" in shown
        assert f"the twin crawls at {ends} m/s" in shown
    assert "uncertain numbers and 1 model form (robot.bending.lead)" in shown
    assert "the parameters is not resolved with 29 samples" in shown


def test_the_picture_shows_the_published_value_and_all_labels():
    path = "bending.pitch_stiffness_nm_per_rad"
    index = {"rank": [1, 2], "total": 0.5, "total_error": 0.2}
    row = {
        "value": 0.2,
        "published": 0.205,
        "interval_50": [0.19, 0.21],
        "interval_95": [0.18, 0.22],
        "interval_95_error": [0.001, 0.001],
        "samples": 64,
        "runs": 64,
        "sensitivity": {path: index},
    }
    figure = draw_intervals(
        "title",
        {
            "target": {"plant": "twin", "metric": "com_speed_m_s"},
            "plants": {"twin": {"com_speed_m_s": row}},
            "swings": [{"parameter": path, "low": 0.19, "high": 0.21, "error": 0.0}],
            "warnings": [],
        },
    )
    (published,) = (line for line in figure.axes[0].lines if 0.205 in line.get_xdata())
    assert list(published.get_ydata()) == [-0.3, 0.3]
    (cause,) = figure.axes[1].get_yticklabels()
    assert cause.get_text().endswith("\n50 ± 20 %, rank 1 to 2")
    assert figure.axes[1].get_xlim() == pytest.approx((0.189, 0.211))
    figure.draw_without_rendering()
    for axes in figure.axes:
        for label in axes.get_yticklabels():
            assert label.get_window_extent().x0 > 0


def test_samples_and_reference_values_are_those_of_single_runs(short, tmp_path):
    scenario = load_scenario(short())
    study = study_of(scenario, samples=16)
    priors = study.priors
    result = propagate(study, tmp_path / "out", local(1))
    spread = result.plants["analytical"]["com_speed_m_s"]
    step = scenario.document["plants"]["analytical"]["timestep_s"]

    def speed(values: Iterable[float], step: float = step) -> float:
        names = (f"robot.{path}" for path in priors.paths)
        changes = dict(zip(names, values, strict=True))
        changes["plants.analytical.timestep_s"] = step
        other = load_scenario(short(), set=changes)
        run = rollout(
            other.build_plant("analytical"),
            other.build_controller(),
            other.duration,
            record_hz=other.record_hz,
        )
        return plant_metrics(run)["com_speed_m_s"]

    medians = priors.quantile(np.full(2, 0.5)).tolist()
    assert medians[priors.paths.index("friction.mu_t")] == pytest.approx(0.045)
    nominal = [prior.value for prior in priors.parameters]
    fifth = priors.quantile(study.fractions[4]).tolist()
    found = (spread.at_medians, spread.value, spread.half_timestep, spread.samples[4])
    expected = (speed(medians), speed(nominal), speed(nominal, step / 2), speed(fifth))
    assert found == pytest.approx(expected, rel=1e-9)
