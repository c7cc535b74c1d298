"""Emulated robot: injected faults, watchdog, messages in real time over a real broker."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from brokers import broker, free_port, needs_broker, wait

from srs_twin import Gait, InputError, load_robot
from srs_twin.live import emulator
from srs_twin.live.emulator import KINDS, EmulatedRobot, Fault, Simulation
from srs_twin.live.links import BrokerAccess, MqttLink
from srs_twin.live.messages import BENDS, COMMAND, PRESSURES, STATUS, VALVES, Message
from srs_twin.live.natnet import rotate
from srs_twin.live.optitrack import NatNetLink

QUIET = {"simulation": Simulation(gain_spread=0.0), "noise_rad": 0.0}


def walked(robot: EmulatedRobot, seconds: float) -> dict[str, np.ndarray]:
    """Drive a robot by a gait; return its readings and states at each tick."""
    gait = Gait(1.5)
    gait.reset(robot.twin.spec, robot.tick)
    seen = {"bends": [], "true": [], "pressure": [], "tracked": []}
    for k in range(round(seconds / robot.tick)):
        valves = gait.valves_at(k * robot.tick)
        state = robot.step(valves if valves.ndim == 2 else valves[-1])
        seen["bends"].append(robot.bends())
        seen["true"].append(state.bend)
        seen["pressure"].append(state.pressure)
        seen["tracked"].append([each.tracked for each in robot.bodies().values()])
    return {name: np.array(values) for name, values in seen.items()}


@pytest.mark.slow
def test_faults_do_what_they_say():
    at = 1.0
    whole = walked(EmulatedRobot("gen4", **QUIET), 3.0)
    later = np.arange(len(whole["bends"])) * 0.02 > at + 0.5
    ill = {
        text: walked(EmulatedRobot("gen4", faults=[f"{text}@{at}"], **QUIET), 3.0)
        for text in (
            "stuck_valve:2+",
            "stuck_valve:2+=closed",
            "leak:1-=fast",
            "dead_sensor:3",
            "dead_sensor:3=frozen",
            "drifting_sensor:4",
            "low_supply_pressure",
            "lost_marker:5",
        )
    }
    for each in ill.values():
        before = slice(0, round(at / 0.02) - 1)
        assert np.array_equal(each["true"][before], whole["true"][before])
    # A chamber that always fills is squeezed by the other one; a sound one is empty
    # once a period.
    assert ill["stuck_valve:2+"]["pressure"][later, 1, 0].min() > 20e3
    assert whole["pressure"][later, 1, 0].min() < 2e3
    assert ill["stuck_valve:2+=closed"]["pressure"][later, 1, 0].max() < 1e3
    leaky, sound = (
        each["pressure"][later, 0, 1].max() for each in (ill["leak:1-=fast"], whole)
    )
    assert leaky < 0.9 * sound
    assert np.isnan(ill["dead_sensor:3"]["bends"][later, 2]).all()
    assert np.ptp(ill["dead_sensor:3=frozen"]["bends"][later, 2]) == 0
    drift = (ill["drifting_sensor:4"]["bends"] - ill["drifting_sensor:4"]["true"])[:, 3]
    assert drift[-1] == pytest.approx(0.1 * (3.0 - at), abs=0.01)
    assert (
        ill["low_supply_pressure"]["pressure"][later].max()
        < 0.6 * whole["pressure"][later].max()
    )
    assert ill["lost_marker:5"]["tracked"][-1].tolist() == [
        True,
        True,
        True,
        True,
        False,
    ]


@pytest.mark.default_cases(at=[0, 1, 2, 4, 5])
@pytest.mark.parametrize(
    ("text", "why"),
    [
        ("stuck", "is not a valid fault; write"),
        ("stuck_valv:2+@5", "unknown fault 'stuck_valv'"),
        ("stuck_valve:2@5", "affects one chamber; write it as stuck_valve:2\\+@5"),
        (
            "low_supply_pressure:2@5",
            "affects the whole robot; write it as low_supply_pressure@5",
        ),
        ("dead_sensor:5@1", "segment 5 does not exist; the robot has 4 of them"),
        ("stuck_valve:2+=shut@5", "unknown variant of stuck_valve 'shut'"),
    ],
)
def test_what_is_no_fault_is_refused(text, why):
    with pytest.raises(InputError, match=why):
        Fault.parse(text, 4)


def test_every_kind_can_be_told():
    for kind, (of, ways) in KINDS.items():
        where = {"chamber": ":1-", "segment": ":1", "connector": ":5", "": ""}[of]
        for how, value in ways.items():
            assert Fault.parse(f"{kind}{where}={how}@2.5", 4).how == value


def test_a_robot_is_given_by_name_or_path(tmp_path, root):
    file = root / "calibration" / "robots" / "gen4.yaml"
    (tmp_path / "mine.yaml").write_text(file.read_text("utf-8"), "utf-8")
    assert (
        EmulatedRobot(str(tmp_path / "mine.yaml"), seed=1).twin.spec
        == EmulatedRobot("gen4", seed=1).twin.spec
    )
    with pytest.raises(InputError, match="nowhere.yaml: no such file"):
        EmulatedRobot(str(tmp_path / "nowhere.yaml"))


def test_robots_differ_by_seed_and_only_by_it():
    one, other, again = (EmulatedRobot("gen4", seed=seed) for seed in (1, 2, 1))
    assert one.twin.spec != other.twin.spec
    assert one.twin.spec == again.twin.spec
    assert one.twin.spec != load_robot("gen4")


def test_sensor_and_camera_noise_is_independent_in_every_component():
    """Tolerances are five standard errors of 1000 frames; heading markers are 20 mm from the centre."""
    robot = EmulatedRobot("gen4", seed=3, noise_rad=0.05)
    seen = []
    bends = []
    for _ in range(1000):
        seen.append([rotate(each, "y")[[0, 1, 3]] for each in robot.bodies().values()])
        bends.append(robot.bends())
    state = robot.state
    bends = np.array(bends)
    noise = np.array(seen) - np.column_stack([state.position, state.connector_heading])
    noise[:, :, 2] = np.arctan2(np.sin(noise[:, :, 2]), np.cos(noise[:, :, 2]))
    assert noise.std(axis=0) == pytest.approx(
        np.tile([0.3e-3, 0.3e-3, 0.3e-3 / 0.02], (5, 1)), rel=0.11
    )
    assert (bends - state.bend).std(axis=0) == pytest.approx(np.full(4, 0.05), rel=0.11)
    both = np.hstack([noise.reshape(1000, -1), bends])
    assert np.abs(np.corrcoef(both.T) - np.eye(both.shape[1])).max() < 0.16


def test_duties_fill_in_between():
    robot = EmulatedRobot("gen4", **QUIET)
    duty = np.zeros((4, 2))
    duty[:, 0] = 0.5
    for _ in range(60):
        half = robot.step(duty).pressure
    assert (half[:, 0] > 5e3).all() and (half[:, 0] < 45e3).all()
    assert (half[:, 1] < 1e3).all()


class Bench:
    """A robot, its link and a clock that only sleeping moves; the robot keeps when it obeyed."""

    tick = 0.02
    valves = np.zeros((4, 2))

    def __init__(self, monkeypatch, commands=()):
        self.now = 100.0
        self.obeyed = []
        self.sent = []
        self._commands = [100.0 + each for each in commands]
        monkeypatch.setattr(emulator, "clock", lambda: self.now)
        monkeypatch.setattr(emulator, "time", SimpleNamespace(sleep=self._sleep))

    def _sleep(self, seconds):
        self.now += seconds

    def received(self):
        due = [each for each in self._commands if each <= self.now]
        self._commands = self._commands[len(due) :]
        return [Message(COMMAND, "bench", each, each, np.ones((4, 2))) for each in due]

    def send(self, kind, values, at=None, wait_s=0.0):
        if at is not None:
            self.sent.append((kind, at, self.now))

    def step(self, command):
        self.obeyed.append((self.now, command is not None))
        return SimpleNamespace(pressure=np.zeros((4, 2)))

    def bends(self):
        return np.zeros(4)


def test_robot_vents_a_fifth_of_a_second_after_the_last_command(monkeypatch):
    commands = [0.0, 0.05, 0.2, 1.0]
    bench = Bench(monkeypatch, commands)
    emulator.emulate(bench, bench, None, duration=2.0)
    assert len(bench.obeyed) == pytest.approx(100, abs=1)
    for now, obeys in bench.obeyed:
        since = [now - 100.0 - each for each in commands if each <= now - 100.0]
        assert obeys == (since[-1] < 0.2 + 1e-9)


def test_messages_are_lost_and_late_as_the_air_says(monkeypatch):
    """Five standard errors of 3000 messages; messages leave when the emulator wakes, every 2 ms."""
    bench = Bench(monkeypatch)
    transport = emulator.Transport(loss=0.3, jitter=0.05, seed=3)
    emulator.emulate(bench, bench, None, transport=transport, duration=20.0)
    late = np.array([now - at for _, at, now in bench.sent])
    assert len(late) == pytest.approx(0.7 * 3000, abs=5 * 25)
    assert late.min() >= -1e-9 and late.max() <= 0.05 + 0.0031
    assert late.mean() == pytest.approx(0.025 + 0.0015, abs=0.003)
    assert {kind for kind, _, _ in bench.sent} == {BENDS, PRESSURES, VALVES}


@pytest.mark.slow
@needs_broker
def test_it_lives_in_real_time_and_vents_when_nobody_commands(tmp_path):
    port = free_port()
    capture = free_port()
    command = [
        *(
            str(Path(sys.executable).with_name("srs-twin")),
            "emulate",
            "gen4",
            "--mqtt",
            f"127.0.0.1:{port}",
        ),
        *(
            "--natnet",
            f"127.0.0.1:{capture}",
            "--name",
            "bench",
            "--fault",
            "lost_marker:5@0",
        ),
        *("--loss", "0.05", "--jitter-s", "0.02"),
    ]
    kinds = (BENDS, PRESSURES, VALVES, STATUS)
    with (
        broker(tmp_path, port),
        MqttLink("bench", 4, BrokerAccess(port=port), kinds=kinds) as link,
    ):
        process = subprocess.Popen(
            command, env=os.environ | {"PYTHONUNBUFFERED": "1"}, cwd=tmp_path
        )
        eyes = NatNetLink(port=capture)
        heard = []
        poses = []
        try:
            wait(
                lambda: (
                    heard.extend(link.received()) or any(m.kind == BENDS for m in heard)
                ),
                60,
            )
            fill = np.tile([1.0, -1.0], (4, 1))
            end = time.monotonic() + 2.0
            heard.clear()
            while time.monotonic() < end:
                link.send(COMMAND, fill)
                time.sleep(0.05)
                heard += link.received()
                poses += eyes.received()
            filled = [m for m in heard if m.kind == PRESSURES][-1].values
            assert (filled[:, 0] > 20e3).all() and (filled[:, 1] < 1e3).all()
            bends = [m for m in heard if m.kind == BENDS]
            spans = np.diff([m.sent for m in bends])
            assert 40 <= len(bends) <= 101, "50 a second, some lost"
            assert np.median(spans) == pytest.approx(0.02, abs=0.004)
            assert poses[-1].names == (
                "connector_1",
                "connector_2",
                "connector_3",
                "connector_4",
            )
            assert poses[-1].values[:, 2] == pytest.approx(0.02)
            time.sleep(1.5)
            heard += link.received()
            assert ([m for m in heard if m.kind == PRESSURES][-1].values < 2e3).all()
            assert ([m for m in heard if m.kind == VALVES][-1].values == -1).all()
            process.send_signal(signal.SIGTERM)
            assert process.wait(20) == 0
            wait(
                lambda: heard.extend(link.received()) or heard[-1].names == ("stopped",)
            )
        finally:
            process.kill()
            process.wait()
            eyes.close()


def test_the_command_says_what_is_wrong(srs_twin, tmp_path):
    port = free_port()
    for more, why in (
        (("--fault", "stuck@1"), "unknown fault 'stuck'"),
        ((), f"no broker answers at 127.0.0.1:{port}"),
        (("--name", "a/b"), "cannot be part of an MQTT topic"),
        (("--start", "1,2"), "--start '1,2' is not a pose; give x and y in m"),
        (("--chambers", "orifce"), "did you mean orifice?"),
    ):
        done = srs_twin(
            "emulate", "gen4", "--mqtt", f"127.0.0.1:{port}", *more, cwd=tmp_path
        )
        assert done.returncode == 2
        assert why in " ".join(done.stderr.split())
