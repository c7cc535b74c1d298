"""Attribution of the difference between the plants: Shapley axioms, switches, and `compare --explain`."""

from __future__ import annotations

import json
from dataclasses import replace
from io import StringIO
from itertools import permutations

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st
from rich.console import Console

from srs_twin import Numerics, TwinSnake, attribution as attribution_module, rollout
from srs_twin.attribution import (
    PlantVariants,
    _builders,
    _in_processes,
    _Task,
    _window,
    contributions,
    explain,
    main_cause,
    subsets,
)
from srs_twin.cli.table import _attribution_table
from srs_twin.comparison.compare import (
    MEASURES,
    AssumptionShare,
    Attribution,
    gap_between,
)
from srs_twin.comparison.contacts import contact_free_s, touches
from srs_twin.comparison.metrics import plant_metrics
from srs_twin.compute.workers import processor_count
from srs_twin.errors import DivergedError, InputError
from srs_twin.experiment import prepare
from srs_twin.scenario.loading import load_scenario, parse_scenario
from srs_twin.viewing.plots.runs import attribution_plot

NAMES = ["a", "b", "c", "d"]


def game(seed: int) -> dict[frozenset[str], np.ndarray]:
    generator = np.random.default_rng(seed)
    return {subset: generator.normal(size=3) for subset in subsets(NAMES)}


@settings(max_examples=20)
@given(st.integers(0, 1000))
def test_shapley_values_are_means_over_all_orders_and_add_up(seed):
    seen = game(seed)
    values = contributions(NAMES, seen)
    by_order = {name: [] for name in NAMES}
    for order in permutations(NAMES):
        for k, name in enumerate(order):
            by_order[name].append(
                seen[frozenset(order[: k + 1])] - seen[frozenset(order[:k])]
            )
    for name, steps in by_order.items():
        assert values[name].value == pytest.approx(np.mean(steps, axis=0))
        assert values[name].low == pytest.approx(np.min(steps, axis=0))
        assert values[name].high == pytest.approx(np.max(steps, axis=0))
    whole = seen[frozenset(NAMES)] - seen[frozenset()]
    assert sum(contribution.value for contribution in values.values()) == pytest.approx(
        whole
    )


def test_shapley_values_of_null_and_symmetric_players():
    def worth(subset: frozenset[str]) -> np.ndarray:
        return np.array(
            [3.0 * ("a" in subset) * ("b" in subset) + 2.0 * ("c" in subset)]
        )

    values = contributions(NAMES, {subset: worth(subset) for subset in subsets(NAMES)})
    assert [values[name].value[0] for name in NAMES] == pytest.approx(
        [1.5, 1.5, 2.0, 0.0]
    )
    assert (values["a"].low[0], values["a"].high[0]) == (0.0, 3.0)


def test_plot_has_bars_sorted_by_size_that_add_up():
    small = np.array([0.001, 0.1, 0.0, 0.0])
    large = np.array([-0.004, 0.7, 0.05, 0.002])
    shares = [
        AssumptionShare(
            name, name, tuple(v), tuple(v - 1e-3), tuple(v + 1e-3), "averaged"
        )
        for name, v in (("small", small), ("large", large))
    ]
    rest = np.full(4, 0.001)
    gap = tuple(small + large + rest)
    figure = attribution_plot(
        Attribution((0.1,) * 4, gap, tuple(rest), gap, (), tuple(shares))
    )
    assert len(figure.axes) == len(MEASURES)
    speed, yaw = figure.axes[:2]
    rows = [tick.get_text() for tick in speed.get_yticklabels()]
    assert rows == ["large", "small", "not explained", "twin − analytical"]
    assert (speed.get_title("left"), yaw.get_title("left")) == (
        "CoM speed (mm/s)",
        "yaw rate (rad/s)",
    )
    for axes, scale, values in (
        (speed, 1e3, [-4.0, 1.0, 1.0, -2.0]),
        (yaw, 1.0, [0.7, 0.1, 0.001, 0.801]),
    ):
        assert [bar.get_x() for bar in axes.patches] == [0.0] * 4
        assert [bar.get_width() for bar in axes.patches] == pytest.approx(values)
        assert [text.get_text() for text in axes.texts][0] == {
            1e3: "−4.0",
            1.0: "+0.70",
        }[scale]
    assert yaw.texts[2].get_text() == "0"


def printed_lines(shares):
    """Return the words of each line of the table of contributions."""
    attribution = Attribution(
        (1.0,) * 4, (0.51, 2.0, 0, 0), (0,) * 4, (0,) * 4, (), shares
    )
    console = Console(width=80, file=StringIO())
    console.print(_attribution_table(attribution.document()))
    return [line.split() for line in console.file.getvalue().splitlines()]


def test_table_states_the_range_over_the_orders():
    shares = (
        AssumptionShare(
            "alone", "", (0.5, 0.0, 0.0, 0.0), (0.5, 0, 0, 0), (0.5, 0, 0, 0), "refined"
        ),
        AssumptionShare(
            "mean",
            "",
            (0.01, 2.0, 0.0, 0.0),
            (-0.04, 1.0, 0, 0),
            (0.05, 3.0, 0, 0),
            "averaged",
        ),
    )
    lines = printed_lines(shares)
    ranges = [
        line[-4:]
        for line in lines
        if line[:1] in (["alone"], ["mean"], ["lowest,"], ["highest,"])
    ]
    expected = [
        "+0.5000 0 0 0",
        "+0.0100 +2.0000 0 0",
        "-0.0400 +1.0000 0 0",
        "+0.0500 +3.0000 0 0",
    ]
    assert [" ".join(line) for line in ranges] == expected


def test_contributions_that_round_to_zero_have_no_sign():
    value = (4.9e-5, -4.9e-5, 5.1e-5, -5.1e-5)
    lines = printed_lines(
        (AssumptionShare("alone", "", value, value, value, "refined"),)
    )
    (printed,) = (line[-4:] for line in lines if line[:1] == ["alone"])
    assert printed == ["0", "0", "+0.0001", "-0.0001"]


@pytest.mark.parametrize("contact", ["loaded", "preloaded"])
def test_variants_of_the_twin_keep_its_friction_solver(contact):
    """The effect of another solver is no part of the difference between model and twin."""
    variants = PlantVariants(
        scenario(plants={"analytical": {}, "twin": {"contact": contact}})
    )
    solver = type(variants.twin().contact)
    changed = [
        refinement.options["contact"]
        for refinement in variants.refinements
        if "contact" in refinement.options
    ]
    assert [type(contact) for contact in changed] == [solver]


def scenario(**changes):
    data = {
        "robot": "gen2",
        "duration_s": 2.0,
        "supply": {"pressure_kpa": 48.3},
        "controller": {"kind": "gait", "frequency_hz": 2.0, "offset": 0.2},
    }
    return parse_scenario(data | changes, name="short")


def both(s):
    return {
        k: rollout(s.build_plant(k), s.build_controller(), s.duration)
        for k in ("analytical", "twin")
    }


@pytest.fixture(scope="module")
def explained():
    s = scenario()
    progress: list[tuple[float, float | None]] = []
    walls = {"analytical": 0.01, "twin": 0.5}
    report = lambda *reported: progress.append(reported)  # noqa: E731
    return explain(s, both(s), progress=report, wall_s=walls), progress


@pytest.mark.slow
def test_variants_under_a_controller_with_sensors_are_the_same_in_worker_processes():
    s = load_scenario("ilc_straight", set={"duration_s": 1.0})
    variants = PlantVariants(s)
    names = list(_builders(variants))[:2]
    counts = []
    tasks = [_Task(s, name, s.build_controller(), s.duration) for name in names]
    runs = _in_processes(tasks, counts.append)
    assert counts == [1, 2] and [run.metadata["plant"] for run in runs] == [
        "twin",
        "analytical",
    ]
    for name, run in zip(names, runs, strict=True):
        here = rollout(_builders(variants)[name](), s.build_controller(), **s.timing)
        assert all(
            (here[column] == run[column]).all()
            for column in ("com_x", "bend_1", "duty_plus_1")
        )


@pytest.mark.slow
def test_remainder_is_small_for_speed_and_yaw_rate(explained):
    """The remainder of the difference was 0.6 % of the speed and 8 % of the yaw rate."""
    attribution, progress = explained
    speed, yaw, *_ = np.abs(attribution.remainder) / np.abs(attribution.reference).clip(
        1e-9
    )
    assert speed < 0.01 and yaw < 0.1
    fractions = [fraction for fraction, _ in progress]
    assert fractions == sorted(fractions) and progress[-1] == (1.0, 0.0)
    # The estimate at the start: 11 runs of the twin and 17 of the model, on the
    # processors of this machine.
    assert progress[0] == (0.0, pytest.approx(0.7 * 11 / processor_count(), rel=0.2))
    assert attribution.same == ("rigid gaps", "frozen chords", "damping")


@pytest.mark.slow
def test_the_effect_of_damping_is_that_of_another_robot(explained):
    attribution, _ = explained
    s = scenario()
    nominal = plant_metrics(both(s)["twin"])["com_speed_m_s"]
    for name, time in (
        ("damping of 0.49 ms", 0.4856e-3),
        ("damping of 3.1 ms", 3.065e-3),
    ):
        spec = replace(s.robot, bending=replace(s.robot.bending, damping_time=time))
        damped = rollout(
            TwinSnake(spec, supply_pa=48.3e3, timestep=0.5e-3),
            s.build_controller(),
            s.duration,
        )
        change = plant_metrics(damped)["com_speed_m_s"] - nominal
        assert attribution.damping[name][0] == pytest.approx(change, abs=0.002)


@pytest.mark.slow
def test_compliance_dominates_and_matched_plants_agree(explained):
    attribution, _ = explained
    shares = {share.name: np.array(share.value) for share in attribution.shares}
    speed, yaw, _, shape = np.array(attribution.gap)
    assert shares["compliance"][3] > 0.5 * shape
    assert abs(attribution.matched[0]) < 0.04 * attribution.reference[0]
    assert abs(attribution.matched[3]) < 0.1 * shape
    assert abs(attribution.remainder[3]) < 0.25 * shape
    for name in ("out-of-plane motion", "link mass"):
        assert abs(shares[name][0]) < 0.02 * attribution.reference[0], name


@pytest.mark.slow
def test_shares_equal_the_changes_of_switches_and_refinements():
    """Only one assumption differs, so that its share is the change by its switch."""
    alike = {"model": "compliant", "friction": "wheel", "inertia": "point"}
    s = scenario(plants={"analytical": alike, "twin": {}})
    runs = both(s)

    def ran(plant, **options):
        return rollout(
            s.build_plant(plant, **options), s.build_controller(), s.duration
        )

    model = ran("analytical", inertia="connector")
    twin = runs["twin"]
    gap = gap_between(model, runs["twin"])
    coarse = s.build_plant("twin").timestep
    finer = ran(
        "analytical", inertia="connector", timestep=0.002 / 4, slip_speed=0.00025 / 4
    )
    expected = {
        "connector inertia": gap_between(runs["analytical"], twin) - gap,
        "twin time step": (
            4 / 3 * (gap - gap_between(model, ran("twin", timestep=coarse / 2)))
        ),
        "wheel inertia": (
            gap - gap_between(model, ran("twin", numerics=Numerics(wheel_spin=0.0)))
        ),
        "model time step": 4 / 3 * (gap - gap_between(finer, twin)),
    }
    attribution = explain(s, runs)
    assert attribution.gap == pytest.approx(gap_between(runs["analytical"], twin))
    shares = {share.name: share.value for share in attribution.shares}
    averaged = {share.name for share in attribution.shares if share.how == "averaged"}
    assert averaged == {"connector inertia"}
    for name, value in expected.items():
        assert np.abs(value[:2]).min() > 1e-4 and shares[name] == pytest.approx(
            value
        ), name


@pytest.mark.slow
@pytest.mark.slow
def test_document_is_plain_data_and_names_its_measures(explained):
    document = json.loads(json.dumps(explained[0].document()))
    assert document["measures"] == list(MEASURES)
    assert len(document["shares"][0]["value"]) == len(MEASURES)


def test_only_differing_assumptions_are_switched():
    alike = {"model": "compliant", "friction": "wheel", "inertia": "connector"}
    assert (
        PlantVariants(scenario(plants={"analytical": alike, "twin": {}})).switches == []
    )
    other = {"model": "simplified", "friction_torque": False, "gaps": False}
    variants = PlantVariants(
        scenario(plants={"analytical": other, "twin": {"wheels": "skid"}})
    )
    names = [
        "friction law",
        "wheel track",
        "rigid gaps",
        "compliance",
        "connector inertia",
    ]
    assert [switch.name for switch in variants.switches] == names
    assert [switch.name for switch in variants.first] == ["frozen chords"]
    assert "wheel inertia" not in [
        refinement.name for refinement in variants.refinements
    ]
    bending = {"base": "gen2", "bending": {"damping_time_s": 0.01}}
    assert "damping" in [
        switch.name for switch in PlantVariants(scenario(robot=bending)).switches
    ]


def test_every_switch_changes_the_plant():
    variants = PlantVariants(
        scenario(plants={"analytical": {"model": "simplified"}, "twin": {}})
    )
    every = [switch.name for switch in (*variants.first, *variants.switches)]
    plain, all_on = (
        variants.analytical(frozenset(on)).describe() for on in ((), every)
    )
    assert (plain["model"], plain["friction"], plain["track_m"], plain["inertia"]) == (
        "simplified",
        "axis",
        0.0,
        "point",
    )
    assert (
        all_on["model"],
        all_on["friction"],
        all_on["track_m"],
        all_on["inertia"],
    ) == (
        "compliant",
        "wheel",
        0.015,
        "connector",
    )
    for refinement in variants.refinements:
        if refinement.plant == "twin" and "robot" not in refinement.options:
            about = variants.twin(**refinement.options).describe()
            usual = variants.twin().describe()
            assert about != usual, refinement.name


@pytest.mark.slow
def test_frozen_chords_are_switched_first_and_shares_add_up():
    """Compliant bends include arcs; averaging over both orders would split the contribution of arcs."""
    s = scenario(
        plants={
            "analytical": {"model": "simplified", "friction_torque": False},
            "twin": {},
        }
    )
    runs = both(s)
    attribution = explain(s, runs)
    assert (attribution.shares[0].name, attribution.shares[0].how) == (
        "frozen chords",
        "first",
    )
    total = (
        np.sum([share.value for share in attribution.shares], axis=0)
        + attribution.remainder
    )
    assert total == pytest.approx(attribution.gap, abs=1e-12)
    arcs = rollout(
        s.build_plant("analytical", model="complete", friction_torque=True),
        s.build_controller(),
        2.0,
    )
    expected = gap_between(runs["analytical"], runs["twin"]) - gap_between(
        arcs, runs["twin"]
    )
    assert attribution.shares[0].value == pytest.approx(expected)


@pytest.mark.slow
def test_diverged_variant_is_named_and_keeps_the_run(tmp_path, monkeypatch):
    def stuck(self):
        raise DivergedError("twin", 0.3, "it flew")

    monkeypatch.setattr(PlantVariants, "stiff_twin", stuck)
    result = prepare(scenario(), tmp_path).execute(explain=explain)
    (error,) = result.failed_attributions
    assert (
        str(error)
        == "short: attribution: stiff twin: twin diverged at t = 0.3 s: it flew"
    )
    assert (
        result.metrics["plants"]["twin"]["com_speed_m_s"] > 0.1
        and "attribution" not in result.metrics
    )
    assert (tmp_path / "report.html").is_file() and (
        tmp_path / "twin.parquet"
    ).is_file()


def test_only_long_runs_under_feedback_are_attributed_over_a_window():
    gait = load_scenario("gen1_straight")
    learning = load_scenario("ilc_straight")
    assert _window(gait, gait.build_controller(), 1e3) is None
    controller = learning.build_controller()
    assert (
        _window(learning, controller, 25.0) == 12.0
        and _window(learning, controller, 11.0) is None
    )
    fine = load_scenario("ilc_growth")
    assert (
        _window(fine, fine.build_controller(), 8.0) == 4.0
    )  # four periods of 1 s, 16,000 steps


def test_window_of_a_run_equals_a_shorter_run():
    s = load_scenario("ilc_straight", set={"duration_s": 1.2})
    long, short = (
        rollout(
            s.build_plant("analytical"),
            s.build_controller(),
            seed=s.seed,
            duration=duration,
        )
        for duration in (1.2, 0.8)
    )
    part = long.between(0.0, 0.8)
    assert part.columns.keys() == short.columns.keys() and len(part) == len(short) == 81
    assert all(
        np.array_equal(part[name], short[name], equal_nan=True)
        for name in short.columns
    )


@pytest.mark.slow
def test_attribution_over_a_window_adds_up_to_the_difference_in_it(monkeypatch):
    s = load_scenario("ilc_straight", set={"duration_s": 5})
    monkeypatch.setattr(attribution_module, "_MAX_STEPS", 3000)
    monkeypatch.setattr(attribution_module, "_MIN_WINDOW_PERIODS", 3)
    runs = {
        k: rollout(s.build_plant(k), s.build_controller(), **s.timing)
        for k in ("analytical", "twin")
    }
    attribution = explain(s, runs)
    assert attribution.window_s == 3.0 and attribution.document()["window_s"] == 3.0
    gap = gap_between(
        *(runs[kind].between(0.0, 3.0) for kind in ("analytical", "twin"))
    )
    total = (
        np.sum([share.value for share in attribution.shares], axis=0)
        + attribution.remainder
    )
    assert attribution.gap == pytest.approx(gap) and total == pytest.approx(
        gap, abs=1e-12
    )
    assert attribution.gap != pytest.approx(
        gap_between(runs["analytical"], runs["twin"])
    )


def test_run_without_attribution_is_rejected():
    s = scenario(duration_s=1.0)
    runs = both(s)
    with pytest.raises(
        InputError, match="an attribution compares the two plants, but only one"
    ):
        explain(s, {"twin": runs["twin"]})
    scaled = {"analytical": {"gaps": False}, "twin": {}}
    with_factor = scenario(plants=scaled, comparison={"gap_factor": True})
    with pytest.raises(
        InputError,
        match="cannot be attributed, because `comparison.gap_factor` scales the speed",
    ):
        explain(with_factor, both(with_factor))
    with pytest.raises(
        InputError, match=r"short: .*; at least three gait periods are needed"
    ):
        explain(s, runs)


def blocked(x):
    """Return a scenario in which the twin runs into a post at x, m, and the model passes through it."""
    gait = {"kind": "gait", "frequency_hz": 2.0}
    return scenario(
        controller=gait, world={"obstacles": [{"x_m": x, "y_m": 0, "radius_m": 0.05}]}
    )


def test_main_cause_refers_to_the_time_before_the_contact():
    s = blocked(0.45)
    runs = both(s)
    end = contact_free_s(runs.values())
    first = touches(runs["twin"])[0].begin
    assert end == pytest.approx(first - 0.01) and 1.5 <= end < s.duration
    cause = main_cause(s, runs)
    compliant = rollout(
        PlantVariants(s).analytical(frozenset({"compliance"})),
        s.build_controller(),
        s.duration,
    )
    before, after = (
        plant_metrics(run.between(0.0, end)) for run in (runs["analytical"], compliant)
    )
    assert cause["window_s"] == end
    for name in ("com_speed_m_s", "yaw_rate_rad_s"):
        assert cause[name] == pytest.approx(after[name] - before[name])
    assert (
        main_cause(s, {kind: run.between(0.0, 1.2) for kind, run in runs.items()})
        is None
    )


def test_variants_of_the_twin_run_without_obstacles():
    variants = PlantVariants(blocked(0.45))
    assert not variants.twin().has_contact and not variants.stiff_twin().has_contact


@pytest.mark.slow
def test_attribution_adds_up_to_the_difference_before_the_contact():
    s = blocked(0.45)
    runs = both(s)
    end = contact_free_s(runs.values())
    attribution = explain(s, runs)
    free = [runs[kind].between(0.0, end) for kind in ("analytical", "twin")]
    assert attribution.window_s == end
    total = (
        np.sum([share.value for share in attribution.shares], axis=0)
        + attribution.remainder
    )
    assert attribution.gap == pytest.approx(
        gap_between(*free)
    ) and total == pytest.approx(attribution.gap)
    # Compliance explains most of the difference, as in a run without an obstacle.
    shares = {share.name: share.value[0] for share in attribution.shares}
    assert max(shares, key=lambda name: abs(shares[name])) == "compliance"


def test_early_contact_leaves_nothing_to_explain(tmp_path, srs_twin):
    world = [
        "--set",
        "world.obstacles=[{x_m: 0.35, y_m: 0, radius_m: 0.05}]",
        "--duration",
        "2",
    ]
    done = srs_twin(
        "compare", "gen2_straight", *world, "--explain", "--out", "out", cwd=tmp_path
    )
    assert done.returncode == 0, done.stderr
    assert done.stderr.count("ignores the obstacles of this world") == 1
    text = " ".join(done.stdout.split())
    assert text.startswith("The twin touches an obstacle ")
    assert "; the model ignores obstacles and overlaps one at 1.13 s, for " in text
    assert "and turns unlike the model" in text and "compliance" not in text.lower()
    assert "too few whole gait periods pass to explain a difference" in text
    metrics = json.loads((tmp_path / "out/metrics.json").read_text("utf-8"))
    assert "attribution" not in metrics and metrics["ignores_obstacles"] == [
        "analytical"
    ]
    twin = metrics["plants"]["twin"]
    model = metrics["plants"]["analytical"]
    kinds = {
        plant: [event["kind"] for event in events]
        for plant, events in metrics["events"].items()
    }
    assert kinds == {"analytical": ["overlap"], "twin": ["contact"] * twin["contacts"]}
    assert model["clearance_m"] < -0.04 < -0.001 < twin["clearance_m"] <= 0.0
    assert model["contact_time_s"] > twin["contact_time_s"] > 0.0
    report = (tmp_path / "out/report.html").read_text("utf-8")
    assert (
        "ignores obstacles and overlaps one" in report
        and "passes through an obstacle" in report
    )


@pytest.mark.slow
def test_command_prints_and_stores_the_attribution(srs_twin, tmp_path):
    text = "robot: gen2\nduration_s: 1.6\ncontroller: {kind: gait, frequency_hz: 2.0}\n"
    (tmp_path / "brief.yaml").write_text(text)
    done = srs_twin("compare", "brief.yaml", "--explain", "--out", "out", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert (
        "contribution of each assumption" in done.stdout
        and "not explained" in done.stdout
    )
    assert "curvature not constant" in done.stdout
    metrics = json.loads((tmp_path / "out/metrics.json").read_text("utf-8"))
    assert metrics["attribution"]["shares"][0]["name"] == "friction law"
    report = (tmp_path / "out/report.html").read_text("utf-8")
    assert (
        "Attribution of the difference" in report
        and "bends: prescribed → compliant" in report
    )
