"""Shadow of an emulated robot in real time over a real broker: its files, and kills."""

from __future__ import annotations

import json
import random
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
from brokers import Broker, free_port, wait
from subsets import first_by_default

from srs_twin.live.emulate_command import interruption
from srs_twin.live.journal import journal_messages
from srs_twin.live.links import MqttLink
from srs_twin.live.messages import BENDS, COMMAND, CONTROL, POSES, STATUS
from srs_twin.live.session import STATE
from srs_twin.trajectory import Trajectory

ENDINGS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
SCRIPT = Path(sys.executable).with_name("srs-twin")


def start(*words: str, cwd: Path) -> subprocess.Popen[str]:
    return subprocess.Popen(
        [str(SCRIPT), *words],
        cwd=cwd,
        text=True,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
    )


class Lab:
    """A broker, and processes of a robot, its camera and its shadow."""

    def __init__(self, broker: Broker, folder: Path) -> None:
        self.broker = broker
        self.folder = folder
        capture = f"127.0.0.1:{free_port()}"
        self._where = ("--mqtt", f"127.0.0.1:{broker.port}", "--natnet", capture)

    def robot(self, *more: str) -> subprocess.Popen[str]:
        return start("emulate", "gen4", *self._where, *more, cwd=self.folder)

    def shadow(self, *more: str) -> subprocess.Popen[str]:
        words = ("shadow", "gen4", *self._where, "--out", "lab", *more)
        return start(*words, cwd=self.folder)


@pytest.fixture
def lab(broker, tmp_path):
    return Lab(broker, tmp_path)


def command(link: MqttLink, positive: bool) -> None:
    """Command one of two shapes."""
    shape = np.tile([[1.0, -1.0], [-1.0, 1.0]], (2, 1))
    link.send(COMMAND, shape if positive else -shape)
    time.sleep(0.02)


def ended(process: subprocess.Popen[str]) -> None:
    if process.poll() is None:
        process.send_signal(signal.SIGTERM)
        try:
            process.wait(20)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()


@pytest.mark.slow
def test_it_runs_beside_a_robot_and_keeps_what_it_heard(lab, tmp_path, srs_twin):
    with MqttLink("gen4", 4, lab.broker.access, kinds=(BENDS,)) as link:
        robot = lab.robot("--fault", "lost_marker:5@0")
        try:
            wait(link.received, 60)
            twin = lab.shadow("--duration", "5", "--json")
            for k in range(10_000):
                if twin.poll() is not None:
                    break
                command(link, k // 17 % 2 == 0)
            said, error = twin.communicate(timeout=30)
            assert twin.returncode == 0, error
        finally:
            ended(robot)
    told = json.loads(said)
    assert told["messages"][BENDS] > 100 and told["messages"][POSES] > 100
    out = tmp_path / "lab"
    kinds = [m.kind for m in journal_messages(out / "journal-1.mcap", "gen4", 4)]
    assert kinds.count(BENDS) >= told["messages"][BENDS]
    estimate = Trajectory.from_parquet(out / "estimate.parquet")
    assert estimate.stack("bend").shape[1] == 4
    # On a busy machine everything may pause for a second, also at the end.
    assert (estimate["lost"] == 0).any()
    assert json.loads((out / "shadow.json").read_text()) == told
    # Four times slower than the robot was, so that a busy machine keeps up.
    words = ("--mcap", "lab/journal-1.mcap", "--speed", "0.25", "--out", "again")
    done = srs_twin("shadow", "gen4", *words, "--json", cwd=tmp_path)
    played = json.loads(done.stdout)
    # A busy machine ends before it has taken all that is in its journal.
    then = Trajectory.from_parquet(tmp_path / "again" / "estimate.parquet")
    poses = np.column_stack([then[name] for name in ("com_x", "com_y", "heading")])
    apart = np.abs(poses[len(poses) // 2 :] - told["estimate"]["pose"])
    assert (apart < [0.01, 0.01, 0.1]).all(axis=1).any()
    # Pauses of a busy machine may also look like a fault of a sensor.
    faults = [(each["part"], each["fault"]) for each in played["faults"]]
    assert ("connector 5", "lost_marker") in faults


@pytest.mark.slow
@pytest.mark.parametrize("how", ["SIGINT", "SIGTERM", "SIGHUP", "SIGKILL", "stop"])
def test_the_end_of_a_process_that_steers_is_reported_and_the_robot_vented(
    broker, tmp_path, how
):
    words = ("--mqtt", f"127.0.0.1:{broker.port}", "--follow", "follow_orifice")
    with MqttLink("gen2", 4, broker.access, kinds=(COMMAND, STATUS)) as robot:
        twin = start("shadow", "gen2", *words, "--out", "lab", cwd=tmp_path)
        heard = []

        def said(kind: str) -> list:
            robot.send(BENDS, np.zeros(4))
            heard.extend(robot.received())
            return [each for each in heard if each.kind == kind]

        try:
            wait(lambda: len(said(COMMAND)) > 5, 120)
            if how == "stop":
                robot.send(CONTROL, how)
            else:
                twin.send_signal(getattr(signal, how))
            wait(lambda: said(STATUS), 30)
            assert said(STATUS)[-1].names == (
                "lost" if how == "SIGKILL" else "stopped",
            )
            assert (said(COMMAND)[-1].values == -1).all()
            twin.wait(30)
        finally:
            ended(twin)
    if how != "SIGKILL":
        assert twin.returncode == 0
        told = json.loads((tmp_path / "lab" / "shadow.json").read_text())
        assert told["following"]["ending"] == "stopped" and told["error"] is None


@pytest.mark.parametrize(
    "ignored", [[signal.SIGHUP], [signal.SIGINT, signal.SIGTERM], []]
)
def test_a_signal_that_the_caller_ignores_ends_nothing(ignored):
    """`nohup` ignores SIGHUP, and shells ignore SIGINT for commands in the background of a script."""
    before = {number: signal.signal(number, signal.SIG_DFL) for number in ENDINGS}
    try:
        for number in ignored:
            signal.signal(number, signal.SIG_IGN)
        over = interruption()
        for number in ignored:
            signal.raise_signal(number)
        assert not over.is_set()
        for number in set(ENDINGS) - set(ignored):
            signal.raise_signal(number)
            assert over.is_set()
            over.clear()
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def hears(folder: Path, known: set[Path]) -> bool:
    """Return whether the journal of a new session has bends and poses of the robot."""
    new = [
        each
        for each in set(folder.glob("journal-*.mcap")) - known
        if each.stat().st_size > 100
    ]
    kinds = {each.kind for path in new for each in journal_messages(path, "gen4", 4)}
    return {BENDS, POSES} <= kinds


@pytest.mark.slow
@pytest.mark.parametrize("kills", first_by_default(1, [5, 20]))
def test_a_session_survives_kills(lab, tmp_path, kills):
    out = tmp_path / "lab"
    draw = random.Random(4)
    told = []
    known = set()
    robot = lab.robot()
    twin = lab.shadow()
    with MqttLink("gen4", 4, lab.broker.access, kinds=(BENDS,)) as gait:
        try:
            wait((out / STATE).exists, 60)
            for k in range(kills):
                end = time.monotonic() + 3.0
                while time.monotonic() < end:
                    command(gait, int(3 * time.monotonic()) % 2 == 0)
                victim = draw.choice(("robot", "twin", "broker"))
                told.append(victim)
                if victim == "robot":
                    robot.kill()
                    robot.wait()
                    robot = lab.robot("--seed", str(k))
                elif victim == "twin":
                    twin.kill()
                    twin.wait()
                    known = set(out.glob("journal-*.mcap"))
                    twin = lab.shadow()
                else:
                    lab.broker.kill()
                    lab.broker.start()
            wait(gait.received, 30)
            # On a busy machine a start takes long.
            wait(lambda: hears(out, known), 60)
            time.sleep(5.0)
        finally:
            ended(twin)
            ended(robot)
    found = json.loads((out / "shadow.json").read_text())
    assert {"robot", "twin", "broker"} <= set(told)
    assert found["resumed"] and found["messages"][BENDS] > 0
    # On a busy machine everything may pause for a second, also at the end.
    estimate = Trajectory.from_parquet(out / "estimate.parquet")
    assert (estimate["lost"] == 0).any()
    journals = sorted(out.glob("journal-*.mcap"))
    # On a busy machine one may be killed before it is there.
    assert 2 <= len(journals) <= 1 + told.count("twin")
    for each in journals:
        assert all(message.kind for message in journal_messages(each, "gen4", 4))
