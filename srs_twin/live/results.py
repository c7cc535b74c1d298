"""Results of a session: summary and table of the estimates."""

from __future__ import annotations

import json
import math
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from srs_twin.io.file_sets import replace_files
from srs_twin.live.estimate import Estimate
from srs_twin.live.links import Link
from srs_twin.live.shadow import Shadow
from srs_twin.robot.spec import RobotSpec
from srs_twin.trajectory import Trajectory

TICK_S = 0.02
"""Interval between updates of the live twin."""
STATE = "state.npz"
SUMMARY, ESTIMATE = "shadow.json", "estimate.parquet"
KEPT = (SUMMARY, ESTIMATE, STATE)
"""Files in the session's folder that the next session replaces; journals and recordings are numbered."""
_MOST_ROWS = 1_000_000


class EstimateTable:
    """Estimates and their standard deviations over time."""

    def __init__(self, spec: RobotSpec) -> None:
        """Begin without rows."""
        self._spec, self._rows = spec, list[np.ndarray]()

    def __len__(self) -> int:
        """Return the number of rows."""
        return len(self._rows)

    def add(self, time: float, e: Estimate) -> None:
        """Add an estimate, at a time from the start of the session (s)."""
        self._rows.append(np.concatenate([[time], e.pose, e.pose_sd, e.bend, e.bend_sd, [bool(e.lost)]]))
        del self._rows[:-_MOST_ROWS]

    def trajectory(self) -> Trajectory:
        """Return the table as a trajectory."""
        segments = range(1, self._spec.segments + 1)
        units = {"com_x_sd": "m", "com_y_sd": "m", "heading_sd": "rad"}
        units |= {f"bend_sd_{j}": "rad" for j in segments}
        names = [
            "time", "com_x", "com_y", "heading", "com_x_sd", "com_y_sd", "heading_sd",
            *(f"bend_{j}" for j in segments), *(f"bend_sd_{j}" for j in segments), "lost",
        ]  # fmt: skip
        columns = dict(zip(names, np.array(self._rows).T, strict=True))
        return Trajectory(columns, units, metadata={"robot": self._spec.name})


def summary(shadow: Shadow, links: Sequence[Link], e: Estimate | None) -> dict[str, Any]:
    """Return message counts, clocks and the last estimate as JSON values."""
    counts: Counter[str] = Counter()
    for link in links:
        counts.update(dict(link.counts))  # a copy, because the link's thread still counts
    dropped: Counter[str] = Counter()
    for (_, kind, what), count in shadow.buffer.counts.items():
        if what != "taken":
            dropped[f"{kind} {what}"] += count
    clocks = {
        sender: {"offset_s": clock.offset, "jitter_s": clock.jitter}
        for sender, clock in shadow.buffer.clocks.items()
    }
    document: dict[str, Any] = {
        "robot": shadow.spec.name, "messages": dict(counts), "dropped": dict(dropped), "clocks": clocks,
    }  # fmt: skip
    if e is not None:
        document["estimate"] = {
            "lost": e.lost, "pose": e.pose.tolist(), "pose_sd": e.pose_sd.tolist(),
            "bend_rad": e.bend.tolist(), "bend_sd_rad": e.bend_sd.tolist(), "off": dict(e.off),
            "parameters": {
                name: {"value": value.tolist(), "sd": sd.tolist()}
                for name, (value, sd) in e.parameters.items()
            },
        }  # fmt: skip
    return document


def timing(ticks: Iterable[float], latency: Iterable[float]) -> dict[str, Any]:
    """Return quantiles of tick durations and latencies (s), in ms, and the number of ticks that overran."""
    ticks = list(ticks)
    return {
        "tick_ms": _quantiles(ticks), "latency_ms": _quantiles(latency),
        "overruns": sum(tick > TICK_S for tick in ticks),
    }  # fmt: skip


def write_results(folder: Path, document: Mapping[str, Any], table: EstimateTable) -> None:
    """Write summary and estimates to a folder."""
    with replace_files(folder, (SUMMARY, ESTIMATE)) as fresh:
        if len(table):
            table.trajectory().to_parquet(fresh / ESTIMATE)
        (fresh / SUMMARY).write_text(json.dumps(document, indent=1) + "\n", "utf-8")


def finite(value: Any) -> Any:
    """Return JSON values in which null replaces each number that is not finite."""
    if isinstance(value, Mapping):
        return {key: finite(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [finite(item) for item in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def _quantiles(values: Iterable[float]) -> Mapping[str, float | None]:
    durations = np.array(list(values)) * 1e3
    if not len(durations):
        return {"median": None, "p99": None}
    return {"median": float(np.median(durations)), "p99": float(np.quantile(durations, 0.99))}
