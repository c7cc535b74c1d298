"""`srs-twin reproduce`: files, stored runs, exit codes, and the pages generated from the baseline."""

from __future__ import annotations

import json
import math
import re
from html.parser import HTMLParser
from xml.etree import ElementTree

import pytest
from conftest import ROOT
from reproduction import judged_claims, markdown, replace_between, table

from srs_twin.cli import main
from srs_twin.reproduction.claims import load_claims
from srs_twin.reproduction.printing import _short_text
from srs_twin.reproduction.report import (
    TITLES,
    by_category,
    count_verdicts,
    number_text,
)
from srs_twin.reproduction.verdicts import MET, ClaimOutcome, load_baseline

FEW = (
    "--only",
    "table9.limit",
    "--only",
    "table9.width",
    "--only",
    "table9.shift",
    "--only",
    "eq33",
    "--only",
    "actuator-90",
    "--only",
    "act-step-gen4",
)
OUT = "out/reproduce"


class ExternalReferences(HTMLParser):
    """Collector of references to resources outside the page."""

    def __init__(self):
        super().__init__()
        self.references = []

    def handle_starttag(self, tag, attrs):
        for name, value in attrs:
            if name in ("src", "href") and not (value or "").startswith(("data:", "#")):
                self.references.append((tag, value))


def test_rows_are_run_judged_stored_and_printed(srs_twin, tmp_path):
    done = srs_twin("reproduce", *FEW, "--out", OUT, cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert re.search(r"^table9\.limit +9 +8\.87 .* met$", done.stdout, re.M)
    assert re.search(r"^actuator-90\.gen2 .*\(fitted\)$", done.stdout, re.M)
    folder = tmp_path / OUT
    document = json.loads((folder / "reproduce.json").read_text("utf-8"))
    rows = {row["id"]: row for row in document["rows"]}
    assert (
        rows["act-step-gen4.tau1"]["fitted"]
        and rows["eq33"]["outcomes"]["alone"]["verdict"] == MET
    )
    assert document["changed_from_baseline"] == []
    assert document["groups"]["alone"]["law"] == {
        "met": 4,
        "explained": 0,
        "missed": 0,
        "all": 4,
    }
    assert {name: row["could_fail"] for name, row in rows.items()} == {
        claim.id: claim.could_fail for claim in CLAIMS if claim.id in rows
    }
    for name, row in rows.items():
        for column, outcome in row["outcomes"].items():
            baseline = BASELINE.outcomes[name][column]
            # The baseline has four digits; errors of computations are rounding errors.
            assert outcome["values"] == pytest.approx(
                baseline.values, rel=6e-4, abs=1e-9
            ), (name, column)
    page = (folder / "reproduce.html").read_text("utf-8")
    assert re.search(r">table9\.limit<(?:(?!</tr>).)*>8\.87<", page, re.S)
    parser = ExternalReferences()
    parser.feed(page)
    assert parser.references == [] and "<script" not in page
    assert (
        "could it have failed?" in page
        and "No: the value is the ratio of two published values." in page
    )
    assert "Fig. 20" in page and "Fig. 31" not in page
    suites = ElementTree.parse(folder / "reproduce.xml").getroot()
    failed = {
        case.get("classname")
        for case in suites.iter("testcase")
        if case.find("failure") is not None
    }
    assert failed == {"actuator-90.gen1", "actuator-90.gen4"}
    times = {path: path.stat().st_mtime_ns for path in folder.rglob("*.parquet")}
    again = srs_twin("reproduce", *FEW, "--out", OUT, cwd=tmp_path)
    assert again.stdout == done.stdout
    assert {
        path: path.stat().st_mtime_ns for path in folder.rglob("*.parquet")
    } == times


@pytest.mark.parametrize(
    ("values", "text"), [((0.25, 0.12), "0.25 > 0.12"), ((0.25, 0.123), "0.25…0.12")]
)
def test_an_ordering_is_shortened_only_if_wider_than_its_column(values, text):
    assert _short_text(ClaimOutcome(MET, values, math.nan, math.nan)) == text


def test_numbers_have_three_digits_or_are_whole():
    texts = list(map(number_text, (0.0, -1234.0, 999999.0, 1e6, 0.12345, 1234.5)))
    assert texts == ["0", "-1234", "999999", "1e+06", "0.123", "1.23e+03"]


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (("--only", "table88"), "unknown claim 'table88'; did you mean"),
        (
            ("--quick", "--write-baseline"),
            "--write-baseline needs all rows; remove --only and --quick",
        ),
    ],
)
def test_invalid_options_exit_with_2(options, message, srs_twin, tmp_path):
    done = srs_twin("reproduce", *options, cwd=tmp_path)
    assert (
        done.returncode == 2
        and message in done.stderr
        and "Traceback" not in done.stderr
    )
    assert not (tmp_path / "runs").exists()


@pytest.mark.parametrize(
    "before", ["met", pytest.param("missed", marks=pytest.mark.slow)]
)
def test_changed_verdicts_exit_with_1_better_or_worse(
    before, tmp_path, monkeypatch, capsys
):
    baseline = json.dumps(
        {
            "versions": {},
            "rows": {
                "actuator-90.gen1": {
                    "alone": {
                        "verdict": before,
                        "values": [],
                        "value": 1,
                        "error": 0,
                        "why": "",
                    }
                }
            },
        }
    )
    path = tmp_path / "baseline.json"
    path.write_text(baseline)
    monkeypatch.setattr("srs_twin.reproduction.verdicts.baseline_file", lambda: path)
    with pytest.raises(SystemExit) as stopped:
        main(
            [
                "reproduce",
                "--only",
                "actuator-90.gen1",
                "--out",
                str(tmp_path / "out"),
                "--quiet",
            ]
        )
    assert stopped.value.code == 1
    messages = capsys.readouterr().err
    assert (
        f"changed from the baseline: actuator-90.gen1, alone: explained, was {before}"
        in messages
    )
    assert "--write-baseline" in messages


CLAIMS = load_claims()
BASELINE = load_baseline()
ROWS = judged_claims(CLAIMS, BASELINE)


@pytest.mark.parametrize(
    ("part", "text"), [("counts", table), ("reproduction", markdown)]
)
def test_page_shows_the_committed_baseline(part, text):
    current = (ROOT / "docs/reproduction.md").read_text("utf-8")
    assert current == replace_between(current, part, text(ROWS)), (
        "run docs/reproduction.py to write it"
    )


def test_readme_counts_the_met_predictions_of_the_baseline():
    readme = (ROOT / "README.md").read_text("utf-8")
    prediction_groups = {
        "**headline predictions** met": ("headline",),
        "other predictions met": tuple(TITLES)[1:6],
    }
    for title, groups in prediction_groups.items():
        (line,) = re.findall(
            rf"^\| {re.escape(title)} \| (.*?) \| (.*?) \|", readme, re.M
        )
        for column, cell in zip(("analytical", "twin"), line, strict=True):
            counts = [
                count_verdicts(by_category(ROWS)[name], column) for name in groups
            ]
            met = sum(each[MET] for each in counts)
            all_rows = sum(each["all"] for each in counts)
            assert cell == f"{met} of {all_rows}"


def test_the_baseline_has_exactly_the_rows_of_the_claims():
    assert {(row.id, column) for row in CLAIMS for column in row.columns} == {
        (name, column)
        for name, columns in BASELINE.outcomes.items()
        for column in columns
    }


@pytest.mark.parametrize(
    ("script", "options"),
    [("run", '--quick --out "$room"'), ("nightly", '--out "$room/claims"')],
)
def test_ci_judges_quick_rows_and_every_row_at_night(script, options):
    text = (ROOT / ".ci" / script).read_text("utf-8")
    assert re.findall(r"srs-twin reproduce (.*)", text) == [options]


def test_all_laws_are_met():
    missed = {
        (row.claim.id, column)
        for row in ROWS
        if row.claim.use == "law"
        for column, outcome in row.outcomes.items()
        if outcome.verdict != MET
    }
    assert missed == set()
