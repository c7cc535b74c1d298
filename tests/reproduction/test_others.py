"""Robots that others built: descriptions, predictions before results, and their comparison."""

from __future__ import annotations

import json
import subprocess

import pytest

from srs_twin.cli import main
from srs_twin.errors import InputError, UnknownNameError
from srs_twin.io.files import data_root
from srs_twin.reproduction import others
from srs_twin.robot.file import load_robot_file

PREDICTION = "quantities: {speed_m_s: {median: 0.1, interval_95: [0.05, 0.2]}}\n"
PUBLISHED = "values: {%s: {value: %s, of: robot, known: false, source: a paper}}\n"


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """Return a folder with a prediction, which replaces the shipped data."""
    calibration = tmp_path / "calibration"
    (calibration / "predictions").mkdir(parents=True)
    (calibration / "published/others").mkdir(parents=True)
    (calibration / "predictions/snake.yaml").write_text(PREDICTION)
    monkeypatch.setattr(others, "data_root", lambda: tmp_path)
    return calibration


def test_every_prediction_is_of_a_robot_whose_intervals_have_sources():
    rows = others.load_predicted_quantities()
    for name in {row.robot for row in rows}:
        records = load_robot_file(
            data_root() / f"calibration/robots/others/{name}.yaml"
        ).records()
        uncertain = [
            record for record in records.values() if record.uncertain is not None
        ]
        assert len(uncertain) >= 5 and all(record.source for record in records.values())
    for numbers in (row.predicted for row in rows):
        low, high = numbers.interval_95
        assert low <= numbers.median <= high


@pytest.mark.default_cases(2)
@pytest.mark.parametrize(
    ("value", "inside"), [(0.05, True), (0.2, True), (0.049, False), (0.21, False)]
)
def test_published_value_is_inside_the_interval_or_not(folder, value, inside):
    (folder / "published/others/snake.yaml").write_text(
        PUBLISHED % ("speed_m_s", value)
    )
    (row,) = others.load_predicted_quantities()
    assert row.document()["inside"] is inside
    assert (row.prediction_commit, row.comparison_commit) == (None, None)


@pytest.mark.default_cases(at=[0, 3, 4, 5])
@pytest.mark.parametrize(
    ("robots", "value", "verdict"),
    [
        (145, 0.1, "undecided"),
        (146, 0.1, "within"),
        (146, 0.06, "undecided"),
        (146, 0.075, "within"),
        (146, 0.17, "undecided"),
        (146, 0.3, "outside"),
    ],
)
def test_verdict_is_undecided_with_few_robots_or_near_an_end(
    folder, robots, value, verdict
):
    path = folder / "predictions/recomputed/snake.yaml"
    path.parent.mkdir()
    path.write_text(
        f"robots: {robots}\nquantities: {{speed_m_s: {{median: 0.1, interval_95: [0.05,"
        " 0.2], interval_95_error: [0.01, 0.02]}}\n"
    )
    (folder / "published/others/snake.yaml").write_text(
        PUBLISHED % ("speed_m_s", value)
    )
    (row,) = others.load_predicted_quantities()
    document = row.document()
    assert (document["verdict"], document["recomputed_verdict"]) == (
        "undecided",
        verdict,
    )
    assert document["recomputed"]["robots"] == robots and document["robots"] == 0
    assert row.recomputed.cells(row.published)[-1].endswith(", undecided") == (
        verdict == "undecided"
    )


def test_prediction_without_published_values_has_no_result(folder):
    (row,) = others.load_predicted_quantities()
    document = row.document()
    assert document["inside"] is None and document["published"] is None


def test_published_quantity_that_was_not_predicted_is_refused(folder):
    (folder / "published/others/snake.yaml").write_text(PUBLISHED % ("speed_mm_s", 1))
    with pytest.raises(UnknownNameError, match="speed_m_s"):
        others.load_predicted_quantities()


@pytest.mark.parametrize("value", [".nan", "1e9", "fast"])
def test_published_value_must_be_a_plausible_number(folder, value):
    (folder / "published/others/snake.yaml").write_text(
        PUBLISHED % ("speed_m_s", value)
    )
    with pytest.raises(InputError, match=r"snake.yaml:1:\d+.*value"):
        others.load_predicted_quantities()


def test_commits_show_that_predictions_came_first(folder):
    """In a separate repository: the first published values, and the last change of the prediction."""

    def git(*command):
        who = (
            "-c",
            "user.name=a",
            "-c",
            "user.email=a@b.c",
            "-c",
            "commit.gpgsign=false",
        )
        subprocess.run(
            ["git", *who, *command], cwd=folder, check=True, capture_output=True
        )

    git("init", "-q")
    published = folder / "published/others/snake.yaml"
    for path, text in (
        (folder / "predictions/snake.yaml", PREDICTION),
        (folder / "predictions/snake.yaml", f"# of commit 12\n{PREDICTION}"),
        (published, PUBLISHED % ("speed_m_s", 0.1)),
        (published, PUBLISHED % ("speed_m_s", 0.11)),
    ):
        path.write_text(text)
        git("add", "-A")
        git("commit", "-q", "-m", "a change")
    log = subprocess.run(
        ["git", "log", "--format=%h"],
        cwd=folder,
        capture_output=True,
        text=True,
        check=True,
    ).stdout.split()
    (row,) = others.load_predicted_quantities()
    # A comment that was added later changes no number.
    assert [row.prediction_commit, row.comparison_commit] == [log[3], log[1]]


def test_shipped_predictions_were_committed_before_published_values():
    root = data_root()
    for row in others.load_predicted_quantities():
        if row.comparison_commit is None or row.prediction_commit is None:
            pytest.skip("needs the history of a checkout")
        command = [
            "git",
            "merge-base",
            "--is-ancestor",
            row.prediction_commit,
            row.comparison_commit,
        ]
        assert row.prediction_commit != row.comparison_commit, row.robot
        assert subprocess.run(command, cwd=root, check=False).returncode == 0, row.robot


def test_command_prints_every_compared_quantity(capsys):
    def printed(*options):
        with pytest.raises(SystemExit) as done:
            main(["reproduce", "--others", *options])
        assert done.value.code == 0
        return capsys.readouterr().out

    rows = json.loads(printed("--json"))["robots"]
    lines = printed().splitlines()
    compared = [row for row in rows if row["published"] is not None]
    assert len(compared) >= 3
    recomputed = sum(line.split()[:1] == ["recomputed"] for line in lines)
    assert recomputed == sum(row["recomputed"] is not None for row in compared) > 0
    assert f"{len(rows) - len(compared)} predicted quantities without" in lines[-1]
    assert {row["unit"] for row in rows if "yaw" in row["quantity"]} <= {"rad/s"}
    for row in compared:
        low, high = row["interval_95"]
        assert row["inside"] == (low <= row["published"] <= high)
        line = next(line for line in lines if f"{row['quantity']} " in line)
        assert ("inside" if row["inside"] else "outside") in line
        assert f" {low:.3g} to {high:.3g} " in line
        assert f" {row['published']:.3g} " in line
        assert (row["verdict"] == "undecided") == ("undecided" in line)
        assert row["robots"] == 40 and row["verdict"] == "undecided"
        (note,) = (line for line in lines if line.startswith(f"{row['robot']}: "))
        assert ("published values known before" in note) == row["known_before"]
        is_simulated = row["of"] == "simulation"
        assert ("simulated by its builders" in note) == is_simulated
