"""Places that cannot hold files, names that cannot exist: exit code 2 for each command, and no trace."""

from __future__ import annotations

import errno
import os
import subprocess
from collections.abc import Iterator
from pathlib import Path

import pytest
from test_refused import refused

from srs_twin.cli import main
from srs_twin.io.files import data_root, shown

EXAMPLES = data_root() / "calibration/examples/my_snake"
WALK, PULLS = str(EXAMPLES / "walk_straight.csv"), str(EXAMPLES / "pulls.csv")
FIT = str(data_root() / "calibration/fits/gen4_table8_analytical.yaml")
FILES = {
    "good.yaml": """\
title: S
robot: gen2
duration_s: 0.2
controller: {kind: gait, frequency_hz: 2.0}
plants: {analytical: {}}
""",
    "plan.yaml": """\
title: A way
robot: gen2
duration_s: 2
world: {goal: {x_m: 0.8, y_m: 0.1, heading_rad: 0, radius_m: 0.05}}
planner: {kind: best_first, footprint: gen2_gait}
controller: {kind: follow, gait: {kind: gait, frequency_hz: 2.0}}
plants: {analytical: {}}
""",
    "sweep.yaml": "{title: S, scenario: ./good.yaml, plants: [analytical], vary: {seed: [1, 2]}}",
    "study.yaml": """\
title: S
scenario: ./good.yaml
variables: {controller.frequency_hz: {low: 0.5, high: 3.0}}
objectives: [{metric: com_speed_m_s, goal: maximize}]
budget: {compliant: 8, twin: 4}
""",
    "result.json": '{"versions": {}, "scenario": "s", "plants": {}, "comparison": {}, "expectations": []}',
    "journal.mcap": "not read before the place was",
    "file": "",
}
FOLDERS = {
    "a file": "file",
    "below a file": "file/x",
    "5000 characters": "x" * 5000,
    "a part of 300 characters": "new/" + "x" * 300,
    "200 levels": "/".join("a" * 200),
    "2000 levels": "/".join("a" * 2000),
    "proc": "/proc/x",
    "a device": "/dev/null",
    "a pipe": "pipe",
    "a link to nothing": "link",
    "a link to itself": "loop",
}
COMMANDS = {
    "run": ("run", "./good.yaml", "--out", "{}"),
    "run of two": ("run", "./good.yaml", "gen2_straight", "--out", "{}"),
    "run --junit": ("run", "./good.yaml", "--junit", "{}/x.xml"),
    "compare": ("compare", "./good.yaml", "--out", "{}"),
    "plan": ("plan", "./plan.yaml", "--search", "--out", "{}"),
    "models export": ("models", "export", "gen2", "--out", "{}"),
    "calibrate footprint": ("calibrate", "footprint", "gen2", "--out", "{}"),
    "calibrate margin": ("calibrate", "margin", "./plan.yaml", "--out", "{}"),
    "calibrate friction": ("calibrate", "friction", PULLS, "--robot", "gen2", "--out", "{}/f.yaml"),
    "calibrate robot": ("calibrate", "robot", FIT, "--name", "r", "--out", "{}/r.yaml"),
    "inspect --write-map": ("inspect", WALK, "--write-map", "{}/m.yaml"),
    "inspect --picture": ("inspect", WALK, "--picture", "{}/m.png"),
    "diff --junit": ("diff", "result.json", "result.json", "--junit", "{}/x.xml"),
    "shadow": ("shadow", "gen2", "--out", "{}"),
    "shadow --mcap": ("shadow", "gen2", "--mcap", "journal.mcap", "--out", "{}"),
}
# These start worker processes before they look at the place.
SLOW = {
    "sweep": ("sweep", "./sweep.yaml", "--out", "{}"),
    "optimize": ("optimize", "./study.yaml", "--out", "{}"),
    "uncertainty": ("uncertainty", "./good.yaml", "--samples", "16", "--twin", "16", "--out", "{}"),
    "reproduce": ("reproduce", "--only", "actuator-90.gen1", "--no-figures", "--out", "{}"),
}
commands = pytest.mark.parametrize(
    "words",
    [
        *(pytest.param(words, id=name) for name, words in COMMANDS.items()),
        *(pytest.param(words, id=name, marks=pytest.mark.slow) for name, words in SLOW.items()),
    ],
)


@pytest.fixture
def here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder with the files that the commands read, and with places that are none."""
    monkeypatch.chdir(tmp_path)
    for name, content in FILES.items():
        Path(name).write_text(content, "utf-8")
    os.mkfifo("pipe")
    Path("link").symlink_to("nowhere")
    Path("loop").symlink_to("loop")
    return tmp_path


def told(*command: str) -> None:
    if subprocess.run(command, capture_output=True).returncode:
        pytest.skip(f"{command[0]} is not possible here")


@pytest.fixture
def read_only(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """A file system that is mounted read-only."""
    place = tmp_path_factory.mktemp("read_only")
    told("mount", "-t", "tmpfs", "-o", "ro,size=1m", "none", str(place))
    yield place
    subprocess.run(["umount", str(place)], check=True)


@pytest.fixture
def immutable(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """A folder to which root, too, can add nothing."""
    place = tmp_path_factory.mktemp("immutable")
    told("chattr", "+i", str(place))
    yield place
    subprocess.run(["chattr", "-i", str(place)], check=True)


@commands
def test_a_place_that_holds_no_files_is_refused(here, capsys, words):
    for name, folder in FOLDERS.items():
        said = refused(capsys, *(word.replace("{}", folder) for word in words))
        assert "cannot" in said and "internal" not in said, f"{name}: {said}"


@commands
def test_a_read_only_file_system_is_refused(here, capsys, read_only, words):
    for folder in (read_only, read_only / "new/folder"):
        said = refused(capsys, *(word.replace("{}", str(folder)) for word in words))
        assert "Read-only file system" in said


@commands
def test_an_immutable_folder_is_refused(here, capsys, immutable, words):
    said = refused(capsys, *(word.replace("{}", str(immutable / "new")) for word in words))
    assert "Operation not permitted" in said


def test_a_hundred_levels_are_made(here, capsys):
    deep = Path("/".join("a" * 100))
    with pytest.raises(SystemExit) as left:
        main(["plan", "./plan.yaml", "--quiet", "--out", str(deep)])
    assert (left.value.code or 0, capsys.readouterr().err) == (0, "")
    assert (deep / "plan.json").is_file()


@pytest.mark.parametrize("name", ["x" * 300, "./" + "x" * 300 + ".yaml", "y" * 5000, "a/" * 2000 + "x.yaml"])
@pytest.mark.parametrize(
    "words",
    [
        ("run", "{}"), ("plan", "{}"), ("view", "{}"), ("show", "{}"), ("inspect", "{}"),
        ("diff", "{}", "file"),
        ("models", "check", "{}"), ("replay", "{}", "--robot", "gen2"), ("inspect", WALK, "--map", "{}"),
        ("calibrate", "robot", FIT, "--name", "r", "--out", "{}"),
        ("calibrate", "robot", "{}", "--name", "r"),
        ("calibrate", "friction", "{}", "--robot", "gen2", "--name", "f"),
        ("run", "./good.yaml", "--set", "start={from: {}, time_s: 0.1}"),
        ("shadow", "gen2", "--mcap", "{}"),
    ],
    ids=lambda words: " ".join(words)[:30],
)  # fmt: skip
def test_a_name_that_no_file_can_have_is_refused(here, capsys, words, name):
    said = refused(capsys, *(word.replace("{}", name) for word in words))
    assert "internal" not in said


@pytest.mark.parametrize(
    "words", [("replay", ".", "--robot", "gen2"), ("calibrate", "locomotion", "", "-r", "gen2")]
)
def test_the_current_folder_is_no_recording(here, capsys, words):
    assert "a folder; give one file" in refused(capsys, *words)


@pytest.mark.parametrize(
    "words",
    [
        ("list",), ("--version",), ("run", "gen2_straight", "--out", "/tmp/new"), ("plan", "gen2_straight"),
        ("sweep", "fig41"), ("diff", "/", "/"), ("emulate", "gen2"), ("doctor",), ("models", "check"),
    ],
    ids=" ".join,
)  # fmt: skip
def test_no_command_starts_in_a_removed_folder(tmp_path, monkeypatch, capsys, words):
    gone = tmp_path / "gone"
    gone.mkdir()
    monkeypatch.chdir(gone)
    gone.rmdir()
    with pytest.raises(SystemExit) as left:
        main(list(words))
    said = capsys.readouterr()
    assert (left.value.code, said.out) == (2, "")
    assert said.err.startswith("cannot use the current folder (No such file or directory)")
    assert shown(tmp_path / "x") == str(tmp_path / "x")  # of a folder that is removed later


@pytest.mark.parametrize(
    ("number", "code"), [(errno.EROFS, 2), (errno.ENAMETOOLONG, 2), (errno.ENOSPC, 2), (errno.ENOENT, 4)]
)
def test_refusals_of_the_machine_are_no_internal_errors(monkeypatch, capsys, number, code):
    def fails(**_: object) -> None:
        raise OSError(number, os.strerror(number), "some/file")

    monkeypatch.setattr("srs_twin.cli.app.command", lambda: fails)
    with pytest.raises(SystemExit) as left:
        main(["list"])
    said = capsys.readouterr().err
    assert left.value.code == code and os.strerror(number) in said
    assert said.startswith("some/file: " if code == 2 else "srs-twin: internal error")
