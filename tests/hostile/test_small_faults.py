"""Mistakes and accidents at the edges: each gets the right answer instead of a report of a bug."""

from __future__ import annotations

import os
import resource
import subprocess
import sys
from pathlib import Path

import pytest
import yaml

from srs_twin.cli import main
from srs_twin.compute.compiled import _why_unsafe
from srs_twin.errors import TaskFailedError
from srs_twin.io.files import atomic_write

ROOT = Path(__file__).parents[2]
SWEEP = "scenario: gen2_straight\n{fixed}vary: {{controller.frequency_hz: [1, 2]}}\n"


def refused(capfd, *words: str) -> str:
    with pytest.raises(SystemExit) as end:
        main(list(words))
    assert end.value.code == 2
    return str(capfd.readouterr().err)


@pytest.mark.parametrize("fixed", ["true", "3", "2.5"])
def test_fixed_values_that_are_no_block_are_refused_with_set(tmp_path, capfd, fixed):
    path = tmp_path / "mine.yaml"
    path.write_text(SWEEP.format(fixed=f"fixed: {fixed}\n"))
    error = refused(
        capfd, "sweep", str(path), "--set", "controller.offset=0.1", "--out", str(tmp_path / "out")
    )
    assert f"mine.yaml:2:8: fixed: must be a block of keys, not {fixed}" in error


@pytest.mark.parametrize("share", ["1e400%", "nan", "-5%", "0%", "inf", "much"])
def test_impossible_accuracy_is_refused(capfd, share):
    error = refused(capfd, "calibrate", "design", "gen2", "--want", f"friction.mu_t={share}")
    assert "must be NAME=PERCENT" in error


def test_exhausted_memory_is_no_bug_of_the_program():
    text = str(TaskFailedError(MemoryError("Unable to allocate 3.00 GiB for an array")))
    assert "the memory is exhausted: Unable to allocate 3.00 GiB" in text
    assert "bug" not in text


@pytest.mark.slow
def test_command_with_too_little_memory_says_so(tmp_path):
    def limit() -> None:
        resource.setrlimit(resource.RLIMIT_AS, (6 << 30, 6 << 30))

    code = "import numpy as np\nfrom srs_twin.cli import main\nimport srs_twin.cli.app as app\n"
    code += "app.command = lambda: lambda **_: np.zeros(1 << 32)\nmain([])\n"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, preexec_fn=limit)
    assert done.returncode == 4
    assert "the memory is exhausted: Unable to allocate 32.0 GiB" in done.stderr


KILLED = """
import os, signal, sys
from srs_twin.io.files import atomic_write
with atomic_write(sys.argv[1]) as temporary:
    temporary.write_text("half")
    os.kill(os.getpid(), signal.SIGKILL)
"""


def test_next_write_removes_the_temporary_file_of_a_killed_one(tmp_path):
    target = tmp_path / "result.yaml"
    foreign = tmp_path / ".result.1234.part.yaml"
    foreign.write_text("of the user")
    subprocess.run([sys.executable, "-c", KILLED, str(target)], check=False)
    (left,) = set(tmp_path.iterdir()) - {foreign}
    with atomic_write(target) as first, atomic_write(target) as second:
        first.write_text("first")
        second.write_text("second")
    assert set(tmp_path.iterdir()) == {foreign, target}
    assert not left.exists()


def test_kernels_of_a_folder_that_a_group_can_write_are_not_trusted(tmp_path, monkeypatch):
    folder = tmp_path / "kernels"
    folder.mkdir()
    folder.chmod(0o775)
    monkeypatch.setattr("srs_twin.compute.compiled._is_own_group", lambda number: False)
    assert "can be written by its group" in str(_why_unsafe(folder))
    folder.chmod(0o755)
    assert _why_unsafe(folder) is None


def test_output_of_the_action_cannot_be_a_workflow_command(tmp_path):
    action = yaml.safe_load((ROOT / ".github/actions/rollouts/action.yml").read_text("utf-8"))
    (script,) = (step["run"] for step in action["runs"]["steps"] if step.get("id") == "run")
    program = tmp_path / "uv"
    program.write_text("#!/bin/sh\nprintf '::error::forged\\n```\\n# forged\\n'\n")
    program.chmod(0o755)
    environment = os.environ | {
        "PATH": f"{tmp_path}:{os.environ['PATH']}", "PROJECT": ".", "SCENARIOS": "s", "ARGUMENTS": "--check",
        "OUT": str(tmp_path / "out"), "GITHUB_OUTPUT": str(tmp_path / "o"),
        "GITHUB_STEP_SUMMARY": str(tmp_path / "s"),
    }  # fmt: skip
    done = subprocess.run(
        ["bash", "-e", "-c", script],
        cwd=tmp_path,
        env=environment,
        capture_output=True,
        text=True,
        check=True,
    )
    first, *inside, last = done.stdout.splitlines()
    command, _, token = first.removeprefix("::").partition("::")
    assert command == "stop-commands" and len(token) == 64 and last == f"::{token}::"
    assert "::error::forged" in inside
    assert all(line.startswith("    ") for line in (tmp_path / "s").read_text().splitlines())
