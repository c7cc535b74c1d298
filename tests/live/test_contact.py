"""Live contact estimate: the period of the commands, and the published message."""

import json

import numpy as np
import pytest

from srs_twin import load_robot
from srs_twin.live.commands import SLOT_S, CommandPeriod
from srs_twin.live.contact_observer import ContactEstimate
from srs_twin.live.estimate import LiveContact
from srs_twin.live.messages import (
    BENDS,
    COMMAND,
    PRESSURES,
    VALVES,
    Message,
    encode_contact,
)
from srs_twin.live.shadow import Shadow
from srs_twin.pneumatics.chambers import air_bend

GEN2 = load_robot("gen2")
N = GEN2.segments
PERIOD = 25


@pytest.mark.slow
def test_square_wave_gets_estimates_after_learning_although_a_shorter_period_fits_at_first():
    rng = np.random.default_rng(1)
    contact = LiveContact(GEN2)
    commands = CommandPeriod()
    first = None
    for k in range(900):
        wave = np.sin(2 * np.pi * (k + 0.5) / PERIOD - np.pi / 2 * np.arange(N))
        valves = np.sign(np.stack([wave, -wave], axis=-1) + 1e-9)
        pressure = 24000.0 * (1 + np.stack([wave, -wave], axis=-1))
        bend = air_bend(GEN2, pressure) + 0.006 * rng.standard_normal(N)
        commands.add((k + 0.5) * SLOT_S, (valves + 1) / 2)
        values = {VALVES: valves, PRESSURES: pressure, BENDS: bend}
        sent = [
            Message(kind, "gen2", k * SLOT_S, k * SLOT_S, value)
            for kind, value in values.items()
        ]
        contact.update(sent, commands)
        if first is None and contact.estimate is not None:
            first = k * SLOT_S
    # The period is known after three seconds; learning takes 12 s, the window 0.3 s.
    assert first is not None and first < 16.0
    assert not contact.estimate.touched


def test_a_robot_with_one_segment_is_observed_without_contacts(srs_twin, tmp_path):
    srs_twin("new", "robot", "one", "--segments", "1", cwd=tmp_path)
    shadow = Shadow(load_robot(tmp_path / "one.yaml"), members=8)
    for k in range(50):
        time = k * SLOT_S
        values = {kind: np.ones((1, 2)) for kind in (COMMAND, VALVES, PRESSURES)}
        sent = [
            Message(kind, "one", time, time, value)
            for kind, value in (values | {BENDS: np.zeros(1)}).items()
        ]
        estimate = shadow.update(time, sent)
    assert np.isfinite(estimate.bend).all() and shadow.contact.estimate is None


def test_message_has_null_for_force_and_place_without_a_contact():
    def sent(*values):
        return json.loads(encode_contact(1.5, ContactEstimate(*values)))

    nothing = dict.fromkeys(["n", "n_interval", "m", "m_interval"])
    assert sent(False, 2.0) == {"t": 1.5, "touched": False, "score": 2.0} | nothing
    assert sent(False, np.nan)["score"] is None
    assert sent(True, 9.0, 0.7, (0.5, 0.9), 0.11, (0.1, 0.12)) == {
        "t": 1.5,
        "touched": True,
        "score": 9.0,
        "n": 0.7,
        "n_interval": [0.5, 0.9],
        "m": 0.11,
        "m_interval": [0.1, 0.12],
    }
