"""Check: one thing looked at, whether it works, and the remedy where it does not."""

from __future__ import annotations

import signal
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Literal

Status = Literal["ok", "missing", "broken", "undecided"]


class Fault(Exception):
    """What a probe finds wrong.

    Attributes:
        status: "missing" or "broken".
        remedy: what to do; empty: the probe's usual one.
    """

    def __init__(self, status: Status, detail: str, remedy: str = "") -> None:
        super().__init__(detail)
        self.status, self.remedy = status, remedy


@dataclass(frozen=True)
class Check:
    """One line of what `srs-twin doctor` says.

    Attributes:
        topic: what it belongs to.
        name: what was looked at, unique.
        status: "ok"; "missing": not there, or too little of it; "broken": there, but it does not work;
            "undecided": no answer in time, or not tried, which says nothing about whether it works.
        detail: what was found.
        remedy: a command or a sentence; empty where, and only where, all is well.
        necessary: whether runs fail without it.
    """

    topic: str
    name: str
    status: Status
    detail: str
    remedy: str = ""
    necessary: bool = False

    def __post_init__(self) -> None:
        if bool(self.remedy) == (self.status == "ok"):
            raise ValueError(f"{self.name}: {self.status}, but its remedy is {self.remedy!r}")


@dataclass(frozen=True)
class Answer:
    """What came of a probe; fields as in `Check`, the remedy empty where the probe names none."""

    status: Status
    detail: str
    remedy: str = ""


def ended(code: int) -> Answer:
    """Return what the end of a process says that gave no answer; below 0 the signal that ended it."""
    if code in (-signal.SIGALRM, -signal.SIGKILL):  # SIGKILL: by a system short of memory
        remedy = "this machine is busy, or very slow: run `srs-twin doctor` again when it is not"
        return Answer("undecided", "slow: no answer in time", remedy)
    if code >= 0:
        return Answer("broken", f"ended with exit code {code}")
    known = -code in set(signal.Signals)
    return Answer("broken", f"ended by {signal.Signals(-code).name if known else f'signal {-code}'}")


def failing(checks: Iterable[Check]) -> list[Check]:
    """Return those that are necessary and do not work; a slow machine is no reason to refuse it."""
    return [check for check in checks if check.necessary and check.status in ("missing", "broken")]
