"""Attribution of the difference between the plants: Shapley axioms, switches, and `compare --explain`."""

from __future__ import annotations

import json
from dataclasses import replace
from itertools import permutations
from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st
from synthetic import Snake

from srs_twin import Numerics, TwinSnake, attribution as attribution_module, rollout
from srs_twin.attribution import (
    PlantVariants,
    _builders,
    _in_processes,
    _relative_cost,
    _reporter,
    _Task,
    _window,
    contributions,
    explain,
    main_cause,
    subsets,
)
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


def share(name, value):
    return AssumptionShare(name, name, value, value, value, "averaged")


def test_plot_has_bars_sorted_by_size_that_add_up():
    small = (0.001, 0.1, 0.0, 0.0)
    large = (-0.004, 0.7, 0.05, 0.002)
    rest = (0.001,) * 4
    gap = tuple(np.sum([small, large, rest], axis=0))
    shares = (share("small", small), share("large", large))
    figure = attribution_plot(Attribution((0.1,) * 4, gap, rest, gap, (), shares))
    assert len(figure.axes) == len(MEASURES)
    speed, yaw = figure.axes[:2]
    rows = [tick.get_text() for tick in speed.get_yticklabels()]
    assert rows == ["large", "small", "not explained", "twin − analytical"]
    for axes, title, values, label in (
        (speed, "CoM speed (mm/s)", [-4.0, 1.0, 1.0, -2.0], "−4.0"),
        (yaw, "yaw rate (rad/s)", [0.7, 0.1, 0.001, 0.801], "+0.70"),
    ):
        assert axes.get_title("left") == title
        assert [bar.get_x() for bar in axes.patches] == [0.0] * 4
        assert [bar.get_width() for bar in axes.patches] == pytest.approx(values)
        assert axes.texts[0].get_text() == label
    assert yaw.texts[2].get_text() == "0"


@pytest.mark.parametrize("contact", ["loaded", "preloaded"])
def test_variants_of_the_twin_keep_its_friction_solver(contact):
    """The effect of another solver is no part of the difference between model and twin."""
    plants = {"analytical": {}, "twin": {"contact": contact}}
    variants = PlantVariants(scenario(plants=plants))
    changed = [
        type(refinement.options["contact"])
        for refinement in variants.refinements
        if "contact" in refinement.options
    ]
    assert changed == [type(variants.twin().contact)]


def scenario(**changes):
    data = {
        "robot": "gen2",
        "duration_s": 2.0,
        "supply": {"pressure_kpa": 48.3},
        "controller": {"kind": "gait", "frequency_hz": 2.0, "offset": 0.2},
    }
    return parse_scenario(data | changes, name="short")


def ran(s, plant, **options):
    """Return a run of a plant of a scenario with other options."""
    plant = s.build_plant(plant, **options)
    return rollout(plant, s.build_controller(), **s.timing)


def both(s):
    return {plant: ran(s, plant) for plant in ("analytical", "twin")}


def between(runs, end=None):
    """Return the differences between two runs until a time."""
    pair = [runs[plant] for plant in ("analytical", "twin")]
    if end is not None:
        pair = [run.between(0.0, end) for run in pair]
    return gap_between(*pair)


def assert_adds_up(attribution, gap):
    """Assert that the contributions and the remainder add up to a difference."""
    assert attribution.gap == pytest.approx(gap)
    parts = [share.value for share in attribution.shares]
    total = np.sum([*parts, attribution.remainder], axis=0)
    assert total == pytest.approx(gap, abs=1e-12)


@pytest.fixture(scope="module")
def explained():
    s = scenario()
    progress: list[tuple[float, float | None]] = []
    walls = {"analytical": 0.01, "twin": 0.5}
    attribution = explain(
        s, both(s), progress=lambda *reported: progress.append(reported), wall_s=walls
    )
    return attribution, progress


@pytest.mark.slow
def test_variants_under_a_controller_with_sensors_are_the_same_in_worker_processes():
    s = load_scenario("ilc_straight", set={"duration_s": 1.0})
    builders = _builders(PlantVariants(s))
    names = list(builders)[:2]
    counts = []
    tasks = [_Task(s, name, s.build_controller(), s.duration) for name in names]
    runs = _in_processes(tasks, counts.append)
    assert counts == [1, 2]
    assert [run.metadata["plant"] for run in runs] == ["twin", "analytical"]
    for name, run in zip(names, runs, strict=True):
        here = rollout(builders[name](), s.build_controller(), **s.timing)
        for column in ("com_x", "bend_1", "duty_plus_1"):
            assert (here[column] == run[column]).all()


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
    twin = runs["twin"]
    model = ran(s, "analytical", inertia="connector")
    gap = gap_between(model, twin)
    half_step = ran(s, "twin", timestep=s.build_plant("twin").timestep / 2)
    still_wheels = ran(s, "twin", numerics=Numerics(wheel_spin=0.0))
    finer = ran(
        s,
        "analytical",
        inertia="connector",
        timestep=0.002 / 4,
        slip_speed=0.00025 / 4,
    )
    expected = {
        "connector inertia": between(runs) - gap,
        "twin time step": 4 / 3 * (gap - gap_between(model, half_step)),
        "wheel inertia": gap - gap_between(model, still_wheels),
        "model time step": 4 / 3 * (gap - gap_between(finer, twin)),
    }
    attribution = explain(s, runs)
    assert_adds_up(attribution, between(runs))
    averaged = {share.name for share in attribution.shares if share.how == "averaged"}
    assert averaged == {"connector inertia"}
    shares = {share.name: share.value for share in attribution.shares}
    for name, value in expected.items():
        assert np.abs(value[:2]).min() > 1e-4
        assert shares[name] == pytest.approx(value), name


def test_contributions_follow_from_the_speeds_of_the_variants(monkeypatch):
    speeds = {
        "model with compliance": 0.17,
        "model with connector inertia": 0.19,
        "model with compliance, connector inertia": 0.15,
        "model time step": 0.152,
        "twin time step": 0.163,
        "stiff twin": 0.18,
        "matched": 0.175,
    }

    def crawling(speed):
        return Snake(speed=speed, sway=(0, 0)).trajectory()

    def simulated(scenario, variants, *options):
        names = _builders(variants)
        assert speeds.keys() < names.keys()
        runs = {name: crawling(speeds.get(name, 0.16)) for name in names}
        return runs | dict.fromkeys(variants.damped_twins(), crawling(0.161))

    monkeypatch.setattr(attribution_module, "_run_all", simulated)
    alike = {"model": "complete", "friction": "wheel", "inertia": "point"}
    s = scenario(plants={"analytical": alike, "twin": {}})
    found = explain(s, {"analytical": crawling(0.2), "twin": crawling(0.16)})
    shares = {each.name: each for each in found.shares}
    compliance = shares.pop("compliance")
    assert compliance.value[0] == pytest.approx(-0.035)
    assert (compliance.low[0], compliance.high[0]) == pytest.approx((-0.04, -0.03))
    values = {name: each.value[0] for name, each in shares.items()}
    # Refinements by which no speed changed contribute nothing.
    assert values == pytest.approx(
        dict.fromkeys(shares, 0.0)
        | {
            "connector inertia": -0.015,
            "twin time step": -4 / 3 * 0.003,
            "model time step": 4 / 3 * 0.002,
        },
        abs=1e-6,
    )
    assert found.reference[0] == pytest.approx(0.2)
    assert found.gap[0] == pytest.approx(-0.04)
    assert found.matched[0] == pytest.approx(0.005, rel=1e-4)
    assert found.remainder[0] == pytest.approx(
        -0.04 + 0.05 + 0.004 - 0.008 / 3, abs=1e-6
    )
    assert len(found.damping) == 2
    for change in found.damping.values():
        assert change[0] == pytest.approx(0.001, rel=1e-3)


def test_only_differing_assumptions_are_switched():
    def variants(analytical, robot="gen2", **twin):
        plants = {"analytical": analytical, "twin": twin}
        return PlantVariants(scenario(plants=plants, robot=robot))

    def names(items):
        return [item.name for item in items]

    alike = {"model": "compliant", "friction": "wheel", "inertia": "connector"}
    assert variants(alike).switches == []
    assert variants(alike | {"contact": True}).matched().options.contact is False
    other = {"model": "simplified", "friction_torque": False, "gaps": False}
    found = variants(other, wheels="skid")
    assert names(found.switches) == [
        "friction law",
        "wheel track",
        "rigid gaps",
        "compliance",
        "connector inertia",
    ]
    assert names(found.first) == ["frozen chords"]
    assert "wheel inertia" not in names(found.refinements)
    damped = {"base": "gen2", "bending": {"damping_time_s": 0.01}}
    assert "damping" in names(variants({}, robot=damped).switches)


def test_every_switch_changes_the_plant():
    variants = PlantVariants(
        scenario(plants={"analytical": {"model": "simplified"}, "twin": {}})
    )
    every = [switch.name for switch in (*variants.first, *variants.switches)]
    plain, all_on = (
        variants.analytical(frozenset(on)).describe() for on in ((), every)
    )
    for key, off, on in (
        ("model", "simplified", "compliant"),
        ("friction", "axis", "wheel"),
        ("track_m", 0.0, 0.015),
        ("inertia", "point", "connector"),
    ):
        assert (plain[key], all_on[key]) == (off, on)
    for refinement in variants.refinements:
        if refinement.plant == "twin" and "robot" not in refinement.options:
            about = variants.twin(**refinement.options).describe()
            assert about != variants.twin().describe(), refinement.name


@pytest.mark.slow
def test_frozen_chords_are_switched_first_and_shares_add_up():
    """Compliant bends include arcs; averaging over both orders would split the contribution of arcs."""
    frozen = {"model": "simplified", "friction_torque": False}
    s = scenario(plants={"analytical": frozen, "twin": {}})
    runs = both(s)
    attribution = explain(s, runs)
    assert_adds_up(attribution, between(runs))
    first = attribution.shares[0]
    assert (first.name, first.how) == ("frozen chords", "first")
    arcs = ran(s, "analytical", model="complete", friction_torque=True)
    change = between(runs) - gap_between(arcs, runs["twin"])
    assert first.value == pytest.approx(change)


@pytest.mark.slow
def test_diverged_variant_is_named_and_keeps_the_run(tmp_path, monkeypatch):
    def stuck(self):
        raise DivergedError("twin", 0.3, "it flew")

    monkeypatch.setattr(PlantVariants, "stiff_twin", stuck)
    result = prepare(scenario(), tmp_path).execute(explain=explain)
    (error,) = result.failed_attributions
    said = "short: attribution: stiff twin: twin diverged at t = 0.3 s: it flew"
    assert str(error) == said
    assert result.metrics["plants"]["twin"]["com_speed_m_s"] > 0.1
    assert "attribution" not in result.metrics
    for name in ("report.html", "twin.parquet"):
        assert (tmp_path / name).is_file()


def test_remaining_time_is_in_proportion_to_the_costs(monkeypatch):
    clock = SimpleNamespace(now=0.0)
    clock.monotonic = lambda: clock.now
    monkeypatch.setattr(attribution_module, "time", clock)
    walls = {"analytical": 0.4, "twin": 2.5}
    names = ["twin time step", "matched", "model with compliance"]
    costs = [_relative_cost(name, walls) for name in names]
    assert costs == pytest.approx([3.5, 1.0, 1.0])
    seen = []
    report = _reporter(lambda *told: seen.append(told), costs, is_measured=True)
    clock.now = 7.0
    report(1)
    report(3)
    whole = 5.5 / min(processor_count(), 3)
    assert seen == [(0.0, whole), pytest.approx((3.5 / 5.5, 4.0)), (1.0, 0.0)]


@pytest.mark.parametrize(
    ("name", "seconds", "window"),
    [
        ("gen1_straight", 1e3, None),
        ("ilc_straight", 25.0, 12.0),
        ("ilc_straight", 11.0, None),
        ("ilc_growth", 8.0, 4.0),  # four periods of 1 s, 16,000 steps
    ],
)
def test_only_long_runs_under_feedback_are_attributed_over_a_window(
    name, seconds, window
):
    s = load_scenario(name)
    assert _window(s, s.build_controller(), seconds) == window


def test_window_of_a_run_equals_a_shorter_run():
    long, short = (
        ran(load_scenario("ilc_straight", set={"duration_s": duration}), "analytical")
        for duration in (1.2, 0.8)
    )
    part = long.between(0.0, 0.8)
    assert part.columns.keys() == short.columns.keys() and len(part) == len(short) == 81
    for name, column in short.columns.items():
        assert np.array_equal(part[name], column, equal_nan=True)


@pytest.mark.slow
def test_attribution_over_a_window_adds_up_to_the_difference_in_it(monkeypatch):
    s = load_scenario("ilc_straight", set={"duration_s": 5})
    monkeypatch.setattr(attribution_module, "_MAX_STEPS", 3000)
    monkeypatch.setattr(attribution_module, "_MIN_WINDOW_PERIODS", 3)
    runs = both(s)
    attribution = explain(s, runs)
    assert attribution.window_s == attribution.document()["window_s"] == 3.0
    assert_adds_up(attribution, between(runs, 3.0))
    assert attribution.gap != pytest.approx(between(runs))


def test_run_without_attribution_is_rejected():
    s = scenario(duration_s=1.0)
    runs = both(s)
    scaled = {"analytical": {"gaps": False}, "twin": {}}
    with_factor = scenario(plants=scaled, comparison={"gap_factor": True})
    for case, plants, words in (
        (s, {"twin": runs["twin"]}, "an attribution compares the two plants, but only"),
        (
            with_factor,
            both(with_factor),
            "because `comparison.gap_factor` scales the speed",
        ),
        (s, runs, r"short: .*; at least three gait periods are needed"),
    ):
        with pytest.raises(InputError, match=words):
            explain(case, plants)


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
    assert cause["window_s"] == end
    plant = PlantVariants(s).analytical(frozenset({"compliance"}))
    compliant = rollout(plant, s.build_controller(), s.duration)
    before, after = (
        plant_metrics(run.between(0.0, end)) for run in (runs["analytical"], compliant)
    )
    for name in ("com_speed_m_s", "yaw_rate_rad_s"):
        assert cause[name] == pytest.approx(after[name] - before[name])
    short = {plant: run.between(0.0, 1.2) for plant, run in runs.items()}
    assert main_cause(s, short) is None


def test_variants_of_the_twin_run_without_obstacles():
    variants = PlantVariants(blocked(0.45))
    assert not variants.twin().has_contact and not variants.stiff_twin().has_contact


@pytest.mark.slow
def test_attribution_adds_up_to_the_difference_before_the_contact():
    s = blocked(0.45)
    runs = both(s)
    attribution = explain(s, runs)
    assert attribution.window_s == contact_free_s(runs.values())
    assert_adds_up(attribution, between(runs, attribution.window_s))
    # Compliance explains most of the difference, as in a run without an obstacle.
    largest = max(attribution.shares, key=lambda share: abs(share.value[0]))
    assert largest.name == "compliance"


def test_early_contact_leaves_nothing_to_explain(tmp_path, srs_twin):
    world = "world.obstacles=[{x_m: 0.35, y_m: 0, radius_m: 0.05}]"
    words = ("gen2_straight", "--set", world, "--duration", "2", "--explain")
    done = srs_twin("compare", *words, "--out", "out", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert done.stderr.count("ignores the obstacles of this world") == 1
    text = " ".join(done.stdout.split())
    assert text.startswith("The twin touches an obstacle ")
    assert "; the model ignores obstacles and overlaps one at 1.13 s, for " in text
    assert "compliance" not in text.lower()
    metrics = json.loads((tmp_path / "out/metrics.json").read_text("utf-8"))
    assert "attribution" not in metrics
    assert metrics["ignores_obstacles"] == ["analytical"]
    twin, model = (metrics["plants"][name] for name in ("twin", "analytical"))
    for plant, kinds in (
        ("analytical", ["overlap"]),
        ("twin", ["contact"] * twin["contacts"]),
    ):
        assert [event["kind"] for event in metrics["events"][plant]] == kinds
    assert model["clearance_m"] < -0.04 < -0.001 < twin["clearance_m"] <= 0.0
    assert model["contact_time_s"] > twin["contact_time_s"] > 0.0
    report = (tmp_path / "out/report.html").read_text("utf-8")
    assert "passes through an obstacle" in report


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
