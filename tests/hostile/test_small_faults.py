"""Mistakes and accidents at the edges: each gets the right answer instead of a report of a bug."""

from __future__ import annotations

import copy
import errno
import os
import subprocess
import sys
from collections.abc import Iterator, Mapping
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import yaml
from malformed_archives import POLICY, archive

from srs_twin import AnalyticalSnake, InputError, TwinSnake, load_robot
from srs_twin.cli import main
from srs_twin.compute.compiled import _is_own_group, _why_unsafe
from srs_twin.envs.policy import load_policy
from srs_twin.errors import TaskFailedError
from srs_twin.io.files import atomic_write

ROOT = Path(__file__).parents[2]
SWEEP = "scenario: gen2_straight\nfixed: 2.5\nvary: {controller.frequency_hz: [1, 2]}\n"
SCENARIO = """title: Mine
robot: {base: gen2, friction: 3}
duration_s: 1
controller: {kind: gait, frequency_hz: 1.0}
plants: {analytical: {}}
"""


def refused(capfd, *words: str) -> str:
    with pytest.raises(SystemExit) as end:
        main(list(words))
    assert end.value.code == 2
    return str(capfd.readouterr().err)


@pytest.mark.parametrize(
    ("command", "text", "field", "place", "value"),
    [
        ("sweep", SWEEP, "controller.offset", "2:8: fixed", "2.5"),
        (
            "sweep",
            SWEEP.replace("2.5", "true"),
            "controller.offset",
            "2:8: fixed",
            "true",
        ),
        ("run", SCENARIO, "robot.friction.mu_n", "2:31: robot.friction", "3"),
    ],
)
def test_a_value_in_place_of_a_block_is_refused_with_set(
    tmp_path, capfd, command, text, field, place, value
):
    path = tmp_path / "mine.yaml"
    path.write_text(text)
    words = ("--set", f"{field}=0.4", "--out", str(tmp_path / "out"))
    error = refused(capfd, command, str(path), *words)
    assert f"mine.yaml:{place}: must be a block of keys, not {value}" in error


@pytest.mark.default_cases(2)
@pytest.mark.parametrize("fraction", ["1e400%", "nan", "-5%", "0%", "much"])
def test_impossible_accuracy_is_refused(capfd, fraction):
    error = refused(
        capfd,
        "calibrate",
        "design",
        "gen2",
        "--target-accuracy",
        f"friction.mu_t={fraction}",
    )
    assert "must have the form NAME=PERCENT" in error


@pytest.mark.default_cases(2)
@pytest.mark.parametrize(
    "error",
    [
        MemoryError("Unable to allocate 3.00 GiB for an array"),
        OSError(errno.ENOMEM, os.strerror(errno.ENOMEM)),
        RuntimeError("can't start new thread"),
        ImportError("libopenblas.so: failed to map segment from shared object"),
    ],
)
def test_exhausted_memory_is_no_bug_of_the_program(error):
    text = str(TaskFailedError(error))
    assert "the memory is exhausted" in text and str(error) in text
    assert "bug" not in text


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
        assert first == left, "the file of the killed process is overwritten"
        first.write_text("first")
        second.write_text("second")
    assert set(tmp_path.iterdir()) == {foreign, target}


def test_file_of_a_live_writer_is_kept_by_other_writers(tmp_path):
    target = tmp_path / "result.yaml"
    with atomic_write(target) as first:
        first.write_text("first")
        with atomic_write(target) as second:
            second.write_text("second")
        assert target.read_text() == "second"
        with pytest.raises(ZeroDivisionError), atomic_write(target) as third:
            third.write_text(str(1 / 0))
    assert target.read_text() == "first"
    assert [*tmp_path.iterdir()] == [target]


def test_kernels_of_a_folder_that_a_group_can_write_are_not_trusted(
    tmp_path, monkeypatch
):
    folder = tmp_path / "kernels"
    folder.mkdir()
    folder.chmod(0o775)
    monkeypatch.setattr("srs_twin.compute.compiled._is_own_group", lambda number: False)
    assert "is writable by its group" in str(_why_unsafe(folder))
    folder.chmod(0o755)
    assert _why_unsafe(folder) is None


def test_a_group_that_others_share_is_not_the_users_own(monkeypatch):
    own = SimpleNamespace(pw_name="ann", pw_gid=100)
    monkeypatch.setattr("pwd.getpwuid", lambda number: own)
    groups = {100: ("users", []), 1000: ("ann", []), 1001: ("ann", ["ann", "bob"])}
    monkeypatch.setattr(
        "grp.getgrgid",
        lambda number: SimpleNamespace(
            gr_name=groups[number][0], gr_mem=groups[number][1]
        ),
    )
    assert [_is_own_group(number) for number in groups] == [False, True, False]


def test_output_of_the_action_cannot_be_a_workflow_command(tmp_path):
    action = yaml.safe_load(
        (ROOT / ".github/actions/rollouts/action.yml").read_text("utf-8")
    )
    (script,) = (
        step["run"] for step in action["runs"]["steps"] if step.get("id") == "run"
    )
    program = tmp_path / "uv"
    text = "::error::forged\\n```\\n# forged\\n"
    program.write_text(f"#!/bin/sh\nprintf '{text}'\nprintf '{text}' >&2\n")
    program.chmod(0o755)
    environment = os.environ | {
        "PATH": f"{tmp_path}:{os.environ['PATH']}",
        "PROJECT": ".",
        "SCENARIOS": "s",
        "ARGUMENTS": "--check",
        "OUT": str(tmp_path / "out"),
        "GITHUB_OUTPUT": str(tmp_path / "o"),
        "GITHUB_STEP_SUMMARY": str(tmp_path / "s"),
    }
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
    assert inside.count("::error::forged") == 2
    assert all(
        line.startswith("    ") for line in (tmp_path / "s").read_text().splitlines()
    )


def test_sparse_file_with_a_large_directory_is_refused_before_it_is_read(tmp_path):
    path = tmp_path / "large.npz"
    path.write_bytes(archive(POLICY))
    os.truncate(path, 3 << 30)
    with pytest.raises(InputError, match="the file has 3221225472 bytes, but at most "):
        load_policy(path)


@pytest.mark.parametrize("plant", [AnalyticalSnake, TwinSnake])
def test_number_in_place_of_an_array_of_a_state_is_refused(plant):
    """Each array of a saved state, also of nested ones, is replaced by a number once."""
    snake = plant(load_robot("gen2"))
    snake.reset()
    state = snake.save()
    arrays = [*array_places(state.content)]
    assert len(arrays) > 5
    for place in arrays:
        content = copy.deepcopy(dict(state.content))
        inner = content
        for name in place[:-1]:
            inner = inner[name]
        inner[place[-1]] = 1.0
        with pytest.raises(
            InputError, match="the saved (value must be|MuJoCo state is)"
        ):
            snake.restore(replace(state, content=content))
    assert snake.restore(state).time == 0.0


def array_places(
    content: Mapping[str, Any], place: tuple[str, ...] = ()
) -> Iterator[tuple[str, ...]]:
    """Yield the names that lead to each array of nested states."""
    for name, value in content.items():
        if isinstance(value, np.ndarray):
            yield (*place, name)
        elif isinstance(value, Mapping):
            yield from array_places(value, (*place, name))
