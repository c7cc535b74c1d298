"""docs/ci.md: its workflow files are sound, and what they and the Containerfile call exists."""

from __future__ import annotations

import json
import re
import shlex

import pytest
from conftest import ROOT
from ruamel.yaml import YAML
from typer.exceptions import TyperException

from srs_twin.cli.app import command
from srs_twin.doctor.examination import REMEDIES, VIEWERS
from srs_twin.viewing.mujoco.opengl import PACKAGES

pytestmark = pytest.mark.fast

DOCS = (ROOT / "docs/ci.md").read_text("utf-8")
CONTAINERFILE = (ROOT / "Containerfile").read_text("utf-8")
FENCES = {
    (kind, name): text for kind, name, text in re.findall(r"^```(\w+) ?(\w*)\n(.*?)^```$", DOCS, re.M | re.S)
}


def workflow(name):
    return YAML(typ="safe", pure=True).load(FENCES["yaml", name])


def github_steps():
    (job,) = workflow("github")["jobs"].values()
    return job["steps"]


def shell_lines():
    """Every line of a shell that the docs and the Containerfile's head show or the workflows hold."""
    lines = [step["run"] for step in github_steps() if "run" in step]
    lines += workflow("gitlab")["scenarios"]["script"]
    lines += FENCES["sh", ""].splitlines()
    lines += re.findall(r"`((?:uv run --no-dev |podman run .*)?srs-twin [a-z][^`…]*)`", DOCS)
    lines += re.findall(r"^#   (podman run .*)$", CONTAINERFILE, re.M)
    lines += [line for line in DOCS.splitlines() if line.startswith("podman run")]
    return sorted({line for line in lines if "srs-twin" in line and " build " not in line})


def arguments(line):
    """Return the words that srs-twin gets; after an image of that name they are the same."""
    words = shlex.split(line)
    return words[words.index("srs-twin") + 1 :]


@pytest.mark.parametrize("line", shell_lines())
def test_commands_and_options_exist(line):
    """Parsed as the command line parses them, without running anything."""
    whole = command()
    verb, *rest = arguments(line)
    assert verb in whole.commands, line
    if verb != "view":
        whole.commands[verb].make_context(verb, rest)


def test_the_rule_catches_options_that_are_not_there():
    with pytest.raises(TyperException, match="No such option: --junitt"):
        command().commands["run"].make_context("run", ["scenarios/", "--junitt", "out.xml"])


def test_both_workflows_do_the_job():
    for lines in (
        [step.get("run", "") for step in github_steps()],
        workflow("gitlab")["scenarios"]["script"],
    ):
        found = [arguments(line) for line in lines if "srs-twin" in line]
        assert [words[0] for words in found] == ["doctor", "run"]
        assert {"--check", "--junit", "out.xml", "scenarios/"} <= set(found[1])
        assert all(line.split()[0] in ("pip", "uv", "") for line in lines if line)


def test_github_keeps_the_report_whatever_came_out():
    upload = next(step for step in github_steps() if "upload-artifact" in step.get("uses", ""))
    assert upload["if"] == "${{ !cancelled() }}"
    kept = upload["with"]["path"].split()
    from srs_twin.experiment import METRICS, RECORDING, REPORT

    assert kept == ["out.xml", *(f"runs/*/{name}" for name in (REPORT, RECORDING, METRICS))]
    assert workflow("github")["permissions"] == {"contents": "read"}
    assert all(re.fullmatch(r"[\w/-]+@v\d+", step["uses"]) for step in github_steps() if "uses" in step)


def test_gitlab_reads_the_report():
    artifacts = workflow("gitlab")["scenarios"]["artifacts"]
    assert artifacts["when"] == "always" and artifacts["reports"] == {"junit": "out.xml"}


def test_workflows_use_a_python_that_is_allowed():
    allowed = re.search(
        r'requires-python = ">=3\.(\d+),<3\.(\d+)"', (ROOT / "pyproject.toml").read_text("utf-8")
    )
    low, high = map(int, allowed.groups())
    versions = [s["with"]["python-version"] for s in github_steps() if "setup-python" in s.get("uses", "")]
    images = re.findall(r"python:([\d.]+)-slim", DOCS + CONTAINERFILE)
    assert len(versions) == 1 and len(images) >= 3
    assert all(low <= int(version.split(".")[1]) < high for version in [*versions, *images])


def test_exit_codes_are_those_of_the_readme():
    def codes(text):
        return re.findall(r"^\| (\d+) \|", text, re.M)

    assert codes(DOCS) == codes((ROOT / "README.md").read_text("utf-8")) == ["0", "1", "2", "3", "4", "130"]


def test_containerfile_copies_what_is_there_and_runs_as_nobody_special():
    copied = [words.split()[:-1] for words in re.findall(r"^COPY (?!--from)(.*)$", CONTAINERFILE, re.M)]
    sources = {source for each in copied for source in each}
    assert sources >= {"pyproject.toml", "srs_twin", "calibration", "models", "scenarios"}
    assert all((ROOT / source).exists() for source in sources)
    last = CONTAINERFILE.rpartition("FROM ")[2]
    assert re.findall(r"^USER (.*)$", last, re.M) == ["snake"] and "useradd --create-home snake" in last
    assert json.loads(re.search(r"^ENTRYPOINT (.*)$", last, re.M).group(1)) == ["srs-twin"]
    assert not re.search(r"(?i)^(ARG|ENV) .*(token|secret|password|key)", CONTAINERFILE, re.M)


def test_containerfile_installs_what_the_doctor_asks_for():
    remedies = [f"apt-get install {names} (Debian" for names in PACKAGES.values()]
    remedies.append(REMEDIES[VIEWERS]["without a screen"])
    asked = {
        name
        for remedy in remedies
        for name in re.findall(r"(?:apt-get install|^)((?: [\w-]+)+) \(Debian", remedy)
    }
    packages = {word for each in asked for word in each.split()}
    installed = set(re.search(r"no-install-recommends \\\n +(.*) \\\n", CONTAINERFILE).group(1).split())
    assert packages and packages == installed


def test_readme_leads_here():
    assert "(docs/ci.md)" in (ROOT / "README.md").read_text("utf-8")
