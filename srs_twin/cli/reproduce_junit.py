"""Rows of the reproduction as JUnit XML: a suite a use, a test case for each row and column."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING
from xml.etree.ElementTree import Element, SubElement

from srs_twin.cli.junit import sum_up, writable, write_tree

if TYPE_CHECKING:
    from srs_twin.reproduction import Judged


def write_rows(path: Path, rows: Sequence[Judged]) -> None:
    """Write a report: what is missed is a failure, explained or not.

    Args:
        path: the file; an earlier one is replaced.
        rows: judged.

    Raises:
        InputError: it cannot be written.
    """
    root = Element("testsuites", name="srs-twin reproduce")
    for use in dict.fromkeys(row.claim.use for row in rows):
        suite = SubElement(root, "testsuite", name=use)
        for row in (row for row in rows if row.claim.use == use):
            _cases(suite, row)
        sum_up(suite, 0.0)
    sum_up(root, 0.0)
    write_tree(path, root)


def _cases(suite: Element, row: Judged) -> None:
    from srs_twin.reproduction.outcomes import MET
    from srs_twin.reproduction.summary import cell

    claim = row.claim
    for column, outcome in row.outcomes.items():
        case = SubElement(suite, "testcase", classname=claim.id, name=column, time="0.000")
        if outcome.verdict != MET:
            said = f"{claim.id}, {column}: {cell(outcome)}, allowed {claim.allowed}"
            failure = SubElement(case, "failure", message=writable(said), type=outcome.verdict)
            failure.text = writable("\n".join([claim.says, claim.source, outcome.why]))
