"""Makefile, hooks, .ci scripts and hosted workflows call existing commands and run every test."""

from __future__ import annotations

import ast
import os
import re
import shlex
import subprocess
import sys
import tomllib
from functools import cache

import pytest
import yaml
from conftest import ROOT

pytestmark = pytest.mark.fast

MAKEFILE = (ROOT / "Makefile").read_text("utf-8")
RUN, NIGHTLY = ((ROOT / ".ci" / name).read_text("utf-8") for name in ("run", "nightly"))
PYPROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))


def read_yaml(name):
    return yaml.safe_load((ROOT / name).read_text("utf-8"))


def recipes():
    """Return the command lines of the Makefile by target."""
    rules = re.findall(r"^(\w+):.*\n((?:\t.*\n)+)", MAKEFILE, re.M)
    return {
        target: [line.strip() for line in lines.splitlines()] for target, lines in rules
    }


def hooks():
    return [
        hook["entry"]
        for repo in read_yaml(".pre-commit-config.yaml")["repos"]
        for hook in repo["hooks"]
    ]


def scripts():
    steps = [
        line
        for text in (RUN, NIGHTLY)
        for line in re.findall(r"^step \w+ (.*)$", text, re.M)
    ]
    return [re.sub(r"^timeout \w+ ", "", step) for step in steps]


def called():
    """Return all command lines that begin with `uv run`."""
    lines = [
        *(line for recipe in recipes().values() for line in recipe),
        *hooks(),
        *scripts(),
    ]
    return sorted({line for line in lines if line.startswith("uv run ")})


def test_called_scripts_and_options_exist():
    for line in called():
        words = shlex.split(re.sub(r"^uv run --(group dev|extra gpu)", "uv run", line))[
            2:
        ]
        if words[0] == "python":
            script = ROOT / words[1]
            known = set(re.findall(r'"(--\w+)"', script.read_text("utf-8")))
            assert {word for word in words[2:] if word.startswith("--")} <= known, line
        else:
            assert words[0] in (
                "codespell",
                "mypy",
                "pytest",
                "ruff",
                "sphinx-build",
                "srs-twin",
            ), line


@cache
def words_of(module):
    """Return the words in the source of a module of the package; empty if there is no such module."""
    place = ROOT / module.replace(".", "/")
    files = [
        path
        for path in (place.with_suffix(".py"), place / "__init__.py")
        if path.is_file()
    ]
    return {
        word for path in files for word in re.findall(r"\w+", path.read_text("utf-8"))
    }


@pytest.mark.parametrize("folder", ["benchmarks", "docs", "examples", "tools"])
def test_scripts_import_names_that_exist(folder):
    """Names that move inside the package move in the scripts as well."""
    missing = []
    for path in (ROOT / folder).rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_text("utf-8"))):
            if isinstance(node, ast.ImportFrom) and (node.module or "").startswith(
                "srs_twin"
            ):
                for name in (alias.name for alias in node.names):
                    if name not in words_of(node.module) and not words_of(
                        f"{node.module}.{name}"
                    ):
                        missing.append(
                            f"{path.relative_to(ROOT)}: {node.module}.{name}"
                        )
    assert missing == []


def test_makefile_targets_run_the_documented_commands():
    assert recipes().keys() >= {"test", "fast", "check", "docs", "golden"}
    assert (
        set(re.search(r"^\.PHONY: (.*)$", MAKEFILE, re.M)[1].split())
        == recipes().keys()
    )
    assert recipes()["test"] == ["uv run --group dev pytest"]
    checks = ["ruff check", "ruff format --check", "mypy"]
    assert recipes()["check"] == [f"uv run --group dev {check}" for check in checks]
    assert set(hooks()) == {*recipes()["check"], ".ci/check-title"}


@pytest.mark.parametrize(
    ("title", "problem"),
    [
        ("Compile the infeasibility proof before the planner's clock starts", "65"),
        ("Slow laws are slow tests", "verb in the imperative"),
        ("Compile the proof before the clock starts", None),
    ],
)
def test_titles_of_commits_are_checked(tmp_path, title, problem):
    message = tmp_path / "COMMIT_EDITMSG"
    message.write_text(f"{title}\n\nThe reason.\n")
    done = subprocess.run(
        [sys.executable, ROOT / ".ci/check-title", message],
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == (problem is not None)
    assert (problem or "") in done.stderr


def test_ci_runs_every_test():
    assert "not slow" in PYPROJECT["tool"]["pytest"]["ini_options"]["addopts"]
    assert [
        line
        for line in scripts()
        if "pytest" in line and not line.startswith(".ci/targets")
    ] == [
        "uv run --group dev pytest",
        'uv run --group dev pytest -m "slow and not nightly"'
        " --durations=40 --durations-min=5",
        "uv run --group dev pytest -m nightly",
    ]


def test_nightly_studies_have_time_limits():
    studies = re.findall(r"^step \w+ (.*)$", NIGHTLY, re.M)
    assert len(studies) >= 3
    assert all(
        re.match(
            r"timeout \d+[mh] (\.ci/targets all |uv run --group dev pytest -m nightly"
            r"|uv run (--extra gpu )?python (benchmarks|tools)/"
            r'|uv run srs-twin (reproduce|run) )|newer$|videos "\$room"/runs/\*$',
            study,
        )
        for study in studies
    )


def test_workflow_runs_the_ci_scripts():
    workflow = read_yaml(".github/workflows/ci.yml")
    assert workflow["permissions"] == {"contents": "read"}
    jobs = workflow["jobs"].values()
    run = {
        step["run"]: job["if"] for job in jobs for step in job["steps"] if "run" in step
    }
    assert run == {
        ".ci/run": "github.event_name != 'schedule'",
        ".ci/nightly": "github.event_name == 'schedule'",
    }
    assert all(os.access(ROOT / script, os.X_OK) for script in run)


def test_every_fault_fits_the_code_and_names_tests_that_exist():
    for fault in read_yaml("tools/faults.yaml"):
        assert (ROOT / fault["file"]).read_text("utf-8").count(fault["old"]) == 1, (
            fault["name"]
        )
        for test in fault["tests"].split():
            file, _, name = test.partition("::")
            assert f"def {name.partition('[')[0]}" in (ROOT / file).read_text(
                "utf-8"
            ), test


def test_release_script_is_valid_and_part_of_the_release_checklist():
    script = ROOT / ".ci/release"
    assert os.access(script, os.X_OK)
    subprocess.run(["bash", "-n", str(script)], check=True)
    checklist = (
        (ROOT / "CONTRIBUTING.md").read_text("utf-8").partition("## Releases")[2]
    )
    assert "`.ci/release`" in checklist and "`.ci/run`" in checklist
