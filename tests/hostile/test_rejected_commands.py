"""A rejected command exits with code 2, prints no control characters and leaves its folder unchanged."""

# ruff: noqa: E501 - one command per line, as a table
from __future__ import annotations

import errno
import os
import re
import subprocess
from collections.abc import Iterator
from pathlib import Path

import pytest
from conftest import as_in_a_process
from malformed_scenarios import SCENARIO

from srs_twin.cli import main
from srs_twin.io.files import data_root, display_path

EXAMPLES = data_root() / "calibration/examples/my_snake"
WALK = str(EXAMPLES / "walk_straight.csv")
PULLS = str(EXAMPLES / "pulls.csv")
FIT = str(data_root() / "calibration/fits/gen4_table8_analytical.yaml")
LONG = "x" * 400
NEW = "new/folder"
FITTING = "calibrate friction nothing.csv --robot gen2"
FOOTPRINT = "calibrate footprint gen2 --name f --overwrite"
REPRODUCE = "reproduce --only actuator-90.gen1"

_PLAN = """\
title: A path
robot: gen2
duration_s: 2
world: {goal: {x_m: 0.8, y_m: 0.1, heading_rad: 0, radius_m: 0.05}}
planner: {kind: %s}
controller: {kind: follow, gait: {kind: gait, frequency_hz: 2.0}}
plants: {analytical: {}}
"""
FILES = {
    "good.yaml": SCENARIO.decode(),
    "plan.yaml": _PLAN % "best_first, footprint: gen2_gait",
    "far.yaml": (_PLAN % "best_first, footprint: gen2_gait").replace(
        "world: {", "world: {bounds: {x_m: [-0.1, 0.9], y_m: [-0.5, 0.5]}, "
    ),
    "sweep.yaml": (
        "{title: S, scenario: ./good.yaml, plants: [analytical], vary: {seed: [1, 2]}}"
    ),
    "study.yaml": (
        """\
title: S
scenario: ./good.yaml
variables: {controller.frequency_hz: {low: 0.5, high: 3.0}}
objectives: [{metric: com_speed_m_s, goal: maximize}]
budget: {compliant: 8, twin: 4}
"""
    ),
    "result.json": (
        '{"versions": {}, "scenario": "s", "plants": {}, "comparison": {},'
        ' "expectations": []}'
    ),
    "journal.mcap": "is not read before the output folder is checked",
    "file": "",
}
# Folders with the names of result files.
FOLDERS = (
    "metrics.json",
    "plan.png",
    "sweep.json",
    "reproduce.json",
    "gen2/scene.xml",
    "f.yaml",
    "g.html",
)
UNUSABLE_FOLDERS = {
    "a file": "file",
    "below a file": "file/x",
    "5000 characters": "x" * 5000,
    "300 characters": "new/" + "x" * 300,
    "200 levels": "/".join("a" * 200),
    "2000 levels": "/".join("a" * 2000),
    "proc": "/proc/x",
    "a device": "/dev/null",
    "a pipe": "pipe",
    "a broken link": "link",
    "a link to itself": "loop",
}
# Commands with {} in place of the output folder.
COMMANDS = (
    "run ./good.yaml --out {}",
    "run ./good.yaml gen2_straight --out {}",
    "run ./good.yaml --junit {}/x.xml",
    "compare ./good.yaml --out {}",
    "plan ./plan.yaml --out {}",
    "models export gen2 --out {}",
    "calibrate footprint gen2 --out {}",
    "calibrate margin ./plan.yaml --out {}",
    f"calibrate friction {PULLS} --robot gen2 --out {{}}/f.yaml",
    f"calibrate robot {FIT} --name r --out {{}}/r.yaml",
    f"inspect {WALK} --write-map {{}}/m.yaml",
    f"inspect {WALK} --picture {{}}/m.png",
    "diff result.json result.json --junit {}/x.xml",
    "shadow gen2 --out {}",
    "shadow gen2 --mcap journal.mcap --out {}",
)
# These start worker processes before they check the folder.
SLOW = (
    "sweep ./sweep.yaml --out {}",
    "optimize ./study.yaml --out {}",
    "uncertainty ./good.yaml --samples 16 --twin 16 --out {}",
    f"{REPRODUCE} --no-figures --out {{}}",
)
each_command = pytest.mark.parametrize(
    "command",
    [*COMMANDS, *(pytest.param(command, marks=pytest.mark.slow) for command in SLOW)],
)

TOO_LONG = "File name too long"
FOLDER = "a folder has the name of an output file"
FAR = "far.yaml: start (0, 0): the footprint of the straight body touches the bounds"
BYTES = "this name cannot be used (it is not valid UTF-8); rename it"
CONTROL = "this name cannot be used (it contains a control character); rename it"
REJECTED = [
    # The output folder cannot be written.
    (f"run ./good.yaml --out runs/{LONG}", TOO_LONG),
    (f"run ./good.yaml sweep.yaml --out runs/{LONG}", TOO_LONG),
    (f"plan ./far.yaml --out runs/{LONG}", TOO_LONG),
    (f"sweep ./sweep.yaml --out runs/{LONG}", TOO_LONG),
    (f"models export gen2 --out new/{LONG}", TOO_LONG),
    (f"{REPRODUCE} --out new/{LONG}", TOO_LONG),
    (f"calibrate footprint gen2 --out new/{LONG}", TOO_LONG),
    (f"run ./good.yaml --junit new/{LONG}/x.xml", TOO_LONG),
    ("run ./good.yaml --out file/x", "Not a directory"),
    # A folder has the name of a result file.
    ("run ./good.yaml --out full", f"full/metrics.json: {FOLDER}"),
    ("compare ./good.yaml --out full", f"full/metrics.json: {FOLDER}"),
    ("plan ./far.yaml --out full", f"full/plan.png: {FOLDER}"),
    ("sweep ./sweep.yaml --out full", f"full/sweep.json: {FOLDER}"),
    (f"{REPRODUCE} --out full", f"full/reproduce.json: {FOLDER}"),
    ("models export gen1 gen2 --out full", f"full/gen2/scene.xml: {FOLDER}"),
    (f"{FOOTPRINT} --out full", "full/f.yaml: "),
    (f"{FITTING} --out full/g.yaml", f"full/g.html: {FOLDER}"),
    # The problem is detected after the output folder was checked.
    (f"plan ./far.yaml --out {NEW}", FAR),
    (f"run ./far.yaml --out {NEW}", FAR),
    (f"sweep ./sweep.yaml --exclude seed=3 --out {NEW}", "unknown value of seed '3'"),
    (f"{FITTING} --out {NEW}/f.yaml", "nothing.csv: no such file"),
    (f"replay nothing.csv --robot gen2 --out {NEW}", "nothing.csv"),
    (f"render nothing --strobe --out {NEW}", "nothing: no finished run was found"),
    # Names that cannot be written to result files.
    ("run ./good.yaml --out new/\udcff", rf"new/\xff: {BYTES}"),
    ("run \udcff.yaml", rf"\xff.yaml: {BYTES}"),
    ("run ./good.yaml --junit \udcff.xml", rf"\xff.xml: {BYTES}"),
    ("plan ./far.yaml --out \udcff", rf"\xff: {BYTES}"),
    ("replay \udcff.csv --robot gen2", rf"\xff.csv: {BYTES}"),
    ("replay a.csv --robot \udcff.yaml", rf"\xff.yaml: {BYTES}"),
    ("view \udcff", rf"\xff: {BYTES}"),
    ("run \x1b[31m", rf"\x1b[31m: {CONTROL}"),
    ("run ./good.yaml --out new\x9b31m", rf"new\x9b31m: {CONTROL}"),
    ("models export ./\x1b[31m.yaml", rf"./\x1b[31m.yaml: {CONTROL}"),
    ("run --\x1b[31m", rf"--\x1b[31m: {CONTROL}"),
    # The current folder is not a recording.
    ("replay . --robot gen2", "a folder; give one file"),
]

# Commands with {} in place of a file name that is too long.
FILE_COMMANDS = (
    "run {}",
    "plan {}",
    "view {}",
    "show {}",
    "inspect {}",
    "diff {} file",
    "models export {}",
    "replay {} --robot gen2",
    f"inspect {WALK} --map {{}}",
    f"calibrate robot {FIT} --name r --out {{}}",
    "calibrate robot {} --name r",
    "calibrate friction {} --robot gen2 --name f",
    "shadow gen2 --mcap {}",
)
LONG_NAMES = ("x" * 300, "a/" * 2000 + "x.yaml")
ANY_COMMANDS = (
    "list",
    "--version",
    "run gen2_straight --out /tmp/new",
    "diff / /",
    "doctor",
)


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Change to a folder with the files that the commands read, and with unusable output folders."""
    monkeypatch.chdir(tmp_path)
    for name, content in FILES.items():
        Path(name).write_text(content, "utf-8")
    for name in FOLDERS:
        Path("full", name).mkdir(parents=True)
    os.mkfifo("pipe")
    Path("link").symlink_to("nowhere")
    Path("loop").symlink_to("loop")
    return tmp_path


def tree(folder: Path) -> dict[bytes, bytes | None]:
    """Return path → content of everything in a folder; None for a folder or special file."""
    paths = sorted(folder.rglob("*"))
    return {
        os.fsencode(p.relative_to(folder)): p.read_bytes() if p.is_file() else None
        for p in paths
    }


def rejection(capsys: pytest.CaptureFixture[str], *arguments: str) -> str:
    """Run a command that must exit with code 2, and return its message."""
    before = tree(Path.cwd())
    with as_in_a_process(), pytest.raises(SystemExit) as exit_:
        main(list(arguments))
    output, message = capsys.readouterr()
    assert (exit_.value.code, output) == (2, ""), message
    assert not re.search("[\x00-\x09\x0b-\x1f\x7f-\x9f\ud800-\udfff]", message), ascii(
        message
    )
    assert tree(Path.cwd()) == before
    return message


@pytest.fixture
def read_only(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """Mount a read-only file system."""
    mount = tmp_path_factory.mktemp("read_only")
    command = ["mount", "-t", "tmpfs", "-o", "ro,size=1m", "none", str(mount)]
    if subprocess.run(command, capture_output=True, check=False).returncode:
        pytest.skip("mount is not possible on this machine")
    yield mount
    subprocess.run(["umount", str(mount)], check=True)


@pytest.mark.default_cases(at=[0, 1, 3, 5, 6, 14, 17, 18, 19, 22, 34])
@pytest.mark.parametrize(
    ("command", "message"),
    REJECTED,
    ids=[ascii(command[:50])[1:-1] for command, _ in REJECTED],
)
def test_rejected_command_changes_no_file(folder, capsys, command, message):
    assert message in rejection(capsys, *command.split(" "))


@pytest.mark.default_cases(at=[0, 2, 5, 6, 7, 8, 13, 14])
@each_command
def test_unusable_output_folder_is_rejected(folder, capsys, command):
    for name, unusable in UNUSABLE_FOLDERS.items():
        message = rejection(capsys, *command.replace("{}", unusable).split())
        assert "cannot" in message and "internal" not in message, f"{name}: {message}"


@pytest.mark.default_cases(at=[0, 2, 5, 6, 7, 8, 14])
@each_command
def test_read_only_file_system_is_rejected(folder, capsys, read_only, command):
    for output in (read_only, read_only / "new/folder"):
        message = rejection(capsys, *command.replace("{}", str(output)).split())
        assert "Read-only file system" in message


def test_a_hundred_levels_of_new_folders_are_created(folder, capsys):
    deep = Path("/".join("a" * 100))
    with pytest.raises(SystemExit) as exit_:
        main(["plan", "./plan.yaml", "--quiet", "--out", str(deep)])
    assert (exit_.value.code or 0, capsys.readouterr().err) == (0, "")
    assert (deep / "plan.json").is_file()


@pytest.mark.default_cases(9)
@pytest.mark.parametrize("name", LONG_NAMES, ids=lambda name: f"{name[:4]} {len(name)}")
@pytest.mark.parametrize("command", FILE_COMMANDS)
def test_too_long_file_name_is_rejected(folder, capsys, command, name):
    assert "internal" not in rejection(capsys, *command.replace("{}", name).split())


@pytest.mark.parametrize("name", LONG_NAMES, ids=lambda name: f"{name[:4]} {len(name)}")
def test_too_long_name_of_a_start_is_rejected(folder, capsys, name):
    start = f"start={{from: {name}, time_s: 0.1}}"
    assert "internal" not in rejection(capsys, "run", "./good.yaml", "--set", start)


def test_empty_recording_name_is_rejected(folder, capsys):
    assert "a folder; give one file" in rejection(
        capsys, "calibrate", "locomotion", "", "-r", "gen2"
    )


@pytest.mark.default_cases(2)
@pytest.mark.parametrize("command", ANY_COMMANDS)
def test_every_command_rejects_a_removed_current_folder(
    tmp_path, monkeypatch, capsys, command
):
    removed = tmp_path / "removed"
    removed.mkdir()
    monkeypatch.chdir(removed)
    removed.rmdir()
    with pytest.raises(SystemExit) as exit_:
        main(command.split())
    output, message = capsys.readouterr()
    assert (exit_.value.code, output) == (2, "")
    assert message.startswith(
        "the current folder cannot be used (No such file or directory); if the"
        " folder was removed, change to another folder"
    )
    assert display_path(tmp_path / "x") == str(
        tmp_path / "x"
    )  # the folder may also be removed later


@pytest.mark.default_cases(2)
@pytest.mark.parametrize(
    ("number", "code"),
    [(errno.EROFS, 2), (errno.ENAMETOOLONG, 2), (errno.ENOSPC, 2), (errno.ENOENT, 4)],
)
def test_errors_of_the_file_system_are_not_internal_errors(
    monkeypatch, capsys, number, code
):
    def fails(**_: object) -> None:
        raise OSError(number, os.strerror(number), "some/file")

    monkeypatch.setattr("srs_twin.cli.app.command", lambda _: fails)
    with pytest.raises(SystemExit) as exit_:
        main(["list"])
    message = capsys.readouterr().err
    assert exit_.value.code == code and os.strerror(number) in message
    assert message.startswith(
        "some/file: " if code == 2 else "srs-twin: internal error"
    )


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (
            b'title: "\\e[31mred"\n' + SCENARIO.partition(b"\n")[2],
            "1:8: the control character \\x1b is not",
        ),
        (
            SCENARIO.replace(b"world", b'"wor\\x9bld"'),
            "6:1: the control character \\x9b is not",
        ),
    ],
)
def test_control_characters_in_a_file_are_escaped_in_messages(
    folder, capsys, content, message
):
    Path("painted.yaml").write_bytes(content)
    assert f"painted.yaml:{message}" in rejection(capsys, "run", "./painted.yaml")


def test_unprintable_names_in_a_folder_are_rejected(folder, capsys):
    Path("many").mkdir()
    for name in (b"\xff.yaml", b"\x1b[31m.yaml"):
        (Path("many") / os.fsdecode(name)).write_bytes(SCENARIO)
    message = rejection(capsys, "run", "many")
    assert f"many/\\xff.yaml: {BYTES}" in message
    assert f"many/\\x1b[31m.yaml: {CONTROL}" in message


def test_control_characters_in_a_recording_are_escaped_in_messages(folder, capsys):
    Path("painted.csv").write_bytes(b"Format Version,1.23\n\x1b[31m,\x9b1m\n")
    assert "painted.csv" in rejection(
        capsys, "replay", "painted.csv", "--robot", "gen2"
    )
