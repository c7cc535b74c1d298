"""Whatever a command refuses: exit code 2, a message without control characters, a folder as it was."""

from __future__ import annotations

import os
import re
from pathlib import Path

import pytest
from parsers import SCENARIO

from srs_twin.cli import main

LONG = "x" * 400
NEW = "new/folder"
FITTING = ("calibrate", "friction", "nothing.csv", "--robot", "gen2")
FOOTPRINT = ("calibrate", "footprint", "gen2", "--name", "f", "--overwrite")
REPRODUCE = ("reproduce", "--only", "actuator-90.gen1")
# Said of a file where a folder stands, of a plan's turns, and of names that no file of results can hold.
FOLDER = "cannot be replaced (a folder)"
TURNS = "plan.yaml: curvature -8 1/m is outside the footprint's range -5.23599 to 5.23599 1/m"
BYTES, CONTROL = (
    "cannot be used (not UTF-8); rename it",
    "cannot be used (a control character in it); rename it",
)

FILES = {
    "good.yaml": SCENARIO,
    "sweep.yaml": b"{title: S, scenario: ./good.yaml, plants: [analytical], vary: {seed: [1, 2]}}",
    "plan.yaml": b"""\
title: A way
robot: gen2
duration_s: 2
world: {goal: {x_m: 0.8, y_m: 0.1, heading_rad: 0, radius_m: 0.05}}
planner: {kind: greedy, footprint: gen2_section52, primitives: {count: 3, turn_rad: 0.8, length_m: 0.1}}
controller: {kind: follow, gait: {kind: gait, frequency_hz: 2.0}}
plants: {analytical: {}}
""",
    "file": b"",
}
OBSTACLES = ("metrics.json", "plan.png", "sweep.json", "reproduce.json", "gen2/scene.xml", "f.yaml", "g.html")


@pytest.fixture
def here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder with what the commands below read."""
    monkeypatch.chdir(tmp_path)
    for name, content in FILES.items():
        Path(name).write_bytes(content)
    for obstacle in OBSTACLES:
        Path("full", obstacle).mkdir(parents=True)
    return tmp_path


def tree(folder: Path) -> dict[str, bytes | None]:
    """Return path → contents of all that lies in a folder; None for a folder."""
    found = sorted(folder.rglob("*"))
    return {os.fsencode(p.relative_to(folder)): p.read_bytes() if p.is_file() else None for p in found}


def refused(capsys: pytest.CaptureFixture[str], *words: str) -> str:
    """Return what a command said that exited with 2."""
    before = tree(Path.cwd())
    with pytest.raises(SystemExit) as left:
        main(list(words))
    said = capsys.readouterr()
    assert (left.value.code, said.out) == (2, ""), said.err
    assert not re.search("[\x00-\x09\x0b-\x1f\x7f-\x9f\ud800-\udfff]", said.err), ascii(said.err)
    assert tree(Path.cwd()) == before
    return said.err


@pytest.mark.parametrize(
    ("words", "says"),
    [
        # A place where nothing can be written.
        (("run", "./good.yaml", "--out", f"runs/{LONG}"), "File name too long"),
        (("run", "./good.yaml", "sweep.yaml", "--out", f"runs/{LONG}"), "File name too long"),
        (("plan", "./plan.yaml", "--out", f"runs/{LONG}"), "File name too long"),
        (("sweep", "./sweep.yaml", "--out", f"runs/{LONG}"), "File name too long"),
        (("models", "export", "gen2", "--out", f"new/{LONG}"), "File name too long"),
        ((*REPRODUCE, "--out", f"new/{LONG}"), "File name too long"),
        (("calibrate", "footprint", "gen2", "--out", f"new/{LONG}"), "File name too long"),
        (("run", "./good.yaml", "--junit", f"new/{LONG}/x.xml"), "File name too long"),
        (("run", "./good.yaml", "--out", "file/x"), "Not a directory"),
        # A folder where a file belongs.
        (("run", "./good.yaml", "--out", "full"), f"full/metrics.json: {FOLDER}"),
        (("compare", "./good.yaml", "--out", "full"), f"full/metrics.json: {FOLDER}"),
        (("plan", "./plan.yaml", "--out", "full"), f"full/plan.png: {FOLDER}"),
        (("sweep", "./sweep.yaml", "--out", "full"), f"full/sweep.json: {FOLDER}"),
        ((*REPRODUCE, "--out", "full"), f"full/reproduce.json: {FOLDER}"),
        (("models", "export", "gen1", "gen2", "--out", "full"), f"full/gen2/scene.xml: {FOLDER}"),
        ((*FOOTPRINT, "--out", "full"), "full/f.yaml: "),
        ((*FITTING, "--out", "full/g.yaml"), f"full/g.html: {FOLDER}"),
        # What is found only after the place was.
        (("plan", "./plan.yaml", "--out", NEW), TURNS),
        (("run", "./plan.yaml", "--out", NEW), TURNS),
        (("sweep", "./sweep.yaml", "--without", "seed=3", "--out", NEW), "unknown value of seed '3'"),
        ((*FITTING, "--out", f"{NEW}/f.yaml"), "nothing.csv: no such file"),
        (("replay", "nothing.csv", "--robot", "gen2", "--out", NEW), "nothing.csv"),
        (("render", "nothing", "--strobe", "--out", NEW), "nothing: no run there"),
        # Names that no file of results can hold.
        (("run", "./good.yaml", "--out", "new/\udcff"), rf"new/\xff: {BYTES}"),
        (("run", "\udcff.yaml"), rf"\xff.yaml: {BYTES}"),
        (("run", "./good.yaml", "--junit", "\udcff.xml"), rf"\xff.xml: {BYTES}"),
        (("plan", "./plan.yaml", "--out", "\udcff"), rf"\xff: {BYTES}"),
        (("replay", "\udcff.csv", "--robot", "gen2"), rf"\xff.csv: {BYTES}"),
        (("replay", "a.csv", "--robot", "\udcff.yaml"), rf"\xff.yaml: {BYTES}"),
        (("view", "\udcff"), rf"\xff: {BYTES}"),
        (("run", "\x1b[31m"), rf"\x1b[31m: {CONTROL}"),
        (("run", "./good.yaml", "--out", "new\x9b31m"), rf"new\x9b31m: {CONTROL}"),
        (("models", "check", "./\x1b[31m.xml"), rf"./\x1b[31m.xml: {CONTROL}"),
        (("run", "--\x1b[31m"), rf"--\x1b[31m: {CONTROL}"),
    ],
    ids=lambda given: ascii(" ".join(given)[:50])[1:-1] if isinstance(given, tuple) else "",
)
def test_a_refused_command_leaves_no_trace(here, capsys, words, says):
    assert says in refused(capsys, *words)


@pytest.mark.parametrize(
    ("content", "says"),
    [
        (b'title: "\\e[31mred"\n' + SCENARIO.partition(b"\n")[2], "1:8: the control character \\x1b is no"),
        (SCENARIO.replace(b"world", b'"wor\\x9bld"'), "6:1: the control character \\x9b is no"),
    ],
)  # fmt: skip
def test_a_file_cannot_paint_the_terminal(here, capsys, content, says):
    Path("painted.yaml").write_bytes(content)
    assert f"painted.yaml:{says}" in refused(capsys, "run", "./painted.yaml")


def test_a_folder_of_files_with_such_names(here, capsys):
    Path("many").mkdir()
    for name in (b"\xff.yaml", b"\x1b[31m.yaml"):
        (Path("many") / os.fsdecode(name)).write_bytes(SCENARIO)
    said = refused(capsys, "run", "many")
    assert "many/\\xff.yaml: cannot be used (not UTF-8)" in said
    assert "many/\\x1b[31m.yaml: cannot be used (a control character in it)" in said


def test_names_in_other_peoples_files_are_escaped(here, capsys):
    Path("painted.csv").write_bytes(b"Format Version,1.23\n\x1b[31m,\x9b1m\n")
    said = refused(capsys, "replay", "painted.csv", "--robot", "gen2")
    assert "painted.csv" in said
