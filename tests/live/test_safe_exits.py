"""However a session ends, a steered robot is vented, its status is sent and the files are written."""

from __future__ import annotations

import errno
import itertools
import json
import os
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pytest

from srs_twin import load_robot, load_scenario
from srs_twin.errors import SessionWarning
from srs_twin.io.files import create_numbered_file
from srs_twin.io.saved_state import SavedState
from srs_twin.live import links, session as sessions, steering as steering_module
from srs_twin.live.journal import Journal, McapLink, journal_messages
from srs_twin.live.links import Link, clock
from srs_twin.live.messages import BENDS, COMMAND, CONTROL, GO, POSES, STATUS, Message
from srs_twin.live.session import Session
from srs_twin.live.shadow import Shadow
from srs_twin.live.shadow_command import _print_result
from srs_twin.live.steering import EstimateSteering
from srs_twin.trajectory import Trajectory

GEN4 = load_robot("gen4")


class Machine:
    """Simulated clock that only sleeping and simulated work advance."""

    def __init__(self) -> None:
        self.now = 100.0

    def monotonic(self) -> float:
        return self.now

    def sleep(self, seconds: float) -> None:
        self.now += seconds

    def slowed(
        self,
        owner: object,
        name: str,
        seconds: float,
        calls: range = range(1, 100_000),
    ) -> None:
        """Make some calls of a method take a given time."""
        method = getattr(owner, name)
        numbers = itertools.count(1)

        def slow(*given, **named):
            if next(numbers) in calls:
                self.sleep(seconds)
            return method(*given, **named)

        setattr(owner, name, slow)


@pytest.fixture
def machine(monkeypatch):
    return simulated_machine(monkeypatch)


def simulated_machine(monkeypatch) -> Machine:
    """Simulate the time of sessions and links."""
    simulated = Machine()
    for module in (sessions, links):
        monkeypatch.setattr(module, "time", simulated)
    monkeypatch.setattr("srs_twin.live.shadow.monotonic", simulated.monotonic)
    return simulated


class Wire(Link):
    """Link to a robot that never moves and sends 50 times per second; keeps sent messages."""

    def __init__(self, segments: int = 4) -> None:
        super().__init__()
        self.sent: list[tuple[float, str, object]] = []
        self._segments = segments
        self._due = clock()

    def received(self) -> list[Message]:
        rows = np.zeros((self._segments + 1, 4))
        rows[:, 0] = -GEN4.geometry.pitch * np.arange(self._segments + 1)
        names = tuple(f"connector_{i}" for i in range(1, self._segments + 2))
        while (sent := self._due) <= clock() + 1e-9:
            self._take(Message(BENDS, "robot", sent, sent, np.zeros(self._segments)))
            self._take(Message(POSES, "natnet", sent, sent, rows, names))
            self._due += 0.02
        return super().received()

    def say(self, word: str) -> None:
        self._take(Message(CONTROL, "robot", clock(), clock(), names=(word,)))

    def send(self, kind, values, *, at=None, wait_s=0.0) -> None:
        self.sent.append((clock(), kind, values))

    def commands(self, since: float = 0.0) -> np.ndarray:
        """Return the valve states sent after a time, shape (commands, segments, 2)."""
        return np.array(
            [each[2] for each in self.sent if each[1] == COMMAND and each[0] > since]
        )

    def close(self) -> None:
        pass


class Steering(EstimateSteering):
    """A steering that commands at once, without a plan."""

    def __init__(self, segments: int = 4) -> None:
        self._pressure = np.zeros((segments, 2))
        self._given_up = ""
        self.follower = Following()
        self._last = self.vented()
        self._control = GO
        self._events = []
        self._steps = 0
        self._tick = 0.02
        self._lost_s = self._uncertain_s = self._paused_s = 0.0

    def _steer(self, found, shadow) -> np.ndarray:
        self._steps += 1
        return np.full(self._pressure.shape, (-1.0) ** self._steps)


class Following:
    ending = None
    finished = False
    submit = None


@pytest.fixture(scope="module", autouse=True)
def compiled():
    sessions.warm_up(GEN4)


def session(out: Path | None = None, **more) -> tuple[Session, Wire]:
    wire = Wire()
    shadow = Shadow(GEN4, members=8)
    steered = Session(
        shadow, [wire], out=out, steering=Steering(), commands=wire, **more
    )
    return steered, wire


def was_made_safe(wire: Wire, status: str = "stopped") -> None:
    assert wire.sent[-1][1:] == (STATUS, status)
    assert wire.sent[-2][1] == COMMAND and (wire.commands()[-1] == -1).all()


def breaks(*_, **__):
    raise ZeroDivisionError("as a test wants it")


@pytest.mark.parametrize(
    "where",
    [
        "shadow.update",
        "shadow.save",
        "_journal.write",
        "_steering.step",
        "view",
        "stop",
    ],
)
def test_any_error_vents_says_so_and_writes_the_summary(
    machine, tmp_path, monkeypatch, where
):
    found, wire = session(tmp_path / "lab", views=[breaks] if where == "view" else [])
    owner, _, method = where.rpartition(".")

    def stop() -> bool:
        if where == "stop":
            breaks()
        # The state is saved in the first tick.
        if owner and (found.ticks or method == "save"):
            monkeypatch.setattr(getattr(found, owner), method, breaks)
        return False

    with pytest.raises(ZeroDivisionError):
        found.run(10.0, stop)
    was_made_safe(wire, "stopped: ZeroDivisionError")
    told = json.loads((tmp_path / "lab/shadow.json").read_text())
    assert told["error"] == "ZeroDivisionError: as a test wants it"
    assert told["following"]["ending"] == "stopped"


def test_results_that_cannot_be_written_do_not_keep_the_robot_from_being_vented(
    machine, tmp_path, monkeypatch
):
    found, wire = session(tmp_path / "lab")
    monkeypatch.setattr(found._journal, "close", breaks)
    monkeypatch.setattr(sessions, "write_results", breaks)
    with pytest.raises(ZeroDivisionError):
        found.run(0.1)
    was_made_safe(wire)


def full(*_, **__):
    raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))


def test_a_full_disk_is_reported_once_and_the_session_goes_on(
    machine, tmp_path, monkeypatch
):
    monkeypatch.setitem(sessions.INTERVALS_S, "save", 0.1)
    monkeypatch.setattr(np, "savez_compressed", full)
    found, wire = session(tmp_path / "lab")

    def stop() -> bool:
        if len(found.ticks) == 20:
            monkeypatch.setattr(found._journal._writer, "add_message", full)
        return False

    with pytest.warns(SessionWarning) as said:
        told = found.run(1.0, stop)
    was_made_safe(wire)
    words = [str(each.message) for each in said if each.category is SessionWarning]
    assert told["problems"] == words and len(words) == 2
    state, journal = words
    assert (
        "lab/state.npz: the file cannot be written (No space left on device)" in state
    )
    assert (
        "lab/journal-1.mcap: the journal ends early, because it cannot be written (No"
        " space left on device)" in journal
    )
    assert json.loads((tmp_path / "lab/shadow.json").read_text())["problems"] == words


def test_only_the_first_lost_connection_and_its_return_are_reported(machine):
    found, wire = session()

    def stop() -> bool:
        wire.connected = len(found.ticks) % 20 < 10
        return False

    with pytest.warns(SessionWarning, match="connection to the broker"):
        told = found.run(0.79, stop)
    assert told["problems"] == [
        "the connection to the broker is lost",
        "the connection to the broker is back",
    ]


def test_a_forecast_that_fails_is_reported_and_the_session_goes_on(
    machine, monkeypatch
):
    found, wire = session()
    monkeypatch.setattr(found.shadow, "prediction_task", lambda: breaks)
    with pytest.warns(SessionWarning, match="a forecast failed"):
        told = found.run(1.0)
    was_made_safe(wire)
    assert len(told["problems"]) == 1


def test_a_forecast_does_not_see_what_is_learnt_meanwhile():
    shadow = Shadow(GEN4, members=8)
    shadow.update(1.0, [Message(BENDS, "robot", 0.9, 0.9, np.zeros(4))])
    shadow.update(1.2, [])
    runs = [shadow.prediction_task() for _ in range(2)]
    before = runs[0]().pose
    connection = shadow.ensemble.odometry.connection
    for _ in range(30):  # number of frames between two fits
        connection.learn(np.ones(len(connection.weights)), np.ones(3))
    assert np.array_equal(runs[1]().pose, before)
    assert not np.array_equal(shadow.prediction_task()().pose, before)


def test_numbers_of_journals_are_taken_atomically(tmp_path):
    with ThreadPoolExecutor(8) as pool:
        paths = list(
            pool.map(
                lambda _: create_numbered_file(tmp_path / "lab", "journal-{}.mcap"),
                range(40),
            )
        )
    assert sorted(int(path.stem.partition("-")[2]) for path in paths) == list(
        range(1, 41)
    )


def test_a_journal_takes_any_message(tmp_path):
    with Journal(tmp_path / "a.mcap") as journal:
        for sent in (1e300, -1e300, 0.5):
            journal.write(Message(BENDS, "r", sent, sent, np.array([0.5])))
            journal.write(
                Message(POSES, "natnet", sent, sent, np.full((1, 4), np.inf), ("a",))
            )
        journal.write(Message(CONTROL, "r", 1.0, 1.0, names=("stop",)))
    assert journal.trouble == ""
    refused = []
    found = list(journal_messages(tmp_path / "a.mcap", "r", 1, refused.append))
    assert [each.kind for each in found] == [BENDS, POSES, CONTROL]
    assert len(refused) == 4


def obeyed(word: str, by: str) -> tuple[Session, np.ndarray, dict]:
    """Return a session of one second whose tick 25 obeys a word, its commands and its summary."""

    def keys() -> list[str]:
        return [word] * (by == "key" and len(found.ticks) == 25)

    def stop() -> bool:
        if by == "topic" and len(found.ticks) == 25:
            wire.say(word)
        return False

    found, wire = session(keys=keys)
    told = found.run(0.99, stop)
    was_made_safe(wire)
    return found, wire.commands(), told


by_key_and_topic = pytest.mark.parametrize("by", ["key", "topic"])


@by_key_and_topic
def test_a_stop_is_obeyed_within_the_tick(machine, by):
    _, commands, told = obeyed("stop", by)
    assert (commands[23] == -commands[24]).all() and (commands[25:] == -1).all()
    assert told["seconds"] == pytest.approx(0.52)


@by_key_and_topic
@pytest.mark.parametrize("word", ["pause", "vent"])
def test_pause_keeps_the_valves_and_vent_vents_until_go(machine, word, by):
    found, commands, told = obeyed(word, by)
    assert len(commands) == 51
    assert (commands[25:50] == (commands[24] if word == "pause" else -1)).all()
    assert told["following"]["events"] == [
        {
            "time_s": pytest.approx(0.02 * found._steering._steps),
            "event": f"control: {word}",
        }
    ]
    found._steering.control("go")
    steps = [found._steering.step(found.estimate, found.shadow) for _ in range(2)]
    assert not np.array_equal(*steps)


@pytest.mark.parametrize(
    ("word", "words"),
    [("go", "following ended: stopped\n"), ("vent", "following did not begin\n")],
)
def test_a_path_that_was_not_begun_has_not_ended(machine, capsys, word, words):
    found, _ = session()
    found._steering.control(word)
    _print_result(found.run(0.3))
    assert capsys.readouterr().err.endswith(words)


def test_the_printed_result_has_the_numbers_of_the_summary(machine, capsys):
    seen = []
    found, _ = session(views=[lambda *_: seen.append(machine.sleep(0.01))])
    found.faults["segment 2", "leak +"] = 1.54
    told = found.run(1.0)
    told["estimate"] |= {"pose": [1.0, -2.0, 0.5], "pose_sd": [0.1, 0.2, 0.3]}
    _print_result(told)
    ticks, age, place, fault, _ = capsys.readouterr().err.splitlines()
    assert ticks == "1.0 s, ticks of 0.0 ms, 99 % below 10.0 ms"
    assert age == "readings are 30 ms old when they are used"
    expected = "at x 1.000 ± 0.196 m, y -2.000 ± 0.392 m, heading 0.50 ± 0.59 rad"
    assert place == expected
    assert fault == "1.5 s: segment 2: leak +"
    named = {"part": "segment 2", "fault": "leak +", "time_s": 1.54}
    assert told["faults"] == [named]
    # A view is drawn every 0.12 s.
    assert len(seen) in (7, 8)
    assert told["view_fraction"] == pytest.approx(0.01 * len(seen) / told["seconds"])


def test_pause_ends_in_venting(machine):
    found, _ = session()
    found.run(0.3)
    steering = found._steering
    steering.control("pause")
    ticks = round(steering_module.PAUSE_LIMIT_S / 0.02)
    paused = [steering.step(found.estimate, found.shadow) for _ in range(ticks - 1)]
    assert (np.ptp(paused, axis=0) == 0).all()
    late = [steering.step(found.estimate, found.shadow) for _ in range(3)]
    assert (late[-1] == -1).all()
    assert steering.summary()["events"][-1]["event"] == "control: vent"


def test_a_steering_that_is_held_lets_time_stand_still(machine):
    shadow = Shadow(load_robot("gen2"), members=8)
    steering = EstimateSteering(load_scenario("follow_orifice"), shadow, 0.02)
    steering.control("pause")
    wire = Wire(shadow.spec.segments)
    for _ in range(80):
        found = shadow.update(clock(), wire.received())
        machine.sleep(0.02)
    assert (steering.step(found, shadow) == -1).all()
    assert steering._steps == 0


def test_files_have_the_numbers_of_the_session(machine, tmp_path):
    found, _ = session(tmp_path / "lab")
    told = found.run(0.59)
    assert SavedState.read(str(tmp_path / "lab/state.npz"))
    table = Trajectory.from_parquet(tmp_path / "lab/estimate.parquet")
    estimate = told["estimate"]
    assert table["time"][-1] == pytest.approx(0.58) and table["lost"][-1] == 0
    last = [table[name][-1] for name in ("com_x", "com_y", "heading")]
    assert last == estimate["pose"]
    # The robot of `Wire` rests in a straight line; four standard deviations.
    mass = GEN4.mass.array()
    centre = -GEN4.geometry.pitch * mass @ np.arange(5) / mass.sum()
    assert (
        np.abs(np.array(last) - [centre, 0.0, 0.0]) < 4 * np.array(estimate["pose_sd"])
    ).all()
    assert max(estimate["pose_sd"]) < 0.02
    last = [table[f"{name}_sd"][-1] for name in ("com_x", "com_y", "heading")]
    assert last == estimate["pose_sd"]
    assert table.stack("bend")[-1].tolist() == estimate["bend_rad"]
    assert table.stack("bend_sd")[-1].tolist() == estimate["bend_sd_rad"]
    assert told["clocks"]["robot"] == pytest.approx(
        {"offset_s": 0.0, "jitter_s": 0.0, "jumps": 0, "age_uncertainty_s": 0.0},
        abs=1e-6,
    )
    assert told["messages"] == {BENDS: 30, POSES: 30} and told["dropped"] == {}
    assert json.loads((tmp_path / "lab/shadow.json").read_text()) == told


def test_a_robot_is_vented_while_its_estimate_is_old(machine):
    found, wire = session()
    machine.slowed(found.shadow, "update", 0.3, range(31, 33))
    told = found.run(1.5)
    commands = wire.commands()
    assert (commands[30:32] == -1).all()
    assert (commands[10:29] == -commands[11:30]).all()
    assert (commands[32:-2] == -commands[33:-1]).all()
    assert told["following"]["ending"] == "stopped"
    assert told["lag_s"] == pytest.approx(0.3) and told["overruns"] == 2


def test_a_machine_that_is_too_slow_ends_the_steering_and_says_so(machine):
    found, wire = session()
    machine.slowed(found.shadow, "update", 1.1, range(31, 100))
    told = found.run(20.0)
    was_made_safe(wire)
    assert told["following"]["ending"] == "estimate_too_old"
    assert told["seconds"] == pytest.approx(30 * 0.02 + 1.1)


def test_ticks_that_take_too_long_are_warned_of_once(machine):
    found, _ = session()
    machine.slowed(found.shadow, "update", 0.03)
    with pytest.warns(SessionWarning):
        told = found.run(2.1)
    assert told["problems"] == [
        "this machine is too slow: ticks take 30 ms instead of 20, so estimates are up"
        " to 0.03 s old"
    ]
    assert told["tick_ms"] == pytest.approx({"median": 30.0, "p99": 30.0})
    assert told["following"]["ending"] == "stopped"


def test_a_machine_that_is_too_slow_still_obeys_and_keeps_its_files(machine, tmp_path):
    """Messages need five times the available time, which made each tick longer than the one before."""
    found, wire = session(tmp_path / "lab")
    machine.slowed(found.shadow, "_use", 0.1)
    begun = clock()

    def stop() -> bool:
        if clock() - begun > 3.0:
            wire.say("stop")
        return False

    with pytest.warns(SessionWarning, match="some are skipped"):
        told = found.run(60.0, stop)
    assert told["seconds"] < 3.3
    assert told["skipped_s"] > 0.3
    was_made_safe(wire)


def test_a_steered_robot_is_given_up_if_messages_are_skipped_for_long(machine):
    found, wire = session()
    machine.slowed(found.shadow, "_use", 0.1)
    with pytest.warns(SessionWarning, match="some are skipped"):
        told = found.run(60.0)
    was_made_safe(wire)
    assert told["following"]["ending"] == "estimate_too_old"
    assert told["seconds"] < 50.0


def test_every_message_of_a_journal_is_used_at_any_speed(tmp_path, monkeypatch):
    """The machine needs longer than the time in which the messages are played."""
    with Journal(tmp_path / "a.mcap") as journal:
        for k in range(20):
            journal.write(Message(BENDS, "robot", k / 50, 100 + k / 50, np.zeros(4)))
    with McapLink(tmp_path / "a.mcap", "robot", 4, speed=50.0) as link:
        found = Session(Shadow(GEN4, members=8), [link])
        used = []
        use = found.shadow._use

        def slow(*given) -> None:
            used.append(given)
            time.sleep(0.03)
            use(*given)

        monkeypatch.setattr(found.shadow, "_use", slow)
        told = found.run(60.0)
    assert len(used) == 20 and told["skipped_s"] == 0
    assert told["messages"] == {BENDS: 20, "over": 1}
    assert told["latency_ms"]["median"] is None


def test_a_killed_session_loses_only_messages_since_the_last_flush(tmp_path):
    path = tmp_path / "journal.mcap"
    with Journal(path) as journal:
        for k in range(20):
            journal.write(Message(BENDS, "robot", k / 50, k / 50, np.zeros(4)))
        journal.flush()
        kept = path.read_bytes()  # what a kill leaves
    (tmp_path / "killed.mcap").write_bytes(kept)
    assert len(list(journal_messages(tmp_path / "killed.mcap", "robot", 4))) == 20
