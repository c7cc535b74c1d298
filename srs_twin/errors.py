"""Exceptions and warnings of the package.

Every error that the package raises on purpose is an `SrsError`. The error message
states where the problem is, what was given, what is allowed and which valid input is
closest.
"""

from __future__ import annotations

import difflib
import math
import re
import signal
import traceback
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from fractions import Fraction
from pathlib import Path, PurePath
from typing import Any, NamedTuple

MAX_LISTED_NAMES = 12

_MAX_SUGGESTIONS = 3
_MIN_SIMILARITY = 0.6
"""Minimum similarity of a suggested name, as computed by `difflib`."""

_SIMILARITY_TIE = 0.05
"""Maximum difference in similarity between the best and any further suggestion."""

_MIN_PREFIX_SIMILARITY = 0.75
"""Minimum similarity between a text and the first words of a name.

This value exceeds `_MIN_SIMILARITY`, because short texts are often similar by chance.
"""

OUTSIDE: set[str] = set()
"""Source files of imported plug-ins, for the location in error messages."""

_FILE_SUFFIXES = (
    ".yaml",
    ".yml",
    ".csv",
    ".parquet",
    ".rrd",
    ".xml",
    ".json",
    ".urdf",
    ".mjcf",
)
_WORD_SEPARATOR = re.compile(r"[_.\s-]")


class SrsError(Exception):
    """Base class of all errors raised on purpose.

    Attributes:
        exit_code: exit code of the command line, which is 2 for invalid input or an error
            in a plug-in, 3 for a divergence, or 4 for an internal error.
    """

    exit_code = 4

    def __reduce__(self) -> tuple[object, ...]:
        """Pickle the class, the arguments and the attributes.

        By default, unpickling would call `__init__` with only the message.
        """
        return _restore_error, (type(self), self.args, self.__dict__)


class InputError(SrsError):
    """Error for invalid input, with exit code 2.

    Commands raise this error before they write results. A sweep that runs out of disk
    space raises the error later and keeps the finished rows.
    """

    exit_code = 2


class WriteError(InputError):
    """Error for a file that cannot be written, for example because the disk is full.

    This error is reported even after an interrupt, because results may be missing.
    """


class AbsentPartError(InputError):
    """Error for a plug-in class that was not imported.

    Plug-ins are not imported while the files of a finished run are read.
    """

    def __init__(self, name: str) -> None:
        super().__init__(
            f"the plug-in class {name} was not imported; load the scenario itself"
            " to run it"
        )


class UnknownNameError(InputError):
    """Error for a name that does not exist, with the closest names as suggestions."""

    def __init__(
        self,
        kind: str,
        name: str,
        available: Iterable[str],
        listing: str = "",
        longest: int = MAX_LISTED_NAMES,
    ) -> None:
        names = sorted(available)
        suggestion = did_you_mean(name, names)
        # A long list of names would hide the suggestion.
        hide_list = suggestion and len(names) > longest
        if hide_list:
            rest = ""
        else:
            rest = f" (available: {format_names(names, listing, longest)})"
        super().__init__(f"unknown {kind} '{name}'{suggestion}{rest}")


@contextmanager
def named_in_errors(file: str) -> Iterator[None]:
    """Add a file name to the messages of input errors raised in a `with` block.

    The types and the attributes of the errors are kept. The `lines` of an
    `InputFileError` are unchanged, because each line names its own file.
    """
    try:
        yield
    except InputError as error:
        error.args = (f"{file}: {error}",)
        raise


class TimeStepError(InputError):
    """Error for a period that is not a multiple of a time step."""

    def __init__(
        self, name: str, period_s: float, step_name: str, step_s: float
    ) -> None:
        # With six digits, 0.13999994 s would be printed as 0.14 s, which is a multiple
        # of 0.02 s.
        period = shortest_decimal(period_s, lambda time: not _is_whole(time / step_s))
        self.problem = (
            f"{name} {period} s is not a multiple of {step_name}"
            f" {format_exact(step_s)} s"
        )
        multiple = max(1, round(period_s / step_s)) * step_s
        divisor = _longest_round_divisor(period_s, step_s)
        longer = shortest_decimal(multiple, lambda time: _is_whole(time / step_s))
        shorter = shortest_decimal(divisor, lambda time: _is_whole(period_s / time))
        super().__init__(
            f"{self.problem}; use {longer} s, or set {step_name} to {shorter} s"
        )


class InputFileError(InputError):
    """Error that lists all problems of one file.

    Each line has the form ``path:line:column: key.path: message``.
    """

    def __init__(self, lines: Iterable[str]) -> None:
        self.lines = tuple(lines)
        super().__init__("\n".join(self.lines))


class RenamedWarning(UserWarning):
    """Warning that a file or command uses the former name of a key or option."""


class UnitWarning(UserWarning):
    """Warning that a number in a robot file probably has the wrong unit."""


class EngineWarning(UserWarning):
    """Warning that a computation does not use the requested engine."""


class SessionWarning(UserWarning):
    """Warning that a live twin is too slow, or that a connection or a task failed."""


class CacheWarning(UserWarning):
    """Warning that compiled kernels cannot be cached and are rebuilt at every start."""


class DivergedError(SrsError):
    """Error for a simulated value that is infinite or implausible, with exit code 3.

    Attributes:
        time: simulated time at which the divergence was detected, s.
        history: samples that the plant computed since the last recorded sample, or
            None.
        trajectory: samples that `rollout` recorded before the divergence, or None.
    """

    exit_code = 3

    def __init__(
        self, plant: str, time: float, what: str, *, history: Any = None
    ) -> None:
        super().__init__(f"{plant} diverged at t = {time:.4g} s: {what}")
        self.time = time
        self.history = history
        self.trajectory: Any = None


class TaskFailedError(SrsError):
    """Error for an unexpected exception, with exit code 4, or 2 in a plug-in."""

    def __init__(self, error: BaseException) -> None:
        if _is_memory_shortage(error):
            super().__init__(
                f"the memory is exhausted ({describe_error(error)}); close other"
                " programs or use fewer workers"
            )
            return
        kind = "internal error"
        fault = (
            "This is a bug in srs-twin, not in your files: please report it with the"
            " command and your files"
        )
        if _plugin_frames(error):
            self.exit_code = InputError.exit_code
            kind = "error in a plug-in"
            fault = (
                "This file is not part of srs-twin: correct it, or report the error to"
                " its authors"
            )
        super().__init__(f"{kind}: {describe_error(error)}. {fault}")


_SHORTAGE = (
    "cannot allocate memory|could not allocate|failed to map segment|can't start new"
    " thread"
)


def _is_memory_shortage(error: BaseException) -> bool:
    return (
        isinstance(error, MemoryError)
        or re.search(_SHORTAGE, str(error), re.IGNORECASE) is not None
    )


class WorkerDiedError(SrsError):
    """Error for a task whose worker process died in every attempt, with exit code 4."""

    def __init__(self, exit_code: int, attempts: int) -> None:
        times = "" if attempts == 1 else f", {attempts} times in a row"
        super().__init__(
            f"the worker process {describe_exit(exit_code)}{times};"
            f" {_exit_cause(exit_code)}"
        )


def describe_error(error: BaseException) -> str:
    """Return the type, the message and the source line of an error.

    If the error passed through a plug-in, the last line in the plug-in is returned.
    """
    frames = _plugin_frames(error) or traceback.extract_tb(error.__traceback__)
    where = ""
    # The message of a SyntaxError contains the source line.
    if frames and not isinstance(error, SyntaxError):
        where = f" ({Path(frames[-1].filename).name}:{frames[-1].lineno})"
    return f"{type(error).__name__}: {' '.join(str(error).split())}{where}"


def _plugin_frames(error: BaseException) -> list[traceback.FrameSummary]:
    return [
        frame
        for frame in traceback.extract_tb(error.__traceback__)
        if frame.filename in OUTSIDE
    ]


def _restore_error(
    kind: type[SrsError], args: tuple[object, ...], attributes: dict[str, object]
) -> SrsError:
    error = kind.__new__(kind)
    error.args = args
    error.__dict__.update(attributes)
    return error


def describe_exit(exit_code: int) -> str:
    """Describe how a process ended. A negative exit code is a negated signal number."""
    if exit_code >= 0:
        return f"ended with exit code {exit_code}"
    try:
        return f"was killed by {signal.Signals(-exit_code).name}"
    except ValueError:
        return f"was killed by signal {-exit_code}"


def _exit_cause(exit_code: int) -> str:
    if exit_code == -signal.SIGKILL:
        return "the machine ran out of memory (use fewer workers), or a user killed it"
    if exit_code < 0:
        return "compiled code crashed, or a user killed it"
    return "the output above states the reason"


def _longest_round_divisor(period_s: float, step_s: float) -> float:
    fewest = max(1, math.ceil(period_s / step_s))
    divisors = (period_s / n for n in range(fewest, min(20 * fewest, fewest + 1000)))
    short = (
        time
        for time in divisors
        if math.isclose(float(f"{time:.4g}"), time, rel_tol=1e-12)
    )
    return next(short, period_s)


def format_names(
    names: Sequence[str], listing: str = "", longest: int = MAX_LISTED_NAMES
) -> str:
    """Return the names as text, separated by commas.

    If there are more than `longest` names, the text states only their number and the
    command `listing`, which prints them.
    """
    if len(names) > longest:
        return f"{len(names)} names{listing and f'; {listing} lists them'}"
    return ", ".join(names) or "none"


def check_choice(name: str, value: str, allowed: Iterable[str]) -> None:
    """Raise an `InputError` if a value is not among the allowed values."""
    allowed = tuple(allowed)
    if value not in allowed:
        raise InputError(
            f"{name} '{value}' is unknown; allowed:"
            f" {', '.join(allowed)}{did_you_mean(value, allowed)}"
        )


RENAMED = {
    "rest_share": "rest_fraction",
    "onset_share": "onset_fraction",
    "turn_share": "turn_fraction",
    "inside_share": "inside_fraction",
    "step_share": "step_fraction",
    "contact_share": "contact_fraction",
    "share": "fraction",
    "momentary": "instantaneous",
    "known": "expected_failure",
    "pitch_m": "spacing_m",
    "onset_rad": "dead_zone_rad",
    "onset_width_rad": "dead_zone_transition_rad",
    "line_begins_kpa": "initial_line_pressure_kpa",
    "settle_m": "response_length_m",
    "run_up_m": "lead_in_m",
    "replans": "max_replans",
    "touch": "contact",
    "starved": "low_supply_pressure",
    "air": "pneumatic_energy",
    "sensed": "measured_bend",
    "sensed_pitch": "measured_pitch",
    "theta": "connector_heading",
    "sensed_ripple_pp_rad": "measured_ripple_pp_rad",
    "plan_kink_rad": "plan_max_heading_jump_rad",
    "box_left_m": "extent_left_m",
    "box_right_m": "extent_right_m",
    "press_on": "allow_zero_margin",
    "--tell-supply": "--publish-supply",
    "--press-on": "--allow-zero-margin",
    "--without": "--exclude",
    "--want": "--target-accuracy",
    "--form": "--model-form",
    "--against": "--compare-signals",
    "--find": "--parameters",
    "--law": "--friction-law",
    "--jobs": "--workers",
    "--threads": "--workers",
    "--duration-s": "--duration",
}
"""Current name of each former key, kind, column, metric and option.

Numbered columns are listed without their number (``theta`` for ``theta_1``).
"""


def current_name(name: str) -> str | None:
    """Return the current name of a renamed key, column or option, or None."""
    base, _, number = name.rpartition("_")
    if number.isdecimal() and base in RENAMED:
        return f"{RENAMED[base]}_{number}"
    return RENAMED.get(name)


def did_you_mean(text: str, available: Iterable[str]) -> str:
    """Return a suggestion such as "; did you mean A, B or C?", or an empty string.

    For a former name, the suggestion is "; it is now called A".

    Only the last component of a dotted name is compared, for example `frequency_hz` in
    `controller.frequency_hz`. Among equally similar names, those in the same section as
    `text` are preferred.
    """
    available = tuple(available)
    if (renamed := current_name(text)) in available:
        return f"; it is now called {renamed}"
    section, last = _split_name(text)
    similarity = {}
    for name in available:
        name_section, candidate = _split_name(name)
        closeness = _similarity(last, candidate)
        # A text without dots may be the beginning of a dotted name.
        if not section and name_section:
            closeness = max(closeness, _similarity(last, name.lower()))
        if closeness >= _MIN_SIMILARITY:
            similarity[name] = closeness + (
                0.5 * _ratio(section, name_section) if section else 0.0
            )
    best = max(similarity.values(), default=0.0)
    close = [name for name in similarity if similarity[name] >= best - _SIMILARITY_TIE]
    close.sort(key=lambda name: -similarity[name])
    if not close:
        return ""
    *first, final = close[:_MAX_SUGGESTIONS]
    if first:
        final = f"{', '.join(first)} or {final}"
    return f"; did you mean {final}?"


def _split_name(name: str) -> tuple[str, str]:
    path = PurePath(name.lower())
    if path.suffix in _FILE_SUFFIXES:
        return str(path.parent), path.stem
    section, _, last = name.lower().rpartition(".")
    return section, last


def _similarity(text: str, name: str) -> float:
    whole = _ratio(text, name)
    if len(text) < 3 or whole == 1.0:
        return whole
    if name.startswith(text):
        return max(whole, 0.85 + 0.1 * len(text) / len(name))
    text = _WORD_SEPARATOR.sub("_", text)
    words = _WORD_SEPARATOR.split(name)
    # The text may consist of the first words of a name that ends in a unit, or of any
    # consecutive words of the name.
    prefix = 0.95 * max(
        (_ratio(text, "_".join(words[:i])) for i in range(1, len(words))), default=0.0
    )
    if prefix <= _MIN_PREFIX_SIMILARITY:
        prefix = 0.0
    within = 0.8 if f"_{text}_" in f"_{name}_" else 0.0
    return max(whole, prefix, within)


def _ratio(one: str, other: str) -> float:
    return difflib.SequenceMatcher(None, one, other).ratio()


def count_steps(name: str, period_s: float, step_name: str, step_s: float) -> int:
    """Return the number of steps in a period.

    Args:
        name: name of the period in messages.
        period_s: duration of the period, s.
        step_name: name of the step in messages.
        step_s: duration of the step, s.

    Raises:
        TimeStepError: the period is not a multiple of the step within a relative
            tolerance of 1e-9.
        InputError: a duration is not finite or not positive.
    """
    for label, value in ((name, period_s), (step_name, step_s)):
        if not 0 < value < math.inf:
            raise InputError(
                f"{label} {value!r} s is not allowed; it must be finite and above 0"
            )
    ratio = period_s / step_s
    if not math.isfinite(ratio):
        period = format_exact(period_s)
        step = format_exact(step_s)
        raise InputError(
            f"{name} {period} s is too long for {step_name} {step} s: the number of steps"
            " exceeds the range of floats"
        )
    if not _is_whole(ratio):
        raise TimeStepError(name, period_s, step_name, step_s)
    return round(ratio)


def _is_whole(ratio: float, tolerance: float = 1e-9) -> bool:
    return 0.5 < ratio < math.inf and abs(ratio - round(ratio)) <= tolerance * max(
        1.0, ratio
    )


def shortest_decimal(value: float, fits: Callable[[float], bool]) -> str:
    """Return a number as text, with six digits or as many as `fits` requires."""
    return next(
        (text for n in range(6, 17) if fits(float(text := f"{value:.{n}g}"))),
        repr(value),
    )


def format_exact(value: float) -> str:
    """Return the shortest decimal text that represents the number exactly."""
    return shortest_decimal(value, lambda read: read == value)


class SamplingGrid(NamedTuple):
    """Times at which a plant can be sampled.

    Attributes:
        tick: control tick, s.
        step: time step of which sampling intervals shorter than a tick must be
            multiples, s, or None if there is no such restriction.
    """

    tick: float
    step: float | None = None

    def fits(self, rate: float, tolerance: float = 1e-9) -> bool:
        """Return whether a plant can be sampled at a rate (Hz)."""
        per_tick = self.tick * rate
        if not 0 < per_tick < math.inf:
            return False
        if per_tick < 1:
            return _is_whole(1 / per_tick, tolerance)
        allowed = self.step is None or _is_whole(1 / (rate * self.step), tolerance)
        return allowed and _is_whole(per_tick, tolerance)

    def rates_near(self, rate: float) -> Iterator[float]:
        """Yield allowed sampling rates close to a given rate, Hz."""
        ticks_per_sample = 1 / (self.tick * rate)
        samples_per_tick = self.tick * rate
        yield from (1 / (k * self.tick) for k in _integers_near(ticks_per_sample))
        if self.step is None:
            yield from (n / self.tick for n in _integers_near(samples_per_tick))
        else:
            steps = round(self.tick / self.step)
            yield from (n / self.tick for n in range(1, steps + 1) if steps % n == 0)


_NEIGHBOUR_COUNT = 20
"""Number of candidate integers on each side of a ratio."""


def _integers_near(number: float) -> range:
    middle = round(min(number, 1e15))
    return range(max(1, middle - _NEIGHBOUR_COUNT), max(1, middle) + _NEIGHBOUR_COUNT)


def nearest_rate(
    rate: float, grids: Sequence[SamplingGrid], low: float = 0.0, high: float = math.inf
) -> str | None:
    """Return the sampling rate that fits all plants and is closest to a given rate.

    Args:
        rate: requested rate, Hz.
        grids: sampling grids of the plants.
        low: minimum allowed rate, Hz.
        high: maximum allowed rate, Hz.

    Returns:
        Rate in Hz as text, or None if no rate fits.
    """
    # Ticks of different lengths coincide at the least common multiple of the lengths.
    ticks = [Fraction(grid.tick).limit_denominator(1_000_000) for grid in grids]
    scale = math.lcm(*(tick.denominator for tick in ticks))
    common = math.lcm(*(max(1, int(tick * scale)) for tick in ticks)) / scale
    candidates = [*SamplingGrid(common).rates_near(rate)]
    candidates += [near for grid in grids for near in grid.rates_near(rate)]

    def fits(rate: float) -> bool:
        # The tolerance is tighter here than in the plants, because the plants add
        # rounding errors when they divide.
        return low <= rate <= high and all(grid.fits(rate, 1e-10) for grid in grids)

    fitting = sorted(
        filter(fits, candidates), key=lambda candidate: abs(math.log(candidate / rate))
    )
    if fitting:
        return shortest_decimal(fitting[0], fits)
    return None
