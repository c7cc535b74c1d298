"""What is in a recording, without a robot: format, clock, axes, markers, distances, order, head, a map.

Facts are plain data with units in their keys, as `srs-twin inspect --json` prints them (`facts.py`). `Scene`
is what its picture is drawn from.
"""

from __future__ import annotations

import os
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np

from srs_twin.errors import InputError
from srs_twin.recordings.body.floor import on_floor
from srs_twin.recordings.body.markers import CARRIED, SOLID, body_order, forward_distance, median_and_spread
from srs_twin.recordings.body.shape import noise_of
from srs_twin.recordings.body.tracking import distances, follow
from srs_twin.recordings.csv_table import (
    CLOCK,
    Meaning,
    RecordedFile,
    laid_out,
    read_file,
    read_table,
    start_of,
)
from srs_twin.recordings.facts import plain_facts
from srs_twin.recordings.formats import identify, plain_csv, read_markers, read_topics
from srs_twin.recordings.formats.base import axis_columns, in_unit
from srs_twin.recordings.formats.topics import RecordedTopics
from srs_twin.recordings.marker_table import MarkerTable
from srs_twin.recordings.recording import bodies_as_pairs, in_slots, read_motion, without_strangers
from srs_twin.recordings.recording_map import LOG_NAME, QUANTITIES, RecordingMap
from srs_twin.recordings.signals.gaps import LEAST_FRAMES, FrameGrid, at_frames, frame_grid, runs
from srs_twin.recordings.signals.units import (
    ABSOLUTE,
    ANGLES,
    PRESSURES,
    bracketed,
    clean,
    looks_absolute,
    stated_unit,
    symbol,
)
from srs_twin.robot.spec import RobotSpec

_RIGID = 1.3  # times what noise gives: a distance that varies less is that of one rigid part
_GAP = 0.2  # s, over which markers are followed
_SAMPLED = 2000
_CRAWLED = 0.3  # of the distance of neighbours: less does not tell the head
_CARRIER = 10.0  # openings a second: more are no gait's
_MOST_SIGNALS = 200
_MILLIMETRES = 2.0  # m between neighbours: more is a unit that was mistaken


@dataclass(frozen=True)
class Scene:
    """Markers from above: places (frames, markers, 2), m, names, order along the body, and rigid pairs."""

    places: np.ndarray
    names: tuple[str, ...]
    order: tuple[int, ...]
    rigid: tuple[tuple[int, int], ...]
    title: str


def inspect_file(
    path: str | os.PathLike[str], map: RecordingMap, spec: RobotSpec | None
) -> tuple[dict[str, Any], Scene | None]:
    """Return the facts of a file, and its markers where it has any.

    Args:
        path: a recording of markers, or a log.
        map: units, rate and places that are known.
        spec: the robot that it may be of.

    Raises:
        InputError: it cannot be read; says why.
    """
    start = start_of(path, map.dialect)
    timed = {clean(name) for name in map.meanings(["time"])} & set(start.names)
    kind = plain_csv.NAME if timed else identify(path, map.dialect)
    if kind == plain_csv.NAME:
        file = laid_out(read_file(path), map.dialect)
        if not axis_columns(file.names) and not any(name.lower().startswith("x_1") for name in file.names):
            return _whole(_table_facts(file, map)), None
    topics = read_topics(path)
    if topics is not None and topics.markers is None and topics.signals:
        return _whole(_topics_facts(topics, kind, map)), None
    if topics is not None and topics.markers is not None:
        table = in_unit(topics.markers, map.units)
    else:
        table = read_markers(
            path, rate_hz=map.rate_hz, unit=map.units, scale_m=map.scale_m, dialect=map.dialect
        )
    facts, scene = _motion_facts(map.applied(table), map)
    if spec is not None:
        facts["robot"] = _beside_robot(path, map, spec)
    if topics is not None:
        facts["signals"] = _topics_facts(topics, kind, map)["signals"]
    return _whole(facts), scene


def _whole(facts: Mapping[str, Any]) -> dict[str, Any]:
    """Return facts with the map that they propose, in plain types."""
    return plain_facts({**facts, "proposals": proposed_map([facts]).splitlines()})


def _topics_facts(topics: RecordedTopics, kind: str, map: RecordingMap) -> dict[str, Any]:
    """Return the facts of the signals of a bag."""
    signals = list(topics.signals.items())[:_MOST_SIGNALS]
    time = max((each for _, (each, _) in signals), key=len, default=np.zeros(0))
    found = [_signal_facts(name, *series, map) for name, series in signals]
    return _log_facts(topics, kind, found, topics.notes, time)


def _motion_facts(table: MarkerTable, map: RecordingMap) -> tuple[dict[str, Any], Scene | None]:
    frames, whole = frame_grid(table.time), bodies_as_pairs(table)
    facts: dict[str, Any] = {
        "file": table.name, "format": table.kind, "content": "markers", "sha256": table.sha256,
        "rate_hz": 1 / frames.period, "duration_s": float(frames.time[-1] - frames.time[0]),
        "frames": int((frames.rows >= 0).sum()), "frames_missing": int((frames.rows < 0).sum()),
        "announced_frames": table.header_frames, "units": table.unit,
        "notes": [*table.corrections, *frames.corrections],
    }  # fmt: skip
    try:
        floor = on_floor(whole.points, map.up or "auto", table.usual_up)
    except InputError as error:
        facts["notes"].append(str(error))
        return facts, None
    seen = at_frames(floor.points, frames)
    turned = np.zeros(len(table.labels), dtype=bool)
    if table.rotations is not None:
        turned = np.isfinite(table.rotations).any(axis=(0, 2))
    owner = np.repeat(np.arange(len(turned)), 1 + turned)  # bodies with a rotation have two columns
    facts["notes"] += floor.corrections
    facts |= {"up": floor.up, "bodies": [table.labels[k] for k in np.flatnonzero(turned)]}
    facts["markers"] = [
        _marker_facts(name, seen[:, owner == k].mean(axis=1), frames, bool(turned[k]))
        for k, name in enumerate(table.labels)
    ]
    return facts, _chain_facts(whole, seen, frames, facts)


def _marker_facts(name: str, place: np.ndarray, frames: FrameGrid, body: bool) -> dict[str, Any]:
    missing = np.isnan(place[:, 0])
    gaps = runs(missing)
    inner = gaps[(gaps[:, 0] > 0) & (gaps[:, 1] < len(place))]
    longest = float(np.diff(inner, axis=1).max(initial=0)) * frames.period
    noise = None if missing.all() else noise_of(place[:, None, :2])
    return {
        "name": name, "rigid_body": body, "coverage": float(1 - missing.mean()), "gaps": len(inner),
        "longest_gap_s": longest, "noise_mm": None if noise is None else 1e3 * noise, "noise_m": noise,
        "height_mm": None if missing.all() else 1e3 * float(np.nanmedian(place[:, 2])),
    }  # fmt: skip


def _chain_facts(
    table: MarkerTable, seen: np.ndarray, frames: FrameGrid, facts: dict[str, Any]
) -> Scene | None:
    """Add order, distances, layouts and head to the facts, as far as markers tell them."""
    slots, columns = in_slots(table, seen)
    nearest = np.fmin.reduce(distances(slots[..., :2], _SAMPLED), axis=2)
    if np.isnan(nearest).all():
        facts["notes"].append("never two markers at once")
        return None
    near = float(np.nanmedian(nearest))
    if near > _MILLIMETRES:
        facts["notes"].append(f"neighbours are {near:.3g} m apart; are lengths in mm? Give --units")
    tracks, origin, dropped = follow(slots, columns, max(1, round(_GAP / frames.period)), 2 * near)
    tracks, origin, _, notes = without_strangers(tracks, origin, table)
    facts["notes"] += notes
    solid = np.flatnonzero((~np.isnan(tracks[..., 0])).mean(axis=0) >= SOLID)
    places, count = tracks[:, solid], len(solid)
    names = _names(origin[:, solid], table.labels, facts)
    facts |= {"tracks": count, "positions_of_nothing": int(dropped)}
    whole = places[np.isfinite(places[..., 0]).all(axis=1)]
    if len(whole) < LEAST_FRAMES or count < 2:
        facts["notes"].append(f"{len(whole)} frames with all {count} lasting markers at once")
        return Scene(places, names, (), (), facts["file"])
    noise, (middle, spread) = noise_of(places), median_and_spread(whole)
    closest = np.nanmin(middle, axis=0)
    rigid = (spread < _RIGID * np.sqrt(2) * noise) & (middle <= 1.5 * np.minimum.outer(closest, closest))
    # Of a body that bends little many distances hardly vary; a marker has one partner on a rigid part.
    single = rigid.sum(axis=0) == 1
    pairs = tuple((int(a), int(b)) for a, b in np.argwhere(np.triu(rigid & single & single[:, None])))
    try:
        order = tuple(body_order(whole).tolist())
    except InputError as error:
        facts["notes"].append(str(error))
        order = ()
    facts |= {"noise_mm": 1e3 * noise, "order": [names[k] for k in order]}
    facts["rigid_pairs"] = [[names[a], names[b]] for a, b in pairs]
    facts["distances"] = [
        {"markers": [names[a], names[b]], "median_mm": 1e3 * middle[a, b], "spread_mm": 1e3 * spread[a, b]}
        for a, b in pairwise(order)
        if names[a] != names[b]  # two markers of ours stand for a rigid body
    ]
    facts["layouts"] = {
        layout: (count - more) // each
        for layout, (each, more) in CARRIED.items()
        if (count - more) % each == 0
    }
    heads = _heads(whole[:, list(order)], frames.period, order, pairs, near) if len(order) > 2 else []
    facts["head"] = [{"marker": names[end], "why": why} for end, why in heads]
    return Scene(places, names, order, pairs, facts["file"])


def _names(origin: np.ndarray, labels: Sequence[str], facts: dict[str, Any]) -> tuple[str, ...]:
    """Return a column's name for each marker, each once; note where markers change columns."""
    from scipy.optimize import linear_sum_assignment

    counts = np.stack([np.bincount(each[each >= 0], minlength=len(labels)) for each in origin.T])
    _, chosen = linear_sum_assignment(-counts)
    if (away := counts.sum() - counts[np.arange(len(chosen)), chosen].sum()) > 0:
        facts["notes"].append(
            f"{100 * away / counts.sum():.0f} % of the positions stand in other columns than their marker's: "
            "columns change places, and a map by their names does not hold for all frames"
        )
    return tuple(labels[k] for k in chosen)


def _heads(
    body: np.ndarray, period: float, order: Sequence[int], pairs: Sequence[tuple[int, int]], near: float
) -> Iterator[tuple[int, str]]:
    """Yield which ends may be the head, the likeliest first, and why."""
    for end, second in (order[:2], order[:-3:-1]):
        if [{end, second}] == [set(pair) for pair in pairs]:
            yield end, "the only end with a second marker on a rigid part"
    crawled = forward_distance(period, body)
    if abs(crawled) > _CRAWLED * near:
        end = order[0] if crawled > 0 else order[-1]
        yield end, f"the body crawled {abs(crawled):.3g} m towards this end"


def _beside_robot(path: str | os.PathLike[str], map: RecordingMap, spec: RobotSpec) -> dict[str, Any]:
    """Return what reading it as a recording of a robot gives."""
    try:
        found = read_motion(path, spec, map=map)
    except InputError as error:
        return {"name": spec.name, "reads": False, "says": str(error)}
    length, markers = found.trajectory.stack("length"), found.summary.markers
    low, middle, high = np.quantile(length, [0.02, 0.5, 0.98], axis=0)
    assert markers is not None, "it is a recording of markers"
    return {
        "name": spec.name, "reads": True, "says": found.summary.text(), "layout": markers.layout,
        "bend_error_rad": markers.bend_error_rad, "length_mm": (1e3 * middle).tolist(),
        "stretch": ((high - low) / spec.geometry.segment_length).tolist(),
    }  # fmt: skip


def _table_facts(file: RecordedFile, map: RecordingMap) -> dict[str, Any]:
    """Return the facts of a table of numbers over time."""
    given = map.meanings(QUANTITIES)
    timed = {name: each for name, each in given.items() if each.name == "time" and clean(name) in file.names}
    clock = next(iter(read_table(file, CLOCK, timed).columns), None)
    notes, time, epoch_ns, unit = [*file.notes], None, None, "no time"
    if clock is not None:
        time, noted, epoch_ns = file.times(clock.place, clock.unit)
        notes += noted
        unit = f"time in {clock.unit}" if clock.unit else "time without a unit"
    signals: list[dict[str, Any]] = []
    for k, name in enumerate(file.names[:_MOST_SIGNALS]):
        if clock is not None and k == clock.place:
            continue
        try:
            values = file.rows(file.header_lines, [k], len(file.names))[0][:, 0]
            signals.append(_signal_facts(name, time, values, map))
        except InputError as error:
            if "is no number" not in str(error):
                raise
            signals.append({"name": name, "looks_like": "text", "understood": False})
    notes.insert(0, f"a log of {len(signals)} signals, {unit}")
    return _log_facts(file, plain_csv.NAME, signals, notes, time, (epoch_ns or 0) / 1e9)


def _log_facts(
    source: RecordedFile | RecordedTopics, kind: str, signals: Sequence[Mapping[str, Any]],
    notes: Sequence[str], time: np.ndarray | None, beginning: float = 0.0,
) -> dict[str, Any]:  # fmt: skip
    """Return the facts of a log: begin, duration, rate and rows are left out where it has fewer than two."""
    about = {"file": source.name, "format": kind, "content": "log", "sha256": source.sha256}
    facts = {**about, "signals": signals, "notes": notes}
    if time is None or len(time) < 2:
        return facts
    step = np.diff(time)
    return facts | {
        "starts_s": beginning + float(time[0]), "duration_s": float(np.ptp(time)), "rows": len(time),
        "rate_hz": float(1 / np.median(step[step > 0])) if (step > 0).any() else None,
        "steps_back": int((step < 0).sum()),
    }  # fmt: skip


def _signal_facts(
    name: str, time: np.ndarray | None, values: np.ndarray, map: RecordingMap
) -> dict[str, Any]:
    """Return range, guess and switching of one signal; no switching without its times."""
    known = values[np.isfinite(values)]
    if not known.size:
        return {"name": name, "looks_like": "nothing", "understood": False}
    facts: dict[str, Any] = {
        "name": name, "looks_like": _looks_like(name, known, map),
        "understood": bool(LOG_NAME.fullmatch(_canonical(name))),
        "low": float(known.min()), "high": float(known.max()), "distinct": len(np.unique(known)),
    }  # fmt: skip
    if facts["distinct"] <= 3 and time is not None:
        opened = time[1:][(values[1:] == known.max()) & (values[:-1] != known.max())]
        rate = float(1 / np.median(np.diff(opened))) if len(opened) > 2 and np.ptp(opened) > 0 else 0.0
        facts["openings_per_s"] = rate
        if rate > _CARRIER:
            facts["looks_like"] += f", switched by a carrier of about {rate:.0f} Hz"
    return facts


def _canonical(name: str) -> str:
    """Return pressure_plus_1 for pressure_plus_1_kpa: a map's key, the unit is left to the column."""
    match = re.fullmatch(r"(.+_\d{1,3})(?:[_ ]+[a-z]+)?", bracketed(name)[0].lower())
    return match[1] if match else name.lower()


def _looks_like(name: str, values: np.ndarray, map: RecordingMap) -> str:
    """Return a guess of a signal's quantity: by a unit in the map or its name, else by its range."""
    distinct, low, high, said = set(np.unique(values)[:4].tolist()), values.min(), values.max(), name.lower()
    meaning = map.meanings(QUANTITIES).get(name, Meaning(""))
    pressure_unit, angle_unit = (
        stated_unit(name, units) or symbol(meaning.unit or meaning.default, units)
        for units in (PRESSURES, ANGLES)
    )
    if pressure_unit:
        return _pressure(pressure_unit, "", low, high, map)
    if angle_unit:
        return f"angle, {angle_unit}"
    pressure = "press" in said or "setpoint" in said
    if distinct <= {-1.0, 0.0, 1.0} and not pressure:
        return "valve states" if -1.0 in distinct else "valve states, 0 venting"
    if low >= 0 and high <= 1 and not pressure:
        return "duty"
    if low >= 0 and high <= 100 and any(word in said for word in ("duty", "pwm", "%")):
        return "duty, per cent"
    if any(word in said for word in ("bend", "angle", "theta")) or (low < 0 and np.abs(values).max() < 7):
        return "angle" + (", degrees" if np.abs(values).max() > 7 else ", rad")
    if pressure or (low > -100 and high > 2):
        unit = "bar" if high < 8 else "kPa" if high < 2e3 else "Pa"
        return _pressure(unit, " by its range", low, high, map)
    return "a number"


def _pressure(unit: str, why: str, low: float, high: float, map: RecordingMap) -> str:
    """Return words on a pressure in a unit, with what it is in kPa."""
    least, most = (PRESSURES[unit] * each for each in (low, high))
    absolute = "; " + ABSOLUTE if not map.ambient and looks_absolute(np.array([least])) else ""
    return f"pressure, {unit}{why}: {least / 1e3:g} to {most / 1e3:g} kPa{absolute}"


def proposed_map(facts: Sequence[Mapping[str, Any]]) -> str:
    """Return a map for files of one recording, in YAML, with what was guessed and why."""
    import json

    lines = ["# Proposed by srs-twin inspect: correct it, then give it as --map."]
    for each in (one for one in facts if one["content"] == "markers"):
        lines.append(f"# {each['file']}: {each['format']}, {each['rate_hz']:.4g} Hz")
        if "up" in each:
            lines.append(f"up: {json.dumps(each['up'])}")
        lines += _marker_lines(each)
    signals = (signal for each in facts for signal in each.get("signals", ()))
    logged = [signal for signal in signals if signal["looks_like"] != "text"]
    keys = [_canonical(signal["name"]) for signal in logged]
    if any(map(LOG_NAME.fullmatch, keys)):
        lines.append("log:")
    elif logged:
        lines.append("# log:  # say which is valve_plus_1, pressure_kpa_plus_1, … of each segment")
    for key, signal in zip(keys, logged, strict=True):
        key = key if LOG_NAME.fullmatch(key) else "# valve_plus_1"
        said = f"{signal['looks_like']}, {signal.get('low', 0):g} to {signal.get('high', 0):g}"
        lines.append(f"  {key}: {json.dumps(signal['name'])}  # {said}")
    return "\n".join(lines) + "\n"


def _marker_lines(facts: Mapping[str, Any]) -> list[str]:
    """Return the lines of markers, head first where it is known."""
    import json

    order, heads = list(facts.get("order", ())), facts.get("head", ())
    if not order:
        return ["# markers: their order is not known; name their places: {connector: 1}, {middle: 1}, …"]
    why = "which end is the head is not known: turn the numbers round if need be"
    if heads:
        why = heads[0]["why"]
        if heads[0]["marker"] == order[-1]:
            order.reverse()
    if any(each["rigid_body"] for each in facts["markers"]):
        named = enumerate(dict.fromkeys(order), start=1)
        places = [f"  {json.dumps(name)}: {{connector: {k}}}" for k, name in named]
        return [f"bodies:  # head: {why}", *places]
    pairs = {frozenset(pair) for pair in facts.get("rigid_pairs", ())}
    twice = len(order) % 2 == 0 and pairs >= set(map(frozenset, zip(order[::2], order[1::2], strict=True)))
    ahead = not twice and len(order) > 2 and frozenset(order[:2]) in pairs
    lines = [f"markers:  # head: {why}"]
    for k, name in enumerate(order):
        connector = k // 2 + 1 if twice else max(1, k + 1 - ahead)
        side = ", side: ahead" if ahead and k == 0 else ""
        lines.append(f"  {json.dumps(name)}: {{connector: {connector}{side}}}")
    others = (each["name"] for each in facts["markers"] if each["name"] not in order)
    return lines + [f"  {json.dumps(name)}: ignore" for name in others]


def in_words(facts: Mapping[str, Any]) -> str:
    """Return the facts for people, a line each."""
    lines = [f"{facts['file']}: {facts['format']}, {facts['content']}"]
    if facts.get("rate_hz"):
        what = "frames" if "frames" in facts else "rows"
        lines.append(f"{facts.get(what)} {what}, {facts['rate_hz']:.4g} Hz, {facts['duration_s']:.4g} s")
    if "up" in facts:
        noise = f"noise {facts['noise_mm']:.2g} mm; " if "noise_mm" in facts else ""
        lines.append(f"up: {facts['up']}; {noise}{facts.get('tracks', 0)} lasting markers")
    for each in facts.get("markers", ())[:40]:
        noise = "never seen"
        if each["noise_mm"] is not None:
            noise = f"noise {each['noise_mm']:.2g} mm, {each['height_mm']:.0f} mm high"
        noise += ", rigid body" if each["rigid_body"] else ""
        gaps = f"{each['gaps']} gaps up to {each['longest_gap_s']:.3g} s"
        seen = f"seen on {100 * each['coverage']:.1f} % of the frames"
        lines.append(f"  {each['name']}: {seen}, {gaps}, {noise}")
    for each in facts.get("distances", ()):
        a, b = each["markers"]
        rigid = ", one rigid part" if {a, b} in [set(pair) for pair in facts["rigid_pairs"]] else ""
        lines.append(f"  {a} to {b}: {each['median_mm']:.1f} mm, varies by {each['spread_mm']:.2g} mm{rigid}")
    if "layouts" in facts:
        fitting = [f"{name} of {count} connectors" for name, count in facts["layouts"].items() if count > 1]
        lines.append(f"layouts with this number of markers: {', '.join(fitting)}")
        heads = "; ".join(f"{each['marker']} ({each['why']})" for each in facts["head"])
        lines.append(f"head: {heads or 'not told by the markers; give --head'}")
    for each in facts.get("signals", ()):
        bounds = f", {each['low']:g} to {each['high']:g}" if "low" in each else ""
        rate = f", opens {each['openings_per_s']:.3g} times a second" if each.get("openings_per_s") else ""
        unknown = "" if each["understood"] else " (needs a map)"
        lines.append(f"  {each['name']}: {each['looks_like']}{bounds}{rate}{unknown}")
    if (robot := facts.get("robot")) is not None:
        lines += [f"as a recording of {robot['name']}:", *(f"  {line}" for line in robot["says"].split("\n"))]
    return "\n".join([*lines, *(f"note: {each}" for each in facts["notes"])])
