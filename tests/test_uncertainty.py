"""Priors, surrogates, propagation: against distributions, known functions, brute force and the command."""

from __future__ import annotations

import json
import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import stats

from srs_twin.errors import InputError, InputFileError
from srs_twin.io.documents import Document, dump_yaml
from srs_twin.io.validation import validate
from srs_twin.robot.file import RobotFile, load_robot_file
from srs_twin.robot.priors import Priors
from srs_twin.scenario.loading import load_scenario
from srs_twin.studies.sweep.execution import OpenSweep, local
from srs_twin.studies.uncertainty.propagation import propagate
from srs_twin.studies.uncertainty.study import Study
from srs_twin.studies.uncertainty.surrogates import Chaos, GaussianProcess, corrected

SHARES = (np.arange(4000) + 0.5) / 4000


def robot(**uncertain: dict[str, Any]) -> RobotFile:
    """Return generation 2 with nothing but these numbers uncertain: section__key={...}."""
    data = load_robot_file("gen2").model_dump(mode="json")
    for section in data.values():
        for record in section.values() if isinstance(section, dict) else ():
            if isinstance(record, dict):
                record.pop("uncertain", None)
    for path, spread in uncertain.items():
        section, key = path.split("__")
        data[section][key]["uncertain"] = spread
    return RobotFile.model_validate(data)


@pytest.mark.parametrize(
    ("spread", "expected"),
    [
        ({"kind": "normal", "sd": 0.004}, stats.norm(0.043, 0.004)),
        ({"kind": "lognormal", "factor": 1.5}, stats.lognorm(math.log(1.5), scale=0.043)),
        ({"kind": "uniform", "low": 0.03, "high": 0.05}, stats.uniform(0.03, 0.02)),
    ],
)
def test_numbers_follow_the_distribution_that_the_file_says(spread, expected):
    (prior,) = Priors.of(robot(friction__mu_t=spread)).each
    assert prior.at(SHARES) == pytest.approx(expected.ppf(SHARES), rel=1e-9)


@pytest.mark.slow
@given(sd=st.floats(1e-4, 10.0), share=st.floats(0.0, 1.0), more=st.floats(0.0, 1.0))
def test_normal_numbers_stay_where_files_allow_them_and_rise_with_their_share(sd, share, more):
    (prior,) = Priors.of(robot(friction__mu_t={"kind": "normal", "sd": sd})).each
    low, high = prior.at(np.sort([share, more]))
    assert 0.0 <= low <= high <= 10.0


def test_numbers_go_together_as_the_file_says():
    file = robot(
        friction__mu_t={"kind": "normal", "sd": 0.002},
        bending__stiffness_nm_per_rad={"kind": "normal", "sd": 0.02},
        geometry__half_track_m={"kind": "uniform", "low": 0.01, "high": 0.02},
    )
    paths = ("friction.mu_t", "bending.stiffness_nm_per_rad")
    data = file.model_dump(mode="json") | {"correlated": [{"of": list(paths), "r": -0.7}]}
    priors = Priors.of(RobotFile.model_validate(data))
    drawn = np.corrcoef(priors.at(stats.qmc.Sobol(3, rng=0).random(4096)).T)
    i, j = (priors.paths.index(path) for path in paths)
    k = 3 - i - j
    assert drawn[i, j] == pytest.approx(-0.7, abs=0.01)
    assert abs(drawn[i, k]) < 0.01


@pytest.mark.parametrize(
    ("spread", "words"),
    [
        ({"kind": "normal", "factor": 2.0}, "normal takes sd, not factor"),
        ({"kind": "uniform", "low": 0.05, "high": 0.04}, "low 0.05 is not below high 0.04"),
        (
            {"kind": "uniform", "low": 0.05, "high": 0.06},
            "the number itself, 0.043, lies outside of 0.05 to 0.06",
        ),
        ({"kind": "uniform", "low": -1.0, "high": 0.06}, "-1 to 0.06 leaves the allowed 0 to 10"),
        ({"kind": "normel", "sd": 1.0}, "normal"),
    ],
)
def test_what_makes_no_distribution_is_refused_with_its_place(spread, words):
    data = robot().model_dump(mode="json")
    data["friction"]["mu_t"]["uncertain"] = spread
    document = Document("mine.yaml", data)
    validate(RobotFile, document, data)
    with pytest.raises(InputFileError, match="friction.mu_t.uncertain") as caught:
        document.finish()
    assert words in str(caught.value)


@pytest.mark.parametrize(
    ("name", "pressure_kpa", "volume_ml"),
    [("gen1", 31.0, 15.0), ("gen2", 48.3, 45.0), ("gen3", 48.3, 45.0), ("gen4", 62.1, 70.0)],
)
def test_stiffness_of_shipped_robots_takes_a_quarter_to_all_of_the_work_of_the_air(
    name, pressure_kpa, volume_ml
):
    record = load_robot_file(name).records()["bending.stiffness_nm_per_rad"]
    bound = pressure_kpa * 1e3 * volume_ml * 1e-6 / (math.pi / 2) ** 2
    ends = [record.uncertain.low, record.value, record.uncertain.high]
    assert ends == pytest.approx([bound / 4, bound / 2, bound], rel=0.01)  # two printed digits


@pytest.mark.parametrize("name", ["gen1", "gen2", "gen3", "gen4"])
def test_no_shipped_robot_draws_drag(name):
    record = load_robot_file(name).records().get("friction.drag_n")
    assert record is None or (record.value == 0 and record.uncertain is None)


def test_nothing_uncertain_is_said_plainly():
    with pytest.raises(InputError, match="nothing is said to be uncertain"):
        Priors.of(robot())


def test_a_number_that_is_set_is_no_longer_uncertain():
    found = load_scenario("gen2_straight", set={"robot.friction.mu_t": 0.05})
    assert "uncertain" not in found.document["robot"]["friction"]["mu_t"]
    assert "uncertain" in found.document["robot"]["friction"]["mu_n"]


def test_sensitivities_of_ishigamis_function():
    """A 7, B 0.1: S = 0.3139, 0.4424, 0; T = 0.5576, 0.4424, 0.2437."""
    shares = stats.qmc.Sobol(3, rng=1).random(1024)
    x = np.pi * (2 * shares - 1)
    y = np.sin(x[:, 0]) + 7 * np.sin(x[:, 1]) ** 2 + 0.1 * x[:, 2] ** 4 * np.sin(x[:, 0])
    found = Chaos.fit(shares, y[:, None])
    expected = np.array([[0.3139, 0.4424, 0.0], [0.5576, 0.4424, 0.2437]])
    assert found.indices[..., 0] == pytest.approx(expected, abs=2e-4)
    assert (np.abs(found.indices[..., 0] - expected) < found.error[..., 0] + 1e-4).all()


def test_errors_of_indices_cover_what_few_samples_do_to_them():
    held = []
    for seed in range(20):
        shares = stats.qmc.Sobol(3, rng=seed).random(64)
        noise = np.random.default_rng(seed).normal(size=64)
        y = 2 * shares[:, 0] + shares[:, 1] + 0.3 * shares[:, 0] * shares[:, 2] + 0.05 * noise
        plain = np.array([2.15, 1.0, 0.15]) ** 2
        share = plain / (plain.sum() + 0.3**2 / 12)
        found = Chaos.fit(shares, y[:, None])
        held.append(np.abs(found.indices[0, :, 0] - share) <= found.error[0, :, 0])
    assert np.mean(held) >= 0.9


@pytest.mark.slow
def test_sensitivities_of_the_complete_model_by_brute_force(tmp_path):
    """Jansen's estimators (1999) on runs of their own: two matrices of samples and their mixtures."""
    file = robot(
        friction__mu_t={"kind": "uniform", "low": 0.03, "high": 0.08},
        actuator__bend_rad={"kind": "normal", "sd": 0.15},
        geometry__rigid_gap_m={"kind": "uniform", "low": 0.01, "high": 0.025},
    )
    found = load_scenario("gen2_straight", set={"duration_s": 3.0})
    document = {**found.document, "robot": file.model_dump(mode="json")}
    from srs_twin.scenario.loading import parse_scenario

    study = Study(parse_scenario(document, name="brute"), Priors.of(file), ("analytical",), samples=512)
    spread = propagate(study, tmp_path, local(2)).plants["analytical"]["com_speed_m_s"]
    rng, priors = np.random.default_rng(0), study.priors
    a, b = rng.random((2, 1000, 3))
    mixed = [np.where(np.arange(3) == i, b, a) for i in range(3)]

    def speeds(shares: np.ndarray) -> np.ndarray:
        from dataclasses import replace

        from srs_twin import AnalyticalSnake, Gait, rollout
        from srs_twin.comparison.metrics import plant_metrics

        out, spec = [], study.scenario.robot
        for row in priors.at(shares):
            at = dict(zip(priors.paths, row, strict=True))
            one = replace(
                spec,
                friction=replace(spec.friction, mu_t=at["friction.mu_t"]),
                geometry=replace(spec.geometry, rigid_gap=at["geometry.rigid_gap_m"]),
                actuator=replace(spec.actuator, gain=at["actuator.bend_rad"] / 48263.299),
            )
            plant = AnalyticalSnake(one, supply_pa=study.scenario.supply_pa)
            out.append(plant_metrics(rollout(plant, Gait(2.0), 3.0))["com_speed_m_s"])
        return np.array(out)

    of_a, of_b, of_mixed = speeds(a), speeds(b), [speeds(each) for each in mixed]
    for i, each in enumerate(of_mixed):

        def indices(rows: np.ndarray, each: np.ndarray = each) -> np.ndarray:
            one, other, both = of_a[rows], of_b[rows], each[rows]
            apart = np.array([((other - both) ** 2).mean(), ((one - both) ** 2).mean()])
            return np.array([1, 0]) + np.array([-1, 1]) * apart / (2 * np.concatenate([one, other]).var())

        again = [indices(rng.integers(0, len(a), len(a))) for _ in range(200)]
        errors = np.std(again, axis=0)
        assert errors.max() < 0.06
        found = np.array([spread.first[i], spread.total[i]])
        assert (np.abs(found - indices(np.arange(len(a)))) < 3 * errors + spread.doubt[:, i]).all()


def test_a_process_without_a_smooth_part_is_ridge_regression():
    """Weights of 1 and h with the prior variance b², and noise of n²: their posterior in closed form."""
    rng = np.random.default_rng(5)
    x, y, new = rng.normal(size=(7, 2)), 3 + rng.normal(size=7), rng.normal(size=(4, 2))
    b, n = 0.7, 0.9
    process = GaussianProcess(x, y, chosen=np.log([1e-9, b, n, 1.0, 1.0]))
    known, asked = (np.column_stack([np.ones(len(each)), each]) for each in (x, new))
    precision = known.T @ known / n**2 + np.eye(3) / b**2
    assert process.at(new) == pytest.approx(asked @ np.linalg.solve(precision, known.T @ y) / n**2, rel=1e-6)
    expected = asked @ np.linalg.inv(precision) @ asked.T
    assert process.covariance(new) == pytest.approx(expected, rel=1e-6, abs=1e-8)


def test_a_costly_result_follows_from_a_cheap_one_and_few_of_its_own():
    """Both known functions: quantiles of 2,048 from 64 of the costly one, within 3 % of the interval."""

    def cheap(u: np.ndarray) -> np.ndarray:
        return np.asarray(np.exp(u[:, 0]) + u[:, 1] * u[:, 2] + 0.2 * u[:, 3])

    def costly(u: np.ndarray) -> np.ndarray:
        return np.asarray(0.8 * cheap(u) + 0.3 * np.sin(3 * u[:, 1]) + 0.1 * u[:, 4] * u[:, 0])

    shares = stats.qmc.Sobol(5, rng=3).random(2048)
    found, _ = corrected(shares, cheap(shares), costly(shares[:64]))
    ends, expected = (np.quantile(each, [0.025, 0.975]) for each in (found, costly(shares)))
    assert np.abs(ends - expected).max() < 0.03 * np.ptp(expected)
    assert found == pytest.approx(costly(shares), abs=0.05)
    alone = np.quantile(costly(shares[:64]), [0.025, 0.975])
    assert np.abs(ends - expected).max() < 0.5 * np.abs(alone - expected).max()


@pytest.fixture
def short(tmp_path) -> Callable[..., Path]:
    """Return what writes a short scenario with two uncertain numbers and an expectation."""

    def make(**changes: Any) -> Path:
        data: dict[str, Any] = {
            "title": "Short",
            "robot": robot(
                friction__mu_t={"kind": "uniform", "low": 0.03, "high": 0.06},
                bending__stiffness_nm_per_rad={"kind": "lognormal", "factor": 1.3},
            ).model_dump(mode="json", exclude_none=True),
            "duration_s": 2.0,
            "controller": {"kind": "gait", "frequency_hz": 2.0, "offset": 0.0},
            "plants": {"analytical": {"model": "compliant", "friction": "wheel"}},
            "expect": [
                {"metric": "com_speed_m_s", "plant": "analytical", "published": 0.19, "within": "interval_95"}
            ],
        } | changes
        path = tmp_path / "short.yaml"
        path.write_text(dump_yaml(data), "utf-8")
        return path

    return make


@pytest.mark.slow
def test_the_command_keeps_intervals_that_expectations_use_until_the_scenario_changes(
    srs_twin, short, tmp_path
):
    path = short()
    without = srs_twin("run", str(path), "--check", cwd=tmp_path)
    assert without.returncode == 0
    assert "no interval is stored" in without.stdout and "expectations: 1 not judged" in without.stderr
    done = srs_twin(
        "uncertainty", str(path), "--samples", "64", "--workers", "1", "--write", "--json", cwd=tmp_path
    )
    assert done.returncode == 0, done.stderr
    found = json.loads(done.stdout)
    speed = found["plants"]["analytical"]["com_speed_m_s"]
    low, high = speed["interval_95"]
    assert low < speed["interval_50"][0] < speed["interval_50"][1] < high
    assert set(speed["sensitivity"]) == {"friction.mu_t", "bending.stiffness_nm_per_rad"}
    assert speed["published"] == 0.19
    assert found["measure_next"][0]["parameter"] in speed["sensitivity"]
    kept = json.loads((tmp_path / "calibration/intervals/short.json").read_text("utf-8"))
    assert kept["plants"]["analytical"]["com_speed_m_s"]["interval_95"] == pytest.approx(
        [low, high], rel=1e-5
    )
    words = ("run", str(path), "--check", "--json", "--junit", "r.xml")
    for changed in ((), ("--seed", "1")):
        judged = srs_twin(*words, *changed, cwd=tmp_path)
        (row,) = json.loads(judged.stdout)["expectations"]
        states = {"within": "met", "undecided": "not_judged", "outside": "missed"}
        assert row["state"] == states[speed["verdict"]]
        assert judged.returncode == (1 if row["state"] == "missed" else 0)
        assert ("<failure" in (tmp_path / "r.xml").read_text("utf-8")) == (row["state"] == "missed")
    assert row["error"] == pytest.approx(row["value"] - 0.19)
    assert row["largest"] in ("u_num", "u_input", "u_d")
    # Another law, seen in the value; another scenario.
    kept["plants"]["analytical"]["com_speed_m_s"]["value"] += 0.011 * (high - low)
    (tmp_path / "calibration/intervals/short.json").write_text(json.dumps(kept), "utf-8")
    moved = srs_twin("run", str(path), "--check", cwd=tmp_path)
    short(controller={"kind": "gait", "frequency_hz": 2.0, "offset": 0.1})
    stale = srs_twin("run", str(path), "--check", cwd=tmp_path)
    for each, why in ((moved, "the stored interval is for"), (stale, "for another robot or scenario")):
        assert each.returncode == 0
        assert why in (said := " ".join(each.stdout.split())) and "not judged" in said
        assert "srs-twin uncertainty" in said.replace("srs- twin", "srs-twin")
    # The published value belongs to the scenario with the original offset.
    modified = srs_twin("run", str(path), "--check", "--set", "controller.offset=0.2", cwd=tmp_path)
    assert modified.returncode == 0 and "expectations: none, 1 left out" in modified.stderr


def test_a_second_start_runs_nothing_and_says_the_same(short, tmp_path):
    found = load_scenario(short())
    study = Study(
        found, Priors.of(RobotFile.model_validate(found.document["robot"])), ("analytical",), samples=32
    )
    first = propagate(study, tmp_path / "out", local(1)).document()
    seen: list[tuple[str, int]] = []

    def progress(part: str, count: int) -> Any:
        seen.append((part, count))

    second = propagate(study, tmp_path / "out", local(1), progress).document()
    assert seen == []
    assert first == second


def test_a_result_is_unmarked_before_the_rows_below_it_change(short, tmp_path, monkeypatch):
    """Who is killed in between leaves no intervals.json next to tables of other samples."""
    found = load_scenario(short())
    priors = Priors.of(RobotFile.model_validate(found.document["robot"]))
    folder, marked, finish = tmp_path / "out", [], OpenSweep.finish

    def watched(opened):
        marked.append((folder / "intervals.json").exists())
        return finish(opened)

    monkeypatch.setattr(OpenSweep, "finish", watched)
    for samples, changed in ((17, False), (17, False), (16, True)):
        propagate(Study(found, priors, ("analytical",), samples=samples), folder, local(1), changed=changed)
        (folder / "intervals.json").write_text("{}")
    assert marked == [False, True, False]


@pytest.mark.slow
def test_measuring_a_number_narrows_the_interval_as_foretold(short, tmp_path):
    """The number that it names, measured wherever in its prior: the mean width comes within 20 %."""
    found = load_scenario(short())
    file = RobotFile.model_validate(found.document["robot"])
    study = Study(found, Priors.of(file), ("analytical",), samples=128)
    before = propagate(study, tmp_path / "before", local(2))
    best = before.measure_next()[0]
    section, key = best["parameter"].split(".")
    (prior,) = (each for each in study.priors.each if each.path == best["parameter"])
    widths = []
    for k, centre in enumerate(prior.at(np.array([0.2, 0.5, 0.8]))):
        data = file.model_dump(mode="json", exclude_none=True)
        data[section][key] |= {
            "value": float(centre),
            "uncertain": {"kind": "normal", "sd": 0.1 / 1.96 * float(centre)},
        }
        measured = load_scenario(short(robot=data))
        after = Study(
            measured,
            Priors.of(RobotFile.model_validate(measured.document["robot"])),
            ("analytical",),
            samples=128,
        )
        spread = propagate(after, tmp_path / f"after{k}", local(2)).plants["analytical"]["com_speed_m_s"]
        widths.append(np.ptp(spread.interval("interval_95")))
    assert np.mean(widths) == pytest.approx(best["width"], rel=0.2)
    assert best["width"] < 0.9 * best["width_now"]


@pytest.mark.slow
def test_the_command_states_samples_errors_and_the_remedy(srs_twin, short, tmp_path):
    words = ("uncertainty", str(short()), "--samples", "16", "--workers", "1")
    shown = srs_twin(*words, cwd=tmp_path)
    assert shown.returncode == 0
    assert "analytical, 16 samples" in shown.stdout
    assert "± at 95 %: standard errors of the two ends" in shown.stdout
    assert "warning: analytical, CoM speed (m/s): 16 samples do not bound the 95 % interval" in shown.stderr
    document = json.loads(srs_twin(*words, "--json", cwd=tmp_path).stdout)
    remedy = " ".join(f"--{name} {count}" for name, count in document["remedy"].items())
    assert f"`{remedy}` should be enough" in shown.stderr
    for text in document["warnings"]:
        assert f"warning: {text}\n" in shown.stderr
    speed = document["plants"]["analytical"]["com_speed_m_s"]
    assert (speed["samples"], speed["runs"]) == (16, 16)
    assert len(speed["interval_50_error"]) == len(speed["interval_95_error"]) == 2
    assert all(1 <= best <= worst <= 2 for best, worst in (s["rank"] for s in speed["sensitivity"].values()))
    quiet = srs_twin(*words, "--quiet", cwd=tmp_path)
    assert (quiet.stdout, quiet.stderr) == ("", "")


def test_the_value_at_the_medians_is_a_run_with_the_numbers_there(short, tmp_path):
    from srs_twin.comparison.metrics import plant_metrics
    from srs_twin.rollout import rollout

    found = load_scenario(short())
    priors = Priors.of(RobotFile.model_validate(found.document["robot"]))
    study = Study(found, priors, ("analytical",), samples=16)
    spread = propagate(study, tmp_path / "out", local(1)).plants["analytical"]["com_speed_m_s"]
    medians = {f"robot.{prior.path}": float(prior.at(np.array([0.5]))[0]) for prior in study.priors.each}
    assert medians["robot.friction.mu_t"] == pytest.approx(0.045)  # of the uniform 0.03 to 0.06
    other = load_scenario(short(), set=medians)
    run = rollout(
        other.build_plant("analytical"), other.build_controller(), other.duration, record_hz=other.record_hz
    )
    assert spread.at_medians == pytest.approx(plant_metrics(run)["com_speed_m_s"], rel=1e-9)
