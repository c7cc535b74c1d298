"""The runner of the studies: lists, stale results, confirmations and the options of all scripts."""

from __future__ import annotations

import ast
import json
import re
import shutil
import subprocess
from importlib.util import find_spec
from pathlib import Path

import pytest
from benchmark_runs import run_benchmark, run_script
from conftest import ROOT
from processes import python

from srs_twin.scenario.provenance import code_digest, code_digests, source_digests

BENCHMARKS = ROOT / "benchmarks"
SCRIPTS = sorted(path.stem for path in BENCHMARKS.glob("*.py") if path.stem != "run")
NEEDS = {"against_drake": "pydrake", "gpu": "warp"}
"""Packages without which a script cannot start."""

SCRIPT = '''\
"""Title of the study."""

import argparse

from common.grid import table
from helper import value

argparse.ArgumentParser().parse_args()
print(table(["case", "value"], [["a", f"{value():.3f}"]]))
'''
HELPER = '''\
"""Helper."""


def value() -> float:
    """Return the value."""
    return 2.0  # exact
'''
TABLE = """

STUDIES = {"example": Study(1, "index.md", seeds="4")}
"""


@pytest.fixture
def checkout(tmp_path):
    """Return a checkout whose only study prints one number that a helper returns."""
    folder = tmp_path / "checkout/benchmarks"
    shutil.copytree(
        BENCHMARKS / "common",
        folder / "common",
        ignore=shutil.ignore_patterns("__pycache__"),
    )
    shutil.copy(BENCHMARKS / "run.py", folder)
    (folder / "example.py").write_text(SCRIPT, "utf-8")
    (folder / "helper.py").write_text(HELPER, "utf-8")
    table = folder / "common/studies.py"
    text = table.read_text("utf-8")
    start = text.index("\nSTUDIES = {")
    end = text.index("\n}\n", start) + 3
    table.write_text(text[:start] + TABLE + text[end:], "utf-8")
    git = ["git", "-c", "user.name=a", "-c", "user.email=a@example.org"]
    for words in (
        ["init", "-q"],
        ["add", "-A", "--", "benchmarks", ":!**/__pycache__/**"],
        ["commit", "-q", "-m", "Add the example"],
    ):
        subprocess.run([*git, *words], cwd=folder.parent, check=True)
    return folder


def run(checkout: Path, *words: str) -> subprocess.CompletedProcess[str]:
    return run_script(str(checkout / "run.py"), *words)


def edit(path: Path, old: str, new: str) -> None:
    text = path.read_text("utf-8")
    assert text.count(old) == 1
    path.write_text(text.replace(old, new), "utf-8")


def stored(checkout: Path) -> dict:
    return json.loads((checkout / "results/example.json").read_text("utf-8"))


@pytest.mark.slow
def test_result_becomes_stale_with_the_code_and_not_with_the_words(checkout):
    assert (found := run(checkout, "--stale")).returncode == 1
    assert found.stdout == "example: never run\n"

    done = run(checkout, "example")
    assert done.returncode == 0, done.stderr
    result = stored(checkout)
    assert result["tables"] == [
        {"title": "", "columns": ["case", "value"], "rows": [["a", "2.000"]]}
    ]
    assert result["seeds"] == "4"
    assert re.fullmatch("[0-9a-f]{8}", result["stamp"]["commit"])
    assert result["stamp"]["processor"] == result["stamp"]["versions"]["arithmetic"]
    assert run(checkout, "--stale").returncode == 0

    edit(checkout / "helper.py", "Return the value.", "Compute the value.")
    edit(checkout / "helper.py", "# exact", "# measured")
    assert (found := run(checkout, "--stale")).returncode == 0, found.stdout

    edit(checkout / "helper.py", "return 2.0", "return 1.0 + 1.0")
    assert (found := run(checkout, "--stale")).returncode == 1
    assert found.stdout == "example: benchmarks/helper.py changed\n"


PAGE = "Before.\n\n<!-- study example 1: begin -->\n<!-- study example 1: end -->\n\nAfter.\n"
"""Page with an empty marker."""


@pytest.mark.slow
def test_run_writes_its_table_with_date_and_commit_into_the_page(checkout):
    page = checkout.parent / "docs/index.md"
    page.parent.mkdir()
    page.write_text(PAGE, "utf-8")
    done = run(checkout, "example")
    assert "updated: docs/index.md" in done.stdout
    stamp = stored(checkout)["stamp"]
    minutes = stored(checkout)["minutes"]
    assert page.read_text("utf-8").split("\n\n") == [
        "Before.",
        "<!-- study example 1: begin -->",
        "| case | value |\n| --- | --- |\n| a | 2.000 |",
        f"*Study `example`: {stamp['date']}, commit {stamp['commit']}, {minutes:.1f} min, seeds 4.*",
        "<!-- study example 1: end -->",
        "After.\n",
    ]
    assert run(checkout, "--pages").stdout == ""

    page.write_text(PAGE.replace("example 1", "example 2"), "utf-8")
    assert "`example` has 1 tables, not 2" in run(checkout, "--pages").stderr


def test_pages_contain_the_stored_tables():
    code = """
from common.study_pages import DOCS, rendered
pages = [path for path in DOCS.glob("*.md") if "<!-- study " in path.read_text("utf-8")]
print(len(pages), [p.name for p in pages if rendered(p.read_text("utf-8")) != p.read_text("utf-8")])
"""
    done = python("-c", code, cwd=BENCHMARKS)
    number, outdated = done.stdout.split(" ", 1)
    assert int(number) > 0, done.stderr
    assert outdated == "[]\n"


@pytest.mark.slow
def test_confirmation_needs_equal_numbers_and_is_recorded(checkout):
    assert "no stored result" in run(checkout, "--confirm", "example").stderr
    run(checkout, "example")
    edit(checkout / "helper.py", "return 2.0", "return 2.0 + 0.004")
    done = run(checkout, "--confirm", "example")
    assert done.returncode == 0, done.stderr
    confirmed = stored(checkout)["confirmed"]
    assert [item["largest_difference"] for item in confirmed] == [
        pytest.approx(0.004 / 2.0)
    ]
    assert confirmed[0]["stamp"]["commit"].endswith("+")
    assert run(checkout, "--stale").returncode == 0

    edit(checkout / "helper.py", "0.004", "0.04")
    done = run(checkout, "--confirm", "example")
    assert done.returncode == 1
    assert "differs by 2.0%" in done.stderr
    assert stored(checkout)["confirmed"] == confirmed
    assert run(checkout, "--stale").returncode == 1


@pytest.mark.slow
def test_failed_study_leaves_the_stored_result(checkout):
    run(checkout, "example")
    before = stored(checkout)
    edit(checkout / "helper.py", "return 2.0", "raise ValueError")
    done = run(checkout, "example")
    assert done.returncode == 1 and "example: exit code 1" in done.stderr
    assert stored(checkout) == before


def test_unknown_study_is_refused():
    done = run_benchmark("run.py", "missing_study")
    assert done.returncode == 2 and "no such study: missing_study" in done.stderr


def test_list_names_every_script():
    done = run_benchmark("run.py", "--list")
    assert done.returncode == 0, done.stderr
    rows = [line.split(" | ") for line in done.stdout.splitlines()[2:]]
    assert sorted(row[0].removeprefix("| ") for row in rows) == SCRIPTS
    assert len(SCRIPTS) <= 35
    for row in rows:
        assert len(row[1]) > 20
        assert float(row[2].removeprefix("about ")) > 0
        assert (ROOT / row[5].rstrip(" |")).is_file(), row


def test_studies_are_declared_to_take_at_most_twelve_minutes():
    # The list shows measured times instead, which are longer on a busy machine.
    table = ast.parse((BENCHMARKS / "common/studies.py").read_text("utf-8"))
    declared = [
        ast.literal_eval(node.args[0])
        for node in ast.walk(table)
        if isinstance(node, ast.Call) and getattr(node.func, "id", "") == "Study"
    ]
    assert len(declared) == len(SCRIPTS)
    assert max(declared) <= 12


@pytest.mark.fast
def test_readme_has_the_table_of_the_studies():
    text = (BENCHMARKS / "README.md").read_text("utf-8")
    assert sorted(re.findall(r"^\| `(\w+)` \|", text, re.M)) == SCRIPTS


@pytest.mark.slow
@pytest.mark.parametrize("script", SCRIPTS)
def test_script_has_help(script):
    package = NEEDS.get(script)
    if package and not find_spec(package):
        pytest.skip(f"{package} is not installed")
    done = run_benchmark(f"{script}.py", "--help")
    assert done.returncode == 0, done.stderr
    assert done.stdout.startswith("usage:")


@pytest.mark.fast
def test_scripts_take_helpers_from_the_folder_of_helpers():
    """A name that the script imports from no package is a module of a folder of helpers."""
    for path in BENCHMARKS.glob("*.py"):
        for node in ast.walk(ast.parse(path.read_text("utf-8"))):
            if isinstance(node, ast.ImportFrom) and node.module:
                first = node.module.partition(".")[0]
                assert not (BENCHMARKS / "common" / f"{first}.py").is_file(), path


@pytest.mark.fast
def test_code_digests_cover_the_modules_of_source_digests():
    module = "srs_twin.pneumatics.lag"
    assert code_digests([module]).keys() == source_digests(module).keys()


@pytest.mark.fast
@pytest.mark.parametrize(
    ("old", "new", "is_equal"),
    [
        ("Words.", "Other words.", True),
        ("return x + 1", "return (x + 1)  # remark", True),
        ("no such file", "not found here", True),
        ("{x:g} means {y:g}", "{y:g}, not {x:.3f}, is", True),
        ("x + 1", "x + 2", False),
        ("0 0 1", "0 0 2", False),
    ],
)
def test_code_digest_ignores_the_wording(old, new, is_equal):
    text = (
        'MESSAGE = "no such file"\nSIZE = "0 0 1"\n'
        'HINT = f"{x:g} means {y:g} kPa, but"\n'
        'def f(x):\n    """Words."""\n    return x + 1\n'
    )
    assert text.count(old) == 1
    assert (code_digest(text) == code_digest(text.replace(old, new))) is is_equal
