"""However a session ends, a steered robot is vented, its status is sent and the files are written."""

from __future__ import annotations

import errno
import json
import os
import time
import warnings
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pytest

from srs_twin import InputError, load_robot, load_scenario
from srs_twin.errors import SessionWarning
from srs_twin.io.files import create_numbered_file
from srs_twin.io.saved_state import SavedState
from srs_twin.live import session as sessions, steering as steering_module
from srs_twin.live.journal import Journal, McapLink, journal_messages
from srs_twin.live.links import Link, clock
from srs_twin.live.messages import BENDS, COMMAND, CONTROL, GO, POSES, STATUS, Message
from srs_twin.live.session import Session
from srs_twin.live.shadow import Shadow
from srs_twin.live.steering import EstimateSteering

STALE_S = sessions.STALE_S
TOO_SLOW_S = sessions.TOO_SLOW_S
WORK_S = sessions._WORK_S


@pytest.fixture(autouse=True)
def patient(monkeypatch):
    """Relax limits, so that sessions steer on a busy machine and a robot that never moves."""
    monkeypatch.setattr(steering_module, "_LARGEST_SD_M", 1.0)
    monkeypatch.setattr(sessions, "STALE_S", 60.0)
    monkeypatch.setattr(sessions, "TOO_SLOW_S", 60.0)
    monkeypatch.setattr(sessions, "_WORK_S", 60.0)  # a busy machine skips no messages


class Wire(Link):
    """Link to a robot that never moves, or to messages added by `tell`; keeps sent messages."""

    def __init__(self, segments: int = 4, *, still: bool = True) -> None:
        super().__init__()
        self.sent: list[tuple[float, str, object]] = []
        self._segments = segments
        self._still = still
        self._count = 0

    def received(self) -> list[Message]:
        if self._still:
            self._tell_of_rest(clock())
        return super().received()

    def _tell_of_rest(self, now: float) -> None:
        self._count += 1
        rows = np.zeros((self._segments + 1, 4))
        rows[:, 0] = -0.1 * np.arange(self._segments + 1)
        names = tuple(f"connector_{i}" for i in range(1, self._segments + 2))
        self.tell(Message(BENDS, "robot", now, now, np.zeros(self._segments)))
        self.tell(Message(POSES, "natnet", now, now, rows, names))

    def tell(self, message: Message) -> None:
        self._take(message)

    def send(self, kind, values, *, at=None, wait_s=0.0) -> None:
        self.sent.append((clock(), kind, values))

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
    sessions.warm_up(load_robot("gen4"))


class SteadyWire(Wire):
    """Wire whose messages arrive 50 times per second, however rarely they are received."""

    def __init__(self) -> None:
        super().__init__()
        self._due = clock()

    def received(self) -> list[Message]:
        while self._due <= clock():
            self._tell_of_rest(self._due)
            self._due += 0.02
        return Link.received(self)


def session(
    out: Path | None = None, wire: Wire | None = None, **more
) -> tuple[Session, Wire]:
    wire = wire or Wire()
    shadow = Shadow(load_robot("gen4"), members=8)
    return (
        Session(shadow, [wire], out=out, steering=Steering(), commands=wire, **more),
        wire,
    )


def was_made_safe(wire: Wire, status: str = "stopped") -> None:
    *_, (_, command, valves), (_, kind, text) = wire.sent
    assert (command, kind, text) == (COMMAND, STATUS, status)
    assert (np.asarray(valves) == -1).all()


class Broken(Exception):
    pass


def breaks(*_, **__):
    raise Broken("as a test wants it")


@pytest.mark.default_cases(at=[0, 2, 5])
@pytest.mark.parametrize(
    "where",
    ["shadow.update", "shadow.save", "view", "stop", "journal.write", "steering.step"],
)
def test_any_error_vents_says_so_and_writes_the_summary(tmp_path, monkeypatch, where):
    found, wire = session(tmp_path / "lab", views=[breaks] if where == "view" else [])
    calls = []

    def stop():
        return False

    def later(*given, **named):
        calls.append(0)
        return (
            breaks()
            if len(calls) > 3 or where == "shadow.save"
            else whole(*given, **named)
        )

    if where == "stop":
        whole = stop
        stop = later
    elif where != "view":
        owner, name = where.split(".")
        of = {
            "shadow": found.shadow,
            "journal": found._journal,
            "steering": found._steering,
        }[owner]
        whole = getattr(of, name)
        monkeypatch.setattr(of, name, later)
    with pytest.raises(Broken):
        found.run(10.0, stop)
    was_made_safe(wire, "stopped: Broken")
    told = json.loads((tmp_path / "lab/shadow.json").read_text())
    assert told["error"] == "Broken: as a test wants it"
    assert told["following"]["ending"] == "stopped"


def test_results_that_cannot_be_written_do_not_keep_the_robot_from_being_vented(
    tmp_path, monkeypatch
):
    found, wire = session(tmp_path / "lab")
    monkeypatch.setattr(found._journal, "close", breaks)
    monkeypatch.setattr(sessions, "write_results", breaks)
    with pytest.raises(Broken):
        found.run(0.1)
    was_made_safe(wire)


@pytest.mark.slow
@pytest.mark.parametrize("sent", [1e11, -1e11, 5e9])
def test_a_time_that_no_clock_shows_ends_nothing(tmp_path, sent):
    found, wire = session(tmp_path / "lab")
    wire.tell(Message(BENDS, "robot", sent, clock(), np.zeros(4)))
    wire.tell(
        Message(POSES, "natnet", sent, clock(), np.zeros((1, 4)), ("connector_1",))
    )
    told = found.run(1.0)
    was_made_safe(wire)
    assert (
        told["error"] is None
        and told["problems"] == []
        and not told["estimate"]["lost"]
    )
    assert len(list(journal_messages(tmp_path / "lab/journal-1.mcap", "robot", 4))) > 10


def test_one_wrong_time_in_a_session_is_named_and_moves_no_clock(tmp_path):
    found, wire = session(tmp_path / "lab")
    begun = clock()

    def stop() -> bool:
        if len(found.ticks) == 20:
            wire.tell(Message(BENDS, "robot", 8e9, clock(), np.zeros(4)))
        return clock() - begun > 1.5

    told = found.run(stop=stop)
    assert told["dropped"] == {"bends off its clock": 1}
    assert found.shadow.buffer.clocks["robot"].jumps == 0


def full(*_, **__):
    raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))


def test_a_full_disk_is_reported_once_and_the_session_goes_on(tmp_path, monkeypatch):
    monkeypatch.setitem(sessions.INTERVALS_S, "save", 0.1)
    monkeypatch.setattr(np, "savez_compressed", full)
    found, wire = session(tmp_path / "lab")
    begun = clock()

    def stop() -> bool:
        if len(found.ticks) == 20:
            monkeypatch.setattr(found._journal._writer, "add_message", full)
        return clock() - begun > 1.0

    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        told = found.run(stop=stop)
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


def test_a_forecast_that_fails_is_reported_and_the_session_goes_on(monkeypatch):
    found, wire = session()
    monkeypatch.setattr(found.shadow, "prediction_task", lambda: breaks)
    with pytest.warns(SessionWarning, match="a forecast failed"):
        told = found.run(1.0)
    was_made_safe(wire)
    assert len(told["problems"]) == 1


def test_a_forecast_does_not_see_what_is_learnt_meanwhile():
    shadow = Shadow(load_robot("gen4"), members=8)
    shadow.update(1.0, [Message(BENDS, "robot", 0.9, 0.9, np.zeros(4))])
    shadow.update(1.2, [])
    runs = [shadow.prediction_task() for _ in range(2)]
    before = runs[0]().pose
    shadow.ensemble.odometry.connection.weights = (
        shadow.ensemble.odometry.connection.weights + 1.0
    )
    assert np.array_equal(runs[1]().pose, before)


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
    (tmp_path / "file").write_text("")
    with pytest.raises(
        InputError, match="file: this is not a folder, so no file can be written there"
    ):
        create_numbered_file(tmp_path / "file", "journal-{}.mcap")


def test_two_sessions_in_one_folder_keep_journals_of_their_own(tmp_path):
    (one, _), (other, _) = session(tmp_path / "lab"), session(tmp_path / "lab")
    assert {each._journal._path.name for each in (one, other)} == {
        "journal-1.mcap",
        "journal-2.mcap",
    }


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


def obeyed(word: str, by: str) -> tuple[Session, Wire, float, dict]:
    """Run a session in which a word is said after half a second; return when, and the summary."""
    at: list[float] = []

    def keys() -> list[str]:
        if clock() - begun < 0.5 or at:
            return []
        at.append(clock())
        if by == "key":
            return [word]
        wire.tell(Message(CONTROL, "robot", clock(), clock(), names=(word,)))
        return []

    found, wire = session(keys=keys)
    begun = clock()
    told = found.run(1.0)
    return found, wire, at[0], told


@pytest.mark.parametrize("by", ["key", "topic"])
def test_a_stop_is_obeyed_within_one_tick(by):
    _, wire, at, told = obeyed("stop", by)
    was_made_safe(wire)
    after = [
        valves for sent, kind, valves in wire.sent if kind == COMMAND and sent > at
    ]
    assert (np.array(after[1 if by == "topic" else 0 :]) == -1).all()
    assert told["seconds"] < 0.9


@pytest.mark.parametrize("by", ["key", pytest.param("topic", marks=pytest.mark.slow)])
@pytest.mark.parametrize("word", ["pause", "vent"])
def test_pause_keeps_the_valves_and_vent_vents_until_go(word, by):
    found, wire, at, told = obeyed(word, by)
    after = [
        np.asarray(valves)
        for sent, kind, valves in wire.sent
        if kind == COMMAND and sent > at
    ]
    after = after[2:]  # a word on the topic is obeyed a tick later
    assert len(after) > 3 and np.ptp(after[:-1], axis=0).max() == 0
    if word == "vent":
        assert (after[0] == -1).all()
    assert told["following"]["events"][-1]["event"] == f"control: {word}"
    found._steering.control("go")
    steps = [found._steering.step(found.estimate, found.shadow) for _ in range(2)]
    assert not np.array_equal(*steps)


def test_pause_ends_in_venting():
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
    steering.control("go")
    steps = [steering.step(found.estimate, found.shadow) for _ in range(2)]
    assert not np.array_equal(*steps)


def test_a_steering_that_is_held_lets_time_stand_still():
    shadow = Shadow(load_robot("gen2"), members=8)
    steering = EstimateSteering(load_scenario("follow_orifice"), shadow, 0.02)
    steering.control("pause")
    wire = Wire(shadow.spec.segments)
    now = 0.0
    for _ in range(80):
        time.sleep(0.001)
        now = clock()
        found = shadow.update(now, wire.received())
    assert (steering.step(found, shadow) == -1).all()
    assert steering._steps == 0


def test_a_state_that_was_saved_is_whole(tmp_path):
    found, _ = session(tmp_path / "lab")
    found.run(0.2)
    assert SavedState.read(tmp_path / "lab/state.npz")


def slowed(found: Session, seconds: float, ticks: range) -> None:
    """Delay the filter of a session in some ticks."""
    take = found.shadow.update
    count = 0

    def slow(now, messages, **options):
        nonlocal count
        count += 1
        if count in ticks:
            time.sleep(seconds)
        return take(now, messages, **options)

    found.shadow.update = slow  # type: ignore[method-assign]


@pytest.fixture
def watched(monkeypatch, patient):
    """Steer with limits that a busy machine keeps, in sessions whose code is compiled."""
    sessions.warm_up(load_robot("gen4"))
    monkeypatch.setattr(sessions, "STALE_S", 5 * STALE_S)
    monkeypatch.setattr(sessions, "TOO_SLOW_S", 5 * TOO_SLOW_S)


@pytest.mark.slow
def test_a_robot_is_vented_while_its_estimate_is_old(watched):
    found, wire = session()
    slowed(found, sessions.STALE_S + 0.1, range(10, 12))
    told = found.run(4.0)
    commands = [np.asarray(valves) for _, kind, valves in wire.sent if kind == COMMAND]
    assert all((valves == -1).all() for valves in commands[9:11])
    assert (np.ptp(commands[11:-1], axis=0) > 0).all()
    assert told["following"]["ending"] == "stopped"
    assert sessions.STALE_S < told["lag_s"] < sessions.TOO_SLOW_S


@pytest.mark.slow
def test_a_machine_that_is_too_slow_ends_the_steering_and_says_so(watched):
    found, wire = session()
    slowed(found, sessions.TOO_SLOW_S + 0.1, range(10, 1000))
    told = found.run(20.0)
    was_made_safe(wire)
    assert told["following"]["ending"] == "estimate_too_old"
    assert told["seconds"] < 10.0
    assert told["overruns"] >= 1


@pytest.mark.slow
def test_ticks_that_take_too_long_are_warned_of_once():
    found, _ = session()
    slowed(found, 0.03, range(1, 1000))
    with pytest.warns(
        SessionWarning, match="this machine is too slow: ticks take"
    ) as warned:
        told = found.run(8.0)
    assert (
        len(
            [each for each in warned if "this machine is too slow" in str(each.message)]
        )
        == 1
    )
    assert len(told["problems"]) == 1
    assert told["following"]["ending"] == "stopped"


def burdened(found, seconds, monkeypatch):
    """Let each use of messages in the filter take a time, as on a machine that is too slow."""
    monkeypatch.setattr(sessions, "_WORK_S", WORK_S)
    use = found.shadow._use

    def slow(*arguments):
        time.sleep(seconds)
        use(*arguments)

    found.shadow._use = slow


@pytest.mark.default_cases(at=[1])
@pytest.mark.parametrize("overload", [2, 5])
def test_a_machine_that_is_too_slow_still_obeys_and_keeps_its_files(
    tmp_path, monkeypatch, overload
):
    """Messages need a multiple of the available time, which made each tick longer than the one before."""
    found, wire = session(tmp_path / "lab", SteadyWire())
    burdened(found, overload * sessions.TICK_S, monkeypatch)
    begun = clock()
    asked = []

    def stop() -> bool:
        if clock() - begun > 3.0 and not asked:
            wire.tell(
                Message(CONTROL, "robot", clock(), clock(), np.zeros(0), ("stop",))
            )
            asked.append(clock())
        return clock() - begun > 60.0

    with warnings.catch_warnings(record=True):
        warnings.simplefilter("always")
        told = found.run(stop=stop)
    assert clock() - asked[0] < 3.0  # a safety factor of ten for a busy machine
    assert told["skipped_s"] > 0.3
    assert any("some are skipped" in problem for problem in told["problems"])
    was_made_safe(wire)


@pytest.mark.default_cases(1)
@pytest.mark.parametrize("speed", [2.0, 50.0, 1000.0])
def test_every_message_of_a_journal_is_used_at_any_speed(tmp_path, monkeypatch, speed):
    """On a machine that needs a multiple of the time in which the messages are played."""
    spec = load_robot("gen4")
    count = 60
    used = []
    with Journal(tmp_path / "a.mcap") as journal:
        for k in range(count):
            journal.write(Message(BENDS, "robot", k / 50, 100 + k / 50, np.zeros(4)))
    with McapLink(tmp_path / "a.mcap", "robot", 4, speed=speed) as link:
        found = Session(Shadow(spec, members=8), [link])
        burdened(found, 2 * sessions.TICK_S, monkeypatch)
        use = found.shadow._use
        monkeypatch.setattr(
            found.shadow, "_use", lambda *given: (used.append(given), use(*given))
        )
        told = found.run(60.0)
    assert len(used) == count and told["skipped_s"] == 0
    assert told["messages"] == {BENDS: count, "over": 1}


@pytest.mark.slow
def test_a_steered_robot_is_given_up_if_messages_are_skipped_for_long(
    watched, monkeypatch
):
    found, wire = session(wire=SteadyWire())
    burdened(found, 5 * sessions.TICK_S, monkeypatch)
    with warnings.catch_warnings(record=True):
        warnings.simplefilter("always")
        told = found.run(60.0)
    was_made_safe(wire)
    assert told["following"]["ending"] == "estimate_too_old"
    assert told["seconds"] < 50.0


def test_a_killed_session_loses_only_messages_since_the_last_flush(tmp_path):
    path = tmp_path / "journal.mcap"
    journal = Journal(path)
    for k in range(20):
        journal.write(Message(BENDS, "robot", k / 50, k / 50, np.zeros(4)))
    journal.flush()
    kept = path.read_bytes()  # what a kill leaves
    journal.close()
    (tmp_path / "killed.mcap").write_bytes(kept)
    assert len(list(journal_messages(tmp_path / "killed.mcap", "robot", 4))) == 20
