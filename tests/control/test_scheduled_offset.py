"""Controllers whose offset changes at given times."""

from __future__ import annotations

import numpy as np
import pytest

from srs_twin import AnalyticalSnake, Gait, InputError, load_robot, rollout
from srs_twin.control.commands import ScheduledOffset
from srs_twin.control.learning import ILC

SPEC = load_robot("gen2")


def run(controller, duration=1.0):
    # The callback makes an open-loop gait run tick by tick, as a steered one does.
    return rollout(
        AnalyticalSnake(SPEC, tick=0.005),
        controller,
        duration,
        observers=[lambda state: None],
    )


@pytest.mark.parametrize(
    "make", [lambda: Gait(2.0, 0.2), lambda: ILC(2.0, 0.2, target=0.5)]
)
def test_without_changes_the_run_is_that_of_the_controller(make):
    plain = run(make())
    steered = run(ScheduledOffset(make(), []))
    assert plain.columns.keys() == steered.columns.keys()
    for name in plain.columns:
        np.testing.assert_array_equal(steered[name], plain[name])
    assert steered.metadata["gait_frequency_hz"] == 2.0


def test_the_offset_changes_at_its_time_in_every_run():
    controller = ScheduledOffset(Gait(2.0, -0.2), [(0.3, 0.1), (0.603, 0.4)])
    for _ in range(2):
        found = run(controller)
        offset = found["offset"]
        time = found.time
        # A sample is taken at the end of its tick.
        assert np.all(offset[time <= 0.3 + 1e-9] == -0.2)
        assert np.all(offset[(time > 0.305) & (time <= 0.6)] == 0.1)
        assert np.all(offset[time > 0.615] == 0.4) and controller.offset == 0.4
        assert [
            (round(e.time, 6), e.text) for e in found.events if e.kind == "offset"
        ] == [
            (0.3, "offset -0.2 to 0.1"),
            (0.605, "offset 0.1 to 0.4"),
        ]
    assert found.metadata["control"]["changes"] == [[0.3, 0.1], [0.603, 0.4]]


@pytest.mark.default_cases(3)
@pytest.mark.parametrize(
    "times", [(0.0,), (-1.0,), (0.5, 0.5), (0.5, 0.2), (float("nan"),)]
)
def test_times_that_do_not_increase_are_refused(times):
    with pytest.raises(InputError, match="they must be positive and strictly"):
        ScheduledOffset(Gait(2.0), [(time, 0.1) for time in times])


def test_an_invalid_offset_is_refused_at_its_time():
    with pytest.raises(InputError, match="gait offset 2.0 is not allowed"):
        run(ScheduledOffset(Gait(2.0), [(0.1, 2.0)]))
