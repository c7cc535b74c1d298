"""Live contact estimate: the contact observer of the core, with a robot's messages as its input."""

from __future__ import annotations

from collections.abc import Iterable

from srs_twin.control.contact_observer import ContactEstimate, ContactObserver
from srs_twin.live.estimate import SLOT_S, CommandPeriod
from srs_twin.live.messages import BENDS, PRESSURES, VALVES, Message
from srs_twin.robot.spec import RobotSpec

_NEEDED = {BENDS, PRESSURES, VALVES}
"""Kinds of messages of one sample. A robot that does not report its valves gets no estimate, because lost
commands would look like contacts."""

_STEADY_S = 0.5
"""Time without a change after which a period is used, s."""


class LiveContact:
    """Contact estimate of a robot whose commands are periodic.

    Attributes:
        estimate: the latest one; None while the observer learns, or without the needed messages.
    """

    def __init__(self, spec: RobotSpec) -> None:
        """Create the observer of a robot, without learnt means."""
        self._observer = ContactObserver(spec, SLOT_S)
        self._sample: int | None = None
        self._period, self._repeated = 0, 0
        self.estimate: ContactEstimate | None = None

    def update(self, messages: Iterable[Message], commands: CommandPeriod) -> None:
        """Update the estimate with the messages of one sending time.

        Args:
            messages: messages of one sending time.
            commands: commands of the last seconds, which determine the period.
        """
        found = {message.kind: message for message in messages if message.kind in _NEEDED}
        if found.keys() != _NEEDED:
            return
        self._update_period(commands.period())
        # The robot's clock numbers the samples, so that lost messages do not shift the phase.
        sample = round(found[BENDS].sent / SLOT_S)
        if self._sample is not None and sample > self._sample:
            self._observer.skip(sample - self._sample - 1)
        self._sample = sample
        self.estimate = self._observer.update(
            found[VALVES].values, found[PRESSURES].values, found[BENDS].values
        )

    def _update_period(self, period: int) -> None:
        """Use a period of the commands that has been the same for half a second; 0 is unknown.

        Until enough commands are known for the true period, a similar shorter one is found.
        """
        if not period:
            return
        self._repeated = self._repeated + 1 if period == self._period else 0
        self._period = period
        if self._repeated * SLOT_S >= _STEADY_S and period != self._observer.period:
            self._observer.set_period(period)
