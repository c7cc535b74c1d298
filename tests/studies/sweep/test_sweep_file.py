"""Sweep files: points, and messages for invalid files."""

from __future__ import annotations

import pytest
from small import SMALL, write

from srs_twin.errors import InputError
from srs_twin.io.files import shipped_names
from srs_twin.scenario.loading import load_scenario, parse_scenario
from srs_twin.studies.sweep.loading import load_sweep


def test_a_grid_makes_documents_with_the_varied_fields(tmp_path):
    sweep = load_sweep(write(tmp_path))
    assert (sweep.name, len(sweep.points), sweep.experiment.plants) == (
        "small",
        8,
        ("analytical",),
    )
    scenario = parse_scenario(sweep.experiment.document(sweep.points[-1].changes))
    assert (
        scenario.controller.frequency_hz,
        scenario.supply_pa,
        scenario.duration,
    ) == (2.5, 55e3, 2.0)
    # Everything else is the scenario's.
    assert scenario.robot == load_scenario("gen2_straight").robot


@pytest.mark.default_cases(2)
@pytest.mark.parametrize("name", shipped_names("sweep"))
def test_shipped_sweeps_load(name):
    assert len(load_sweep(name).points) > 1


@pytest.mark.slow
def test_shipped_grids_are_those_of_the_figures():
    """Sections 3.4.1 to 3.4.3: 56 frequencies by 31 pressures; the ranges of Fig. 32, 33, 38."""
    sizes = {
        name: len(load_sweep(name).points)
        for name in ("fig31", "fig32", "fig33", "fig38", "fig39")
    }
    assert sizes == {"fig31": 1736, "fig32": 88, "fig33": 88, "fig38": 30, "fig39": 12}
    pressures = [
        point.changes["supply.pressure_kpa"] for point in load_sweep("fig31").points
    ]
    assert min(pressures) == pytest.approx(3.125 * 6.894757, rel=1e-4)
    assert max(pressures) == pytest.approx(5 * 6.894757, rel=1e-4)


def test_periods_are_rounded_to_whole_ticks(tmp_path):
    # 5/0.7 = 7.1429 s is rounded up to ticks of 20 ms or 50 ms.
    for tick, expected in ((0.02, {7.16, 2.0}), (0.05, {7.15, 2.0})):
        fixed = f"periods: 5\nfixed: {{plants.analytical.tick_s: {tick}}}"
        text = SMALL.replace("fixed: {duration_s: 2}", fixed)
        sweep = load_sweep(write(tmp_path, text.replace("[2, 2.5]", "[0.7, 2.5]")))
        durations = {
            sweep.experiment.document(point.changes)["duration_s"]
            for point in sweep.points
        }
        assert durations == expected


def test_a_sweep_may_have_one_point(tmp_path):
    text = SMALL.replace("[2, 2.5]", "[2]").replace(
        "{from: 41, to: 55, count: 4}", "[48]"
    )
    (point,) = load_sweep(write(tmp_path, text)).points
    assert point.changes == {"controller.frequency_hz": 2, "supply.pressure_kpa": 48}


def test_a_varied_robot_value_keeps_its_unit(tmp_path):
    text = SMALL.replace(
        "controller.frequency_hz: [2, 2.5]", "robot.friction.mu_n: [0.3, 0.4]"
    )
    sweep = load_sweep(write(tmp_path, text))
    record = sweep.experiment.document(sweep.points[-1].changes)["robot"]["friction"][
        "mu_n"
    ]
    assert record == {
        "value": 0.4,
        "unit": "1",
        "status": "estimated",
        "source": "varied by a sweep",
    }


def test_the_resolved_scenario_expects_only_results_of_plants_that_run(tmp_path):
    base = load_sweep(write(tmp_path)).experiment.base
    assert {item.subject for item in parse_scenario(base).file.expect} == {"analytical"}


@pytest.mark.parametrize(
    ("span", "seeds"),
    [
        ("{from: 0, to: 4, count: 5}", [0, 1, 2, 3, 4]),
        ("{from: 1, to: 32, count: 6, scale: log}", [1, 2, 4, 8, 16, 32]),
    ],
)
def test_a_range_of_whole_numbers_suits_whole_fields(tmp_path, span, seeds):
    text = SMALL.replace("controller.frequency_hz: [2, 2.5]", f"seed: {span}")
    points = load_sweep(write(tmp_path, text)).points
    assert list(dict.fromkeys(point.changes["seed"] for point in points)) == seeds


def test_a_range_of_a_field_for_numbers_gives_floats(tmp_path):
    text = SMALL.replace("[2, 2.5]", "{from: 1, to: 3, count: 3}")
    values = load_sweep(write(tmp_path, text)).values
    assert {type(frequency) for frequency, _ in values} == {float}


def test_robots_are_varied_by_name(tmp_path):
    text = SMALL.replace("controller.frequency_hz: [2, 2.5]", "robot: [gen2, gen4]")
    sweep = load_sweep(write(tmp_path, text))
    robots = [
        parse_scenario(sweep.experiment.document(point.changes)).robot.name
        for point in sweep.points[::4]
    ]
    assert robots == ["gen2", "gen4"]


def test_an_element_of_a_list_is_varied(tmp_path):
    scenario = (
        "robot: gen2\nduration_s: 1\ncontroller: {kind: gait, frequency_hz: 2}\n"
        "world: {obstacles: [{x_m: 1, y_m: 0, radius_m: 0.1}]}\n"
    )
    path = write(tmp_path, scenario, "world.yaml")
    text = SMALL.replace("gen2_straight", str(path)).replace(
        "controller.frequency_hz: [2, 2.5]", "'world.obstacles[0].x_m': [2, 3]"
    )
    sweep = load_sweep(write(tmp_path, text))
    assert [
        sweep.experiment.document(p.changes)["world"]["obstacles"][0]["x_m"]
        for p in sweep.points[::4]
    ] == [2, 3]


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        (
            "gen2_straight",
            "gen2_strait",
            "1:11: scenario: unknown scenario 'gen2_strait'; did you mean gen2",
        ),
        (
            "controller.frequency_hz",
            "frequency_hz",
            "5:3: vary.frequency_hz: unknown key; did you mean controller.frequency_hz?",
        ),
        (
            "[2, 2.5]",
            "[2, 99]",
            (
                "5:32: vary.controller.frequency_hz[1]: must be a number from 0.01 to"
                " 50, n"
            ),
        ),
        (
            "[2, 2.5]",
            "[]",
            "5:28: vary.controller.frequency_hz: must have at least 1 entry, not 0",
        ),
        (
            "to: 55",
            "to: 99",
            "6:39: vary.supply.pressure_kpa.to: 99 kPa is above the limit of gen2",
        ),
        (
            "from: 41",
            "from: 61",
            "6:24: vary.supply.pressure_kpa: `from` must be below `to`, but 61 is not"
            " belo",
        ),
        (
            ", count: 4",
            "",
            (
                "5:3: vary: supply.pressure_kpa: the range has no `count`; give"
                " `count`, or set `sampling` to latin_hypercube or sobol"
            ),
        ),
        (
            "plants: [analytical]",
            "plants: [twins]",
            "2:10: plants[0]: must be one of analytical, twin, not",
        ),
        (
            "duration_s: 2",
            "title: x",
            "3:9: fixed.title: this field only names or judges the results",
        ),
        (
            "duration_s: 2}",
            "supply.pressure_kpa: 45}",
            "3:9: fixed.supply.pressure_kpa: this field is also varied",
        ),
        (
            "fixed:",
            "periods: 5\nfixed:",
            "4:9: fixed.duration_s: `periods` also sets the duration",
        ),
        (
            "fixed:",
            "metrics: [speed]\nfixed:",
            "3:11: metrics[0]: unknown metric 'speed'",
        ),
        (
            "fixed:",
            "metrics: [com_speed_rel]\nfixed:",
            "3:11: metrics[0]: the metric `com_speed_rel` compares both plants",
        ),
        (
            "fixed:",
            "plots: [{kind: line, x: seed, metric: com_speed_m_s}]\nfixed:",
            (
                "3:25: plots[0].x: the field 'seed' is not varied; varied:"
                " controller.frequency_hz, supply.pressure_kpa"
            ),
        ),
        (
            "fixed:",
            "sampling: {kind: list}\nfixed:",
            "6:3: vary: `sampling: list` needs the same number of",
        ),
        (
            "fixed:",
            "sampling: {kind: sobol, count: 100}\nfixed:",
            "3:11: sampling: `count` 100 is not allowed for sobol",
        ),
        (
            "fixed:",
            "sampling: {kind: sobol}\nfixed:",
            "3:11: sampling: the sampling sobol needs the number of points",
        ),
        (
            "fixed:",
            "sampling: {seed: 3}\nfixed:",
            "3:11: sampling: `seed` is allowed only for latin_hypercube",
        ),
        (
            "count: 4}",
            "count: 10000}\n  seed: {from: 0, to: 9999, count: 10000}",
            "5:3: vary: the grid has",
        ),
        (
            "controller.frequency_hz",
            "plants.twin.wheels",
            "5:3: vary.plants.twin.wheels: the plant `twin` does not run here",
        ),
        (
            SMALL[SMALL.index("vary:") :],
            "vary: {}",
            "4:7: vary: must have at least 1 entry, not 0",
        ),
        (
            "controller.frequency_hz",
            "controller..frequency_hz",
            "5:29: vary.controller..frequency_hz: 'controller..frequency_hz' is not a va",
        ),
        (
            "fixed:",
            "fixed: {supply.: 1}\nx:",
            "3:18: fixed.supply.: 'supply.' is not a valid field name; write it as in",
        ),
        (
            "controller.frequency_hz: [2, 2.5]",
            "seed: {from: 0, to: 1, count: 3}",
            "5:3: vary: seed: the range gives 0.5, but the field needs whole numbers;",
        ),
    ],
)
def test_one_mistake_gives_one_message(tmp_path, monkeypatch, old, new, message):
    monkeypatch.chdir(tmp_path)
    assert old in SMALL
    with pytest.raises(InputError) as error:
        load_sweep(write(tmp_path, SMALL.replace(old, new, 1)).relative_to(tmp_path))
    lines = str(error.value).splitlines()
    assert any(line.startswith(f"small.yaml:{message}") for line in lines), lines


def test_errors_of_the_scenario_name_its_file(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    write(
        tmp_path,
        "robot: gen2\nduration_s: 1\ncontroller: {kind: gait, frequency_hz: 0}\n",
        "bad.yaml",
    )
    with pytest.raises(
        InputError, match=r"^bad.yaml:3:40: controller.frequency_hz: must be a number"
    ):
        load_sweep(write(tmp_path, SMALL.replace("gen2_straight", "bad.yaml")))


def test_plots_are_judged_only_with_valid_fields_and_metrics(tmp_path):
    text = SMALL.replace("frequency_hz", "frequncy_hz") + (
        "metrics: [com_speed]\n"
        "plots: [{kind: line, x: controller.frequency_hz, metric: com_speed_m_s}]\n"
    )
    with pytest.raises(InputError) as error:
        load_sweep(write(tmp_path, text))
    vary, metric = str(error.value).splitlines()
    assert "unknown key; did you mean frequency_hz?" in vary
    assert "did you mean com_speed_m_s?" in metric
