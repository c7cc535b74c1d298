"""Public docstrings are complete: arguments, fields and errors."""

from __future__ import annotations

import dataclasses
import inspect
import re

import pytest

import srs_twin
from srs_twin import errors

pytestmark = pytest.mark.fast

PUBLIC = [getattr(srs_twin, name) for name in srs_twin.__all__ if name != "__version__"]
CLASSES = [each for each in PUBLIC if inspect.isclass(each)]
DATA = [each for each in CLASSES if dataclasses.is_dataclass(each)]


def own_methods(owner):
    """Yield methods that are new here; what redefines a method keeps to its docstring."""
    for name, value in vars(owner).items():
        written = name != "__init__" or owner not in DATA
        if (
            inspect.isfunction(value)
            and written
            and (name == "__init__" or not name.startswith("_"))
        ) and (
            name == "__init__"
            or not any(hasattr(base, name) for base in owner.__mro__[1:-1])
        ):
            yield value


CALLABLE = [each for each in PUBLIC if inspect.isfunction(each)]
CALLABLE += [
    method
    for each in CLASSES
    if not issubclass(each, Exception)
    for method in own_methods(each)
]


def section(text, title):
    """Return the names that a section of a Google docstring lists."""
    found = re.search(
        rf"^{title}:\n((?: +.*\n|\n)+)", inspect.cleandoc(text or "") + "\n", re.M
    )
    return set(re.findall(r"^    \**(\w+):", found[1], re.M)) if found else set()


def test_every_argument_is_named():
    """A single argument may be described in the first sentence."""
    for given in CALLABLE:
        named = section(given.__doc__, "Args")
        arguments = {
            name for name in inspect.signature(given).parameters if name != "self"
        }
        assert named == arguments or (not named and len(arguments) < 2), (
            given.__qualname__
        )


def test_every_field_is_named():
    for given in DATA:
        assert {each.name for each in dataclasses.fields(given)} == section(
            given.__doc__, "Attributes"
        ), given.__name__


def test_raised_errors_are_documented():
    """Return the errors of srs_twin that a function raises in its body, with their base classes."""
    for given in CALLABLE:
        documented = tuple(
            getattr(errors, name, KeyError) for name in section(given.__doc__, "Raises")
        )
        for name in re.findall(r"raise (\w+Error)\(", inspect.getsource(given)):
            assert not hasattr(errors, name) or issubclass(
                getattr(errors, name), documented
            ), (given.__qualname__, name)
