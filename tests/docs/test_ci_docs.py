"""docs/ci.md: its workflow files are valid, and the files that they and the Containerfile use exist."""

from __future__ import annotations

import os
import re
import shlex
import shutil
import stat
import subprocess
import sys
from pathlib import Path

import pytest
import yaml
from conftest import ROOT

from srs_twin.cli import main
from srs_twin.cli.app import command
from srs_twin.cli.doctor.probes import NO_VULKAN, PROBES

pytestmark = pytest.mark.fast

DOCS = (ROOT / "docs/ci.md").read_text("utf-8")
CONTAINERFILE = (ROOT / "Containerfile").read_text("utf-8")
FENCES = dict(re.findall(r"^```yaml (\w+)\n(.*?)^```$", DOCS, re.M | re.S))


def workflow(name):
    return yaml.safe_load(FENCES[name])


ACTION = yaml.safe_load(
    (ROOT / ".github/actions/rollouts/action.yml").read_text("utf-8")
)
TEMPLATE = yaml.safe_load((ROOT / "examples/ci/gitlab.yml").read_text("utf-8"))[
    ".srs_twin_rollouts"
]


def github_steps():
    return ACTION["runs"]["steps"]


def inputs_of(text, **given):
    """Return a text of the action with its inputs in their places."""
    values = {name: each["default"] for name, each in ACTION["inputs"].items()} | given
    return re.sub(r"\$\{\{ inputs\.(\w+) \}\}", lambda found: values[found[1]], text)


def test_command_of_the_containerfile_exists():
    """Parsed as the command line parses it; `test_docs.py` does this for the pages."""
    (line,) = re.findall(r"^#   podman run .* srs-twin (.*)$", CONTAINERFILE, re.M)
    verb, *rest = shlex.split(line)
    command().commands[verb].make_context(verb, rest)


def test_documented_workflows_use_existing_files():
    (job,) = workflow("github")["jobs"].values()
    checkout, ours = job["steps"]
    assert (ROOT / ours["uses"] / "action.yml").is_file()
    assert checkout["uses"] == "actions/checkout@v4"
    assert set(ours["with"]) <= set(ACTION["inputs"])
    assert workflow("github")["permissions"] == {"contents": "read"}
    page = workflow("gitlab")
    assert (ROOT / page["include"]).is_file()
    assert page["scenarios"]["extends"] == ".srs_twin_rollouts"
    assert set(page["scenarios"]["variables"]) <= set(TEMPLATE["variables"])
    for step in github_steps():
        assert re.fullmatch(r"[\w/-]+@v\d+", step.get("uses", "a@v1"))


FAST = """title: short
robot: gen2
duration_s: 2
controller: {kind: gait, frequency_hz: 2.0, offset: 0.0}
plants: {analytical: {}}
expect: [{metric: com_speed_m_s, plant: analytical, above: LEAST}]
"""


@pytest.fixture
def room(tmp_path, monkeypatch):
    """A folder with a scenario, and a `uv` that runs this package and installs nothing."""
    (tmp_path / "bin").mkdir()
    program = shlex.quote("from srs_twin.cli import main; main()")
    write_program(
        tmp_path / "bin/uv",
        '[ "$1" = sync ] && exit 0\nwhile [ "$1" != srs-twin ]; do shift; done; shift\n'
        f'exec {shlex.quote(sys.executable)} -c {program} "$@"',
    )
    monkeypatch.setenv("RECORD", str(tmp_path / "record"))
    monkeypatch.setenv("PATH", f"{tmp_path / 'bin'}{os.pathsep}{os.environ['PATH']}")
    (tmp_path / "scenarios").mkdir()
    return tmp_path


def write_program(path, lines):
    path.write_text(f"#!/bin/sh\n{lines}\n")
    path.chmod(0o755)


def bash(script, room, **variables):
    command = ["bash", "--noprofile", "--norc", "-e", "-o", "pipefail", "-c", script]
    env = os.environ | {name: str(value) for name, value in variables.items()}
    return subprocess.run(
        command, cwd=room, env=env, capture_output=True, text=True, check=False
    )


def run_action(room, **given):
    """Run the shell steps of the action with inputs in the places that it gives them."""
    files = {"GITHUB_OUTPUT": room / "output", "GITHUB_STEP_SUMMARY": room / "summary"}
    done = []
    for step in github_steps():
        if "run" in step:
            env = {n: inputs_of(v, **given) for n, v in step.get("env", {}).items()}
            done.append(bash(inputs_of(step["run"], **given), room, **files, **env))
    return done


HOSTILE = [
    "runs$(touch X)",
    "runs`touch X`",
    "runs; touch X",
    "runs && touch X #",
    "runs | touch X",
    '"; touch X; "',
    "'; touch X; '",
    '" > X; "',
    "runs\ntouch X",
    "$IFS;touch${IFS}X",
    "${OUT@P}$(touch X)",
    "a=([$(touch X)]=1)",
]


@pytest.mark.default_cases(2)
@pytest.mark.parametrize("text", HOSTILE)
def test_inputs_are_never_executed(text, room):
    write_program(room / "bin/uv", 'printf "%s\\n" "$@" >> "$RECORD"')
    (room / "output").touch()
    for name in ACTION["inputs"]:
        run_action(room, **{name: text})
    for name in TEMPLATE["variables"]:
        bash(
            "\n".join(TEMPLATE["script"]), room, **TEMPLATE["variables"] | {name: text}
        )
    assert not list(room.rglob("X"))
    lines = (room / "output").read_text().splitlines()
    assert lines and all(line.startswith("junit=") for line in lines)
    assert "srs-twin" in (room / "record").read_text().split()


def test_no_workflow_pastes_an_expression_into_a_shell():
    files = [*ROOT.glob(".github/**/*.yml"), ROOT / "examples/ci/gitlab.yml"]

    def scripts(value):
        for key, each in value.items() if isinstance(value, dict) else enumerate(value):
            if key in ("run", "script", "before_script"):
                yield str(each)
            elif isinstance(each, dict | list):
                yield from scripts(each)

    found = [
        text
        for path in files
        for text in scripts(yaml.safe_load(path.read_text("utf-8")))
    ]
    assert len(found) >= 5
    assert not [text for text in found if "${{" in text]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("least", "code"), [("0.1", 0), pytest.param("0.9", 1, marks=pytest.mark.nightly)]
)
def test_the_steps_of_the_action_run(room, least, code):
    (room / "scenarios/short.yaml").write_text(FAST.replace("LEAST", least))
    installed, done = run_action(room, project=str(ROOT))
    assert installed.returncode == 0
    assert done.returncode == code, done.stderr
    assert ("met " if code == 0 else "MISSED") in (room / "summary").read_text()
    assert (room / "output").read_text() == "junit=runs/junit.xml\n"
    upload = next(
        step for step in github_steps() if "upload-artifact" in step.get("uses", "")
    )
    assert upload["if"] == "${{ !cancelled() }}"
    for pattern in inputs_of(upload["with"]["path"]).split():
        assert list(room.glob(pattern)), pattern


@pytest.mark.slow
@pytest.mark.parametrize(
    ("least", "code"), [pytest.param("0.1", 0, marks=pytest.mark.nightly), ("0.9", 1)]
)
def test_the_script_of_the_template_runs(room, least, code):
    (room / "scenarios/short.yaml").write_text(FAST.replace("LEAST", least))
    variables = TEMPLATE["variables"] | {
        "PROJECT": ROOT,
        "UV_CACHE_DIR": room / "cache",
    }
    done = bash("\n".join(TEMPLATE["script"]), room, **variables)
    assert done.returncode == code, done.stderr
    artifacts = TEMPLATE["artifacts"]
    assert artifacts["when"] == "always"
    assert (room / artifacts["reports"]["junit"]).is_file() and (
        room / artifacts["paths"][0]
    ).is_dir()


def test_workflows_use_a_supported_python():
    project = (ROOT / "pyproject.toml").read_text("utf-8")
    ((low, high),) = re.findall(r'requires-python = ">=3\.(\d+),<3\.(\d+)"', project)
    (version,) = (
        step["with"]["python-version"]
        for step in github_steps()
        if "setup-python" in step.get("uses", "")
    )
    images = re.findall(r"python:([\d.]+)-slim", TEMPLATE["image"] + CONTAINERFILE)
    assert len(images) >= 3
    for used in (version, *images):
        assert int(low) <= int(used.split(".")[1]) < int(high)


def test_exit_codes_are_those_of_the_command_line():
    stated = main.__doc__.partition("The exit codes are ")[2].partition(". If")[0]
    assert re.findall(r"^\| (\d+) \|", DOCS, re.M) == re.findall(r"\b\d+\b", stated)


def test_containerfile_copies_existing_files_and_runs_unprivileged():
    copied = re.findall(r"^COPY (?!--from)(.*) \S+$", CONTAINERFILE, re.M)
    sources = set(" ".join(copied).split())
    needed = {"pyproject.toml", "srs_twin", "calibration", "models", "scenarios"}
    assert sources >= needed
    assert all((ROOT / source).exists() for source in sources)
    last = CONTAINERFILE.rpartition("FROM ")[2]
    assert re.findall(r"^USER (.*)$", last, re.M) == ["snake"]
    assert "useradd --create-home snake" in last
    assert '\nENTRYPOINT ["srs-twin"]\n' in f"{last}\n"
    assert not re.search(
        r"(?i)^(ARG|ENV) .*(token|secret|password|key)", CONTAINERFILE, re.M
    )


@pytest.fixture
def container(tmp_path):
    """The start script of the container, and a program that prints the cache folders it gets."""
    for name in ("start", "bin", "tmp"):
        (tmp_path / name).mkdir()
    shutil.copy(ROOT / "examples/ci/container.sh", tmp_path / "start/srs-twin")
    write_program(
        tmp_path / "bin/srs-twin",
        'echo "$NUMBA_CACHE_DIR"; echo "$MPLCONFIGDIR"; echo "$@"',
    )
    return tmp_path


def started(container):
    """Return the private folder that the program gets."""
    taken = ("NUMBA_CACHE_DIR", "MPLCONFIGDIR")
    given = {name: value for name, value in os.environ.items() if name not in taken}
    words = [str(container / "start/srs-twin"), "run", "a b"]
    env = given | {"TMPDIR": str(container / "tmp")}
    done = subprocess.run(words, env=env, capture_output=True, text=True, check=True)
    kernels, pictures, arguments = done.stdout.splitlines()
    assert (Path(kernels).name, Path(pictures).name) == ("numba", "matplotlib")
    assert Path(kernels).parent == Path(pictures).parent and arguments == "run a b"
    return Path(kernels).parent


@pytest.mark.default_cases(2)
@pytest.mark.parametrize(
    "before", ["nothing", "private", "open", "link", "file", "foreign"]
)
def test_caches_of_the_container_are_private_to_its_user(before, container):
    own = container / f"tmp/srs-twin-{os.getuid()}"
    if before == "link":
        (container / "elsewhere").mkdir(mode=0o777)
        own.symlink_to(container / "elsewhere")
    elif before == "file":
        own.touch()
    elif before != "nothing":
        own.mkdir()
        own.chmod(0o700 if before == "private" else 0o777)
    if before == "foreign":
        if os.getuid() != 0:
            pytest.skip("only root can give a folder away")
        os.chown(own, 65534, 65534)
    found = started(container)
    there = found.lstat()
    assert stat.S_ISDIR(there.st_mode) and stat.S_IMODE(there.st_mode) == 0o700
    assert there.st_uid == os.getuid() and found.parent == own.parent
    assert (found == own) == (before in ("nothing", "private"))


def test_containerfile_installs_the_remedies_of_doctor():
    remedies = PROBES["pictures of MuJoCo"].remedy + NO_VULKAN
    asked = re.findall(r"apt-get install((?: [\w-]+)+) \(Debian", remedies)
    (installed,) = re.findall(r"no-install-recommends \\\n +(.*) \\\n", CONTAINERFILE)
    assert set(" ".join(asked).split()) == set(installed.split())
