"""Contacts and overlaps as metrics, events and sentences, and per cents of quantities near zero."""

from __future__ import annotations

import math

import numpy as np
import pytest
from synthetic import Snake, numbered, with_columns

from srs_twin.comparison.contacts import (
    CONTACT_UNITS,
    contact_events,
    contact_free_s,
    contact_metrics,
    ignores_obstacles,
    object_metrics,
)
from srs_twin.comparison.metrics import headline, result_rows
from srs_twin.comparison.sampling import is_near_zero
from srs_twin.trajectory import Event

pytestmark = pytest.mark.fast

RUN = Snake(amplitude=0.0, sway=(0.0, 0.0), heading_sway=0.0).trajectory()
"""Rod that slides along x for 6 s, with 100 samples a second."""


def touching(force):
    zero = np.zeros_like(force)
    return with_columns(
        RUN, **numbered("obstacle_force_x", zero), **numbered("obstacle_force_y", force)
    )


def test_contacts_are_events_with_their_time_and_largest_force():
    force = np.zeros((len(RUN), 5))
    force[100:120, 0] = 0.2  # 0.2 s
    force[125:130, 2] = -0.9  # 0.05 s later: the same contact
    force[[400, 411], 4] = 0.5  # 0.11 s apart: two contacts
    force[500:520, 1] = 1e-6  # nothing
    metrics = contact_metrics(touching(force))
    assert metrics["contacts"] == 3
    assert metrics["contact_time_s"] == pytest.approx(0.27)
    assert contact_events(touching(force)) == [
        Event(1.0, "contact", "connector 3, up to 0.9 N, for 0.29 s"),
        Event(4.0, "contact", "connector 5, up to 0.5 N"),
        Event(4.11, "contact", "connector 5, up to 0.5 N"),
    ]


def test_the_object_that_moved_farthest_counts():
    path = np.linspace(0.0, 1.0, len(RUN))
    run = with_columns(
        RUN,
        **numbered("object_x", np.outer(path, [0.3, 0.1])),
        **numbered("object_y", np.outer(path, [-0.4, 0.1])),
    )
    assert object_metrics(run) == {"object_moved_m": pytest.approx(0.5)}
    assert object_metrics(RUN) == {}


def test_overlaps_take_the_place_of_contacts_on_a_plant_that_ignores_obstacles():
    apart = np.full(len(RUN), 0.02)
    apart[100:151] = -0.007
    apart[300:301] = 0.0
    run = with_columns(RUN, clearance=apart)
    assert ignores_obstacles(run)
    assert list(contact_metrics(run).values()) == [1, pytest.approx(0.51), -0.007]
    said = "the body passes through an obstacle, at least 7 mm deep, for 0.5 s"
    assert contact_events(run) == [Event(1.0, "overlap", said)]
    assert contact_free_s([run]) == math.inf, "an overlap does not affect the motion"


def test_a_contact_between_two_samples_leaves_no_clearance():
    force = np.zeros((len(RUN), 5))
    force[50, 0] = 1.0
    run = with_columns(touching(force), clearance=np.full(len(RUN), 1e-4))
    assert contact_metrics(run)["clearance_m"] == 0.0
    assert contact_free_s([RUN, run]) == RUN.time[49]


def test_a_world_without_obstacles_has_no_contacts():
    assert contact_metrics(RUN) == dict.fromkeys(CONTACT_UNITS)
    assert (
        contact_events(RUN) == []
        and contact_free_s([RUN]) == math.inf
        and not ignores_obstacles(RUN)
    )


@pytest.mark.parametrize(
    ("reference", "value", "unit", "near"),
    [
        (0.05, 0.06, "rad/s", True),
        (0.051, 0.06, "rad/s", False),
        (6e-5, 4e-4, "m/s", False),
        (0.001, 0.2, "m/s", True),
        (0.0, 0.0, "1", True),
        (0.3, 3.2, "1", False),
        (0.3, 3.4, "1", True),
    ],
)
def test_a_reference_is_near_zero_below_its_resolution_or_a_small_part_of_the_change(
    reference, value, unit, near
):
    assert is_near_zero(reference, value, unit) == near
    assert is_near_zero(-reference, -value, unit) == near


def test_tables_state_no_per_cent_of_a_reference_near_zero():
    def shown(metric, model, twin):
        plants = {"analytical": {metric: model}, "twin": {metric: twin}}
        (row,) = result_rows({"plants": plants}, [metric], str)
        return row.difference, row.per_cent

    assert shown("error_rms_rad", 1e-7, 0.02) == ("+0.02", "")
    assert shown("com_speed_m_s", 0.2, 0.1) == ("-0.1", "-50.0")
    assert shown("com_speed_m_s", 0.2, 0.2) == ("0", "0")
    assert shown("com_speed_m_s", 1e-6, 1e-6) == ("0", "")


def meeting(kind, *times):
    return [{"time": time, "kind": kind, "text": ""} for time in times]


def compared(touches, overlaps, before=None, **more):
    """Return the metrics of a twin that touches and a model that passes through obstacles at given times."""
    gaits = {"analytical": (0.223, -0.000111), "twin": (0.151, -0.207)}
    plants = {
        name: dict(zip(("com_speed_m_s", "yaw_rate_rad_s"), row, strict=True))
        for name, row in gaits.items()
    }
    plants["twin"] |= {"contacts": len(touches), "contact_time_s": 0.5}
    plants["analytical"] |= {"contacts": len(overlaps), "contact_time_s": 1.25}
    events = {
        "twin": meeting("contact", *touches),
        "analytical": meeting("overlap", *overlaps),
    }
    more |= {} if before is None else {"before_contact": before}
    return {
        "plants": plants,
        "comparison": {},
        "events": events,
        "ignores_obstacles": ["analytical"],
    } | more


def free(analytical, twin):
    rows = {"analytical": analytical, "twin": twin}
    return {
        "end_s": 3.0,
        "plants": {
            name: {"com_speed_m_s": speed, "yaw_rate_rad_s": speed and 0.0}
            for name, speed in rows.items()
        },
    }


def test_headline_names_the_contact_and_who_ignores_it():
    said = headline(compared([3.1], [2.9], free(None, None)))
    assert (
        said == "The twin touches an obstacle at 3.1 s, for 0.5 s; the model ignores"
        " obstacles and overlaps one at 2.9 s, for 1.2 s. Over the whole run, the"
        " twin crawls 32 % slower than the model (0.151 against 0.223 m/s), and"
        " turns unlike the model (-0.207 against -0.000111 rad/s). Before the"
        " contact, too few whole gait periods pass to explain a difference."
    )


def test_headline_explains_the_difference_before_the_contact_only():
    cause = {"name": "compliance", "com_speed_m_s": -0.03, "yaw_rate_rad_s": 0.0}
    said = headline(
        compared([3.1], [], free(0.2, 0.16), cause=cause | {"window_s": 3.0})
    )
    whole, before = said.split(" Before the contact ")
    assert (
        "touches an obstacle at 3.1 s, for 0.5 s; the model ignores obstacles. Over"
        in whole
    )
    assert "compliance" not in whole
    assert before.startswith(
        "(first 3 s), it crawls 20 % slower than the model (0.16 against 0.2 m/s;"
        " compliance alone would slow it by 15 %, other effects by another 5 %)."
    )
    # The attribution of the same part takes precedence; one of another part explains
    # nothing here.
    fractions = [{"name": "rigid gaps", "value": [-0.02, 0.0]}]
    measured = {"measures": ["com_speed_m_s", "yaw_rate_rad_s"], "shares": fractions}
    same, other = (
        headline(
            compared(
                [3.1], [], free(0.2, 0.16), attribution=measured | {"window_s": end}
            )
        )
        for end in (3.0, 2.0)
    )
    assert "rigid gaps slows it by 10 %" in same and "rigid gaps" not in other


def test_headline_counts_several_contacts():
    said = headline(compared([3.1, 4.0], [1.0, 2.0], free(None, None)))
    assert said.startswith(
        "The twin touches an obstacle 2 times, first at 3.1 s, for 0.5 s; the model"
        " ignores obstacles and overlaps one 2 times, first at 1 s, for 1.2 s. "
    )


def test_headline_without_a_contact_is_that_of_a_free_run():
    assert headline(compared([], [])).startswith("The twin crawls 32 % slower")
    passing = headline(compared([], [2.0]))
    assert passing.startswith(
        "The twin touches none; the model ignores obstacles and overlaps one at 2 s"
    )
    assert " The twin crawls 32 % slower" in passing, (
        "the motion of neither plant is affected"
    )


def test_headline_of_one_plant_names_its_contact():
    plant = {
        "com_speed_m_s": 0.1,
        "yaw_rate_rad_s": 0.0,
        "contacts": 1,
        "contact_time_s": 0.3,
    }
    metrics = {"events": {"twin": meeting("contact", 1.5)}}
    said = headline({"plants": {"twin": plant}} | metrics)
    assert (
        said
        == "The twin touches an obstacle at 1.5 s, for 0.3 s. The twin crawls at 0.1"
        " m/s, straight on."
    )
    said = headline({"plants": {"twin": plant | {"object_moved_m": 0.2}}} | metrics)
    assert said.startswith("The twin touches an object at 1.5 s")
