"""Changed fields of a scenario, and the expectations that they invalidate.

A run of a modified scenario is no longer the published experiment, so the title of the
run names the changed fields. If a changed field affects a metric, published
expectations about this metric are omitted.
"""

from __future__ import annotations

import hashlib
import json
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from functools import reduce
from pathlib import PurePath
from typing import Any

from pydantic import Field

from srs_twin.comparison.gait import ENERGY_MEANINGS
from srs_twin.io.documents import Loc, child, format_path, parse_path
from srs_twin.scenario.expectation import COMPARISON, Expectation
from srs_twin.scenario.fields import Line, Section

Changes = Sequence[Mapping[str, Any]]
"""Changed fields, each a mapping with the keys ``field``, ``from`` and ``to``."""

PLANTS = "plants"
"""Field that is reported as changed if a run uses other plants than the file."""

STEADY = frozenset(
    [
        "com_speed_m_s",
        "yaw_rate_rad_s",
        "turning_radius_m",
        "mean_bend_amplitude_rad",
        "amplitude_rel",
        "amplitude_spread_rel",
        "phase_lag_rad",
        "phase_lag_spread_rad",
        "fit_residual_rad",
        "com_speed_rel",
        "gap_factor",
        "yaw_rate_abs",
        "shape_rms_m",
        "shape_rms_body",
        "plan_found",
        "plan_length_m",
        "plan_nodes",
        "plan_max_heading_jump_rad",
    ]
).union(ENERGY_MEANINGS)
"""Metrics that do not depend on the simulated duration, such as plan metrics and means
over gait periods."""

_NAMES = ("name", "title", "changes", "robot.name", "robot.title")
_NO_CONDITION = (
    *(*_NAMES, "expect", "seed", "record_hz", PLANTS),
    *("allow_overpressure", "supply.allow_overpressure"),
)
"""Fields that do not affect published metrics, such as names, the random seed and the
recording rate."""
_MAX_TITLE_LENGTH = 64
"""Maximum number of characters that describe the changes in a title."""
_DIGEST = ", sha256 "
"""Separator before the digest that abbreviates a long value."""
_MAX_VALUES = 24
"""Maximum length of a list that is shown in full instead of as a digest."""


class ChangedField(Section):
    """Field changed after the scenario file was read."""

    field: Line
    """Path of the field, in the format of --set."""
    before: Any = Field(
        default=None,
        alias="from",
        title="From",
        description="Value in the file, or the default value.",
    )
    to: Any = None
    """New value."""


def changed_fields(
    before: Mapping[str, object],
    after: Mapping[str, object],
    locs: Iterable[Loc],
    earlier: Changes = (),
) -> list[dict[str, object]]:
    """Return the fields in which two resolved scenarios differ.

    Args:
        before: plain data of the unmodified scenario.
        after: plain data of the modified scenario.
        locs: paths of the fields that were set. Blocks are compared field by field.
        earlier: changes that `before` already contains. Fields that have returned to
            the original value are omitted.
    """
    known = {change["field"]: change.get("from") for change in earlier}
    paths = {field: parse_path(field) for field in known if field != PLANTS}
    for loc in locs:
        paths |= {format_path(leaf): leaf for leaf in _leaves(loc, before, after)}
    changes = [
        change
        for change in map(dict, earlier)
        if change["field"] == PLANTS and PLANTS not in paths
    ]
    for field, path in paths.items():
        was = known.get(field, _value(before, path))
        now = _value(after, path)
        if was != now:
            changes.append({"field": field, "from": was, "to": now})
    return changes


def with_plants(
    changes: Changes, named: Sequence[str], run: Sequence[str]
) -> list[dict[str, object]]:
    """Return the changes, with an entry for the plants if the run uses other plants."""
    rest = [dict(change) for change in changes if change["field"] != PLANTS]
    if set(named) == set(run):
        return rest
    return [*rest, {"field": PLANTS, "from": list(named), "to": list(run)}]


def marked(title: str, changes: Changes) -> str:
    """Append the changed fields to a title."""
    if changes:
        return f"{title} (modified: {changes_text(changes)})"
    return title


def changes_text(changes: Changes) -> str:
    """Return the changed fields and values as text, or a summary if they are long."""
    texts = [f"{c['field']} {text_of(c['from'])} → {text_of(c['to'])}" for c in changes]
    text = ", ".join(texts)
    if len(text) <= _MAX_TITLE_LENGTH:
        return text
    if len(changes) > 1:
        return f"{len(changes)} fields"
    return str(changes[0]["field"])


def text_of(value: object) -> str:
    """Format the value of a field on one line."""
    match value:
        case None:
            return "unset"
        case float():
            return f"{value:.6g}"
        case list() if not any(isinstance(item, list | dict) for item in value):
            return ", ".join(map(text_of, value)) or "none"
        case str():
            if "/" in value:
                return PurePath(value).name
            return value.partition(_DIGEST)[0]
    return json.dumps(value, ensure_ascii=False)


def invalidated_by(expectation: Expectation, changes: Changes) -> list[str]:
    """Return the changed fields that invalidate an expectation.

    Expectations with `source`, `published` or `expected_failure` refer to the
    unmodified scenario. Other expectations are bounds that also apply to modified
    scenarios.
    """
    if (expectation.source, expectation.published, expectation.expected_failure) == (
        None,
    ) * 3:
        return []
    fields = (str(change["field"]) for change in changes)
    return [
        field
        for field in fields
        if affects(field, expectation.metric, expectation.subject)
    ]


def affects(field: str, metric: str, subject: str) -> bool:
    """Return whether a changed field affects the conditions of a published metric.

    The subject of the metric is "analytical", "twin" or "comparison".
    """
    first, *rest = re.split(r"[.\[]", field)
    if field in _NO_CONDITION or first == "expect":
        return False
    if field == "duration_s":
        return metric not in STEADY
    if first == PLANTS:
        return subject in (rest[0], COMPARISON)
    return first != COMPARISON or subject == COMPARISON


def left_out_line(left_out: Sequence[Mapping[str, Any]]) -> list[str]:
    """Return a list with one line about omitted expectations, or an empty list."""
    if not left_out:
        return []
    metrics = ", ".join(
        dict.fromkeys(f"{row['of']} {row['metric']}" for row in left_out)
    )
    fields = dict.fromkeys(field for row in left_out for field in row["because"])
    plural = "s" if len(left_out) > 1 else ""
    verb = "was" if len(fields) == 1 else "were"
    return [
        f"left out: {len(left_out)} expectation{plural} of the unmodified scenario"
        f" ({metrics}), because {', '.join(fields)} {verb} changed"
    ]


def _leaves(loc: Loc, before: object, after: object) -> Iterator[Loc]:
    if format_path(loc) in _NAMES:
        return
    if loc[:2] == ("robot", "base"):
        loc = ("robot",)
    if loc == ("robot",) and _value(before, loc) != _value(after, loc):
        yield loc
        return
    one: Any = reduce(child, loc, before)
    other: Any = reduce(child, loc, after)
    if not (_is_block(one) and _is_block(other)):
        if _value(before, loc) != _value(after, loc):
            yield loc
        return
    if loc == (PLANTS,) and set(one) != set(other):
        yield loc
    for key in dict.fromkeys((*one, *other)):
        if loc != (PLANTS,) or (key in one and key in other):
            yield from _leaves((*loc, key), before, after)


def _is_block(value: object) -> bool:
    return isinstance(value, Mapping) and not {"value", "unit"} <= value.keys()


def _value(document: object, loc: Loc) -> object:
    """Return the value at a path for display.

    Robots and plants are represented by their names, records with a unit by their
    numbers, and long lists by a digest.
    """
    value = reduce(child, loc, document)
    if loc == ("robot",) and isinstance(value, Mapping):
        return value.get("name") or value.get("base")
    if loc == (PLANTS,) and isinstance(value, Mapping):
        return sorted(value)
    if isinstance(value, Mapping) and not _is_block(value):
        value = value["value"]
    text = json.dumps(value, sort_keys=True)
    if (count := text.count(",") + 1) > _MAX_VALUES:
        return f"{count} values{_DIGEST}{hashlib.sha256(text.encode()).hexdigest()[:8]}"
    return value
