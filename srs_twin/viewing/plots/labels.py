"""What people call a field of a scenario and a metric, with its unit: labels of axes."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from functools import lru_cache
from typing import Any

from srs_twin.comparison.metrics import COMPARISON_UNITS, LIST_METRIC_UNITS, METRIC_UNITS
from srs_twin.comparison.sampling import split_unit as split_metric
from srs_twin.robot.sourced import split_unit
from srs_twin.scenario.file import ScenarioFile

# How names of metrics end, and what is said instead.
_ENDINGS = {
    "_rel": ", relative difference",
    "_abs": ", size of difference",
    "_body": " over body length",
}
_SENTENCES = ("What ", "Which ", "How ")
_LONGEST = 36  # characters of a title from the schema; longer ones are sentences


def field_label(path: str) -> str:
    """Return 'gait frequency (Hz)' for controller.frequency_hz; what nobody titled is called by its key."""
    parts = path.split(".")
    name, unit = split_unit(parts[-1])
    title = re.split(r" \(|[,:]", _title(path))[0]
    if not 0 < len(title) <= _LONGEST or title.startswith(_SENTENCES):
        group = parts[-2] if len(parts) > 1 and parts[0] != "plants" else ""
        title = f"{group} {_spaced(name)}".strip()
    title = title if title[:2].isupper() else title[:1].lower() + title[1:]
    if parts[0] == "plants" and len(parts) > 2:
        title = f"{title}, {parts[1]}"
    return _with_unit(title, unit)


def metric_label(metric: str) -> str:
    """Return 'CoM speed (m/s)' for com_speed_m_s, and 'bend amplitude 2 (rad)' for a list's second."""
    units = METRIC_UNITS | LIST_METRIC_UNITS | COMPARISON_UNITS
    stem, _, number = metric.rpartition("_")
    if metric not in units and number.isdigit() and stem in units:
        return _with_unit(f"{metric_title(stem)} {number}", units[stem])
    return _with_unit(metric_title(metric), units.get(metric, split_metric(metric)[1]))


def metric_title(metric: str) -> str:
    """Return 'CoM speed' for com_speed_m_s."""
    name, _ = split_metric(metric)
    for ending, words in _ENDINGS.items():
        if name.endswith(ending):
            words = ", relative" if ending == "_rel" and metric not in COMPARISON_UNITS else words
            name = name.removesuffix(ending) + words
    title = _spaced(name.replace("com_", "CoM ").replace("_rms", " RMS"))
    return {"wall": "time to compute", "plan": "time to plan"}.get(title, title)


def _with_unit(title: str, unit: str) -> str:
    return title if unit == "1" else f"{title} ({unit.replace('*', '·')})"


def _spaced(name: str) -> str:
    for letter, greek in (("mu_", "μ_"), ("tau_", "τ_")):
        if name.startswith(letter):
            return name.replace(letter, greek, 1)
    return name.replace("_", " ")


def _title(path: str) -> str:
    """Return the title that the schema of scenario files gives a field, empty where it gives none."""
    nodes = [_schema()]
    for part in path.split("."):
        below = (option.get("properties", {}).get(part) for node in nodes for option in _options(node))
        nodes = [node for node in below if node is not None]
    return str(next((node["title"] for node in nodes if "title" in node), ""))


@lru_cache(maxsize=1)
def _schema() -> dict[str, Any]:
    return ScenarioFile.model_json_schema()


def _options(node: Mapping[str, Any]) -> Iterator[Mapping[str, Any]]:
    """Yield what a node of the schema may be: itself, what it refers to, its alternatives."""
    yield node
    if "$ref" in node:
        yield from _options(_schema()["$defs"][node["$ref"].rsplit("/", 1)[1]])
    for option in (*node.get("anyOf", ()), *node.get("oneOf", ())):
        yield from _options(option)
