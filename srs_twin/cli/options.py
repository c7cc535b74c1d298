"""Options that several commands share, and classes of options that commands take as one parameter."""

from __future__ import annotations

import inspect
from collections.abc import Callable
from dataclasses import dataclass, is_dataclass
from functools import wraps
from typing import Annotated, Any, get_type_hints

import typer

FITS = "calibration/fits"


def option(words: str, help: str, **more: Any) -> Any:
    """Return an option of a command, written as help shows it: "--robot -r ROBOT"; a flag: "--check"."""
    flags = [word for word in words.split() if word.startswith("-")]
    value = [word for word in words.split() if not word.startswith("-")]
    return typer.Option(*flags, metavar=" ".join(value) or None, help=help, **more)


def argument(name: str, help: str) -> Any:
    """Return an argument of a command."""
    return typer.Argument(metavar=name, help=help)


def at_once(words: str) -> Any:
    """Return the option that says how many of a command's runs go on at once."""
    return option(words, "Runs at once; 1: one after the other. [default: one a processor]", min=1, max=4096)


ScenarioArgument = Annotated[str, argument("SCENARIO", "A shipped scenario or a file.")]
RobotArgument = Annotated[str, argument("ROBOT", "A shipped robot or a file.")]
OneOutOption = Annotated[str | None, option("--out DIR", "Folder for the files. [default: runs/SCENARIO]")]
CheckOption = Annotated[bool, option("--check", "Exit with 1 when an expectation fails.")]
_STRICT = "--check, which also fails on what is marked `known`, met or missed."
StrictOption = Annotated[bool, option("--strict", _STRICT)]
QuietOption = Annotated[bool, option("--quiet -q", "No table and no progress; errors only.")]
JobsOption = Annotated[int | None, at_once("--jobs -j N")]
JsonOption = Annotated[bool, option("--json", "Print JSON instead of a table.")]
OverwriteOption = Annotated[bool, option("--overwrite", "Replace another file.")]

FilesArgument = Annotated[list[str], argument("FILE", "Recordings or tables that the fit is made from.")]
RobotOption = Annotated[str, option("--robot -r ROBOT", "Where the search starts: shipped, or a file.")]
_VALIDATE = "Held against the fit, which does not see it; repeatable."
ValidateOption = Annotated[list[str] | None, option("--validate FILE", _VALIDATE)]
_LOGS = "Log of each recording, FILE... first, then --validate. [default: NAME.valves.csv beside it]"
ValvesOption = Annotated[list[str] | None, option("--valves LOG", _LOGS)]
_OFFSET = "What to add to the logs' times. [default: estimated]"
OffsetOption = Annotated[float | None, option("--offset S", _OFFSET)]
PressureOption = Annotated[float | None, option("--pressure KPA", "Of the supply. [default: the robot's]")]
_FIND = "What to look for, as friction.mu_t,friction.mu_n."
FindOption = Annotated[str | None, option("--find NAMES", _FIND)]
FrequencyOption = Annotated[float | None, option("--frequency HZ", "Of the gait. [default: the valves']")]
_FLOOR = "Of the analytical plant's floor. [default: wheel]"
FloorOption = Annotated[str | None, option("--law NAME", _FLOOR)]


@dataclass(frozen=True)
class ReadingOptions:
    """How markers are read; see `RecordingReader`."""

    up: Annotated[str, option("--up AXIS", "Axis of the files that points up.")] = "auto"
    layout: Annotated[str, option("--layout NAME", "Markers: auto, single, head or pair.")] = "auto"
    head: Annotated[str | None, option("--head MARKER", "At the head. [default: where it crawls to]")] = None
    longest_gap: Annotated[
        float | None, option("--longest-gap S", "Longest gap that is filled. [default: 0.2]")
    ] = None

    def given(self) -> dict[str, Any]:
        """Return what was given, by the names of `RecordingReader`."""
        values = {"up": self.up, "layout": self.layout, "head": self.head, "longest_gap_s": self.longest_gap}
        return {name: value for name, value in values.items() if value is not None}


@dataclass(frozen=True)
class FitOptions:
    """Where a fit goes, and whether to be quiet."""

    name: Annotated[str | None, option("--name NAME", "Of the fit and its file. [default: ROBOT_WHAT]")] = (
        None
    )
    out: Annotated[str | None, option("--out FILE.yaml", f"Its file. [default: {FITS}/NAME.yaml]")] = None
    overwrite: Annotated[bool, option("--overwrite", "Replace the fit of another command.")] = False
    quiet: QuietOption = False


def with_options(command: Callable[..., None]) -> Callable[..., None]:
    """Return a command in which a parameter that is a class of options has become these options."""
    hints = get_type_hints(command, include_extras=True)
    groups = {name: kind for name, kind in hints.items() if isinstance(kind, type) and is_dataclass(kind)}
    parameters: list[inspect.Parameter] = []
    for name, parameter in inspect.signature(command).parameters.items():
        of, annotations = [parameter], hints
        if name in groups:
            of = list(inspect.signature(groups[name]).parameters.values())
            annotations = get_type_hints(groups[name], include_extras=True)
        keyword = inspect.Parameter.KEYWORD_ONLY
        parameters += [each.replace(kind=keyword, annotation=annotations[each.name]) for each in of]

    @wraps(command)
    def run(**given: Any) -> None:
        for name, kind in groups.items():
            given[name] = kind(**{field: given.pop(field) for field in inspect.signature(kind).parameters})
        command(**given)

    run.__signature__ = inspect.Signature(parameters)  # type: ignore[attr-defined]
    return run
