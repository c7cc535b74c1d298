"""What can go wrong, each with its own exit code and a message that says what to do.

Every error the package raises on purpose is an `SrsError`. Its text is complete: where, what was given,
what is allowed, what was probably meant. The command line prints it and exits with `exit_code`.
"""

from __future__ import annotations

import difflib
import math
import re
import signal
import traceback
from collections.abc import Callable, Iterable, Iterator, Sequence
from fractions import Fraction
from pathlib import Path, PurePath
from typing import Any, NamedTuple

FEW = 12
"""Most names that a message lists."""

_MOST = 3  # names suggested
_CLOSE = 0.6  # similarity from which on a name is suggested; that of `difflib`
_ALIKE = 0.05  # names this much less similar than the best are suggested with it
_STEM = 0.75  # the same for the beginning of a name: short words are soon alike
_SUFFIXES = (".yaml", ".yml", ".csv", ".parquet", ".rrd", ".xml", ".json", ".urdf", ".mjcf")
_WORDS = re.compile(r"[_.\s-]")


class SrsError(Exception):
    """Base of all errors raised on purpose.

    Attributes:
        exit_code: what the command line exits with (2 bad input, 3 diverged, 4 internal).
    """

    exit_code = 4

    def __reduce__(self) -> tuple[Any, ...]:
        """Come back from another process as it was: `Exception` would call __init__ with its own message."""
        return _restored, (type(self), self.args, self.__dict__)


class InputError(SrsError):
    """Something a person gave cannot be used; nothing was written. Exit code 2."""

    exit_code = 2


class UnknownNameError(InputError):
    """A name that is not among the available ones; says which are closest, and all where they are few.

    Args:
        kind: what it names.
        given: the name.
        available: those that there are.
        listed: where they are listed, said where none is close and they are many.
    """

    def __init__(self, kind: str, given: str, available: Iterable[str], listed: str = "") -> None:
        names = sorted(available)
        close = did_you_mean(given, names)
        # Many names are a wall of words, which hides the close ones and helps nobody without them.
        rest = "" if close and len(names) > FEW else f" (available: {some(names, listed)})"
        super().__init__(f"unknown {kind} '{given}'{close}{rest}")


class TimeStepError(InputError):
    """A period that is no whole multiple of a shorter one; prints both.

    Attributes:
        fault: the message without the times that would do.
    """

    def __init__(self, name: str, period_s: float, step_name: str, step_s: float) -> None:
        # With enough digits to see it: 0.13999994 s, which is 0.14 s to six digits, is no multiple of 0.02 s.
        given = decimal(period_s, lambda time: not _is_whole(time / step_s))
        self.fault = f"{name} {given} s is no multiple of {step_name} {exact(step_s)} s"
        multiple, part = max(1, round(period_s / step_s)) * step_s, _round_part(period_s, step_s)
        longer = decimal(multiple, lambda time: _is_whole(time / step_s))
        shorter = decimal(part, lambda time: _is_whole(period_s / time))
        super().__init__(f"{self.fault}; {longer} s or {step_name} {shorter} s would be")


class InputFileError(InputError):
    """All that is wrong with a file, each line as ``path:line:column: key.path: message``.

    Attributes:
        lines: the messages, in the order of the file.
    """

    def __init__(self, lines: Iterable[str]) -> None:
        self.lines = tuple(lines)
        super().__init__("\n".join(self.lines))


class EngineWarning(UserWarning):
    """Something ran elsewhere than asked for."""


class SessionWarning(UserWarning):
    """A session beside a robot goes on without something: a file that cannot be written, a forecast."""


class CacheWarning(UserWarning):
    """Machine code cannot be kept: every start compiles it again."""


class DivergedError(SrsError):
    """A simulation left the range of the finite and plausible. Exit code 3.

    Attributes:
        time: simulated time at which it was found, s.
        history: the samples of the unfinished stretch before it, or None.
        trajectory: what was recorded up to there (set by `rollout`), or None.
    """

    exit_code = 3

    def __init__(self, plant: str, time: float, what: str, *, history: Any = None) -> None:
        super().__init__(f"{plant} diverged at t = {time:.4g} s: {what}")
        self.time = time
        self.history = history
        self.trajectory: Any = None


class TaskFailedError(SrsError):
    """A task in a worker process raised what nobody foresaw. Exit code 4."""

    def __init__(self, error: BaseException) -> None:
        frames = traceback.extract_tb(error.__traceback__)
        where = f" ({Path(frames[-1].filename).name}:{frames[-1].lineno})" if frames else ""
        said = " ".join(str(error).split())
        super().__init__(
            f"internal error: {type(error).__name__}: {said}{where}. "
            "This is a fault of srs-twin, not of your files: please report it as CONTRIBUTING.md says"
        )


class WorkerDiedError(SrsError):
    """A worker process ended in the middle of its task, as often as it was tried. Exit code 4."""

    def __init__(self, exit_code: int, attempts: int) -> None:
        times = "" if attempts == 1 else f", {attempts} times in a row"
        super().__init__(f"the worker process {ending(exit_code)}{times}; {_cause(exit_code)}")


def _restored(kind: type[SrsError], args: tuple[Any, ...], attributes: dict[str, Any]) -> SrsError:
    error = kind.__new__(kind)
    error.args = args
    error.__dict__.update(attributes)
    return error


def ending(exit_code: int) -> str:
    """Return how a process ended: multiprocessing gives a signal as its negative."""
    if exit_code >= 0:
        return f"ended with exit code {exit_code}"
    try:
        return f"was killed by {signal.Signals(-exit_code).name}"
    except ValueError:
        return f"was killed by signal {-exit_code}"


def _cause(exit_code: int) -> str:
    if exit_code == -signal.SIGKILL:
        return "the machine was out of memory (fewer workers help), or somebody ended it"
    if exit_code < 0:
        return "compiled code failed, or somebody ended it"
    return "its own output above may say why"


def _round_part(period_s: float, step_s: float) -> float:
    """Return the longest whole part of a period, up to a step, that a person can write out."""
    fewest = max(1, math.ceil(period_s / step_s))
    parts = (period_s / n for n in range(fewest, min(20 * fewest, fewest + 1000)))
    return next((part for part in parts if math.isclose(float(f"{part:.4g}"), part, rel_tol=1e-12)), period_s)


def some(names: Sequence[str], listed: str = "") -> str:
    """Return names for a message: all where they are few, else how many and where they are listed."""
    if len(names) > FEW:
        return f"{len(names)} names{listed and f'; {listed} lists them'}"
    return ", ".join(names) or "none"


def one_of(name: str, given: str, allowed: Iterable[str]) -> None:
    """Raise InputError unless a value is one of those allowed; the closest is suggested."""
    allowed = tuple(allowed)
    if given not in allowed:
        raise InputError(
            f"{name} '{given}' is unknown; allowed: {', '.join(allowed)}{did_you_mean(given, allowed)}"
        )


def did_you_mean(given: str, available: Iterable[str]) -> str:
    """Return '; did you mean A, B or C?' for the closest available names, or an empty string.

    Names are compared by their last part: `frequency_hz` of `controller.frequency_hz`, `gen2_turn` of
    `scenarios/gen2_turn.yaml`. An abbreviation, or a name without its unit, is close; of names that are as
    close, those in the same section are meant.

    Args:
        given: the name that there is not.
        available: those that there are; the closest, at most three, are suggested in this order.
    """
    section, last = _parts(given)
    found = {}
    for name in available:
        where, candidate = _parts(name)
        closeness = _closeness(last, candidate)
        if not section and where:  # perhaps the beginning was given
            closeness = max(closeness, _closeness(last, name.lower()))
        if closeness >= _CLOSE:
            found[name] = closeness + (0.5 * _ratio(section, where) if section else 0.0)
    best = max(found.values(), default=0.0)
    names = sorted((name for name in found if found[name] >= best - _ALIKE), key=lambda name: -found[name])
    *others, final = names[:_MOST] or [""]
    return f"; did you mean {', '.join(others)}{' or ' if others else ''}{final}?" if final else ""


def _parts(name: str) -> tuple[str, str]:
    """Return where a name stands and its last part, in small letters."""
    path = PurePath(name.lower())
    if path.suffix in _SUFFIXES:
        return str(path.parent), path.stem
    section, _, last = name.lower().rpartition(".")
    return section, last


def _closeness(given: str, name: str) -> float:
    """Return how much one name is like another, from 0 to 1."""
    alike = _ratio(given, name)
    if len(given) < 3 or alike == 1.0:
        return alike
    if name.startswith(given):
        return max(alike, 0.85 + 0.1 * len(given) / len(name))
    given, words = _WORDS.sub("_", given), _WORDS.split(name)
    # From the front, as without a unit; or from anywhere, as without what it is of.
    stem = 0.95 * max((_ratio(given, "_".join(words[:i])) for i in range(1, len(words))), default=0.0)
    within = 0.8 if f"_{given}_" in f"_{name}_" else 0.0
    return max(alike, stem if stem > _STEM else 0.0, within)


def _ratio(one: str, other: str) -> float:
    return difflib.SequenceMatcher(None, one, other).ratio()


def whole_steps(name: str, period_s: float, step_name: str, step_s: float) -> int:
    """Return how many steps fill a period.

    Args:
        name: what the period is called in the message.
        period_s: the longer time, s.
        step_name: what the step is called in the message.
        step_s: the shorter time, s.

    Raises:
        TimeStepError: the ratio is not a whole number (relative tolerance 1e-9).
        InputError: one of them is not finite or not above 0.
    """
    for what, value in ((name, period_s), (step_name, step_s)):
        if not (math.isfinite(value) and value > 0):
            raise InputError(f"{what} {value!r} s is not allowed; it must be finite and above 0")
    ratio = period_s / step_s
    if not math.isfinite(ratio):
        raise InputError(f"{name} {exact(period_s)} s is too long for {step_name} {exact(step_s)} s")
    if not _is_whole(ratio):
        raise TimeStepError(name, period_s, step_name, step_s)
    return round(ratio)


def _is_whole(ratio: float, tolerance: float = 1e-9) -> bool:
    """Say whether a number is a whole number above 0, within a relative tolerance."""
    return 0.5 < ratio < math.inf and abs(ratio - round(ratio)) <= tolerance * max(1.0, ratio)


def decimal(value: float, fits: Callable[[float], bool]) -> str:
    """Return the shortest decimal text of a number, from six digits up, that still fits."""
    return next((text for n in range(6, 17) if fits(float(text := f"{value:.{n}g}"))), repr(value))


def exact(value: float) -> str:
    """Return the shortest text that reads back as the same number."""
    return decimal(value, lambda read: read == value)


class Clock(NamedTuple):
    """Times at which a plant can be sampled.

    Attributes:
        tick: control tick, s.
        step: unit of the intervals between samples within a tick, s; None: any interval is allowed.
    """

    tick: float
    step: float | None = None

    def fits(self, rate: float, tolerance: float = 1e-9) -> bool:
        """Say whether samples at a rate (Hz) coincide with ticks, or divide them into allowed parts."""
        per_tick = self.tick * rate
        if not 0 < per_tick < math.inf:
            return False
        if per_tick < 1:
            return _is_whole(1 / per_tick, tolerance)
        allowed = self.step is None or _is_whole(1 / (rate * self.step), tolerance)
        return allowed and _is_whole(per_tick, tolerance)

    def near(self, rate: float) -> Iterator[float]:
        """Yield rates (Hz) near a rate that fit this plant."""
        ticks, parts = 1 / (self.tick * rate), self.tick * rate
        yield from (1 / (k * self.tick) for k in _near(ticks))
        if self.step is None:
            yield from (n / self.tick for n in _near(parts))
        else:
            steps = round(self.tick / self.step)
            yield from (n / self.tick for n in range(1, steps + 1) if steps % n == 0)


_NEIGHBOURS = 20


def _near(number: float) -> range:
    """Return whole numbers above 0 about a number."""
    middle = round(min(number, 1e15))
    return range(max(1, middle - _NEIGHBOURS), max(1, middle) + _NEIGHBOURS)


def nearest_rate(
    rate: float, clocks: Sequence[Clock], low: float = 0.0, high: float = math.inf
) -> str | None:
    """Return the sampling rate nearest to one asked for that fits all plants, as text to type, Hz.

    Args:
        rate: that was asked for, above 0.
        clocks: of the plants.
        low: least rate that is allowed.
        high: greatest rate that is allowed.

    Returns:
        None where no rate fits.
    """
    # Ticks that are no multiples of each other meet at multiples of their least common multiple.
    ticks = [Fraction(clock.tick).limit_denominator(1_000_000) for clock in clocks]
    scale = math.lcm(*(each.denominator for each in ticks))
    common = math.lcm(*(max(1, int(each * scale)) for each in ticks)) / scale
    candidates = [*Clock(common).near(rate), *(each for clock in clocks for each in clock.near(rate))]

    def fits(rate: float) -> bool:
        # Tighter than the checks, which divide once more.
        return low <= rate <= high and all(clock.fits(rate, 1e-10) for clock in clocks)

    fitting = sorted(filter(fits, candidates), key=lambda each: abs(math.log(each / rate)))
    return decimal(fitting[0], fits) if fitting else None
