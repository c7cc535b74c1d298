"""Emulated robot: injected faults, watchdog, messages in real time over a real broker."""

from __future__ import annotations

import json
import os
import signal
from concurrent.futures import ThreadPoolExecutor
from types import SimpleNamespace

import numpy as np
import pytest
from brokers import free_port, wait

from srs_twin import Gait, InputError, load_robot
from srs_twin.live import emulator
from srs_twin.live.emulator import EmulatedRobot, Fault, Simulation
from srs_twin.live.links import Link, MqttLink
from srs_twin.live.messages import (
    BENDS,
    COMMAND,
    PRESSURES,
    STATUS,
    SUPPLY,
    VALVES,
    Message,
)
from srs_twin.live.natnet import rotate
from srs_twin.live.optitrack import NatNetServer

QUIET = {"simulation": Simulation(gain_spread=0.0), "noise_rad": 0.0}


def walked(*faults: str) -> SimpleNamespace:
    """Drive a robot by a gait for a second; return its readings and states at each tick."""
    robot = EmulatedRobot("gen4", faults=[f"{each}@0.4" for each in faults], **QUIET)
    gait = Gait(2.0)
    gait.reset(robot.twin.spec, robot.tick)
    seen = []
    for k in range(50):
        valves = gait.valves_at(k * robot.tick)
        state = robot.step(valves if valves.ndim == 2 else valves[-1])
        tracked = [each.tracked for each in robot.bodies().values()]
        seen.append((state.time, robot.bends(), state.bend, state.pressure, tracked))
    names = ("time", "bends", "true", "pressure", "tracked")
    columns = map(np.array, zip(*seen, strict=True))
    return SimpleNamespace(**dict(zip(names, columns, strict=True)))


def test_faults_of_sensors_and_markers_do_what_they_say():
    faulty = walked(
        "dead_sensor:1", "dead_sensor:2=frozen", "drifting_sensor:3", "lost_marker:5"
    )
    healthy = walked()
    assert np.array_equal(faulty.true, healthy.true)
    before = faulty.time < 0.4 - 1e-9
    later = faulty.time > 0.4 + 1e-9
    assert np.array_equal(faulty.bends[before], faulty.true[before])
    assert np.isnan(faulty.bends[later, 0]).all()
    assert np.ptp(faulty.bends[later, 1]) == 0
    drift = 0.1 * (faulty.time[later] - 0.4)
    assert faulty.bends[later, 2] == pytest.approx(faulty.true[later, 2] + drift)
    assert np.array_equal(faulty.bends[:, 3], faulty.true[:, 3])
    assert faulty.tracked[before].all() and faulty.tracked[:, :4].all()
    assert not faulty.tracked[later, 4].any()


def test_faults_of_valves_and_chambers_do_what_they_say():
    faulty = walked("stuck_valve:2+", "stuck_valve:3-=closed", "leak:1+=fast")
    healthy = walked()
    weak = walked("low_supply_pressure")
    before = healthy.time < 0.4 - 1e-9
    later = healthy.time > 0.75
    for each in (faulty, weak):
        assert np.array_equal(each.true[before], healthy.true[before])
    # A chamber that always fills is squeezed by the other one; a healthy one is empty
    # once a period.
    assert faulty.pressure[later, 1, 0].min() > 20e3
    assert healthy.pressure[later, 1, 0].min() < 3e3
    assert faulty.pressure[later, 2, 1].max() < 1e3
    assert (
        faulty.pressure[later, 0, 0].max() < 0.9 * healthy.pressure[later, 0, 0].max()
    )
    assert weak.pressure[later].max() < 0.6 * healthy.pressure[later].max()


@pytest.mark.parametrize(
    ("text", "why"),
    [
        ("stuck", "is not a valid fault; write"),
        ("stuck_valv:2+@5", "unknown fault 'stuck_valv'"),
        ("stuck_valve:2@5", "affects one chamber; write it as stuck_valve:2\\+@5"),
        ("low_supply_pressure:2@5", "write it as low_supply_pressure@5"),
        ("dead_sensor:5@1", "segment 5 does not exist; the robot has 4 segments"),
        ("stuck_valve:9+@5", "segment 9 does not exist; the robot has 4 segments"),
        ("stuck_valve:2+=shut@5", "unknown variant of stuck_valve 'shut'"),
    ],
)
def test_what_is_no_fault_is_refused(text, why):
    with pytest.raises(InputError, match=why):
        Fault.parse(text, 4)


def test_a_loss_of_supply_lowers_the_regulated_pressure():
    for how, left in (("half", 0.5), ("empty", 0.1)):
        fault = f"low_supply_pressure={how}@0.01"
        robot = EmulatedRobot("gen4", faults=[fault], **QUIET)
        found = [robot.step(None) and robot.supply_now_pa for _ in range(2)]
        robot.regulate(0.9)
        assert [*found, robot.supply_now_pa] == pytest.approx(
            48.3e3 * np.array([1, left, 0.9 * left])
        )


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
    assert {each.place[1] for each in robot.bodies().values()} == {0.02}
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


class Bench(Link):
    """A robot, its link and a clock that only sleeping moves; the robot keeps when it obeyed."""

    tick = 0.02
    valves = np.zeros((4, 2))

    def __init__(self, monkeypatch, commands=()):
        super().__init__()
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

    def close(self):
        pass


def test_robot_vents_a_fifth_of_a_second_after_the_last_command(monkeypatch):
    commands = [0.0, 0.05, 0.2, 1.0]
    bench = Bench(monkeypatch, commands)
    result = emulator.emulate(bench, bench, None, duration=2.0)
    assert result == {"ticks": 100, "late": 0, "disconnected": 0}
    for now, obeys in bench.obeyed:
        since = [now - 100.0 - each for each in commands if each <= now - 100.0]
        assert obeys == (since[-1] < 0.2 + 1e-9)


def test_a_slow_robot_counts_late_ticks_and_stays_within_a_second_of_real_time(
    monkeypatch,
):
    bench = Bench(monkeypatch)
    step = bench.step
    bench.step = lambda command: bench._sleep(0.05) or step(command)
    result = emulator.emulate(bench, bench, None, duration=2.0)
    assert (result["ticks"], result["late"]) == (100, 100)
    assert 1.0 < max(now - at for _, at, now in bench.sent) < 1.04


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


def test_the_command_emulates_a_robot_until_a_signal(
    srs_twin, tmp_path, broker, monkeypatch
):
    frames = []
    monkeypatch.setattr(
        NatNetServer, "send", lambda _, time, bodies: frames.append(bodies)
    )
    kinds = (BENDS, PRESSURES, VALVES, SUPPLY, STATUS)
    words = [
        "--mqtt",
        f"127.0.0.1:{broker.port}",
        "--natnet",
        f"127.0.0.1:{free_port()}",
    ]
    words += ["--name", "bench", "--fault", "lost_marker:5@0", "--publish-supply"]
    messages = []
    with (
        MqttLink("bench", 4, broker.access, kinds=kinds) as link,
        ThreadPoolExecutor(1) as pool,
    ):

        def end() -> None:
            # The command may have to compile kernels before it starts.
            wait(lambda: messages.extend(link.received()) or len(messages) > 40, 120)
            os.kill(os.getpid(), signal.SIGTERM)

        ended = pool.submit(end)
        options = ("--duration", "5", "--json")
        done = srs_twin("emulate", "gen4", *words, *options, cwd=tmp_path)
        assert done.returncode == 0, done.stderr
        ended.result()
        wait(lambda: messages.extend(link.received()) or not messages[-1].values.size)
    told = json.loads(done.stdout)
    assert [messages[k].names for k in (0, -1)] == [("running",), ("stopped",)]
    values = {kind: [m.values for m in messages if m.kind == kind] for kind in kinds}
    assert [len(values[kind]) for kind in kinds[:-1]] == 4 * [told["ticks"]]
    sent = [message.sent for message in messages if message.kind == BENDS]
    assert np.median(np.diff(sent)) == pytest.approx(0.02)
    assert np.max(values[PRESSURES]) < 1.0 and np.max(values[VALVES]) == -1
    assert np.mean(values[SUPPLY]) == pytest.approx(48.3e3, rel=0.01)
    tracked = [body.tracked for body in frames[-1].values()]
    assert tracked == [True, True, True, True, False]


def test_the_command_says_that_the_broker_is_gone(srs_twin, tmp_path, broker):
    with (
        MqttLink("gen4", 4, broker.access, kinds=(BENDS,)) as link,
        ThreadPoolExecutor(1) as pool,
    ):

        def end() -> None:
            wait(link.received, 120)
            broker.kill()

        ended = pool.submit(end)
        words = ("--mqtt", f"127.0.0.1:{broker.port}", "--duration", "2")
        done = srs_twin("emulate", "gen4", *words, cwd=tmp_path)
        ended.result()
    assert done.stderr.count("s: the connection to the broker is lost") == 1
    assert "\n100 ticks of 0.02 s, " in done.stderr
    assert done.stderr.endswith("lost connections to the broker: 1\n")


def test_the_command_says_what_is_wrong(srs_twin, tmp_path):
    port = free_port()
    for more, why in (
        (("--fault", "stuck@1"), "unknown fault 'stuck'"),
        ((), f"no broker answers at 127.0.0.1:{port}"),
        (("--mqtt", "lab:0"), "'lab:0' is not an address"),
        (("--name", "a/b"), "cannot be part of an MQTT topic"),
        (("--name", ""), "cannot be part of an MQTT topic"),
        (("--start", "1,2"), "--start '1,2' is not a pose; give x and y in m"),
        (("--chambers", "orifce"), "--chambers: must be one of lag, orifice"),
        (("--pressure", "500"), "--pressure: 500 kPa is above the limit of gen4"),
    ):
        done = srs_twin(
            "emulate", "gen4", "--mqtt", f"127.0.0.1:{port}", *more, cwd=tmp_path
        )
        assert done.returncode == 2
        said = " ".join(done.stderr.split())
        assert why in said and "emulate: " not in said and "allow_over" not in said
