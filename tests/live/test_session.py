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
from brokers import broker, free_port, needs_broker, wait
from subsets import first_by_default

from srs_twin.live.emulate_command import interruption
from srs_twin.live.journal import journal_messages
from srs_twin.live.links import BrokerAccess, MqttLink
from srs_twin.live.messages import BENDS, COMMAND, CONTROL, POSES, STATUS
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


def emulator(port: int, capture: int, cwd: Path, *more: str) -> subprocess.Popen[str]:
    return start(
        "emulate",
        "gen4",
        "--mqtt",
        f"127.0.0.1:{port}",
        "--natnet",
        f"127.0.0.1:{capture}",
        *more,
        cwd=cwd,
    )


def shadow(port: int, capture: int, cwd: Path, *more: str) -> subprocess.Popen[str]:
    where = ("--mqtt", f"127.0.0.1:{port}", "--natnet", f"127.0.0.1:{capture}")
    return start("shadow", "gen4", *where, "--out", "lab", *more, cwd=cwd)


def ended(process: subprocess.Popen[str]) -> None:
    if process.poll() is None:
        process.send_signal(signal.SIGTERM)
        try:
            process.wait(20)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()


@pytest.mark.slow
@needs_broker
def test_it_runs_beside_a_robot_and_keeps_what_it_heard(tmp_path, srs_twin):
    port = free_port()
    capture = free_port()
    with (
        broker(tmp_path, port),
        MqttLink("gen4", 4, BrokerAccess(port=port), kinds=(BENDS,)) as link,
    ):
        robot = emulator(port, capture, tmp_path, "--fault", "lost_marker:5@0")
        try:
            wait(lambda: any(m.kind == BENDS for m in link.received()), 60)
            twin = shadow(port, capture, tmp_path, "--duration", "5", "--json")
            for k in range(10_000):
                if twin.poll() is not None:
                    break
                link.send(
                    COMMAND,
                    np.tile([[1.0, -1.0], [-1.0, 1.0]], (2, 1)) * (-1) ** (k // 17),
                )
                time.sleep(0.02)
            said, error = twin.communicate(timeout=30)
            assert twin.returncode == 0, error
        finally:
            ended(robot)
    told = json.loads(said)
    assert told["messages"][BENDS] > 100 and told["messages"][POSES] > 100
    lab = tmp_path / "lab"
    kinds = [m.kind for m in journal_messages(lab / "journal-1.mcap", "gen4", 4)]
    assert kinds.count(BENDS) >= told["messages"][BENDS]
    estimate = Trajectory.from_parquet(lab / "estimate.parquet")
    assert estimate.stack("bend").shape[1] == 4
    # On a busy machine everything may pause for a second, also at the end.
    assert (estimate["lost"] == 0).mean() > 0.5
    assert json.loads((lab / "shadow.json").read_text()) == told
    # Four times slower than the robot was, so that a busy machine keeps up.
    words = (
        "--mcap",
        "lab/journal-1.mcap",
        "--speed",
        "0.25",
        "--out",
        "again",
        "--json",
    )
    played = json.loads(srs_twin("shadow", "gen4", *words, cwd=tmp_path).stdout)
    # A busy machine ends before it has taken all that is in its journal.
    then = Trajectory.from_parquet(tmp_path / "again" / "estimate.parquet")
    poses = np.column_stack([then[name] for name in ("com_x", "com_y", "heading")])
    apart = np.abs(poses[len(poses) // 2 :] - told["estimate"]["pose"])
    assert (apart < [0.01, 0.01, 0.1]).all(axis=1).any()
    assert [(f["part"], f["fault"]) for f in played["faults"]] == [
        ("connector 5", "lost_marker")
    ]


def test_the_command_says_what_is_wrong(srs_twin, tmp_path):
    port = free_port()
    for more, why in (
        ((), f"no broker answers at 127.0.0.1:{port}"),
        (("--mcap", "no.mcap"), "--mcap replays a recorded journal"),
        (("--body", "head=9"), "write BODY=CONNECTOR"),
        (("--follow", "gen2_straight"), "the scenario follows no planned path"),
    ):
        done = srs_twin(
            "shadow", "gen4", "--mqtt", f"127.0.0.1:{port}", *more, cwd=tmp_path
        )
        assert done.returncode == 2, done.stderr
        assert why in " ".join(done.stderr.split())


@needs_broker
@pytest.mark.slow
@pytest.mark.parametrize("how", ["SIGINT", "SIGTERM", "SIGHUP", "SIGKILL", "stop"])
def test_the_end_of_a_process_that_steers_is_reported_and_the_robot_vented(
    tmp_path, how
):
    port = free_port()
    words = (
        "--mqtt",
        f"127.0.0.1:{port}",
        "--follow",
        "follow_orifice",
        "--out",
        "lab",
    )
    with (
        broker(tmp_path, port),
        MqttLink("gen2", 4, BrokerAccess(port=port), kinds=(COMMAND, STATUS)) as robot,
    ):
        twin = start("shadow", "gen2", *words, cwd=tmp_path)
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


def hears(lab: Path, known: set[Path]) -> bool:
    """Return whether the journal of a new session has a reading of the robot."""
    new = [
        each
        for each in set(lab.glob("journal-*.mcap")) - known
        if each.stat().st_size > 100
    ]
    return any(
        each.kind == BENDS for path in new for each in journal_messages(path, "gen4", 4)
    )


@needs_broker
@pytest.mark.slow
@pytest.mark.parametrize("kills", first_by_default(1, [5, 20]))
def test_a_session_survives_kills(tmp_path, kills):
    port = free_port()
    capture = free_port()
    draw = random.Random(4)
    told = []
    known = set()
    alive = broker(tmp_path, port)
    alive.__enter__()
    robot = emulator(port, capture, tmp_path)
    twin = shadow(port, capture, tmp_path)
    gait = MqttLink("gen4", 4, BrokerAccess(port=port), kinds=(BENDS,))
    try:
        for k in range(kills):
            end = time.monotonic() + 3.0
            while time.monotonic() < end:
                gait.send(
                    COMMAND,
                    np.tile([[1.0, -1.0], [-1.0, 1.0]], (2, 1))
                    * (-1) ** int(3 * time.monotonic()),
                )
                time.sleep(0.02)
            victim = draw.choice(("robot", "twin", "broker"))
            told.append(victim)
            if victim == "robot":
                robot.kill()
                robot.wait()
                robot = emulator(port, capture, tmp_path, "--seed", str(k))
            elif victim == "twin":
                twin.kill()
                twin.wait()
                known = set((tmp_path / "lab").glob("journal-*.mcap"))
                twin = shadow(port, capture, tmp_path)
            else:
                alive.__exit__(None, None, None)
                alive = broker(tmp_path, port)
                alive.__enter__()
        wait(gait.received, 30)
        wait(
            lambda: hears(tmp_path / "lab", known), 60
        )  # on a busy machine a start takes long
        time.sleep(5.0)
        ended(twin)
        found = json.loads((tmp_path / "lab" / "shadow.json").read_text())
    finally:
        gait.close()
        ended(twin)
        ended(robot)
        alive.__exit__(None, None, None)
    assert {"robot", "twin", "broker"} <= set(told)
    assert found["resumed"] and found["estimate"]["lost"] == ""
    assert found["messages"][BENDS] > 0
    journals = sorted((tmp_path / "lab").glob("journal-*.mcap"))
    # On a busy machine one may be killed before it is there.
    assert 2 <= len(journals) <= 1 + told.count("twin")
    for each in journals:
        for message in journal_messages(each, "gen4", 4):
            assert message.kind
