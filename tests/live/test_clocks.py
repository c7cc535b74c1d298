"""Offset and jitter of a sender's clock, and messages in order, against clocks that were made up here."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, strategies as st

from srs_twin.live.clocks import ReorderBuffer, SenderClock
from srs_twin.live.messages import BENDS, PRESSURES, VALVES, Message


def message(sent: float, arrived: float, kind: str = BENDS) -> Message:
    return Message(kind, "robot", sent, arrived)


@pytest.mark.parametrize("offset", [-1e6, 0.0, 12.5])
def test_the_offset_is_found_but_for_the_least_delay(offset):
    rng = np.random.default_rng(2)
    clock = SenderClock()
    delays = 0.004 + rng.gamma(1.0, 0.02, 1000)
    for k, delay in enumerate(delays):
        sent = 0.02 * k
        found = clock.update(sent, sent + offset + delay)
    assert clock.offset == pytest.approx(offset + 0.004, abs=0.001)
    assert found == pytest.approx(sent + offset + 0.004, abs=0.001)
    assert clock.jitter == pytest.approx(
        np.sqrt(np.mean((delays[-500:] - delays.min()) ** 2)), rel=0.1
    )


def test_a_drift_is_followed_and_a_clock_that_is_set_begins_anew():
    clock = SenderClock()
    for k in range(3000):
        sent = 0.02 * k
        clock.update(sent, 1.0 + sent * (1 + 5e-5) + 0.01)
    assert clock.offset == pytest.approx(1.01 + 5e-5 * sent, abs=6e-4)
    assert clock.jumps == 0
    for k in range(30):
        clock.update(0.02 * k, sent + 2.0 + 0.02 * k)
    assert clock.jumps == 1
    assert clock.offset == pytest.approx(sent + 2.0)
    assert clock.uncertainty == 0.0  # no transport takes a minute


steps = pytest.mark.parametrize("step", [-10.0, -0.9, -0.1, 0.1, 0.9, 10.0])


def stepped(step, at, *, once, rate=50.0, seed=0):
    """Return a buffer, and when which messages were used, of a sender whose clock steps by `step` (s)."""
    random = np.random.default_rng(seed)
    buffer = ReorderBuffer()
    sent = np.arange(0.0, at + 6.0, 1 / rate)
    stepped_at = np.abs(sent - at) < 1e-9 if once else sent >= at
    stamps = 100.0 + sent + np.where(stepped_at, step, 0.0)
    arrivals = sent + 0.004 + random.gamma(1.0, 0.005, len(sent))
    events = sorted(zip(arrivals.tolist(), stamps.tolist(), strict=True))
    used = []
    for now in np.arange(0.0, at + 6.0, 0.02):
        while events and events[0][0] <= now:
            arrived, stamp = events.pop(0)
            buffer.push(message(stamp, arrived))
        used += [(now, time, each.arrived) for time, each in buffer.pop_until(now)]
    return buffer, np.array(used)


@steps
def test_a_single_wrong_stamp_is_ignored(step):
    buffer, used = stepped(step, 8.0, once=True)
    assert np.diff(used[:, 0]).max() < 0.1
    assert buffer.clocks["robot"].jumps == 0
    assert np.abs(used[:, 1] - used[:, 2]).max() < 0.06


@pytest.mark.default_cases(at=[0, 5, 6, 11])
@steps
@pytest.mark.parametrize("rate", [10.0, 200.0])
def test_a_clock_that_is_set_is_followed_within_half_a_second(step, rate):
    buffer, used = stepped(step, 8.0, once=False, rate=rate, seed=3)
    assert np.diff(used[:, 0]).max() < 0.5 + 1 / rate
    clock = buffer.clocks["robot"]
    assert clock.jumps == 1
    # The times of messages remain those at which they were sent on our clock.
    assert np.abs(used[:, 1] - used[:, 2]).max() < 0.06
    # A clock set back may as well be a longer transport.
    assert clock.uncertainty == pytest.approx(max(0.0, -step), abs=0.02)


def test_late_messages_after_the_first_one_leave_its_offset():
    clock = SenderClock()
    for k in range(4):
        clock.update(0.02 * k, 5.0 + 0.02 * k + (0.06 if k else 0.0))
    assert (clock.offset, clock.jumps) == (5.0, 0)


def test_a_transport_that_recovers_leaves_no_uncertainty():
    clock = SenderClock()
    for k in range(600):
        slow = 0.4 if 200 <= k < 400 else 0.0
        clock.update(0.02 * k, 5.0 + 0.02 * k + slow)
    assert clock.jumps == 2
    assert clock.offset == pytest.approx(5.0)
    assert clock.uncertainty == pytest.approx(0.0, abs=1e-9)


def test_a_longer_transport_is_confirmed_0_4_s_after_the_last_confirmed_offset():
    """Messages 19 and 24 confirm an offset, at 0.38 and 0.79 s."""
    clock = SenderClock()
    jumps = []
    for k in range(60):
        slower = 0.31 * ((k >= 20) + int(k >= 25))
        clock.update(0.02 * k, 0.02 * k + slower)
        jumps.append(clock.jumps)
    assert [jumps.index(count) for count in (1, 2)] == [24, 29]
    assert clock.uncertainty == pytest.approx(0.62)


@given(st.lists(st.floats(0.0, 0.06), min_size=5, max_size=60), st.randoms())
def test_what_is_handed_out_is_in_order_and_nothing_twice(delays, random):
    buffer = ReorderBuffer(hold_s=0.03)
    sent = [0.02 * k for k in range(len(delays))]
    arriving = sorted((s + d, s) for s, d in zip(sent, delays, strict=True))
    handed = []
    for arrived, s in arriving:
        buffer.push(message(s, arrived))
        if random.random() < 0.3:
            buffer.push(message(s, arrived + 0.001))
        handed += buffer.pop_until(arrived)
    handed += buffer.pop_until(1e9)
    times = [time for time, _ in handed]
    assert times == sorted(times)
    found = [each.sent for _, each in handed]
    assert len(found) == len(set(found))
    late = buffer.counts["robot", BENDS, "late"]
    assert len(found) + late == len(sent)
    if max(delays) - min(delays) < 0.03:
        assert late == 0


@pytest.mark.default_cases(2)
@pytest.mark.parametrize(
    ("jitter", "longest", "late"),
    [(0.02, 0.03, 0.0), (0.08, 0.08, 0.05), (0.5, 0.1, 0.9), (3.0, 0.1, 1.0)],
)
def test_hold_follows_the_jitter_up_to_a_tenth_of_a_second(jitter, longest, late):
    """Both clocks agree here: every twentieth message has no delay."""
    delay = np.random.default_rng(4).uniform(0.0, jitter, 1500)
    delay[::20] = 0.0
    sent = 0.02 * np.arange(len(delay))
    buffer = ReorderBuffer(hold_s=0.03)
    events = sorted(
        [(s + d, s) for s, d in zip(sent, delay, strict=True)]
        + [(t, -1.0) for t in sent + 0.01]
    )
    waiting: dict[float, float] = {}
    for now, of in events:
        if of >= 0:
            taken = buffer.counts["robot", BENDS, "taken"]
            buffer.push(message(of, now))
            if buffer.counts["robot", BENDS, "taken"] > taken:
                waiting[of] = now
        for _, each in buffer.pop_until(now):
            del waiting[each.sent]
        assert all(arrived > now - longest - 1e-9 for arrived in waiting.values())
    assert buffer.counts["robot", BENDS, "late"] <= late * len(delay)


def test_what_was_sent_at_once_comes_as_it_is_needed():
    buffer = ReorderBuffer()
    for kind in (PRESSURES, BENDS, VALVES, VALVES):
        buffer.push(message(1.0, 2.0, kind))
    found = [each.kind for _, each in buffer.pop_until(10.0)]
    assert found == [VALVES, BENDS, PRESSURES]
    counts = [buffer.counts["robot", VALVES, what] for what in ("taken", "duplicate")]
    assert counts == [1, 1]


def test_messages_with_wrong_times_are_refused_until_three_agree():
    buffer = ReorderBuffer()
    for k in range(50):
        buffer.push(message(0.02 * k, 5.0 + 0.02 * k))
    for k, wrong in enumerate((8e9, -8e9, 7e9, 6e9, 5e9)):
        buffer.push(message(wrong, 6.0 + 0.02 * k))
    assert buffer.counts["robot", BENDS, "off its clock"] == 5
    assert buffer.clocks["robot"].jumps == 0
    for k in range(3):
        buffer.push(message(100.0 + 0.02 * k, 8.0 + 0.02 * k))
    assert buffer.counts["robot", BENDS, "off its clock"] == 7
    assert buffer.clocks["robot"].jumps == 1
    assert buffer.clocks["robot"].offset == pytest.approx(-92.0)
