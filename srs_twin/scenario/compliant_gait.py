"""Section `controller: compliant_gait` of a scenario."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Literal

from srs_twin.control.compliant_gait import SMALLEST_AMPLITUDE, CompliantGait, check_robot, layouts_of
from srs_twin.robot.spec import RobotSpec
from srs_twin.scenario.controllers import ControllerSection
from srs_twin.scenario.fields import constructor_default, quantity


class CompliantGaitFile(ControllerSection):
    """Lateral undulation that yields to contact."""

    constructors = (CompliantGait,)

    kind: Literal["compliant_gait"]
    """Controller."""
    frequency_hz: float = quantity(0.01, 50.0)
    """Gait frequency."""
    offset: float = quantity(-0.95, 0.95)
    """Steering offset, positive to the left."""
    response: Literal["amplitude", "wave_number", "hold", "vent"] = constructor_default()
    """Reaction to contact: an admittance on the amplitude or on the lag per segment; or blocked segments hold
    their air or vent."""
    gain: float = quantity(-10.0, 10.0)
    """Gain of the admittance; above 0 the wave yields, below 0 it pushes harder."""
    time_s: float = quantity(0.001, 100.0)
    """Time constant of the admittance."""
    amplitude: float = quantity(SMALLEST_AMPLITUDE, 1.0)
    """Nominal amplitude of the wave relative to that of full pressure."""
    threshold_rad: float = quantity(0.01, 3.0)
    """Lag of a bend behind its free bend above which the segment is blocked (hold, vent)."""
    phase_rad: float = quantity(-6.3, 6.3)
    """Phase at the start."""
    phase_step_rad: float | None = quantity(-6.3, 6.3)
    """Lag of each segment behind the one before it (default: the robot's)."""

    def layouts(self, products: Mapping[str, Any]) -> tuple[str, ...]:
        """See `ControllerSection.layouts`."""
        return layouts_of(self.response)

    def check(self, spec: RobotSpec, tick: float) -> None:
        """See `ControllerSection.check`: two or more segments that bend in one plane."""
        check_robot(spec)
