"""Typical mistakes of a first day: every message names the place and a remedy, and none a wrong word."""

from __future__ import annotations

import pytest

GOOD = """title: Mine
robot: gen2
duration_s: 2
supply: {pressure_kpa: 48.3}
controller: {kind: gait, frequency_hz: 2.0, offset: 0.0}
plants: {analytical: {}, twin: {}}
"""

TYPED = [
    ("run gen2straight", "unknown scenario 'gen2straight'; did you mean gen2_straight?"),
    ("run scenario/gen2_straight.yaml", "no such file; did you mean gen2_straight?"),
    ("run mine.yml", "mine.yml: no such file"),
    ("comapre gen2_straight", "Did you mean 'compare'?"),
    ("compare gen2_straight --explian", "--explain"),
    ("compare gen2_straight --set stiffness=0.2", "did you mean robot.bending.stiffness_nm_per_rad?"),
    ("compare gen2_straight --set robot.mu_t=0.2", "did you mean robot.friction.mu_t?"),
    ("compare gen2_straight --set friction.mu_t=0.2", "did you mean robot.friction.mu_t?"),
    ("compare gen2_straight --set supply.pressure_kpa", "must be FIELD=VALUE"),
    ("compare gen2_straight --duration=-1", "--duration -1: duration_s: must be a number from 0.001"),
    ("compare gen2_straight --duration 3s", "write the number alone, its unit stands in the key"),
    ("run gen2_straight --seed 1.5", "--seed 1.5: seed: must be a whole number from 0"),
    ("run gen2_straight --plants both", "--plants: 'both' is unknown; allowed: analytical, twin"),
    ("show gen5", "unknown scenario or robot 'gen5'; did you mean gen"),
    ("list robot", "unknown kind 'robot'; did you mean robots?"),
    (
        "sweep gen2_straight",
        "unknown sweep 'gen2_straight' (available: 16 names; `srs-twin list sweeps` lists them)",
    ),
    ("plan gen2_straight", "there is no planner section; add planner, and controller.kind: follow"),
    ("view gen2_straight", "no recording there"),
    ("render gen2_straight", "give one of --video FILE.mp4"),
    ("diff a b", "a: no such file"),
    ("models export gen7", "unknown robot 'gen7'; did you mean gen"),
    ("models export gen2 --contact loaded", "no MJCF file carries"),
    ("models check model.xml", "model.xml: no such file; give an MJCF or URDF file"),
    ("models check ./model.xml", "give an MJCF or URDF file, or the name of a shipped robot"),
    ("play gen22", "unknown robot 'gen22'; did you mean gen2?"),
    ("play gen2 --set controller.offset=0.1", "play has no scenario; set a field of robot"),
    ("reproduce --only XY", "docs/reproduction.md lists them"),
    ("schema robots", "(available: inspect, scenario, setup, study, sweep)"),
    ("replay walk.csv --robot gen2", "walk.csv: no such file"),
]

WRITTEN = [
    ("robot: gen2", "robot: gen 2", "2:8: robot: unknown robot 'gen 2'; did you mean gen2?"),
    ("title: Mine", "title: Mine\nbending: {k: 1}", "2:1: bending: unknown key; did you mean robot.bending?"),
    ("frequency_hz: 2.0", "frequency: 2.0", "controller.frequency: unknown key; did you mean frequency_hz?"),
    ("frequency_hz: 2.0", "frequency_hz: 2,0", "unknown key; a number has a decimal point, no comma"),
    ("frequency_hz: 2.0", "frequency_hz: 2 Hz", "not text '2 Hz'; write the number alone"),
    ("pressure_kpa: 48.3", "pressure_psi: 7", "supply.pressure_psi: unknown key; did you mean pressure_kpa?"),
    ("pressure_kpa: 48.3", "pressure_kpa: 483", "lower it, or set allow_overpressure: true"),
    ("pressure_kpa: 48.3", "pressure_kpa: 48300", "not 48300; did you mean 48.3?"),
    ("kind: gait", "kind: sine", "controller.kind: must be one of gait, ilc,"),
    ("kind: gait, ", "", "controller.kind: missing"),
    ("duration_s: 2", "duration_s: 2.005", "no multiple of the analytical plant's tick 0.02 s; 2 s"),
    ("duration_s: 2", "duration: 2", "3:1: duration: unknown key; did you mean duration_s?"),
    ("duration_s: 2", "duration_s: 2\n\tseed: 1", "YAML is indented with spaces, not tabs"),
    ("twin: {}", "twin: {wheels: skis}", "one of rolling, skid, not text 'skis'; did you mean skid?"),
    ("twin: {}", "twin: {timestep_ms: 1}", "plants.twin.timestep_ms: unknown key; did you mean timestep_s?"),
    (
        "twin: {}",
        "twin: {contact: preloaded, friction: wheel}",
        "plants.twin: friction needs contact: loaded",
    ),
    ("analytical: {}", "analytical: {model: compliance}", "did you mean compliant?"),
    (
        "twin: {}}",
        "twin: {contact: preloaded}}\nworld: {floor: {tilt_deg: 3}}",
        "7:16: world.floor: a twin on this floor needs contact: loaded (plants.twin)",
    ),
    ("title: Mine", "title: Mine\nworld: {obstacles: [{x: 1}]}", "known here: x_m, y_m, radius_m"),
    (
        "title: Mine",
        "title: Mine\nexpect: [{metric: speed, plant: twin, below: 1}]",
        "did you mean com_speed_m_s",
    ),
    (
        "title: Mine",
        "title: Mine\nexpect: [{metric: com_speed_m_s, plant: twin, near: 1}]",
        "either rel or abs",
    ),
    ("robot: gen2", "robot: {base: gen2, geometry: {segment_length_m: 37}}", "not 37; did you mean 0.037?"),
    ("supply: {pressure_kpa: 48.3}", "supply: 48.3", "4:9: supply: must be a block of keys (pressure_kpa,"),
    ("controller:", "controllers:", "5:1: controllers: unknown key; did you mean controller?"),
]


@pytest.mark.parametrize(("typed", "said"), TYPED)
def test_what_was_typed(srs_twin, tmp_path, typed, said):
    done = srs_twin(*typed.split(), cwd=tmp_path)
    assert done.returncode == 2
    assert said in done.stderr
    assert not done.stdout and not list(tmp_path.iterdir())


@pytest.mark.parametrize(("good", "bad", "said"), WRITTEN)
def test_what_was_written(srs_twin, tmp_path, good, bad, said):
    assert good in GOOD
    (tmp_path / "mine.yaml").write_text(GOOD.replace(good, bad))
    done = srs_twin("run", "mine.yaml", cwd=tmp_path)
    assert done.returncode == 2
    assert any(line.startswith("mine.yaml:") and said in line for line in done.stderr.splitlines())
    assert [each.name for each in tmp_path.iterdir()] == ["mine.yaml"]
