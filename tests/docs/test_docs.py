"""Pages: commands parse, files load, examples run. The build of the site checks links."""

from __future__ import annotations

import ast
import importlib
import json
import re
import shutil
import sys
from pathlib import Path

import pytest
import yaml
from conftest import ROOT
from dm_environments import dm_environments
from pages import PAGES, Page, words_of
from typer.exceptions import TyperException

from srs_twin import load_robot, load_scenario
from srs_twin.cli.app import command
from srs_twin.extensions import PLUGINS
from srs_twin.io.documents import dump_yaml
from srs_twin.io.files import shipped_names
from srs_twin.live.setup_file import load_setup
from srs_twin.recordings.recording_map import read_map
from srs_twin.scenario.file import with_extensions
from srs_twin.studies.optimization.loading import load_study
from srs_twin.studies.sweep.loading import load_sweep

BY_PATH = {page.path: page for page in PAGES}
COMMANDS = [(page, line) for page in PAGES for line in (*page.commands, *page.mentions)]
BLOCKS = [(page, block) for page in PAGES for block in page.blocks]
# Other programs in command blocks. Check whether a new program here can be tested.
OTHERS = {
    "srs-twin",
    "pip",
    "python3",
    "uv",
    "podman",
    "docker",
    ".ci/run",
    "python",
    "mosquitto",
}
GIVEN = {"scenario": "scenario", "scenarios": "scenario", "sweep": "sweep"}
SCENARIO = set(with_extensions().model_fields)
FRAGMENT = {
    "robot": "gen2",
    "duration_s": 5.0,
    "controller": {"kind": "gait", "frequency_hz": 2.0},
}


def name_of(value):
    return value.name if isinstance(value, Page) else None


def parsed(words, *, mention=False):
    """Parse what follows `srs-twin` without running it; return the context of a command, or None."""
    if "--help" in words or "--version" in words:
        words = [word for word in words if word not in ("--help", "--version")]
        assert not words or words[0] in command().commands
        return None
    while words and words[0].startswith("-"):
        assert any(words[0] in each.opts for each in command().params), words[0]
        words = words[1:]
    given = command()
    name = ""
    while words and hasattr(given, "commands"):
        name, *words = words
        assert name in given.commands, f"there is no command {name}"
        given = given.commands[name]
    if hasattr(given, "commands"):
        return None
    if mention and all(word.startswith("-") for word in words):
        known = {
            spelt
            for each in given.params
            for spelt in (*each.opts, *each.secondary_opts)
        }
        assert set(words) <= known, f"{name} knows no {set(words) - known}"
        return None
    return given.make_context(name, list(words))


def is_there(kind, value, page):
    """Say whether a scenario or sweep that a page names can be found."""
    if value.isupper() or value in page.files:
        return True
    if "/" in value or "." in value:
        return bool(list(ROOT.glob(value)))
    return value in shipped_names(kind) or (ROOT / value).is_dir()


def check_srs_twin(page, words, *, mention=False):
    context = parsed(words, mention=mention)
    for parameter, kind in GIVEN.items():
        given = context.params.get(parameter) if context else None
        for value in [given] if isinstance(given, str) else given or []:
            if context.info_name != "view":
                assert is_there(kind, value, page), f"{kind} {value} is not there"


def check_script(words):
    (script,) = (word for word in words if word.endswith(".py"))
    text = (ROOT / script).read_text("utf-8")
    for word in words[words.index(script) + 1 :]:
        option = word.partition("=")[0]
        assert not word.startswith("--") or f'"{option}"' in text, option


def check_command(page, line):
    """Check that a command line of a page parses and that the files it names exist."""
    for part in line.split(" && "):
        words = words_of(part)
        if "srs-twin" in words and "build" not in words:
            mention = line not in page.commands
            check_srs_twin(page, words[words.index("srs-twin") + 1 :], mention=mention)
        elif "pytest" in words:
            for word in words:
                assert not word.startswith("tests/") or (ROOT / word).exists(), word
        elif any(word.endswith(".py") for word in words):
            check_script(words)
        assert words[0] in OTHERS or words[0].endswith(("/pip", "/uv")), line


def test_documented_commands_parse_and_their_files_exist():
    problems = []
    for page, line in COMMANDS:
        try:
            check_command(page, line)
        except (AssertionError, TyperException) as error:
            problems.append(f"{page.path}: {line}: {error!r}")
    assert problems == [], "\n".join(problems)


@pytest.mark.parametrize(
    "line",
    ["compare gen2_strait", "run scenarios/gone.yaml", "compare gen2_turn --explian"],
)
def test_checker_finds_missing_descriptions(line):
    with pytest.raises((AssertionError, TyperException)):
        check_srs_twin(PAGES[0], line.split())


@pytest.mark.default_cases(2)
@pytest.mark.parametrize(
    ("page", "block"),
    [each for each in BLOCKS if each[1].language == "python"],
    ids=name_of,
)
def test_python_errors_list_the_available_names(page, block):
    skip_without_dm_control(block.text)
    for node in ast.walk(ast.parse(block.text)):
        if isinstance(node, ast.Import):
            for each in node.names:
                importlib.import_module(each.name)
        elif isinstance(node, ast.ImportFrom) and f"{node.module}.py" not in page.files:
            module = importlib.import_module(node.module)
            for each in node.names:
                assert hasattr(module, each.name) or importlib.import_module(
                    f"{node.module}.{each.name}"
                )
        elif isinstance(node, ast.Attribute) and getattr(node.value, "id", "") in (
            "srs",
            "srs_twin",
        ):
            assert hasattr(importlib.import_module("srs_twin"), node.attr), node.attr


def skip_without_dm_control(script):
    if "srs_twin.envs import dm" in script:
        dm_environments()


def yaml_blocks():
    done_elsewhere = {"github", "gitlab", "tolerances"}  # test_ci_docs.py, test_diff.py
    return [
        (p, b)
        for p, b in BLOCKS
        if b.language == "yaml" and b.mark not in done_elsewhere
    ]


@pytest.mark.default_cases(at=[0, 6, 16, 17, 18, 20, 21, 28, 29, 34])
@pytest.mark.parametrize(("page", "block"), yaml_blocks(), ids=name_of)
def test_yaml_loads(page, block, tmp_path, monkeypatch):
    """Whole files as they are; parts over the file that the fence names (`yaml over PATH`), or a scenario."""
    monkeypatch.chdir(tmp_path)
    for folder in ("calibration", "scenarios"):
        (tmp_path / folder).symlink_to(ROOT / folder)
    (tmp_path / "ca.pem").touch()  # certificate of the laboratory's broker
    for each in page.blocks:
        if each.file:
            (tmp_path / each.file).write_text(each.text, "utf-8")
        if each.file and each.file.endswith(".py"):
            monkeypatch.delitem(
                sys.modules, each.file.removesuffix(".py"), raising=False
            )
            monkeypatch.setenv(PLUGINS, each.file)
        # A footprint that a command of the page measures; loading a scenario needs any.
        for name in re.findall(
            r"calibrate footprint .* --out \. --name (\w+)", each.text
        ):
            shutil.copy(
                ROOT / "calibration/footprints/gen2_gait.yaml",
                tmp_path / f"{name}.yaml",
            )
    document = yaml.safe_load(block.text.replace("{…}", "{}"))
    if block.mark == "map":
        found = read_map(document)
        assert found.markers or found.bodies
        return
    path = tmp_path / "printed.yaml"
    if block.mark.startswith("over "):
        base = yaml.safe_load(
            (ROOT / block.mark.removeprefix("over ")).read_text("utf-8")
        )
    else:
        base = (
            {}
            if set(document) >= {"robot", "controller"} or not set(document) <= SCENARIO
            else FRAGMENT
        )
    printed = {**base, **document}
    path.write_text(dump_yaml(printed), "utf-8")
    loaders = {
        "vary": load_sweep,
        "geometry": load_robot,
        "objectives": load_study,
        "broker": lambda given: load_setup(Path(given)),
    }
    load = next(
        (load for key, load in loaders.items() if key in printed), load_scenario
    )
    assert load(str(path))


COMMANDED = [
    page for page in PAGES if any(block.mark == "runnable" for block in page.blocks)
]
SCRIPTED = [page for page in PAGES if page.script]
README = BY_PATH[ROOT / "README.md"]
QUICKSTART = BY_PATH[ROOT / "docs/quickstart.md"]


@pytest.mark.slow
@pytest.mark.parametrize("page", COMMANDED, ids=name_of)
def test_commands_run_from_top_to_bottom(page, tmp_path, srs_twin_process):
    """As a reader would: save what is to be saved, type what is to be typed."""
    page.save_files(tmp_path)
    for block in page.blocks:
        for line in block.text.splitlines() if block.mark == "runnable" else ():
            assert block.language == "sh"
            words = words_of(line)
            done = srs_twin_process(*words[words.index("srs-twin") + 1 :], cwd=tmp_path)
            assert done.returncode == 0, done.stderr


@pytest.mark.slow
@pytest.mark.parametrize("page", SCRIPTED, ids=name_of)
def test_python_runs_as_a_script(page, tmp_path):
    skip_without_dm_control(page.script)
    page.run_script(tmp_path)


def test_first_readme_command_gives_the_documented_output(
    tmp_path, srs_twin, monkeypatch
):
    README.save_files(tmp_path)
    monkeypatch.setenv("UV_RUN_RECURSION_DEPTH", "1")  # as `uv run` does
    first = README.commands[0]
    assert first.startswith("pip install uv && uv run srs-twin compare scenarios/gen2")
    done = srs_twin(*first.partition("srs-twin ")[2].split(), cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    promised = re.findall(r"^\| ((?:`[\w.]+`(?:, )?)+) \|", QUICKSTART.text, re.M)
    run = tmp_path / "runs/gen2_straight"
    files = set(re.findall(r"`([\w.]+)`", " ".join(promised)))
    assert {path.name for path in run.iterdir()} == files
    metrics = json.loads((run / "metrics.json").read_text("utf-8"))
    speeds = pytest.approx(
        [metrics["plants"][name]["com_speed_m_s"] for name in ("analytical", "twin")],
        rel=0.01,
    )
    shape = pytest.approx([metrics["comparison"]["shape_rms_body"]], abs=0.001)
    assert printed("CoM speed") == speeds
    assert printed("body shape") == shape
    (output,) = (block.text for block in README.blocks if block.language == "text")
    shown = without_numbers(done.stdout + done.stderr)
    assert without_numbers(output) - {"…"} <= shown
    (row,) = re.findall(r"^ CoM speed .*$", output, re.M)
    assert [float(cell) for cell in row.split()[3:5]] == speeds


def without_numbers(text):
    """Return the lines of a text with their numbers replaced."""
    return {re.sub(r"[\d.]+", "#", line).strip() for line in text.splitlines()}


def printed(row):
    """Return the numbers of the analytical and the twin column in the README's table of measured values."""
    (cells,) = re.findall(rf"^\| {row}[^|]*\|([^|]*)\|([^|]*)\|", README.text, re.M)
    return [float(cell) for cell in cells if cell.strip()]


def test_inspect_gives_the_documented_output(tmp_path, srs_twin):
    page = BY_PATH[ROOT / "docs/recordings.md"]
    page.save_files(tmp_path)
    done = srs_twin(*page.commands[0].split()[3:], cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    shown = f"\n{done.stdout}{done.stderr}"
    output = next(block.text for block in page.blocks if block.language == "")
    for line in output.splitlines():
        assert line.strip() == "…" or f"\n{line.removesuffix('…')}" in shown


def test_printed_study_is_the_shipped_file():
    page = BY_PATH[ROOT / "docs/optimization.md"]
    study = (ROOT / "scenarios/studies/gen2_speed.yaml").read_text("utf-8")
    assert study in [block.text for block in page.blocks]


def test_failing_script_is_detected(tmp_path):
    path = tmp_path / "page.md"
    path.write_text(
        "```python\nnumber = 1\n```\n\n```python\nassert number == 2\n```\n"
    )
    with pytest.raises(AssertionError, match="assert number == 2"):
        Page(path).run_script(tmp_path)


def test_errata_that_the_project_names_are_listed():
    """E1 to E29 are in the errata exactly once, with a location and a correction."""
    text = BY_PATH[ROOT / "docs/reproduction.md"].text
    rows = re.findall(r"^\| E(\d+) \| (.*) \| (.*) \| (.*) \|$", text, re.M)
    assert [int(number) for number, *_ in rows] == list(range(1, 30))
    assert all(cell.strip() for _, *cells in rows for cell in cells)
    paths = [
        *ROOT.glob("srs_twin/**/*.py"),
        *ROOT.glob("calibration/**/*.yaml"),
        *ROOT.glob("docs/*.md"),
    ]
    sources = "\n".join(path.read_text("utf-8") for path in paths)
    named = set(map(int, re.findall(r"\(E(\d+)\b", sources)))
    assert named and named <= set(range(1, 30))


@pytest.mark.slow
def test_known_misses_name_an_existing_section():
    reasons = {
        each.expected_failure
        for name in shipped_names("scenario")
        for each in load_scenario(name).expect
    }
    for reason in reasons - {None}:
        named = re.search(r"\((docs/[\w-]+\.md)#([\w-]+)\)$", reason)
        assert named, reason
        assert named[2] in BY_PATH[ROOT / named[1]].anchors, reason


@pytest.mark.slow
def test_pages_count_the_shipped_scenarios_and_their_known_misses():
    numbers = [
        "no",
        "one",
        "two",
        "three",
        "four",
        "five",
        "six",
        "seven",
        "eight",
        "nine",
        "ten",
    ]
    text = " ".join((ROOT / "docs/ci.md").read_text("utf-8").split())
    pattern = (
        r"Of the (\d+) shipped scenarios, (\w+) miss a published value and (\w+) miss a"
        r" bound"
    )
    (counts,) = re.findall(pattern, text)
    expected = [load_scenario(name).expect for name in shipped_names("scenario")]
    missed = [
        sum(
            any(
                each.expected_failure and bool(each.source) is sourced
                for each in expect
            )
            for expect in expected
        )
        for sourced in (True, False)
    ]
    assert counts == (str(len(expected)), *(numbers[count] for count in missed))


def test_the_site_drops_no_line_of_a_page():
    """MyST drops lines that begin with `%` or `+++`."""
    for page in PAGES:
        assert not re.search(r"^\s*(%|\+\+\+)", page.prose, re.M), page.name


def test_files_named_on_pages_exist():
    sources = [f"/{path.relative_to(ROOT)}" for path in ROOT.rglob("*.py")]
    sources = [source for source in sources if "/.venv/" not in source]
    missing = [
        (page.name, name)
        for page in PAGES
        for name in re.findall(r"`([\w/]+\.py)`", page.prose)
        if name not in page.files
        and not any(source.endswith(f"/{name}") for source in sources)
    ]
    assert missing == []
