"""Every parser rejects every malformed file with one clear message and exit code 2, and writes nothing."""

from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from harness import Malformed, Parser, check_lines, rejection
from hypothesis import HealthCheck, given, settings, strategies as st
from parsers import PARSERS

from srs_twin.cli import main
from srs_twin.errors import InputFileError
from srs_twin.io.documents import dump_yaml, parse_yaml
from srs_twin.io.files import shipped_names
from srs_twin.scenario.loading import load_scenario

# Files that take seconds to write or to reject.
LARGE = {
    "a document of 20 MB",
    "metadata of 100 MB",
    "metadata of 40 MB",
    "3 GB in a small file",
    "110,000 column chunks",
    "300 MB",
    "200,000,000 rows",
    "200 MB of junk",
    "200 MB of junk after the header",
    "200 MB without a line end",
}


def cases() -> Iterator[Any]:
    """Yield each parser with its malformed files; the same defect in further parsers is a slow test."""
    seen = set(LARGE)
    for parser in PARSERS:
        for malformed in parser.all_malformed:
            marks = [pytest.mark.slow] if malformed.name in seen else []
            seen.add(malformed.name)
            name = ascii(f"{parser.name}: {malformed.name}"[:90])[1:-1]
            yield pytest.param(parser, malformed, id=name, marks=marks)


CASES = list(cases())
# `tools/fuzz.py` generates 10,000 files per parser.
EXAMPLES = {"damaged": 200, "values": 200, "bytes": 100}
each_parser = pytest.mark.parametrize("parser", PARSERS, ids=lambda parser: parser.name)


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Change to an empty folder and return its relative path."""
    monkeypatch.chdir(tmp_path)
    return Path()


@each_parser
def test_valid_file_is_read(parser: Parser, folder: Path):
    path = parser.path_in(folder)
    path.write_bytes(parser.good)
    assert parser.same(parser.parse(path), (parser.quick or parser.parse)(path))


@pytest.mark.parametrize(("parser", "malformed"), CASES)
def test_malformed_file_is_rejected_with_its_position(
    parser: Parser, malformed: Malformed, folder: Path
):
    path = parser.path_in(folder)
    malformed.write(path)
    before = sorted(os.listdir())
    message = rejection(parser, path)
    assert malformed.message in message
    assert "Traceback" not in message and "pydantic" not in message
    assert sorted(os.listdir()) == before, "a file was written"


@pytest.mark.default_cases(8)
@pytest.mark.parametrize(
    ("parser", "malformed"), [case for case in CASES if case.values[0].command]
)
def test_command_rejects_a_malformed_file(
    parser: Parser,
    malformed: Malformed,
    folder: Path,
    capsys: pytest.CaptureFixture[str],
):
    path = parser.path_in(folder)
    malformed.write(path)
    before = sorted(os.listdir())
    with pytest.raises(SystemExit) as exit_:
        main(parser.arguments(path))
    output, message = capsys.readouterr()
    assert (exit_.value.code, output) == (2, ""), message
    check_lines(message, str(path))
    assert malformed.message in message
    assert sorted(os.listdir()) == before, "a file was written"


@pytest.mark.default_cases(2)
@pytest.mark.skipif(os.geteuid() == 0, reason="root can read every file")
@each_parser
def test_unreadable_file_is_rejected(parser: Parser, folder: Path):
    path = parser.path_in(folder)
    path.write_bytes(parser.good)
    path.chmod(0)
    assert "cannot be read" in rejection(parser, path) or "denied" in rejection(
        parser, path
    )


def read_generated(parser: Parser, kind: str, path: Path, **options: Any) -> None:
    """Parse generated files; only `InputError` may be raised."""

    @settings(suppress_health_check=list(HealthCheck), **options)
    @given(parser.generated[kind])
    def check(content: bytes) -> None:
        parser.read_or_reject(content, path)

    check()


@pytest.mark.slow
@each_parser
def test_sample_of_generated_files_is_read_or_rejected(parser: Parser, tmp_path: Path):
    for kind in EXAMPLES:
        read_generated(
            parser,
            kind,
            parser.path_in(tmp_path),
            max_examples=8,
            derandomize=True,
            database=None,
        )


@pytest.mark.nightly
@pytest.mark.parametrize("kind", EXAMPLES)
@each_parser
def test_generated_files_are_read_or_rejected(
    parser: Parser, kind: str, tmp_path: Path
):
    read_generated(parser, kind, parser.path_in(tmp_path), max_examples=EXAMPLES[kind])


@pytest.mark.default_cases(at=[7, 14, 18, 35, 37, 49])
@pytest.mark.parametrize("name", shipped_names("scenario"))
def test_resolved_scenario_is_read_back_unchanged(name: str, folder: Path):
    scenario = load_scenario(name)
    path = folder / "scenario.resolved.yaml"
    path.write_text(dump_yaml(scenario.document))
    assert load_scenario(path) == scenario


@given(st.text(max_size=200))
def test_any_text_is_parsed_or_rejected_with_its_position(text: str):
    try:
        parse_yaml(text, "x").raise_problems()
    except InputFileError as error:
        assert all(line.startswith("x:") for line in error.lines)
