"""Units of recorded quantities, and their spellings in column names."""

from __future__ import annotations

import re
import unicodedata
from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from srs_twin.errors import InputError

LENGTHS = {"m": 1.0, "cm": 1e-2, "mm": 1e-3, "in": 0.0254, "ft": 0.3048, "um": 1e-6}
TIMES = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9, "min": 60.0}
ANGLES = {"rad": 1.0, "deg": 0.017453292519943295, "mrad": 1e-3}
PRESSURES = {
    "Pa": 1.0,
    "kPa": 1e3,
    "bar": 1e5,
    "psi": 6894.757,
    "MPa": 1e6,
    "mbar": 100.0,
    "hPa": 100.0,
}
PRESSURES |= {
    "mPa": 1e-3,
    "atm": 101325.0,
    "mmHg": 133.322387415,
    "cmH2O": 98.0665,
    "kgf/cm2": 98066.5,
}
"""Units of gauge pressure, without units of absolute pressure (psia, bara)."""
FRACTIONS = {"1": 1.0, "%": 1e-2}

QUANTITIES: dict[str, dict[str, float]] = {
    "time": TIMES,
    "valve": {},
    "duty": FRACTIONS,
    "pressure": PRESSURES,
    "setpoint": PRESSURES,
    "bend": ANGLES,
}
"""Accepted units of each quantity in a log."""

_UNIT_REQUIRED = ("pressure", "setpoint", "bend")
"""Quantities whose unit must be stated if the column has a custom name."""

_SPELLED = (
    'm meter metre,cm centimeter centimetre,mm millimeter millimetre,in inch inche ",ft'
    " foot feet,um micron,um micrometer micrometre,s sec second,min minute,ms msec"
    " milli millisecond,us usec micro microsecond,ns nsec nano nanosecond,rad"
    " radian,deg degree °,mrad milliradian,pa pascal n/m2 pag pagauge,bar barg"
    " bargauge,kpa kilopascal kn/m2 kpag kpagauge,mbar millibar mbarg,hpa hectopascal,%"
    " percent pct,MPa n/mm2 mn/m2 megapascal,psi psig psigauge lbf/in2 lb/in2,atm"
    " atmosphere,mmhg torr,kgf/cm2 kg/cm2"
)
_SYMBOLS = {
    word: line.split()[0] for line in _SPELLED.split(",") for word in line.split()[1:]
}
_MEGA = ("mbar", "mm", "mrad")
"""Symbols that are invalid with a capital M, which would mean mega."""
_ABSOLUTE = re.compile(
    # The word "abs" begins after a separator, P, a unit or a lower-case letter, as in
    # "P_abs", "Pabs", "kPaabs" and "pAbs". The words "Labs" and "slabs" are names.
    r"(?:(?<![A-Za-z])(?:[Pp]ressure|[Pp]ress|[Pp])?|(?<=[a-z])(?=A)|[Pp]a|[Bb]ar|psi)"
    r"[Aa]bs(?:olute)?(?![a-z])"
    r"|(?:(?<![A-Za-z])(?:PRESSURE|PRESS|P)?|(?<=[a-z])|KPA|BAR|PSI)"
    r"ABS(?:OLUTE)?(?![A-Z])"
    # A unit with the suffix "a", as in "psia", "bar(a)" and "kPa_a". After a space or
    # an underscore, a capital A is a name, for example of a port.
    r"|(?i:psi|bar|[khm]pa)(?:[Aa](?![A-Za-z])|[ _]*\([ _]*[Aa](?![A-Za-z0-9])"
    r"|[ _]+a(?![A-Za-z0-9]))"
)
_AMBIENT = (7e4, 1.1e5)
"""Range of ambient pressures up to an altitude of 3000 m, Pa."""
_BRACKETS = re.compile(r"(.*?)\s*[(\[{<]([^()\[\]{}<>]*)[)\]}>]")
_WORD = re.compile(r"(?:[^\W\d_]|°)+(?:/[^\W_]+)?|%")
_CAMEL = re.compile(r"(?<=[a-z])[A-Z]+[a-z]*$")


def clean(text: str) -> str:
    """Normalise Unicode characters, such as µ and ², and spaces in a text."""
    return " ".join(unicodedata.normalize("NFKC", text).split())


def symbol(text: str, units: Mapping[str, float]) -> str:
    """Return the symbol of a unit in any spelling.

    The result is an empty string if `units` does not contain the unit, or if the
    spelling is ambiguous (such as `mpa`).
    """
    word = re.sub(r"[\s^]", "", clean(text).replace("μ", "u"))
    if word in units:
        return word
    folded = word.lower()
    if folded in _MEGA and word[0] == "M" and not word.isupper():
        return ""
    named = _SYMBOLS.get(folded) or _SYMBOLS.get(folded.removesuffix("s")) or folded
    matches = [unit for unit in units if named in (unit, unit.lower())]
    if len(matches) == 1:
        return matches[0]
    return ""


def bracketed(name: str) -> tuple[str, str]:
    """Split a column name such as `P1 (bar)` into the name and the text in brackets."""
    match = _BRACKETS.fullmatch(name.strip())
    if match:
        return (match[1], match[2].strip(" -"))
    return (name, "")


def stated_unit(name: str, units: Mapping[str, float]) -> str | None:
    """Return the unit in a name such as `P1 (bar)`, `time_ms`, `P1/bar` or `timeMs`.

    The result is an empty string without a unit, and None if the unit is unknown, the
    pressure is absolute, or the name contains two different units.
    """
    name = clean(name)
    bare, inside = bracketed(name)
    words: list[str] = _WORD.findall(bare)
    if is_absolute(name, units):
        return None
    if [word.lower() for word in words] == ["pa"]:
        words = []  # "Pa" also names a chamber or port, like "Pb".
    stated = {unit for word in words if (unit := _unit_in_word(word, units)) != ""}
    if inside:
        stated.add(symbol(inside, units) or None)
    if len(stated) > 1 or None in stated:
        return None
    return next(iter(stated), "")


def is_absolute(name: str, units: Mapping[str, float]) -> bool:
    """Return whether a name such as `Pabs (kPa)` states an absolute pressure."""
    return "Pa" in units and bool(_ABSOLUTE.search(name))


def _unit_in_word(word: str, units: Mapping[str, float]) -> str | None:
    camel = _CAMEL.search(word)
    lower = [unit.lower() for unit in units]
    for end in (word, word.rpartition("/")[2], camel[0] if camel else ""):
        if end and (found := symbol(end, units)):
            return found
        if lower.count(end.lower()) > 1:
            return None
    return ""


class Meaning(NamedTuple):
    """Meaning of a column with a custom name, as stated in a recording map.

    Attributes:
        kind: quantity, one of the keys of `QUANTITIES`.
        name: quantity and side, such as "pressure_plus".
        default: unit in the map key, which is used if the column name contains no unit.
        unit: unit that the map states for this column, or an empty string.
    """

    kind: str
    name: str
    number: int = 0
    default: str = ""
    unit: str = ""

    @property
    def key(self) -> str:
        """Name with the segment number, such as "pressure_plus_1"."""
        return f"{self.name}_{self.number}" if self.number else self.name


def unit_of(
    column: str, stated: str | None, units: Mapping[str, float], meaning: Meaning
) -> tuple[str, str]:
    """Return the unit of a mapped column, and a note if the map key has another unit.

    `stated` is the unit in the column name, as returned by `stated_unit`.
    """
    allowed = f"allowed: {', '.join(units) or 'none'}"
    given = symbol(meaning.unit, units)
    default = symbol(meaning.default, units)
    missing = meaning.kind in _UNIT_REQUIRED and not (stated or default)
    if not given and (stated is None or missing):
        problem = (
            f"the unit of the column '{column}' is not known ({allowed});"
            f" give it in the map: {{column: '{column}', unit: …}}"
        )
        if is_absolute(column, units):
            problem += (
                ". The name states an absolute pressure, so give also the ambient"
                " pressure in the map: ambient_kpa: 101.3"
            )
        raise InputError(problem)
    if not stated:
        return given or default, ""
    if given and units[stated] != units[given]:
        raise InputError(
            f"the unit of the column '{column}' is {stated} according to its name, but"
            f" {given} according to the map; correct one of them"
        )
    if default and not given and units[stated] != units[default]:
        return stated, (
            f"the column '{column}' is read in {stated}, as its name states,"
            f" although the map key states {default}"
        )
    return stated, ""


_CLOCK = re.compile("time|timestamps?|stamp|t|epoch|elapsed")
_CLOCK_QUALIFIER = re.compile(
    "since|start|unix|ros|system|host|header|field|log|relative|absolute"
)
"""Additional words that the name of a time column may contain."""


def is_clock(name: str) -> bool:
    """Return whether a name such as `t_ms` or `timestamp [ns]` is a time column."""
    bare, _ = bracketed(clean(name))
    if re.search(r"\d", bare):
        return False
    words = [
        word.lower()
        for word in re.findall(r"[A-Z]*[a-z]+|[A-Z]+", bare.replace("Stamp", "stamp"))
    ]
    units = [word for word in words if symbol(word, TIMES)]
    rest = [word for word in words if word not in units]
    named = any(map(_CLOCK.fullmatch, rest))
    others = [word for word in rest if not _CLOCK.fullmatch(word)]
    if not all(map(_CLOCK_QUALIFIER.fullmatch, others)):
        return False
    return named or (not rest and len("".join(units)) > 1 and units != ["min"])


def looks_absolute(pressures: np.ndarray) -> bool:
    """Return whether the minimum pressure (Pa) is close to the ambient pressure."""
    return bool(_AMBIENT[0] <= np.nanmin(pressures, initial=np.inf) <= _AMBIENT[1])


ABSOLUTE = (
    "The pressures look absolute; to subtract the ambient pressure, set `log:"
    " {ambient_kpa: 101.3}` in a map"
)
