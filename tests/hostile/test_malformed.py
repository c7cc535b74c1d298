"""Every parser against every malformed file: one clear message, exit code 2, nothing written."""

from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from harness import Malformed, Parser, refusal
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from parsers import PARSERS, path_of

from srs_twin.cli import main

# Large files that take seconds to make and to refuse.
LARGE = {"metadata of 100 MB", "metadata of 40 MB", "3 GB in a small file", "110,000 pieces"}


def pairs() -> Iterator[Any]:
    """Yield each parser with what it refuses; by default each kind of fault comes to one parser only."""
    seen = set(LARGE)
    for parser in PARSERS:
        for malformed in parser.refused:
            marks = [pytest.mark.slow] if malformed.name in seen else []
            seen.add(malformed.name)
            yield pytest.param(parser, malformed, id=f"{parser.name}: {malformed.name}", marks=marks)


PAIRS = list(pairs())
# `benchmarks/fuzz.py` makes 10,000 files a parser.
IDENTITIES = 12
EXAMPLES = {"damaged": 200, "values": 200, "bytes": 100}
SAMPLE = 8
parsers = pytest.mark.parametrize("parser", PARSERS, ids=lambda parser: parser.name)


@pytest.fixture
def here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder to be in."""
    monkeypatch.chdir(tmp_path)
    return Path()


def test_there_are_enough_of_them():
    assert len({(parser.name, malformed.name) for parser, malformed in (p.values for p in PAIRS)}) == len(
        PAIRS
    )
    assert len({malformed.content for parser in PARSERS for malformed in parser.refused}) >= 150


@parsers
def test_the_good_one_is_read(parser: Parser, here: Path):
    path = path_of(parser, here)
    path.write_bytes(parser.good)
    first, second = parser.parse(path), (parser.quick or parser.parse)(path)
    assert parser.same(first, second)


@pytest.mark.parametrize(("parser", "malformed"), PAIRS)
def test_a_malformed_file_is_refused_with_its_place(parser: Parser, malformed: Malformed, here: Path, capsys):
    path = path_of(parser, here)
    malformed.write(path)
    before = sorted(os.listdir())
    if parser.command is None:
        said = refusal(parser, path)
    else:
        with pytest.raises(SystemExit) as left:
            main(parser.words(path))
        out, said = capsys.readouterr()
        assert left.value.code == 2, said
        assert out == ""
        assert all(line.lstrip("'").startswith(str(path)) for line in said.splitlines()), said
    assert malformed.says in said
    assert "Traceback" not in said and "pydantic" not in said
    assert sorted(os.listdir()) == before, "something was written"


@pytest.mark.skipif(os.geteuid() == 0, reason="root may read everything")
@parsers
def test_a_file_that_may_not_be_read(parser: Parser, here: Path):
    path = path_of(parser, here)
    path.write_bytes(parser.good)
    path.chmod(0)
    assert "cannot be read" in refusal(parser, path) or "denied" in refusal(parser, path)


def survives(parser: Parser, way: str, path: Path, **examples: Any) -> None:
    @settings(suppress_health_check=list(HealthCheck), **examples)
    @given(parser.generated[way])
    def check(content: bytes) -> None:
        parser.survives(content, path)

    check()


@parsers
def test_a_sample_of_generated_files_is_read_or_refused(parser: Parser, tmp_path: Path):
    for way in EXAMPLES:
        survives(parser, way, path_of(parser, tmp_path), max_examples=SAMPLE, derandomize=True, database=None)


@pytest.mark.slow
@pytest.mark.parametrize("way", EXAMPLES)
@parsers
def test_generated_files_are_read_or_refused_and_nothing_else(parser: Parser, way: str, tmp_path: Path):
    survives(parser, way, path_of(parser, tmp_path), max_examples=EXAMPLES[way])


@pytest.mark.slow
@pytest.mark.parametrize("parser", [p for p in PARSERS if p.identity], ids=lambda parser: parser.name)
def test_what_is_written_is_read_back(parser: Parser, tmp_path: Path):
    path, identity = path_of(parser, tmp_path), parser.identity
    assert identity is not None

    @settings(max_examples=IDENTITIES, suppress_health_check=list(HealthCheck))
    @given(identity.things)
    def check(thing: object) -> None:
        path.write_bytes(identity.write(thing))
        assert parser.same(parser.parse(path), thing)

    check()


@given(st.text(max_size=200))
def test_any_text_is_a_document_or_refused(text: str):
    from srs_twin.errors import InputFileError
    from srs_twin.io.documents import parse_yaml

    try:
        parse_yaml(text, "x").finish()
    except InputFileError as error:
        assert all(line.startswith("x:") for line in error.lines)
