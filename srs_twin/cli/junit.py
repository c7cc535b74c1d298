"""What came of scenarios as JUnit XML, which GitHub, GitLab and Jenkins show: a test suite each."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence, Set
from pathlib import Path
from typing import Any, NamedTuple
from xml.etree import ElementTree
from xml.etree.ElementTree import Element, SubElement

from srs_twin.cli.cases import Case
from srs_twin.errors import InputError
from srs_twin.io.files import atomic_write

_OUTCOMES = {"failures": "failure", "errors": "error", "skipped": "skipped"}
# What XML 1.0 has no way to write: control characters, and the halves of a file name that is not UTF-8.
_UNWRITABLE = re.compile("[^\t\n\r\x20-\ud7ff\ue000-\ufffd\U00010000-\U0010ffff]")


def report_path(given: str) -> Path:
    """Return the file that a report goes to.

    Raises:
        InputError: it does not end in .xml, as a scenario does that was taken for it.
    """
    path = Path(given)
    if path.suffix.lower() != ".xml":
        raise InputError(f"--junit {given}: not the name of a report; give one that ends in .xml")
    return path


class TestCase(NamedTuple):
    """A test case of a report.

    Attributes:
        classname: what it belongs to.
        name: of it.
        wall_s: what it took, s.
        outcome: "failure", "error" or "skipped"; empty where it passed.
        message: what is said of the outcome, on a line.
        kind: of the failure or error.
        text: all that is said of it.
    """

    classname: str
    name: str
    wall_s: float = 0.0
    outcome: str = ""
    message: str = ""
    kind: str = ""
    text: str = ""


def write_report(path: Path, name: str, suites: Iterable[tuple[str, Iterable[TestCase]]]) -> None:
    """Write a report, whole or not at all.

    Args:
        path: the file; an earlier one is replaced.
        name: of the report.
        suites: the name and the test cases of each.

    Raises:
        InputError: it cannot be written.
    """
    root = Element("testsuites", name=name)
    for title, cases in suites:
        suite = SubElement(root, "testsuite", name=_writable(title))
        for each in cases:
            names = {"classname": _writable(each.classname), "name": _writable(each.name)}
            case = SubElement(suite, "testcase", names, time=f"{each.wall_s:.3f}")
            if each.outcome:
                about = {"message": _writable(each.message)} | ({"type": each.kind} if each.kind else {})
                SubElement(case, each.outcome, about).text = _writable(each.text) or None
    for element in (*root, root):
        tests = list(element.iter("testcase"))
        element.set("tests", str(len(tests)))
        for counted, tag in _OUTCOMES.items():
            element.set(counted, str(len(list(element.iter(tag)))))
        element.set("time", f"{sum(float(test.get('time', 0)) for test in tests):.3f}")
    tree = ElementTree.ElementTree(root)
    ElementTree.indent(tree)
    with atomic_write(path) as part:
        tree.write(part, encoding="utf-8", xml_declaration=True)


def write_junit(path: Path, cases: Sequence[Case], fails: Set[str] = frozenset()) -> None:
    """Write a report: a suite for each scenario, a test case for its run and for each of its expectations.

    A missed expectation is a failure; a divergence, bad input or a dead worker is an error of the test case
    ``runs``. An expectation that was not reached, is not judged or is known to be missed is skipped.

    Args:
        path: the file; an earlier one is replaced.
        cases: the scenarios, whether they have ended or not.
        fails: verdicts on expectations that are failures besides "missed".

    Raises:
        InputError: it cannot be written.
    """
    write_report(path, "srs-twin", [(case.label, _test_cases(case, fails | {"missed"})) for case in cases])


def _test_cases(case: Case, fails: Set[str]) -> Iterator[TestCase]:
    run = TestCase(case.label, "runs", case.ended.wall_s if case.ended else 0.0)
    if case.ended is None:
        run = run._replace(outcome="skipped", message="not finished")
    elif case.ended.errors:
        words, kind = "\n".join(map(str, case.ended.errors)), type(case.ended.errors[0]).__name__
        run = run._replace(outcome="error", message=words, kind=kind, text=words)
    yield run
    metrics = case.ended.metrics if case.ended else {}
    expected = case.scenario.expect if case.scenario else ()
    rows = [{"of": each.subject, "metric": each.metric} for each in expected]
    # As they were judged: of plants that did not run there are none.
    rows = metrics["expectations"] if metrics else rows
    seen: Counter[str] = Counter()
    for row in rows:
        name = f"{row['of']} {row['metric']}"
        seen[name] += 1
        test = TestCase(case.label, f"{name} ({seen[name]})" if seen[name] > 1 else name)
        yield (
            _judged(test, row, fails)
            if metrics
            else test._replace(outcome="skipped", message="there is no whole run to measure")
        )


def _judged(test: TestCase, row: Mapping[str, Any], fails: Set[str]) -> TestCase:
    """Return the test case of an expectation with its verdict."""
    from srs_twin.scenario.expectation import result_text, verdict

    found = verdict(row)
    if found in fails:
        given = {key: row[key] for key in ("reason", "known") if row.get(key)}
        about = {"value": row["value"], "allowed": row["allowed"], "source": row["source"] or "ours"} | given
        text = "\n".join(f"{key}: {value}" for key, value in about.items())
        message = f"{test.name} {result_text(row)}"
        return test._replace(outcome="failure", message=message, kind="expectation", text=text)
    skipped = {"known": f"known: {row.get('known')}", "not_judged": f"not judged: {row.get('reason')}"}
    return test._replace(outcome="skipped", message=skipped[found]) if found in skipped else test


def _writable(text: str) -> str:
    """Return a text with escapes for what XML cannot write."""
    return _UNWRITABLE.sub(lambda found: ascii(found[0])[1:-1], text)
