"""Check: one thing looked at, whether it works, and the remedy where it does not."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Literal

Mark = Literal["ok", "missing", "broken"]


@dataclass(frozen=True)
class Check:
    """One line of what `srs-twin doctor` says.

    Attributes:
        topic: what it belongs to.
        name: what was looked at, unique.
        mark: "ok"; "missing": not there, or too little of it; "broken": there, but it does not work.
        detail: what was found.
        remedy: a command or a sentence; empty where, and only where, all is well.
        necessary: whether runs fail without it.
    """

    topic: str
    name: str
    mark: Mark
    detail: str
    remedy: str = ""
    necessary: bool = False

    def __post_init__(self) -> None:
        if bool(self.remedy) == (self.mark == "ok"):
            raise ValueError(f"{self.name}: {self.mark}, but its remedy is {self.remedy!r}")


def failing(checks: Iterable[Check]) -> list[Check]:
    """Return those that are necessary and do not work."""
    return [check for check in checks if check.necessary and check.mark != "ok"]
