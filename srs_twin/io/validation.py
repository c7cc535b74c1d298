"""Plain data against a strict pydantic model; what does not fit is said in words, where it stands."""

from __future__ import annotations

import ast
import inspect
import json
import math
import re
import sys
from collections.abc import Iterable, Iterator, Mapping
from functools import cache
from itertools import pairwise
from pathlib import Path
from typing import Any, ClassVar, TypeVar

from pydantic import BaseModel, ConfigDict, ValidationError

from srs_twin.errors import did_you_mean, some
from srs_twin.io.documents import Document, Loc, child, has_child, load_yaml

Schema = Mapping[str, Any]
Model = TypeVar("Model", bound=BaseModel)

_LISTED = "`srs-twin schema` or docs/reference"
# Keys whose numbers are usual in a unit of a thousandth or a thousand as well.
_PREFIXED = ("_kpa", "_m", "_mm", "_kg", "_s", "_ml", "_nm_per_rad")
_BLOCK = "a block of keys"
_WITH_UNIT = re.compile(r"[-+]?[0-9.]+(e[-+]?[0-9]+)? ?[^\W\d_][\w/*·%]*", re.IGNORECASE)
_NO_SUCH_KIND = ("union_tag_invalid", "union_tag_not_found")


@cache
def _docstrings(module: str) -> dict[str, dict[str, str]]:
    """Return what stands below the keys of a module's classes: class → key → text in one line."""
    found: dict[str, dict[str, str]] = {}
    try:
        tree = ast.parse(inspect.getsource(sys.modules[module]))
    except (OSError, TypeError):
        return found  # a class that was typed into a shell
    for cls in (each for each in tree.body if isinstance(each, ast.ClassDef)):
        for key, below in pairwise(cls.body):
            if isinstance(key, ast.AnnAssign) and isinstance(below, ast.Expr):
                text = " ".join(ast.literal_eval(below.value).split())
                found.setdefault(cls.name, {})[ast.unparse(key.target)] = text
    return found


def docstrings(cls: type[Strict]) -> dict[str, str]:
    """Return what stands below the keys of a model and of its bases: key → text in one line.

    Read when a schema is asked for: pydantic's `use_attribute_docstrings` takes 0.2 s at every import.
    """
    texts: dict[str, str] = {}
    for base in reversed([each for each in cls.__mro__ if issubclass(each, Strict)]):
        texts |= _docstrings(base.__module__).get(base.__name__, {})
    return texts


def _describe(schema: dict[str, Any], cls: type[Strict]) -> None:
    """Say of each key what its docstring says."""
    for key, text in docstrings(cls).items():
        schema["properties"][key].setdefault("description", text)


class Strict(BaseModel):
    """Base of all models of files: no conversions, no unknown keys, finite numbers only.

    The docstring of a key is its description in JSON schemas.
    A model whose parts may contradict each other has `contradictions()`: path and message of each.

    Attributes:
        elsewhere: keys that people look for here, and where they are.
    """

    elsewhere: ClassVar[dict[str, str]] = {}

    model_config = ConfigDict(
        strict=True, extra="forbid", allow_inf_nan=False, frozen=True, json_schema_extra=_describe
    )


def load_model(model: type[Model], path: Path) -> Model:
    """Load and check a YAML file.

    Args:
        model: a subclass of `Strict`.
        path: of the file.

    Raises:
        InputError: not readable.
        InputFileError: everything that is wrong with it.
    """
    document = load_yaml(path)
    file = validate(model, document, document.data)
    document.finish()
    assert file is not None, "a file without a problem was checked"
    return file


def validate(model: type[Model], document: Document, data: Any, *, prefix: Loc = ()) -> Model | None:
    """Return plain data as a model, or None after reporting all that is wrong to the document.

    Args:
        model: a subclass of `Strict`.
        document: what the problems are reported to.
        data: plain data, ``document.data`` or a part of it.
        prefix: path of the data in the document.
    """
    try:
        file = model.model_validate_json(json.dumps(data), strict=True)
    except ValidationError as error:
        schema, elsewhere = _schema_of(model), getattr(model, "elsewhere", {})
        for item in error.errors(include_url=False):
            # What is missing, and a default that does not fit what was given, are not in the data.
            loc = _locate(item["loc"], data)
            if item["type"] in _NO_SUCH_KIND:
                _report_kind(document, item, prefix + loc)
                continue
            absent = _is_absent(item, schema, loc, data)
            loc = (*loc, item["loc"][-1]) if absent else loc
            message = _message(item, schema, loc, data)
            if item["type"] == "extra_forbidden" and loc[1:] == () and loc[0] in elsewhere:
                message = f"unknown key; did you mean {elsewhere[str(loc[0])]}?"
            where = prefix + loc if absent else document.visible(prefix, loc)
            document.report(where, message, at_key=item["type"] == "extra_forbidden")
        return None
    contradictions = list(file.contradictions()) if hasattr(file, "contradictions") else []
    for loc, message in contradictions:
        document.report(document.visible(prefix, loc), message)
    return None if contradictions else file


@cache
def _schema_of(model: type[Strict]) -> Schema:
    """Return the JSON schema of a model; putting one together takes longer than checking a file."""
    return model.model_json_schema()


def allowed(schema: Schema, root: Schema, *, brief: bool = False) -> str:
    """Return in words what a JSON schema admits: 'a number from 0.01 to 50'.

    Args:
        schema: the schema of one value.
        root: the whole schema, which holds the definitions.
        brief: say of many choices how many they are.
    """
    texts = [_allowed(option, root, brief) for option in _options(schema, root)]
    if sum(text.startswith(_BLOCK) for text in texts) > 2:
        texts = [_BLOCK if text.startswith(_BLOCK) else text for text in texts]
    return " or ".join(dict.fromkeys(filter(None, texts)))


def _report_kind(document: Document, item: Any, loc: Loc) -> None:
    """Report a block that does not say which of several kinds it is."""
    context, block = item["ctx"], item["input"]
    key = context["discriminator"].strip("'")
    if not isinstance(block, Mapping):
        document.report(loc, f"must be a block of keys with {key}, not {_given(block)}")
    elif not has_child(block, key):
        document.report((*loc, key), "missing; it says which of several blocks of keys this is")
    else:
        names = [name.strip("'") for name in context.get("expected_tags", "").split(", ")]
        given = child(block, key)
        close = did_you_mean(given, names) if isinstance(given, str) else ""
        document.report((*loc, key), f"must be one of {some(names)}, not {_given(given)}{close}")


def _message(item: Any, schema: Schema, loc: Loc, data: Any) -> str:
    kind = item["type"]
    if kind == "extra_forbidden":
        keys = _keys(schema, loc[:-1], data)
        close = did_you_mean(str(loc[-1]), keys)
        if str(loc[-1]).isdigit():
            return "unknown key; a number has a decimal point, no comma"
        return f"unknown key{close or f'; known here: {some(keys, _LISTED)}'}"
    if kind == "value_error":
        return str(item["ctx"]["error"])
    options = list(_schemas_at(schema, loc, data))
    words = " or ".join(dict.fromkeys(allowed(option, schema, brief=True) for option in options))
    if kind == "missing":
        return f"missing; it must be {words}"
    given, flat = item["input"], [each for option in options for each in _options(option, schema)]
    choices = [c for o in options for c in _choices(o, schema)]
    close = did_you_mean(given, choices) if isinstance(given, str) and len(choices) > 1 else ""
    if isinstance(given, str) and _WITH_UNIT.fullmatch(given) and any("minimum" in each for each in flat):
        close = "; write the number alone, its unit stands in the key"
    return f"must be {words}, not {_given(given)}{close or _in_another_unit(given, loc, flat)}"


def _in_another_unit(given: Any, loc: Loc, options: Iterable[Schema]) -> str:
    """Return '; did you mean 48.3?' for a number that is allowed in another usual unit of its key."""
    if isinstance(given, bool) or not isinstance(given, int | float) or not 0 < abs(given) < 1e300:
        return ""
    key = next((part for part in reversed(loc) if isinstance(part, str) and part != "value"), "")
    factors = [1e-3, 1e3] * key.endswith(_PREFIXED) + [math.pi / 180] * key.endswith("_rad")
    for option in options:
        low, high = option.get("minimum"), option.get("maximum")
        if low is not None and high is not None and not low <= given <= high:
            fitting = [factor * given for factor in factors if low < factor * given < high]
            return f"; did you mean {fitting[0]:.4g}?" if fitting else ""
    return ""


def _locate(loc: Loc, data: Any) -> Loc:
    """Drop what pydantic puts into a path that is not in the data: names of union members, absent keys."""
    kept: list[str | int] = []
    for part in loc:
        if has_child(data, part):
            data = child(data, part)
            kept.append(part)
    return tuple(kept)


def _is_absent(item: Any, schema: Schema, loc: Loc, data: Any) -> bool:
    """Say whether a problem is with a key that its block does not have: it is missing, or its default."""
    last = item["loc"][-1] if item["loc"] else None
    known = item["type"] == "value_error" and isinstance(last, str) and loc[-1:] != (last,)
    return item["type"] == "missing" or (known and last in _keys(schema, loc, data))


def _given(value: Any) -> str:
    """Return a value as a person who wrote it in YAML recognises it."""
    if value is None:
        return "nothing"
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, str):
        return f"text {value!r}" if len(value) <= 40 else f"text {value[:40]!r}…"
    if isinstance(value, dict):
        return "a block of keys"
    return f"a list of {len(value)}" if isinstance(value, list) else _number(value)


def _number(value: float) -> str:
    """Return a number as text: whole ones in full, others short."""
    if value != value:
        return "NaN"
    if abs(value) > 1e300:
        return "infinity"
    return str(int(value)) if value == int(value) and abs(value) < 1e15 else f"{value:g}"


def _allowed(schema: Schema, root: Schema, brief: bool) -> str:
    if choices := _choices(schema, root):
        names = [c if isinstance(c, str) else json.dumps(c) for c in choices]
        return (
            names[0] if len(names) == 1 else f"one of {some(names, _LISTED) if brief else ', '.join(names)}"
        )
    kind = schema.get("type")
    if kind in ("number", "integer"):
        return ("a whole number" if kind == "integer" else "a number") + _range(schema)
    if kind == "array":
        inner = allowed(schema.get("items", {}), root, brief=brief)
        count = f" of {schema['minItems']}" if schema.get("minItems") == schema.get("maxItems", -1) else ""
        return f"a list{count} (each {inner})" if inner else f"a list{count}"
    if kind == "object":
        keys = ", ".join(schema.get("properties", {}))
        return f"a block of keys ({keys})" if keys else "a block of keys"
    if kind == "string":
        longest = schema.get("maxLength")
        return f"text of 1 to {longest} characters" if longest else "text"
    return {"boolean": "true or false"}.get(str(kind), "")


def _range(schema: Schema) -> str:
    low, high = schema.get("minimum"), schema.get("maximum")
    if low is not None and high is not None:
        return f" from {_number(low)} to {_number(high)}"
    return f" of at least {_number(low)}" if low is not None else ""


def _choices(schema: Schema, root: Schema) -> list[Any]:
    found = []
    for option in _options(schema, root):
        found += [option["const"]] if "const" in option else list(option.get("enum", ()))
    return found


def _options(schema: Schema, root: Schema) -> Iterator[Schema]:
    """Yield what a schema is a choice of, references resolved."""
    while "$ref" in schema:
        schema = root["$defs"][schema["$ref"].rsplit("/", 1)[1]]
    inner = schema.get("anyOf") or schema.get("oneOf")
    if not inner:
        yield schema
        return
    for option in inner:
        yield from _options(option, root)


def _schemas_at(root: Schema, loc: Loc, data: Any) -> Iterator[Schema]:
    """Yield the schemas that a value at a path may have; of blocks of several kinds, that of its kind."""
    found: list[Schema] = [root]
    for part in loc:
        step: list[Schema] = []
        for schema in found:
            for option in _of_its_kind(schema, root, data):
                if isinstance(part, str):
                    inner = option.get("properties", {}).get(part, option.get("additionalProperties"))
                else:
                    inner = option.get("items")
                step += [inner] if isinstance(inner, Mapping) else []
        found, data = step, child(data, part)
    yield from found


def _keys(root: Schema, loc: Loc, data: Any) -> list[str]:
    schemas = list(_schemas_at(root, loc, data))
    for part in loc:
        data = child(data, part)
    return [key for s in schemas for o in _of_its_kind(s, root, data) for key in o.get("properties", {})]


def _of_its_kind(schema: Schema, root: Schema, data: Any) -> list[Schema]:
    """Return what a schema is a choice of, less the blocks that some data are not by their discriminator."""
    while "$ref" in schema:
        schema = root["$defs"][schema["$ref"].rsplit("/", 1)[1]]
    if "anyOf" in schema:  # a block that may be left out is a choice of nothing and of its kinds
        return [o for member in schema["anyOf"] for o in _of_its_kind(member, root, data)]
    key, options = schema.get("discriminator", {}).get("propertyName"), list(_options(schema, root))
    if key is None:
        return options
    return [o for o in options if o.get("properties", {}).get(key, {}).get("const") == child(data, key)]
