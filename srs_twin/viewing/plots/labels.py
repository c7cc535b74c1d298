"""Labels of scenario fields and metrics, with units."""

from __future__ import annotations

import re
from collections.abc import Iterator
from functools import lru_cache

from srs_twin.comparison.metrics import COMPARISON_UNITS, all_units
from srs_twin.comparison.sampling import split_unit as split_metric
from srs_twin.io.validation import Schema
from srs_twin.robot.sourced import split_unit
from srs_twin.scenario.file import with_extensions

# Texts that replace suffixes of metric names in labels.
_SUFFIXES = {
    "_rel": ", relative difference",
    "_abs": ", size of difference",
    "_body": " over body length",
}
_TITLES = {
    "amplitude_error_end_rel": "amplitude error, end",
    "amplitude_error_end_rad": "amplitude error, end",
    "path_speed_m_s": "speed at the end",
    "path_curvature_before_per_m": "curvature before",
    "path_curvature_per_m": "curvature at the end",
    "rise_time_s": "rise, 10 to 90 %",
    "settling_5_s": "settled within 5 %",
    "settling_2_s": "settled within 2 %",
    "steady_error_rad": "mean error at rest",
    "steady_rms_rad": "RMS error at rest",
    "ripple_pp_rad": "ripple, peak-peak",
    "fit_residual_rad": "from a sine, RMS",
    "reading_r_squared": "reading: R² of a line",
    "reading_backstep_rad": "reading: backstep",
    "reading_range_t": "reading: field range",
    "cross_track_rms_m": "cross-track, RMS",
    "cross_track_max_m": "cross-track, largest",
    "inside_fraction": "inside the footprint, share of time",
    "inside_50mm_fraction": "inside the 50 mm box, share of time",
    "clearance_m": "smallest clearance",
    "following_time_s": "time of following",
    "replans": "new plans",
    "wall_s": "time to compute",
    "plan_s": "time to plan",
}
"""Labels of metrics whose names would be unclear as labels."""

_SENTENCE_STARTS = ("What ", "Which ", "How ")
"""First words of schema titles that are unsuitable as labels."""

_MAX_TITLE = 36
"""Maximum length of a schema title used as a label, in characters."""


def field_label(path: str) -> str:
    """Return the label of a scenario field, for example 'gait frequency (Hz)'.

    The label is the title in the schema, or the key of the field if the title is long.
    """
    keys = path.split(".")
    name, unit = split_unit(keys[-1])
    title = re.split(r" \(|[,:]", _title(path))[0]
    if not 0 < len(title) <= _MAX_TITLE or title.startswith(_SENTENCE_STARTS):
        group = ""
        if len(keys) > 1 and keys[0] != "plants":
            group = keys[-2]
        title = f"{group} {_spaced(name)}".strip()
    if not title[:2].isupper():
        title = title[:1].lower() + title[1:]
    if keys[0] == "plants" and len(keys) > 2:
        title = f"{title}, {keys[1]}"
    return _with_unit(title, unit)


def metric_label(metric: str) -> str:
    """Return the label of a metric, for example 'CoM speed (m/s)' for `com_speed_m_s`.

    A number at the end of `metric` selects an element of a list-valued metric, as in
    'bend amplitude 2 (rad)'.
    """
    units = all_units()
    stem, _, number = metric.rpartition("_")
    if metric not in units and number.isdigit() and stem in units:
        return _with_unit(f"{metric_title(stem)} {number}", units[stem])
    return _with_unit(metric_title(metric), units.get(metric, split_metric(metric)[1]))


def metric_title(metric: str) -> str:
    """Return the label of a metric without its unit, for example 'CoM speed'."""
    if metric in _TITLES:
        return _TITLES[metric]
    name, _ = split_metric(metric)
    suffixes = dict(_SUFFIXES)
    if metric not in COMPARISON_UNITS:
        suffixes["_rel"] = ", relative"
    for suffix, text in suffixes.items():
        if name.endswith(suffix):
            name = name.removesuffix(suffix) + text
    return _spaced(name.replace("com_", "CoM ").replace("_rms", " RMS"))


def _with_unit(title: str, unit: str) -> str:
    if unit == "1":
        return title
    return f"{title} ({unit.replace('*', '·')})"


def _spaced(name: str) -> str:
    for letter, greek in (("mu_", "μ_"), ("tau_", "τ_")):
        if name.startswith(letter):
            return name.replace(letter, greek, 1)
    return name.replace("_", " ")


def _title(path: str) -> str:
    nodes = [_schema()]
    for key in path.split("."):
        children = (
            option.get("properties", {}).get(key)
            for node in nodes
            for option in _options(node)
        )
        nodes = [node for node in children if node is not None]
    return str(next((node["title"] for node in nodes if "title" in node), ""))


@lru_cache(maxsize=1)
def _schema() -> Schema:
    return with_extensions().model_json_schema()


def _options(node: Schema) -> Iterator[Schema]:
    """Yield a schema node and all nodes that it references or lists as options."""
    yield node
    if "$ref" in node:
        yield from _options(_schema()["$defs"][node["$ref"].rsplit("/", 1)[1]])
    for option in (*node.get("anyOf", ()), *node.get("oneOf", ())):
        yield from _options(option)
