"""Validation of plain data by strict pydantic models, with simple error messages."""

from __future__ import annotations

import ast
import inspect
import json
import math
import re
import sys
import warnings
from collections.abc import Iterable, Iterator, Mapping, Sequence
from functools import cache, reduce
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, TypeVar

from pydantic import BaseModel, ConfigDict, ValidationError

from srs_twin.errors import (
    MAX_LISTED_NAMES,
    RENAMED,
    RenamedWarning,
    did_you_mean,
    format_names,
)
from srs_twin.io.documents import (
    Document,
    Loc,
    child,
    format_path,
    has_child,
    load_yaml,
    resolve_scalar,
)

if TYPE_CHECKING:
    from pydantic_core import ErrorDetails

Schema = Mapping[str, Any]

Model = TypeVar("Model", bound=BaseModel)

_LIST_HINT = "`srs-twin schema`"
# Numbers with these units are often given with a wrong prefix, such as mm for m.
_SCALED_SUFFIXES = ("_kpa", "_m", "_mm", "_kg", "_s", "_ml", "_nm_per_rad")
_BLOCK = "a block of keys"
_WITH_UNIT = re.compile(
    r"[-+]?[0-9.]+(e[-+]?[0-9]+)? ?[^\W\d_][\w/*·%]*", re.IGNORECASE
)
_ANY = object()
RETIRED_KINDS = {
    "compliant_gait": (
        "it was retired, because none of its reactions to contact clearly increased the"
        " speed (docs/friction.md#yielding-gaits)"
    ),
    "greedy": (
        "it was retired; use best_first (`benchmarks/common/greedy.py` still"
        " contains it)"
    ),
    "ompl": (
        "it was retired; use best_first (`benchmarks/common/rrt_connect.py` still"
        " contains it)"
    ),
    "beside": (
        "it was retired; `srs-twin reproduce` compares results with published values"
    ),
    "contour": (
        "it was retired; use the kind `line`, with one of the two fields under"
        " the key `by`"
    ),
}
"""Hint about each removed kind or key, which names its replacement or the reason for
its removal."""
_COUNT_LIMITS = {
    "too_short": ("min_length", "at least "),
    "too_long": ("max_length", "at most "),
}
"""Name of the limit in pydantic's error context and its wording, keyed by error type.
"""
_COUNT_KEYWORDS = {"too_short": "minItems", "too_long": "maxItems"}
"""JSON Schema keyword of the limit, keyed by error type."""
_NUMERIC_TYPES = ("number", "integer")
_UNION_TAG_ERRORS = ("union_tag_invalid", "union_tag_not_found")


@cache
def _module_docstrings(module: str) -> dict[str, dict[str, str]]:
    docstrings: dict[str, dict[str, str]] = {}
    try:
        tree = ast.parse(inspect.getsource(sys.modules[module]))
    except (OSError, TypeError):
        return docstrings  # a class from an interactive shell has no source
    for cls in (node for node in tree.body if isinstance(node, ast.ClassDef)):
        for key, docstring in pairwise(cls.body):
            if isinstance(key, ast.AnnAssign) and isinstance(docstring, ast.Expr):
                text = " ".join(ast.literal_eval(docstring.value).split())
                docstrings.setdefault(cls.name, {})[ast.unparse(key.target)] = text
    return docstrings


def attribute_docstrings(cls: type[StrictModel]) -> dict[str, str]:
    """Return the attribute docstrings of a model and its base classes, by key.

    The source code is parsed only when the docstrings are needed, because
    `use_attribute_docstrings` of pydantic takes 0.2 s at every import.
    """
    texts: dict[str, str] = {}
    for base in reversed(
        [base for base in cls.__mro__ if issubclass(base, StrictModel)]
    ):
        texts |= _module_docstrings(base.__module__).get(base.__name__, {})
    return texts


def _add_descriptions(schema: dict[str, Any], cls: type[StrictModel]) -> None:
    for key, text in attribute_docstrings(cls).items():
        schema["properties"][key].setdefault("description", text)


class StrictModel(BaseModel):
    """Base class of all file models.

    A model rejects unknown keys, infinite numbers and NaN, and does not convert types.
    Attribute docstrings become the descriptions of the keys in JSON Schemas. The
    optional method `contradictions()` yields the path and a message for each violated
    constraint between keys.

    Attributes:
        elsewhere: correct path of each key that belongs to another block, keyed by the
            path at which users may expect it.
    """

    elsewhere: ClassVar[dict[str, str]] = {}

    model_config = ConfigDict(
        strict=True,
        extra="forbid",
        allow_inf_nan=False,
        frozen=True,
        json_schema_extra=_add_descriptions,
    )


def load_model(model: type[Model], path: Path, paths: Mapping[Loc, str] = {}) -> Model:
    """Load and validate a YAML file."""
    document = load_yaml(path)
    for loc, kind in paths.items():
        document.locate(loc, kind)
    file = validate(model, document, document.data)
    document.raise_problems()
    assert file is not None, "a document without problems has a model"
    return file


def validate(
    model: type[Model], document: Document, data: object, *, prefix: Loc = ()
) -> Model | None:
    """Convert plain data to a model, or report all problems and return None."""
    try:
        file = model.model_validate_json(json.dumps(data), strict=True)
    except ValidationError as error:
        schema = _schema_of(model)
        if _adopt_current_names(error, schema, data):
            return validate(model, document, data, prefix=prefix)
        elsewhere = getattr(model, "elsewhere", {})
        items = [
            item for item in error.errors(include_url=False) if not _miscounts(item)
        ]
        inside = {_existing_path(item["loc"], data)[:-1] for item in items}
        for item in items:
            # The path of an error does not exist in the data if a key is missing or a
            # default value contradicts the given keys.
            loc = _existing_path(item["loc"], data)
            # A block with wrong keys was not meant as one of the literals.
            if loc in inside and item["type"] == "literal_error":
                continue
            if item["type"] in _UNION_TAG_ERRORS:
                _report_block_kind(document, item, prefix + loc)
                continue
            absent = _is_absent(item, schema, loc, data)
            loc = (*loc, item["loc"][-1]) if absent else loc
            message = _message(item, schema, loc, data)
            if (
                item["type"] == "extra_forbidden"
                and (path := format_path(loc)) in elsewhere
            ):
                message = f"unknown key; did you mean {elsewhere[path]}?"
            user_loc = prefix + loc if absent else document.user_path(prefix, loc)
            document.report(user_loc, message, at_key=item["type"] == "extra_forbidden")
        return None
    valid = True
    if hasattr(file, "contradictions"):
        for loc, message in file.contradictions():
            document.report(document.user_path(prefix, loc), message)
            valid = False
    if valid:
        return file
    return None


def _adopt_current_names(error: ValidationError, schema: Schema, data: Any) -> bool:
    """Replace renamed keys and kinds in the data, and return whether any existed."""
    adopted: dict[str, str] = {}
    for item in error.errors(include_url=False):
        *parents, key = _existing_path(item["loc"], data) or ("",)
        block = reduce(child, parents, data)
        if item["type"] == "literal_error":
            former = item["input"]
            current = RENAMED.get(former) if isinstance(former, str) else None
            if current is not None and repr(current) in item["ctx"]["expected"]:
                block[key] = adopted[former] = current
        elif item["type"] == "extra_forbidden":
            current = RENAMED.get(str(key))
            allowed = _allowed_keys(schema, tuple(parents), data)
            if current in allowed and not has_child(block, current):
                block[current] = block.pop(key)
                adopted[str(key)] = current
    for former, current in adopted.items():
        warnings.warn(f"{former} is now called {current}", RenamedWarning, 2)
    return bool(adopted)


@cache
def _schema_of(model: type[StrictModel]) -> Schema:
    return model.model_json_schema()


def accepts_only_integers(model: type[StrictModel], loc: Loc, data: object) -> bool:
    """Return whether the numbers at a path must be integers.

    Args:
        model: model of a file.
        loc: path of a value in the file.
        data: file as plain data, which selects the kinds of blocks.
    """
    schema = _schema_of(model)
    types = {
        option.get("type")
        for at_path in _schemas_at(schema, loc, data)
        for option in _alternatives(at_path, schema)
    }
    return "integer" in types and "number" not in types


def describe_schema(schema: Schema, root: Schema, *, brief: bool = False) -> str:
    """Describe the values of a JSON Schema, as in 'a number from 0.01 to 50'.

    If `brief` is true, a long list of choices is replaced by the number of choices.
    """
    texts = [
        _describe_option(option, root, brief) for option in _alternatives(schema, root)
    ]
    if sum(text.startswith(_BLOCK) for text in texts) > 2:
        texts = [_BLOCK if text.startswith(_BLOCK) else text for text in texts]
    return " or ".join(dict.fromkeys(filter(None, texts)))


def _report_block_kind(document: Document, item: ErrorDetails, loc: Loc) -> None:
    context = item["ctx"]
    block = item["input"]
    key = context["discriminator"].strip("'")
    if not isinstance(block, Mapping):
        document.report(
            loc, f"must be a block of keys with {key}, not {_describe_value(block)}"
        )
    elif not has_child(block, key):
        document.report((*loc, key), "missing; it selects the kind of this block")
    else:
        names = [
            name.strip("'") for name in context.get("expected_tags", "").split(", ")
        ]
        value = child(block, key)
        close = _hint(value, names)
        document.report(
            (*loc, key),
            f"must be one of {format_names(names)}, not"
            f" {_describe_value(value)}{close}",
        )


def _hint(value: object, names: Iterable[str]) -> str:
    if not isinstance(value, str):
        return ""
    if value in RETIRED_KINDS:
        return f": {RETIRED_KINDS[value]}"
    return did_you_mean(value, names)


def _describe_unknown_key(key: object, allowed: Sequence[str]) -> str:
    if str(key).isdecimal():
        return "unknown key; a decimal number is written with a point, not with a comma"
    if close := _hint(key, allowed):
        return f"unknown key{close}"
    listed = ", ".join(allowed[:MAX_LISTED_NAMES])
    if len(allowed) > MAX_LISTED_NAMES:
        listed += f", … ({_LIST_HINT} lists all {len(allowed)})"
    return f"unknown key; allowed: {listed}"


def _message(item: ErrorDetails, schema: Schema, loc: Loc, data: object) -> str:
    kind = item["type"]
    if kind == "extra_forbidden":
        return _describe_unknown_key(loc[-1], _allowed_keys(schema, loc[:-1], data))
    if kind == "value_error":
        return str(item["ctx"]["error"])
    options = list(_schemas_at(schema, loc, data))
    words = " or ".join(
        dict.fromkeys(describe_schema(option, schema, brief=True) for option in options)
    )
    if kind == "missing":
        return "; it must be ".join(filter(None, ["missing", words]))
    value = item["input"]
    flat = [inner for option in options for inner in _alternatives(option, schema)]
    if kind in _COUNT_LIMITS:
        return _describe_wrong_count(item, flat)
    choices = [choice for option in options for choice in _choices(option, schema)]
    if isinstance(value, str):
        close = _suggest_for_text(value, flat, choices)
    else:
        close = _suggest_unit(value, loc, flat)
    described = _describe_value(value)
    if kind == "int_type" and isinstance(value, float) and value.is_integer():
        # Without the decimal point, the value would look like an allowed value.
        described = repr(value)
        if any(_accepts(option, int(value)) for option in flat):
            close = f"; write it as a whole number, such as {int(value)}"
    return f"must be {words}, not {described}{close}"


def _miscounts(item: ErrorDetails) -> bool:
    # Pydantic counts only the valid entries of a list.
    kind = item["type"]
    return kind == "too_short" and len(item["input"]) >= item["ctx"]["min_length"]


def _describe_wrong_count(item: ErrorDetails, options: Iterable[Schema]) -> str:
    name, bound = _COUNT_LIMITS[item["type"]]
    limit = item["ctx"][name]
    keyword = _COUNT_KEYWORDS[item["type"]]
    failed = [option for option in options if option.get(keyword) == limit]
    if failed and all(
        option.get("minItems") == option.get("maxItems") for option in failed
    ):
        bound = ""
    noun = "entry" if limit == 1 else "entries"
    return f"must have {bound}{limit} {noun}, not {len(item['input'])}"


def _suggest_for_text(
    value: str, options: Iterable[Schema], choices: Sequence[Any]
) -> str:
    numeric = [option for option in options if option.get("type") in _NUMERIC_TYPES]
    unquoted = resolve_scalar(value)
    if any(_accepts(option, unquoted) for option in numeric):
        return "; write the number without quotes"
    if numeric and _WITH_UNIT.fullmatch(value):
        return "; write the number without its unit, which the key states"
    if len(choices) > 1:
        return _hint(value, choices)
    return ""


def _accepts(option: Schema, value: object) -> bool:
    """Return whether a schema of a number accepts a value."""
    if option.get("type") == "integer":
        is_number = isinstance(value, int)
    else:
        is_number = isinstance(value, int | float)
    return (
        is_number
        and not isinstance(value, bool)
        and option.get("minimum", -math.inf) <= value <= option.get("maximum", math.inf)
        and option.get("exclusiveMinimum", -math.inf) < value
        and value < option.get("exclusiveMaximum", math.inf)
    )


def _suggest_unit(value: object, loc: Loc, options: Iterable[Schema]) -> str:
    if (
        isinstance(value, bool)
        or not isinstance(value, int | float)
        or not 0 < abs(value) < 1e300
    ):
        return ""
    # The unit is part of the key of a record, not of the key `value` inside the record.
    key = next(
        (key for key in reversed(loc) if isinstance(key, str) and key != "value"), ""
    )
    factors = [1e-3, 1e3] * key.endswith(_SCALED_SUFFIXES) + [
        math.pi / 180
    ] * key.endswith("_rad")
    for option in options:
        low = option.get("minimum")
        high = option.get("maximum")
        if low is not None and high is not None and not low <= value <= high:
            for fitting in (factor * value for factor in factors):
                if low < fitting < high:
                    return f"; did you mean {fitting:.4g}?"
            return ""
    return ""


def _existing_path(loc: Loc, data: object) -> Loc:
    existing: list[str | int] = []
    for key in loc:
        if has_child(data, key):
            data = child(data, key)
            existing.append(key)
    return tuple(existing)


def _is_absent(item: ErrorDetails, schema: Schema, loc: Loc, data: object) -> bool:
    last = item["loc"][-1] if item["loc"] else None
    known = (
        item["type"] == "value_error" and isinstance(last, str) and loc[-1:] != (last,)
    )
    return item["type"] == "missing" or (
        known and last in _allowed_keys(schema, loc, data)
    )


def _describe_value(value: Any) -> str:
    if value is None:
        return "nothing"
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, str):
        if len(value) <= 40:
            return f"text {value!r}"
        return f"text {value[:40]!r}…"
    if isinstance(value, dict):
        return "a block of keys"
    if isinstance(value, list):
        return f"a list of {len(value)}"
    return _format_number(value)


def _format_number(value: float) -> str:
    # This includes integers that are too large for a float.
    if abs(value) > 1e300:
        return "infinity"
    if math.isnan(value):
        return "NaN"
    if value == int(value) and abs(value) < 1e15:
        return str(int(value))
    return f"{value:g}"


def _describe_option(schema: Schema, root: Schema, brief: bool) -> str:
    if choices := _choices(schema, root):
        return _describe_choices(choices, brief)
    match schema.get("type"):
        case "number":
            return f"a number{_describe_range(schema)}"
        case "integer":
            return f"a whole number{_describe_range(schema)}"
        case "array":
            return _describe_list(schema, root, brief)
        case "object":
            if keys := ", ".join(schema.get("properties", {})):
                return f"{_BLOCK} ({keys})"
            return _BLOCK
        case "string":
            if longest := schema.get("maxLength"):
                rule = schema.get("$comment", "")
                return f"text of 1 to {longest} characters{rule}"
            return "text"
        case "boolean":
            return "true or false"
    return ""


def _describe_choices(choices: list[object], brief: bool) -> str:
    names = [c if isinstance(c, str) else json.dumps(c) for c in choices]
    if len(names) == 1:
        return names[0]
    if brief:
        return f"one of {format_names(names, _LIST_HINT)}"
    return f"one of {', '.join(names)}"


def _describe_list(schema: Schema, root: Schema, brief: bool) -> str:
    text = "a list"
    if schema.get("minItems") == schema.get("maxItems", -1):
        text += f" of {schema['minItems']}"
    elif schema.get("minItems", 0) > 1 and "maxItems" in schema:
        text += f" of {schema['minItems']} to {schema['maxItems']}"
    if inner := describe_schema(schema.get("items", {}), root, brief=brief):
        text += f" (each {inner})"
    return text


def _describe_range(schema: Schema) -> str:
    low = schema.get("minimum")
    high = schema.get("maximum")
    if low is not None and high is not None:
        return f" from {_format_number(low)} to {_format_number(high)}"
    if schema.get("exclusiveMinimum") == 0:
        return " above 0" + (f" and up to {_format_number(high)}" if high else "")
    if low is not None:
        return f" of at least {_format_number(low)}"
    return ""


def _choices(schema: Schema, root: Schema) -> list[Any]:
    choices: list[Any] = []
    for option in _alternatives(schema, root):
        choices += [option["const"]] if "const" in option else option.get("enum", ())
    return choices


def _alternatives(
    schema: Schema, root: Schema, data: object = _ANY
) -> Iterator[Schema]:
    while "$ref" in schema:
        schema = root["$defs"][schema["$ref"].rsplit("/", 1)[1]]
    inner = schema.get("anyOf") or schema.get("oneOf")
    if not inner:
        yield schema
        return
    key = schema.get("discriminator", {}).get("propertyName")
    for member in inner:
        for option in _alternatives(member, root, data):
            kind = option.get("properties", {}).get(key, {})
            if data is _ANY or key is None or kind.get("const") == child(data, key):
                yield option


def _schemas_at(root: Schema, loc: Loc, data: object) -> Iterator[Schema]:
    schemas: list[Schema] = [root]
    for key in loc:
        inner_schemas: list[Schema] = []
        for schema in schemas:
            for option in _alternatives(schema, root, data):
                if isinstance(key, str):
                    inner = option.get("properties", {}).get(
                        key, option.get("additionalProperties")
                    )
                else:
                    inner = option.get("items")
                if isinstance(inner, Mapping):
                    inner_schemas.append(inner)
        schemas = inner_schemas
        data = child(data, key)
    yield from schemas


def _allowed_keys(root: Schema, loc: Loc, data: object) -> list[str]:
    block = reduce(child, loc, data)
    found: dict[str, None] = {}
    for schema in _schemas_at(root, loc, data):
        for option in _alternatives(schema, root, block):
            found |= dict.fromkeys(option.get("properties", {}))
    return list(found)
