"""Journals: what was written is played at any speed; what a kill leaves is read up to there."""

from __future__ import annotations

import math
import time

import numpy as np
import pytest
from brokers import wait

from srs_twin import InputError
from srs_twin.errors import WriteError
from srs_twin.live.journal import Journal, McapLink, journal_messages
from srs_twin.live.messages import BENDS, COMMAND, POSES, PRESSURES, STATUS, Message


def messages(count: int) -> list[Message]:
    found = []
    for k in range(count):
        sent = 0.02 * k
        arrived = 100 + 0.02 * k
        found.append(
            Message(BENDS, "r", sent, arrived, np.array([0.1 * (k % 5), math.nan]))
        )
        found.append(
            Message(
                COMMAND,
                "r",
                sent,
                arrived + 0.001,
                np.array([[1.0, -1.0], [0.25, 0.0]]),
            )
        )
        poses = np.array([[1.0, 2.0, 0.0, 0.5], [0.0, 0.0, 0.0, math.nan]])
        found.append(
            Message(POSES, "natnet", sent + 5, arrived + 0.002, poses, ("head", "tail"))
        )
    found.append(Message(PRESSURES, "r", 1.0, 200.0, np.full((2, 2), 12e3)))
    return [*found, Message(STATUS, "r", 1.0, 200.0, names=("fine",))]


def same(one: Message, other: Message) -> bool:
    return (
        (one.kind, one.source, one.names) == (other.kind, other.source, other.names)
        and math.isclose(one.sent, other.sent)
        and math.isclose(one.arrived, other.arrived)
        and np.allclose(one.values, other.values, equal_nan=True)
    )


def written(path, count: int) -> list[Message]:
    said = messages(count)
    with Journal(path) as journal:
        for each in said:
            journal.write(each)
    return said


def test_what_was_written_comes_back(tmp_path):
    said = written(tmp_path / "a.mcap", 20)
    found = list(journal_messages(tmp_path / "a.mcap", "r", 2))
    assert len(found) == len(said)
    assert all(same(a, b) for a, b in zip(found, said, strict=True))
    # Another program reads it.
    reader = pytest.importorskip("mcap.reader")
    with (tmp_path / "a.mcap").open("rb") as file:
        summary = reader.make_reader(file).get_summary()
    assert summary.statistics.message_count == len(said)
    assert {each.topic for each in summary.channels.values()} >= {
        "srs/r/bends",
        "srs/natnet/poses",
    }


def test_a_kill_takes_the_end_with_it_and_no_more(tmp_path):
    said = written(tmp_path / "a.mcap", 2000)
    raw = (tmp_path / "a.mcap").read_bytes()
    for fraction in (0.3, 0.77):
        (tmp_path / "b.mcap").write_bytes(raw[: int(fraction * len(raw))])
        found = list(journal_messages(tmp_path / "b.mcap", "r", 2))
        assert len(found) > 0.8 * fraction * len(said) * 0.9
        assert all(same(a, b) for a, b in zip(found, said, strict=False))


@pytest.mark.parametrize("speed", [math.inf, 20.0])
def test_it_is_played_at_any_speed(tmp_path, speed):
    said = written(tmp_path / "a.mcap", 40)[:-2]
    begun = time.monotonic()
    found = []
    with McapLink(tmp_path / "a.mcap", "r", 2, speed=speed) as link:
        wait(lambda: found.extend(link.received()) or len(found) >= len(said))
    assert all(same(a, b) for a, b in zip(found, said, strict=False))
    if speed != math.inf:
        assert time.monotonic() - begun > 0.9 * 0.8 / speed


def test_no_file_is_said(tmp_path):
    with pytest.raises(InputError, match="nowhere.mcap: no such file"):
        list(journal_messages(tmp_path / "nowhere.mcap", "r", 2))
    (tmp_path / "file").write_text("")
    with pytest.raises(WriteError, match="cannot be written"):
        Journal(tmp_path / "file" / "a.mcap")


@pytest.mark.parametrize("content", [b"", b"hello" * 100, b"\x89MCAP1\r\n"])
def test_a_file_that_is_no_journal_is_refused_at_once(tmp_path, content):
    (tmp_path / "a.mcap").write_bytes(content)
    with pytest.raises(InputError, match="a.mcap: this is not an MCAP file"):
        McapLink(tmp_path / "a.mcap", "r", 2)


def foreign(path, records) -> None:
    """Write topics, data and times of logging (ns) with the library `mcap`."""
    writer_of = pytest.importorskip("mcap.writer").Writer
    with path.open("wb") as file:
        writer = writer_of(file)
        writer.start(profile="", library="")
        schema = writer.register_schema(name="x", encoding="jsonschema", data=b"{}")
        for topic, data, log_time in records:
            channel = writer.register_channel(
                topic=topic, message_encoding="json", schema_id=schema
            )
            writer.add_message(
                channel_id=channel, data=data, log_time=log_time, publish_time=0
            )
        writer.finish()


BEND = b'{"t": 1, "rad": [0.1, 0.2]}'
POSE = b'{"t": 1, "poses": [[0, 0, 0, 0]], "names": ["a"]}'
SECOND = 10**9


@pytest.mark.parametrize(
    ("records", "words"),
    [
        ([], "has no messages at all"),
        (
            [("/imu/data", b"{}", 1)],
            "unreadable messages: 1 × the message is not in the srs-twin format:"
            " ValueError",
        ),
        (
            [("srs/r/bends", b'{"t": 1, "rad": [0.1]}', 1)],
            "unreadable messages: 1 × `rad` must be a list of 2 numbers",
        ),
    ],
)
def test_a_journal_without_a_message_of_the_robot_is_refused(tmp_path, records, words):
    foreign(tmp_path / "a.mcap", records)
    with pytest.raises(InputError, match=f"a.mcap: .*{words}"):
        McapLink(tmp_path / "a.mcap", "r", 2)


def test_the_command_refuses_a_journal_of_another_robot(tmp_path, srs_twin):
    records = [("srs/other/bends", BEND, 1), ("srs/natnet/poses", POSE, 2)]
    foreign(tmp_path / "a.mcap", records)
    done = srs_twin("shadow", "gen2", "--mcap", "a.mcap", "--name", "r", cwd=tmp_path)
    assert done.returncode == 2
    assert (
        "a.mcap: the journal has no messages of 'r', but messages of other (choose"
        " one with --name)" in done.stderr
    )


def test_frames_alone_are_played(tmp_path):
    foreign(tmp_path / "a.mcap", [("srs/natnet/poses", POSE, 1)])
    with McapLink(tmp_path / "a.mcap", "r", 2) as link:
        wait(lambda: link.counts["over"])
        assert [each.kind for each in link.received()] == [POSES]


@pytest.mark.parametrize(
    ("times", "played"),
    [
        ([1, 2**64 - 1, 2, 3], [2, 3]),
        ([2**64 - 1, 1, 2], [1, 2]),
        ([100, 101, 0, 102], [100, 101, 102]),
        ([1, 2, 10_000_000, 10_000_001], [1, 2, 10_000_000, 10_000_001]),
        ([1, 2, 10_000_000], [1, 2]),
    ],
)
def test_times_out_of_order_are_refused_and_gaps_passed_over(tmp_path, times, played):
    records = [("srs/r/bends", BEND, min(each * SECOND, 2**64 - 1)) for each in times]
    foreign(tmp_path / "a.mcap", records)
    with McapLink(tmp_path / "a.mcap", "r", 2, speed=1000.0) as link:
        # Without skipping, the longest gap would take hours.
        wait(lambda: link.counts["over"])
        assert [round(each.arrived) for each in link.received()] == played
    bad = "bad: a record is earlier than the record before it"
    assert link.counts[bad] == len(times) - len(played)


def test_playback_waits_while_the_queue_is_full(tmp_path, monkeypatch):
    said = written(tmp_path / "a.mcap", 40)
    monkeypatch.setattr("srs_twin.live.links._MOST_WAITING", 10)
    found = []
    with McapLink(tmp_path / "a.mcap", "r", 2, speed=math.inf) as link:
        time.sleep(0.1)
        wait(lambda: found.extend(link.received()) or link.over)
    assert len(found) == len(said)
    with McapLink(tmp_path / "a.mcap", "r", 2, speed=math.inf):
        pass  # closing ends the playback, although the queue is full


def test_an_error_while_a_journal_is_played_ends_it_by_name(tmp_path, monkeypatch):
    written(tmp_path / "a.mcap", 3)
    monkeypatch.setattr(McapLink, "_take", lambda *_: 1 / 0)
    with McapLink(tmp_path / "a.mcap", "r", 2) as link:
        wait(lambda: link.counts["over"])
    assert link.counts["bad: ZeroDivisionError"] == 1


def test_records_that_are_no_messages_are_counted_and_skipped(tmp_path):
    records = [
        ("other", b"{}"),
        ("srs/r/bends", b"[" * 60_000),
        ("srs/r/bends", b"\xff"),
        ("srs/r/unknown", b"{}"),
        ("srs/cameras/poses", b"[" * 60_000),
        ("srs/cameras/poses", b"[]"),
        ("srs/cameras/poses", b'{"t": NaN, "poses": [[1, 2, 3, 4]], "names": ["a"]}'),
        ("srs/cameras/poses", b'{"t": 1, "poses": [[1, 2, 3, 4]], "names": []}'),
        ("srs/r/bends", b'{"t": 1, "rad": [0.1, 0.2]}'),
    ]
    foreign(tmp_path / "a.mcap", [(topic, data, SECOND) for topic, data in records])
    with McapLink(tmp_path / "a.mcap", "r", 2, speed=math.inf) as link:
        wait(lambda: link.counts["over"])
        (message,) = link.received()
    assert message.kind == BENDS and message.values.tolist() == [0.1, 0.2]
    assert (
        sum(count for what, count in link.counts.items() if what.startswith("bad: "))
        == len(records) - 1
    )
