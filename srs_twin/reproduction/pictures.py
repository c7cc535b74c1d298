"""PICTURES: which figures of the dissertation are drawn again, from which runs."""

from __future__ import annotations

from collections.abc import Mapping

from srs_twin.reproduction import drawing
from srs_twin.reproduction.claims import Measure, Setting, Value
from srs_twin.reproduction.figures import Picture


def _run(name: str, changes: Mapping[str, Setting] | None = None, periods: float | None = None) -> Measure:
    return Measure("scenario", name, "", changes or {}, periods)


def _sweep(name: str, **where: Value) -> Measure:
    return Measure("sweep", name, "", where=where)


_STEP = _run("module_static", {"supply.pressure_kpa": 55.158056, "record_hz": 1000, "duration_s": 2.5})
_UNEQUAL = _run(
    "gen1_straight",
    {
        "robot.modules.gain_spread": 0.1,
        "robot.modules.tau_spread": 0.1,
        "robot.modules.bias_spread_rad": 0.05,
    },
)
_FAST3 = _run("gen3_straight", {"controller.frequency_hz": 2.0, "sensor.kind": "hall"})
_FREQUENCY, _PRESSURE = "controller.frequency_hz", "supply.pressure_kpa"
_SIMPLIFIED = {"plants.analytical.model": "simplified"}
_CONTOURS = {
    "fig31": ("31a", "gen 1 over the whole map, analytical"),
    "fig31_coarse": ("31", "gen 1 over few points, both plants"),
    "fig32": ("32a, c", "gen 2 straight, complete model and twin"),
    "fig32_simplified": ("32b", "gen 2 straight, simplified model"),
    "fig33": ("33a, c", "gen 2 at offset 0.4, complete model and twin"),
    "fig33_simplified": ("33b", "gen 2 at offset 0.4, simplified model"),
}


def _contours() -> list[Picture]:
    speed = drawing.sweep("contour", _FREQUENCY, "com_speed_m_s", y=_PRESSURE)
    radius = drawing.sweep("contour", _FREQUENCY, "turning_radius_m", y=_PRESSURE)
    made = [
        Picture(f"Fig. {number}", f"Speed of {what} (sweep {name})", (_sweep(name),), speed)
        for name, (number, what) in _CONTOURS.items()
    ]
    for name, number in (("fig33", "33d, f"), ("fig33_simplified", "33e")):
        what = _CONTOURS[name][1]
        made.append(
            Picture(f"Fig. {number}", f"Turning radius of {what} (sweep {name})", (_sweep(name),), radius)
        )
    return made


def _modules() -> list[Picture]:
    made = []
    for number, name, what in (
        ("42", "step", "a step of 25°"),
        ("43a", "sine_025hz", "a sine of 0.25 Hz"),
        ("43b", "sine_1hz", "a sine of 1 Hz"),
        ("43c", "sine_4hz", "a sine of 4 Hz"),
        ("43d, 45", "sine_6hz", "a sine of 6 Hz"),
        ("46", "square_2hz", "a square wave of 2 Hz"),
    ):
        for kind in ("direct", "iterative"):
            needs = (_run(f"module_{name}_{kind}"),)
            made.append(Picture(f"Fig. {number}", f"One module, {what}, {kind} SMC", needs, drawing.tracking))
    for metric, panel in (("amplitude_rel", "a"), ("phase_lag_rad", "b")):
        draw = drawing.sweep("line", "controller.reference.frequency_hz", metric)
        for kind in ("direct", "iterative"):
            caption = f"Closed loop over frequency, {kind} SMC"
            made.append(Picture(f"Fig. 44{panel}", caption, (_sweep(f"fig44_{kind}", seed=0),), draw))
    return made


def _offsets() -> list[Picture]:
    line = drawing.sweep("line", _FREQUENCY, "com_speed_m_s", by="controller.offset")
    yaw = drawing.sweep("line", _FREQUENCY, "yaw_rate_rad_s", by="controller.offset")
    offsets = (-0.2, -0.1, 0.0, 0.1, 0.2)
    needs = tuple(_run("gen3_turn", {"controller.offset": offset}) for offset in offsets)
    names = [f"offset {offset:g}" for offset in offsets]
    return [
        Picture("Fig. 36", "Gen 3 at offset 0.2, 0.9 Hz, from above", (_run("gen3_turn"),), drawing.above),
        Picture("Fig. 37", "Gen 3, 0.9 Hz, five offsets", needs, drawing.paths(*names)),
        Picture("Fig. 38", "Speed of gen 3 over frequency (sweep fig38)", (_sweep("fig38"),), line),
        Picture("Fig. 39", "Yaw rate of gen 3 over frequency (sweep fig39)", (_sweep("fig39"),), yaw),
        Picture(
            "Fig. 40", "Gen 3 at 2 Hz: bends, and the Hall sensors' readings", (_FAST3,), drawing.readings
        ),
    ]


def _learning() -> list[Picture]:
    made = [
        Picture(
            "Fig. 47", "Gen 4 in the open loop: bends, and the sensors' readings",
            (_run("gen4_straight", {"sensor.kind": "hall"}),), drawing.readings,
        )
    ]  # fmt: skip
    for name, numbers, what in (
        ("ilc_straight", ("48", "49"), "straight"),
        ("ilc_curve", ("50", "51"), "a curve"),
    ):
        needs = (_run(name),)
        made.append(
            Picture(f"Fig. {numbers[0]}", f"Learning to go {what}: what is learnt", needs, drawing.learning)
        )
        made.append(Picture(f"Fig. {numbers[1]}", f"Learning to go {what}: the path", needs, drawing.above))
    return made


def _plans() -> list[Picture]:
    made = [
        Picture(f"Fig. {number}", caption, (_run(name),), drawing.plan)
        for number, name, caption in (
            ("53", "plan_fig53", "The example of the text's planner, and both plants following"),
            ("54b", "plan_fig54_3", "Planned among 3 obstacles"),
            ("54c", "plan_fig54_5", "Planned among 5 obstacles"),
            ("54d", "plan_fig54_5_failed", "The text's search fails among 5 obstacles"),
            ("54e", "plan_fig54_8", "Planned among 8 obstacles"),
            ("56", "follow_fig56", "A given path is followed"),
            ("57", "follow_fig57", "Planned and followed among four obstacles"),
            ("59", "follow_gen4_a", "Gen 4, goal at 60°"),
            ("60", "follow_gen4_b", "Gen 4, gaps too narrow"),
            ("61", "follow_gen4_c", "Gen 4, an S through gaps"),
        )
    ]
    study = Measure("law", "planner_success", "", {"planner": "greedy", "draws": 50})
    made.insert(
        5, Picture("Fig. 55", "Success of the text's search over obstacles", (study,), drawing.success)
    )
    return made


PICTURES: tuple[Picture, ...] = (
    Picture("Fig. 20", "The actuator's step to 8 psi", (_STEP,), drawing.step),
    Picture("Fig. 21, 29", "Speed of gen 1", (_run("gen1_straight"),), drawing.speed),
    Picture("Fig. 24", "Bends of gen 1 with modules that differ", (_UNEQUAL,), drawing.bends),
    Picture("Fig. 25, 26", "Bends of gen 1 with equal modules", (_run("gen1_straight"),), drawing.bends),
    Picture("Fig. 27, 28", "Difference of the bodies, gen 1", (_run("gen1_straight"),), drawing.differences),
    Picture("Fig. 30", "Heading of gen 1's tail", (_run("gen1_straight"),), drawing.tail_angle),
    *_contours(),
    Picture(
        "Fig. 34", "Gen 2, offset 0.4, 2 Hz, 54 kPa: both models and the twin",
        (_run("gen2_turn", {_PRESSURE: 54.0}), _run("gen2_turn", {_PRESSURE: 54.0, **_SIMPLIFIED})),
        drawing.paths("complete", "simplified"),
    ),
    *_offsets(),
    Picture(
        "Fig. 41", "Static bend over pressure (sweep fig41)", (_sweep("fig41"),),
        drawing.sweep("line", _PRESSURE, "final_bend_rad", by="controller.plus"),
    ),
    *_modules(),
    *_learning(),
    *_plans(),
    Picture("Fig. 58", "What gen 4 sweeps on a curve", (_run("ilc_curve"),), drawing.above),
)  # fmt: skip
"""In the order of the text."""
