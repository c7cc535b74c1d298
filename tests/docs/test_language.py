"""Plain English: few suspicious sentences in each room, none in the help of the command line."""

from __future__ import annotations

import re

import pytest
from language import _COMPILED, hits, rooms, share

from srs_twin.cli.app import command

pytestmark = pytest.mark.fast

MOST = 0.015
"""Largest share of suspicious sentences in a room; false alarms make about one per cent."""


@pytest.mark.slow
@pytest.mark.parametrize("room", rooms())
def test_few_sentences_are_suspicious(room):
    paths = rooms()[room]
    found = [
        f"{hit.path.name}:{hit.line}: {hit.sentence} {hit.patterns}"
        for path in paths
        for hit in hits(path)
    ]
    assert share(paths) <= MOST or len(found) < 2, "\n".join(found)


def _helps(group, words=("srs-twin",)):
    yield " ".join(words), group.help or ""
    for parameter in group.params:
        yield (
            f"{' '.join(words)} {parameter.name}",
            getattr(parameter, "help", None) or "",
        )
    for name, inner in (getattr(group, "commands", None) or {}).items():
        yield from _helps(inner, (*words, name))


def test_no_help_text_is_suspicious():
    found = []
    for name, text in _helps(command()):
        for sentence in re.split(r"(?<=[.:;?!])\s", text):
            found += [
                f"{name}: {sentence} [{rule}]"
                for rule, p in _COMPILED.items()
                if p.search(sentence.strip())
            ]
    assert found == []


def test_the_checker_finds_translated_sentences(tmp_path):
    page = tmp_path / "page.md"
    page.write_text(
        "What no frame tells of how a robot goes is never taken for known.\n\nA plain"
        " sentence here.\n"
    )
    assert [len(hits(page)), share([page])] == [1, 0.5]
