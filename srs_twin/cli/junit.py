"""What came of scenarios as JUnit XML, which GitHub, GitLab and Jenkins show: a test suite each."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterator, Sequence, Set
from pathlib import Path
from typing import Any
from xml.etree import ElementTree
from xml.etree.ElementTree import Element, SubElement

from srs_twin.cli.batch import Case
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


def write_junit(path: Path, cases: Sequence[Case], fails: Set[str] = frozenset()) -> None:
    """Write a report: a suite for each scenario, a test case for its run and for each of its expectations.

    A missed expectation is a failure; a divergence, bad input or a dead worker is an error of the test case
    ``runs``; what was not reached, could not be measured or is known to be missed is skipped.

    Args:
        path: the file; an earlier one is replaced.
        cases: the scenarios, whether they have ended or not.
        fails: verdicts on expectations that are failures besides "missed".

    Raises:
        InputError: it cannot be written.
    """
    root = Element("testsuites", name="srs-twin")
    root.extend(_suite(case, fails | {"missed"}) for case in cases)
    sum_up(root, sum(case.ended.wall_s for case in cases if case.ended))
    write_tree(path, root)


def write_tree(path: Path, root: Element) -> None:
    """Write a report, whole or not at all.

    Raises:
        InputError: it cannot be written.
    """
    tree = ElementTree.ElementTree(root)
    ElementTree.indent(tree)
    with atomic_write(path) as part:
        tree.write(part, encoding="utf-8", xml_declaration=True)


def _suite(case: Case, fails: Set[str]) -> Element:
    from srs_twin.scenario.expectation import verdict

    suite = Element("testsuite", name=writable(case.name))
    wall_s = case.ended.wall_s if case.ended else 0.0
    run = _test(suite, case, "runs", wall_s)
    if case.ended is None:
        SubElement(run, "skipped", message="not finished")
    elif case.ended.errors:
        words = writable("\n".join(map(str, case.ended.errors)))
        kind = type(case.ended.errors[0]).__name__
        SubElement(run, "error", message=words, type=kind).text = words
    for name, outcome in _outcomes(case):
        test = _test(suite, case, name, 0.0)
        if outcome is None:
            SubElement(test, "skipped", message="there is no whole run to measure")
        elif verdict(outcome) in fails:
            said = f"{name} = {outcome['value']}, allowed {outcome['allowed']}"
            failure = SubElement(test, "failure", message=writable(said), type="expectation")
            known = {"known": outcome["known"]} if outcome["known"] else {}
            told = {key: outcome[key] for key in ("value", "allowed")}
            told |= {"source": outcome["source"] or "ours"} | known
            failure.text = writable("\n".join(f"{key}: {each}" for key, each in told.items()))
        elif verdict(outcome) == "known":
            SubElement(test, "skipped", message=writable(f"known: {outcome['known']}"))
    sum_up(suite, wall_s)
    return suite


def _outcomes(case: Case) -> Iterator[tuple[str, dict[str, Any] | None]]:
    """Yield a name for each expectation and what came out; None where nothing could be measured."""
    expected = case.scenario.expect if case.scenario else ()
    metrics = case.ended.metrics if case.ended else None
    seen: Counter[str] = Counter()
    for each in expected:
        name = f"{each.subject} {each.metric}"
        seen[name] += 1
        number = f" ({seen[name]})" if seen[name] > 1 else ""
        yield name + number, each.check(metrics) if metrics else None


def _test(suite: Element, case: Case, name: str, wall_s: float) -> Element:
    return SubElement(suite, "testcase", classname=writable(case.name), name=name, time=f"{wall_s:.3f}")


def sum_up(element: Element, wall_s: float) -> None:
    """Count what is in a suite, or in all of them."""
    element.set("tests", str(sum(1 for _ in element.iter("testcase"))))
    for name, outcome in _OUTCOMES.items():
        element.set(name, str(sum(1 for _ in element.iter(outcome))))
    element.set("time", f"{wall_s:.3f}")


def writable(text: str) -> str:
    """Return a text with escapes for what XML cannot write."""
    return _UNWRITABLE.sub(lambda found: ascii(found[0])[1:-1], text)
