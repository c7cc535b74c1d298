"""docs/ci.md: its workflow files are valid, and the files that they and the Containerfile use exist."""

from __future__ import annotations

import json
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
from typer.exceptions import TyperException

from srs_twin.cli import main
from srs_twin.cli.app import command
from srs_twin.cli.doctor.probes import NO_VULKAN, PROBES

pytestmark = pytest.mark.fast

DOCS = (ROOT / "docs/ci.md").read_text("utf-8")
CONTAINERFILE = (ROOT / "Containerfile").read_text("utf-8")
FENCES = {
    (kind, name): text
    for kind, name, text in re.findall(
        r"^```(\w+) ?(\w*)\n(.*?)^```$", DOCS, re.M | re.S
    )
}


def workflow(name):
    return yaml.safe_load(FENCES["yaml", name])


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


def shell_lines():
    """Every line of a shell that the docs and the Containerfile's head show or the workflows hold."""
    lines: list[str] = []
    lines += FENCES["sh", ""].splitlines()
    lines += re.findall(r"`((?:uv run |podman run .*)?srs-twin [a-z][^`…]*)`", DOCS)
    lines += re.findall(r"^#   (podman run .*)$", CONTAINERFILE, re.M)
    lines += [line for line in DOCS.splitlines() if line.startswith("podman run")]
    return sorted(
        {line for line in lines if "srs-twin" in line and " build " not in line}
    )


def arguments(line):
    """Return the words that srs-twin gets; after an image of that name they are the same."""
    words = shlex.split(line)
    return words[words.index("srs-twin") + 1 :]


@pytest.mark.default_cases(2)
@pytest.mark.parametrize("line", shell_lines())
def test_commands_and_options_exist(line):
    """Parsed as the command line parses them, without running anything."""
    whole = command()
    verb, *rest = arguments(line)
    assert verb in whole.commands, line
    if verb != "view":
        whole.commands[verb].make_context(verb, rest)


def test_checker_finds_unknown_options():
    with pytest.raises(TyperException, match="No such option: --junitt"):
        command().commands["run"].make_context(
            "run", ["scenarios/", "--junitt", "out.xml"]
        )


def test_documented_workflows_use_existing_files():
    (job,) = workflow("github")["jobs"].values()
    checkout, ours = job["steps"]
    assert (ROOT / ours["uses"] / "action.yml").is_file() and checkout[
        "uses"
    ] == "actions/checkout@v4"
    assert set(ours["with"]) <= set(ACTION["inputs"])
    assert workflow("github")["permissions"] == {"contents": "read"}
    page = workflow("gitlab")
    assert (ROOT / page["include"]).is_file() and page["scenarios"][
        "extends"
    ] == ".srs_twin_rollouts"
    assert set(page["scenarios"]["variables"]) <= set(TEMPLATE["variables"])
    assert all(
        re.fullmatch(r"[\w/-]+@v\d+", step["uses"])
        for step in github_steps()
        if "uses" in step
    )


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
    uv = tmp_path / "bin/uv"
    python = (
        f'exec {shlex.quote(sys.executable)} -c "from srs_twin.cli import main; main()"'
    )
    skip = (
        '[ "$1" = sync ] && exit 0\nwhile [ "$1" != srs-twin ]; do shift; done; shift'
    )
    uv.write_text(f'#!/bin/sh\n{skip}\n{python} "$@"\n')
    uv.chmod(0o755)
    monkeypatch.setenv("RECORD", str(tmp_path / "record"))
    monkeypatch.setenv("PATH", f"{tmp_path / 'bin'}{os.pathsep}{os.environ['PATH']}")
    (tmp_path / "scenarios").mkdir()
    return tmp_path


def bash(script, room, **variables):
    named = {name: str(value) for name, value in variables.items()}
    command = ["bash", "--noprofile", "--norc", "-e", "-o", "pipefail", "-c", script]
    return subprocess.run(
        command,
        cwd=room,
        env=os.environ | named,
        capture_output=True,
        text=True,
        check=False,
    )


def run_action(room, **given):
    """Run the shell steps of the action with inputs in the places that it gives them."""
    files = {"GITHUB_OUTPUT": room / "output", "GITHUB_STEP_SUMMARY": room / "summary"}
    steps = [step for step in github_steps() if "run" in step]
    return [
        bash(
            inputs_of(step["run"], **given),
            room,
            **files,
            **{
                name: inputs_of(value, **given)
                for name, value in step.get("env", {}).items()
            },
        )
        for step in steps
    ]


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
    (room / "bin/uv").write_text('#!/bin/sh\nprintf "%s\\n" "$@" >> "$RECORD"\n')
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
    allowed = re.search(
        r'requires-python = ">=3\.(\d+),<3\.(\d+)"',
        (ROOT / "pyproject.toml").read_text("utf-8"),
    )
    low, high = map(int, allowed.groups())
    versions = [
        s["with"]["python-version"]
        for s in github_steps()
        if "setup-python" in s.get("uses", "")
    ]
    images = re.findall(r"python:([\d.]+)-slim", TEMPLATE["image"] + CONTAINERFILE)
    assert len(versions) == 1 and len(images) >= 3
    assert all(
        low <= int(version.split(".")[1]) < high for version in [*versions, *images]
    )


def test_exit_codes_are_those_of_the_command_line():
    stated = main.__doc__.partition("The exit codes are ")[2].partition(". If")[0]
    assert re.findall(r"^\| (\d+) \|", DOCS, re.M) == re.findall(r"\b\d+\b", stated)


def test_containerfile_copies_existing_files_and_runs_unprivileged():
    copied = [
        words.split()[:-1]
        for words in re.findall(r"^COPY (?!--from)(.*)$", CONTAINERFILE, re.M)
    ]
    sources = {source for each in copied for source in each}
    assert sources >= {
        "pyproject.toml",
        "srs_twin",
        "calibration",
        "models",
        "scenarios",
    }
    assert all((ROOT / source).exists() for source in sources)
    last = CONTAINERFILE.rpartition("FROM ")[2]
    assert (
        re.findall(r"^USER (.*)$", last, re.M) == ["snake"]
        and "useradd --create-home snake" in last
    )
    assert json.loads(re.search(r"^ENTRYPOINT (.*)$", last, re.M).group(1)) == [
        "srs-twin"
    ]
    assert not re.search(
        r"(?i)^(ARG|ENV) .*(token|secret|password|key)", CONTAINERFILE, re.M
    )


@pytest.fixture
def container(tmp_path):
    """The start script of the container, and a program that prints the cache folders it gets."""
    for name in ("start", "bin", "tmp"):
        (tmp_path / name).mkdir()
    shutil.copy(ROOT / "examples/ci/container.sh", tmp_path / "start/srs-twin")
    program = tmp_path / "bin/srs-twin"
    program.write_text(
        '#!/bin/sh\necho "$NUMBA_CACHE_DIR"; echo "$MPLCONFIGDIR"; echo "$@"\n'
    )
    program.chmod(0o755)
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
    if before in ("open", "foreign"):
        own.mkdir()
        own.chmod(0o777)
    elif before == "private":
        own.mkdir(mode=0o700)
    elif before == "link":
        (container / "elsewhere").mkdir(mode=0o777)
        own.symlink_to(container / "elsewhere")
    elif before == "file":
        own.touch()
    if before == "foreign":
        if os.getuid() != 0:
            pytest.skip("only root can give a folder away")
        os.chown(own, 65534, 65534)
    found = started(container)
    there = found.lstat()
    assert stat.S_ISDIR(there.st_mode) and stat.S_IMODE(there.st_mode) == 0o700
    assert there.st_uid == os.getuid() and found.parent == own.parent
    assert (found == own) == (before in ("nothing", "private"))


def test_the_container_starts_with_private_caches():
    last = CONTAINERFILE.rpartition("FROM ")[2]
    assert "COPY examples/ci/container.sh /opt/srs-twin/start/srs-twin\n" in last
    assert "ENV PATH=/opt/srs-twin/start:/opt/srs-twin/bin:$PATH\n" in last
    assert "CACHE_DIR" not in last and os.access(
        ROOT / "examples/ci/container.sh", os.X_OK
    )


def test_containerfile_installs_the_remedies_of_doctor():
    remedies = (PROBES["pictures of MuJoCo"].remedy, NO_VULKAN)
    asked = {
        name
        for remedy in remedies
        for name in re.findall(r"apt-get install((?: [\w-]+)+) \(Debian", remedy)
    }
    packages = {word for each in asked for word in each.split()}
    installed = set(
        re.search(r"no-install-recommends \\\n +(.*) \\\n", CONTAINERFILE)
        .group(1)
        .split()
    )
    assert packages and packages == installed


def test_readme_leads_here():
    assert "(docs/ci.md)" in (ROOT / "README.md").read_text("utf-8")
