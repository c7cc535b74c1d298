"""JUnit XML reports for continuous integration."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence, Set
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple
from xml.etree import ElementTree
from xml.etree.ElementTree import Element, SubElement

from srs_twin.cli.cases import Case, CaseResult
from srs_twin.errors import InputError
from srs_twin.io.files import atomic_write

if TYPE_CHECKING:
    from srs_twin.scenario.expectation import ExpectationRow

_OUTCOMES = {"failures": "failure", "errors": "error", "skipped": "skipped"}
# XML 1.0 excludes control characters and surrogates. In file names, Python represents
# invalid UTF-8 bytes by surrogates.
_INVALID_XML = re.compile("[^\t\n\r\x20-\ud7ff\ue000-\ufffd\U00010000-\U0010ffff]")


def report_path(name: str) -> Path:
    """Return the path of a report, whose file name must end with .xml.

    The fixed suffix prevents a mistyped command from overwriting a scenario file.

    Raises:
        InputError: the name does not end with .xml.
    """
    path = Path(name)
    if path.suffix.lower() != ".xml":
        raise InputError(
            f"--junit {name} is not allowed; the file name of a report must end in .xml"
        )
    return path


class TestCase(NamedTuple):
    """Test case in a JUnit report.

    Attributes:
        classname: group of the test case, for example the scenario.
        wall_s: wall time, s.
        outcome: "failure", "error" or "skipped", or an empty string if the test passed.
        message: one-line reason for the outcome.
        kind: type of the failure or error.
        text: full description of the outcome.
    """

    classname: str
    name: str
    wall_s: float = 0.0
    outcome: str = ""
    message: str = ""
    kind: str = ""
    text: str = ""


def write_report(
    path: Path, name: str, suites: Iterable[tuple[str, Iterable[TestCase]]]
) -> None:
    """Write a JUnit report atomically.

    Raises:
        InputError: the file cannot be written.
    """
    root = Element("testsuites", name=name)
    for title, cases in suites:
        suite = SubElement(root, "testsuite", name=_escape(title))
        for case in cases:
            names = {"classname": _escape(case.classname), "name": _escape(case.name)}
            test = SubElement(suite, "testcase", names, time=f"{case.wall_s:.3f}")
            if case.outcome:
                attributes = {"message": _escape(case.message)}
                if case.kind:
                    attributes["type"] = case.kind
                SubElement(test, case.outcome, attributes).text = (
                    _escape(case.text) or None
                )
    for element in (*root, root):
        tests = list(element.iter("testcase"))
        element.set("tests", str(len(tests)))
        for attribute, tag in _OUTCOMES.items():
            element.set(attribute, str(len(list(element.iter(tag)))))
        element.set("time", f"{sum(float(test.get('time', 0)) for test in tests):.3f}")
    tree = ElementTree.ElementTree(root)
    ElementTree.indent(tree)
    with atomic_write(path) as temporary:
        tree.write(temporary, encoding="utf-8", xml_declaration=True)


def write_junit(
    path: Path, cases: Sequence[Case], fails: Set[str] = frozenset()
) -> None:
    """Write a JUnit report with one test suite per scenario.

    A suite contains a test case ``runs`` for the simulation and one test case per
    expectation. If the simulation diverges, the input is invalid or a worker process
    dies, ``runs`` has an error. By default, expectations that cannot be judged or are
    missed for a known reason are skipped.

    Args:
        path: path of the report.
        cases: scenarios with results.
        fails: states of expectations that count as failures, in addition to "missed".

    Raises:
        InputError: the file cannot be written.
    """
    write_report(
        path,
        "srs-twin",
        [(case.label, _test_cases(case, fails | {"missed"})) for case in cases],
    )


def _test_cases(case: Case, fails: Set[str]) -> Iterator[TestCase]:
    result = case.result or CaseResult(None)
    run = TestCase(case.label, "runs", result.wall_s)
    if case.result is None:
        run = run._replace(outcome="skipped", message="not finished")
    elif result.errors:
        text = "\n".join(map(str, result.errors))
        kind = type(result.errors[0]).__name__
        run = run._replace(outcome="error", message=text, kind=kind, text=text)
    yield run
    expected = case.scenario.expect if case.scenario else ()
    rows: list[ExpectationRow] = [
        {"of": each.subject, "metric": each.metric} for each in expected
    ]
    # metrics.json contains no expectations about plants that did not run.
    rows = result.metrics.get("expectations", rows)
    counts: Counter[str] = Counter()
    for row in rows:
        name = f"{row['of']} {row['metric']}"
        counts[name] += 1
        if counts[name] > 1:
            name += f" ({counts[name]})"
        test = TestCase(case.label, name)
        if result.metrics:
            yield _add_outcome(test, row, fails)
        else:
            yield test._replace(outcome="skipped", message="the run is incomplete")


def _add_outcome(test: TestCase, row: ExpectationRow, fails: Set[str]) -> TestCase:
    from srs_twin.scenario.expectation import remarks, result_text, verdict

    state = verdict(row)
    if state in fails:
        values = {
            "value": row["value"],
            "allowed": row["allowed"],
            "source": row["source"] or "none stated",
            **remarks(row),
        }
        text = "\n".join(f"{key}: {value}" for key, value in values.items())
        message = f"{test.name} {result_text(row)}"
        return test._replace(
            outcome="failure", message=message, kind="expectation", text=text
        )
    skipped = {
        "expected_failure": f"expected failure: {row.get('expected_failure')}",
        "not_judged": f"not judged: {row.get('reason')}",
    }
    if state in skipped:
        return test._replace(outcome="skipped", message=skipped[state])
    return test


def _escape(text: str) -> str:
    return _INVALID_XML.sub(lambda match: ascii(match[0])[1:-1], text)
