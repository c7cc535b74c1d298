"""Public docstrings are complete: arguments, fields and exceptions."""

from __future__ import annotations

import dataclasses
import inspect
import re

import pytest

import srs_twin
from srs_twin import errors

pytestmark = pytest.mark.fast

PUBLIC = [getattr(srs_twin, name) for name in srs_twin.__all__ if name != "__version__"]
CLASSES = [item for item in PUBLIC if inspect.isclass(item)]
DATA = [item for item in CLASSES if dataclasses.is_dataclass(item)]


def own_methods(owner):
    """Yield methods that the class introduces; overriding methods inherit the docstring."""
    for name, value in vars(owner).items():
        written = name != "__init__" or owner not in DATA
        if inspect.isfunction(value) and written and (name == "__init__" or not name.startswith("_")):
            if name == "__init__" or not any(hasattr(base, name) for base in owner.__mro__[1:-1]):
                yield value


CALLABLE = [item for item in PUBLIC if inspect.isfunction(item)]
CALLABLE += [method for item in CLASSES if not issubclass(item, Exception) for method in own_methods(item)]


def section(text, title):
    """Return the names that a section of a Google docstring lists."""
    result = re.search(rf"^{title}:\n((?: +.*\n|\n)+)", inspect.cleandoc(text or "") + "\n", re.M)
    return set(re.findall(r"^    \**(\w+):", result[1], re.M)) if result else set()


@pytest.mark.parametrize("given", CALLABLE, ids=lambda given: given.__qualname__)
def test_docstring_names_every_argument(given):
    """A single argument may be described in the first sentence."""
    named = section(given.__doc__, "Args")
    arguments = {name for name in inspect.signature(given).parameters if name != "self"}
    assert named == arguments or (not named and len(arguments) < 2)


@pytest.mark.parametrize("given", DATA, ids=lambda item: item.__name__)
def test_docstring_names_every_field(given):
    assert {item.name for item in dataclasses.fields(given)} == section(given.__doc__, "Attributes")


@pytest.mark.parametrize("given", CALLABLE, ids=lambda given: given.__qualname__)
def test_docstring_names_every_exception(given):
    """Exceptions of the package that the body raises, or their base classes."""
    message = tuple(getattr(errors, name, KeyError) for name in section(given.__doc__, "Raises"))
    for name in re.findall(r"raise (\w+Error)\(", inspect.getsource(given)):
        assert not hasattr(errors, name) or issubclass(getattr(errors, name), message), name
