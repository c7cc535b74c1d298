"""Fields that differ from the scenario's file, and the expectations that they invalidate.

A run of a modified scenario is not the published experiment any more. Its titles name the changed fields, and
an expectation that refers to the unmodified scenario is left out if a changed field decides its metric.
"""

from __future__ import annotations

import hashlib
import json
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import PurePath
from typing import Any

from pydantic import Field

from srs_twin.comparison.gait import ENERGY_METRICS
from srs_twin.io.documents import Loc, child, format_path, parse_path
from srs_twin.scenario.expectation import COMPARISON, Expectation
from srs_twin.scenario.fields import Line, Section

Changes = Sequence[Mapping[str, Any]]
"""Changed fields as plain data: ``{"field", "from", "to"}`` each."""

PLANTS = "plants"
"""The changed field of a run on other plants than the file names."""

STEADY = frozenset(
    f"""
    com_speed_m_s yaw_rate_rad_s turning_radius_m mean_bend_amplitude_rad {ENERGY_METRICS}
    amplitude_rel amplitude_spread_rel phase_lag_rad phase_lag_spread_rad fit_residual_rad
    com_speed_rel gap_factor yaw_rate_abs shape_rms_m shape_rms_body
    plan_found plan_length_m plan_nodes plan_kink_rad
""".split()
)
"""Metrics that do not depend on the duration: means over periods, shape differences, and plans."""

_NAMES = ("name", "title", "changes", "robot.name", "robot.title")
# They choose what is recorded, judged or allowed, or are random; none is a condition of the experiment.
_NO_CONDITION = (
    *(*_NAMES, "expect", "seed", "record_hz", PLANTS),
    *("allow_overpressure", "supply.allow_overpressure"),
)
_LONGEST = 64  # characters of the changes in a title
_DIGEST = ", sha256 "
_MOST_VALUES = 24  # of a list that is written out


class ChangedField(Section):
    """A field that was changed after the scenario had been read from its file."""

    field: Line
    """Path of the field, as --set takes it."""
    before: Any = Field(
        default=None, alias="from", title="From", description="Value in the file, or the default."
    )
    to: Any = None
    """Value that was set."""


def changed_fields(
    before: Mapping[str, Any], after: Mapping[str, Any], locs: Iterable[Loc], earlier: Changes = ()
) -> list[dict[str, Any]]:
    """Return the fields in which two resolved scenarios differ.

    Args:
        before: plain data of the unmodified scenario.
        after: plain data of the scenario that is run.
        locs: paths that were set; of a block, the values in it are compared.
        earlier: changes that `before` had already; a field that has its first value again is left out.
    """
    known = {each["field"]: each.get("from") for each in earlier}
    paths = {field: parse_path(field) for field in known if field != PLANTS}
    for loc in locs:
        paths |= {format_path(leaf): leaf for leaf in _leaves(loc, before, after)}
    found = [each for each in map(dict, earlier) if each["field"] == PLANTS and PLANTS not in paths]
    for field, path in paths.items():
        was, now = known.get(field, _value(before, path)), _value(after, path)
        if was != now:
            found.append({"field": field, "from": was, "to": now})
    return found


def with_plants(changes: Changes, named: Sequence[str], run: Sequence[str]) -> list[dict[str, Any]]:
    """Return changes with the plants that run where these are not those that the scenario names."""
    rest = [dict(each) for each in changes if each["field"] != PLANTS]
    if set(named) == set(run):
        return rest
    return [*rest, {"field": PLANTS, "from": list(named), "to": list(run)}]


def marked(title: str, changes: Changes) -> str:
    """Return a title that names the changed fields, or says how many they are."""
    return f"{title} (modified: {changes_text(changes)})" if changes else title


def changes_text(changes: Changes) -> str:
    """Return the changed fields with their values, or how many they are if that is too long."""
    texts = [f"{each['field']} {text_of(each['from'])} → {text_of(each['to'])}" for each in changes]
    text = ", ".join(texts)
    if len(text) > _LONGEST:
        text = f"{len(changes)} fields" if len(changes) > 1 else changes[0]["field"]
    return text


def text_of(value: Any) -> str:
    """Return the value of a field in one line."""
    match value:
        case None:
            return "unset"
        case float():
            return f"{value:.6g}"
        case list() if not any(isinstance(each, list | dict) for each in value):
            return ", ".join(map(text_of, value)) or "none"
        case str():
            return PurePath(value).name if "/" in value else value.partition(_DIGEST)[0]
    return json.dumps(value, ensure_ascii=False)


def invalidated_by(each: Expectation, changes: Changes) -> list[str]:
    """Return the changed fields that decide what an expectation says of the unmodified scenario.

    An expectation with `source`, `published` or `known` refers to the unmodified scenario. Other expectations
    are bounds that hold for modified scenarios too.
    """
    if each.source is None and each.published is None and each.known is None:
        return []
    fields = (str(change["field"]) for change in changes)
    return [field for field in fields if decides(field, each.metric, each.subject)]


def decides(field: str, metric: str, subject: str) -> bool:
    """Say whether a changed field changes the conditions under which a metric was published.

    Args:
        field: its path.
        metric: name of the metric.
        subject: "analytical", "twin" or "comparison".
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
    """Return a line that names the expectations that changed fields invalidate; none where there are none.

    Args:
        left_out: as `Scenario.left_out`.
    """
    if not left_out:
        return []
    metrics = ", ".join(dict.fromkeys(f"{each['of']} {each['metric']}" for each in left_out))
    fields = dict.fromkeys(field for each in left_out for field in each["because"])
    count = "1 expectation" if len(left_out) == 1 else f"{len(left_out)} expectations"
    changed = f"{', '.join(fields)} {'was' if len(fields) == 1 else 'were'} changed"
    return [f"left out: {count} of the unmodified scenario ({metrics}), because {changed}"]


def _leaves(loc: Loc, before: Any, after: Any) -> Iterator[Loc]:
    """Yield the paths of different values at and below a path."""
    if format_path(loc) in _NAMES:
        return
    if loc[:2] == ("robot", "base"):
        loc = ("robot",)
    if loc == ("robot",) and _value(before, loc) != _value(after, loc):
        yield loc
        return
    one, other = _at(before, loc), _at(after, loc)
    if not (_is_block(one) and _is_block(other)):
        if _value(before, loc) != _value(after, loc):
            yield loc
        return
    if loc == (PLANTS,) and set(one) != set(other):
        yield loc
    for key in dict.fromkeys((*one, *other)):
        if loc != (PLANTS,) or (key in one and key in other):
            yield from _leaves((*loc, key), before, after)


def _is_block(value: Any) -> bool:
    return isinstance(value, Mapping) and not {"value", "unit"} <= value.keys()


def _at(document: Any, loc: Loc) -> Any:
    for part in loc:
        document = child(document, part)
    return document


def _value(document: Any, loc: Loc) -> Any:
    """Return the value at a path: a robot's name, the plants' names, a record's number; of much, a digest."""
    value = _at(document, loc)
    if loc == ("robot",) and isinstance(value, Mapping):
        return value.get("name") or value.get("base")
    if loc == (PLANTS,) and isinstance(value, Mapping):
        return sorted(value)
    if isinstance(value, Mapping) and not _is_block(value):
        value = value["value"]
    text = json.dumps(value, sort_keys=True)
    if (count := text.count(",") + 1) > _MOST_VALUES:
        return f"{count} values{_DIGEST}{hashlib.sha256(text.encode()).hexdigest()[:8]}"
    return value
