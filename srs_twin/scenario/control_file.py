"""What a scenario file says of the controller and of the bend that it is to follow."""

from __future__ import annotations

import math
from typing import Annotated, Literal

from pydantic import Field, model_validator

from srs_twin.control import learning, smc
from srs_twin.control.duties import LARGEST_OFFSET
from srs_twin.io.validation import Strict
from srs_twin.scenario.fields import quantity, section

_KIND = "Which controller."
_SHAPE = "How the bend changes over time."
_RIGHT = math.pi / 2

Bend = Annotated[float, Field(ge=-_RIGHT, le=_RIGHT)]


class GaitFile(Strict):
    """Lateral undulation, open loop (Eq. 13)."""

    kind: Literal["gait"] = section(_KIND)
    frequency_hz: float = quantity("Gait frequency", "Hz", 0.01, 50.0)
    offset: float = quantity("Steering offset, positive to the left", "", -0.95, 0.95, 0.0)
    phase_rad: float = quantity("Phase at the start", "rad", -6.3, 6.3, 0.0)
    phase_step_rad: float | None = quantity(
        "Lag of each segment behind the one before it (default: the robot's)", "rad", -6.3, 6.3, None
    )


class ConstantFile(Strict):
    """One bend for ever."""

    kind: Literal["constant"] = section(_SHAPE)
    bend_rad: float = quantity("Bend", "rad", -_RIGHT, _RIGHT)


class StepFile(Strict):
    """A jump from one bend to another."""

    kind: Literal["step"] = section(_SHAPE)
    bend_rad: float = quantity("Bend after the step", "rad", -_RIGHT, _RIGHT)
    before_rad: float = quantity("Bend before it", "rad", -_RIGHT, _RIGHT, 0.0)
    time_s: float = quantity("When it comes", "s", 0.0, 3600.0, 0.0)


class _PeriodicFile(Strict):
    amplitude_rad: float = quantity("Amplitude", "rad", 0.001, _RIGHT)
    frequency_hz: float = quantity("Frequency", "Hz", 0.01, 50.0)
    phase_rad: float = quantity("Phase at the start", "rad", -6.3, 6.3, 0.0)
    offset_rad: float = quantity("Mean bend", "rad", -_RIGHT, _RIGHT, 0.0)


class SineFile(_PeriodicFile):
    """A sine."""

    kind: Literal["sine"] = section(_SHAPE)


class SquareFile(_PeriodicFile):
    """A square wave."""

    kind: Literal["square"] = section(_SHAPE)


class StaircaseFile(Strict):
    """One bend after another, each held for the same time; the last one stays."""

    kind: Literal["staircase"] = section(_SHAPE)
    bends_rad: Annotated[list[Bend], Field(min_length=1, max_length=1000)] = section("The bends, rad.")
    hold_s: float = quantity("How long each is held", "s", 0.001, 3600.0)


ReferenceFile = Annotated[
    ConstantFile | StepFile | SineFile | SquareFile | StaircaseFile, Field(discriminator="kind")
]


class _FollowingFile(Strict):
    reference: ReferenceFile = section("The bend that every segment is to follow.")
    beyond_range: Literal["refuse", "saturate"] = section(
        "What becomes of a reference beyond what the segments bend by at the supply pressure.", "refuse"
    )


class DirectFile(_FollowingFile):
    """Sliding mode control by valve states, with separate inlet and outlet valves (Eq. 31)."""

    kind: Literal["direct_smc"] = section(_KIND)
    d_per_s: float = quantity("D, slope of the sliding manifold", "1/s", 0.001, 1000.0, smc.DIRECT_D_PER_S)
    epsilon_rad_per_s: float = quantity(
        "ε, half the width of the dead zone", "rad/s", 0.0001, 1000.0, smc.EPSILON_RAD_PER_S
    )
    cutoff_hz: float = quantity("Cutoff of the velocity filter", "Hz", 0.1, 1000.0, smc.CUTOFF_HZ)


class IterativeFile(_FollowingFile):
    """Sliding mode control through the duty of pulse-width modulated 3/2 valves (Eq. 29)."""

    kind: Literal["iterative_smc"] = section(_KIND)
    k_s_per_rad: float = quantity("K, gain", "s/rad", 1e-5, 1000.0, smc.K_S_PER_RAD)
    d_per_s: float = quantity("D, slope of the sliding manifold", "1/s", 0.001, 1000.0, smc.ITERATIVE_D_PER_S)
    carrier_hz: float = quantity("Carrier of the pulse-width modulation", "Hz", 1.0, 1000.0, smc.CARRIER_HZ)


class HoldFile(Strict):
    """Valves that stay as they are."""

    kind: Literal["hold_valves"] = section(_KIND)
    plus: Literal["fill", "hold", "vent"] = section("Valves of the + chambers.", "fill")
    minus: Literal["fill", "hold", "vent"] = section("Valves of the - chambers.", "vent")


class ReplayFile(Strict):
    """Valves that were recorded, or chambers that hold recorded pressures; the scenario needs a recording."""

    kind: Literal["replay"] = section(_KIND)


class LearningFile(Strict):
    """Iterative learning control of a gait: the duty of each chamber, learnt once a period (Eq. 32)."""

    kind: Literal["ilc"] = section(_KIND)
    frequency_hz: float = quantity("Gait frequency", "Hz", 0.01, 50.0)
    offset: float = quantity(
        "Steering offset, positive to the left, by unequal targets", "", -LARGEST_OFFSET, LARGEST_OFFSET, 0.0
    )
    target: Literal["smallest"] | None = section(
        "Target of the larger side: the smallest amplitude recorded (default), unless target_rad is given.",
        None,
    )
    target_rad: float | None = quantity("Target of the larger side", "rad", 0.01, _RIGHT, None)
    k_per_rad: float = quantity("k, change of duty for an error", "1/rad", 1e-4, 100.0, learning.K_PER_RAD)
    free_periods: int = quantity(
        "Periods at full duty before the recorded one", "", 1, 1000, learning.FREE_PERIODS
    )
    carrier_hz: float = quantity(
        "Carrier of the pulse-width modulation", "Hz", 1.0, 1000.0, learning.CARRIER_HZ
    )
    on_fault: Literal["go_on", "stop"] = section(
        "What a dead sensor or a stuck valve leads to: going on without that module, or the end of the run.",
        "go_on",
    )
    steering: Literal["targets", "targets_and_wave"] = section(
        "What the offset acts on: unequal targets, or also the valves' wave (Eq. 13), which then fills the "
        "chambers of the side to turn to for longer.",
        learning.TARGETS,
    )
    phase_rad: float = quantity("Phase at the start", "rad", -6.3, 6.3, 0.0)
    phase_step_rad: float | None = quantity(
        "Lag of each segment behind the one before it (default: the robot's)", "rad", -6.3, 6.3, None
    )

    @model_validator(mode="after")
    def _fits(self) -> LearningFile:
        if self.target is not None and self.target_rad is not None:
            raise ValueError("give either target or target_rad")
        least = 2 * learning.LEAST_PULSES * self.frequency_hz
        if self.carrier_hz < least:
            raise ValueError(f"a gait of this frequency needs a carrier_hz of {least:g} or more")
        return self


class CameraFile(Strict):
    """Motion capture: how a follower sees the snake."""

    rate_hz: float = quantity("Frames a second", "Hz", 5.0, 10_000.0, 120.0)
    position_noise_m: float = quantity("RMS noise of x and y", "m", 0.0, 1.0, 0.0)
    heading_noise_rad: float = quantity("RMS noise of the heading", "rad", 0.0, 3.0, 0.0)


class FollowFile(Strict):
    """Following of a plan by the offset of a gait (Section 5.2.2); the scenario needs a planner."""

    kind: Literal["follow"] = section(_KIND)
    follower: Literal["bearing", "path"] = section(
        "bearing: the text's, towards one node after the other; path: feedback of the distance from the path "
        "with its curvature ahead.",
        "path",
    )
    gait: Annotated[GaitFile | LearningFile, Field(discriminator="kind")] = section("What is steered.")
    delay_s: float = quantity("How long a command takes to the snake", "s", 0.0, 10.0, 0.1)
    camera: CameraFile = section("How it sees the snake.", CameraFile())
    gain_per_rad: float | None = quantity(
        "Offset for an error of bearing (bearing; default 0.6)", "1/rad", 0.001, 100.0, None
    )
    node_m: float | None = quantity("Distance of the nodes (bearing; default 0.2)", "m", 0.001, 100.0, None)
    near_m: float | None = quantity(
        "How near to a node is near enough (bearing; default 0.2)", "m", 0.001, 100.0, None
    )
    lookahead_m: float | None = quantity(
        "Path over which a distance from it dies out (path; default 0.15)", "m", 0.001, 100.0, None
    )
    settle_m: float | None = quantity(
        "Path over which a new offset takes hold (path; default: a third of the footprint's longest "
        "transient, 0.05 without one)", "m", 0.0, 100.0, None,
    )  # fmt: skip
    replan_beyond_m: float | None = quantity(
        "Distance from the path that calls for a new plan (default: none is made)", "m", 0.001, 100.0, None
    )
    replans: int = quantity("How often a new plan is asked for at most", "", 0, 1000, 3)

    @model_validator(mode="after")
    def _what_belongs_together(self) -> FollowFile:
        if self.gait.offset != 0:
            raise ValueError("the follower decides the offset; take gait.offset out")
        for follower, names in FOLLOWERS.items():
            given = [name for name in names if getattr(self, name) is not None]
            if given and self.follower != follower:
                raise ValueError(
                    f"{given[0]} belongs to follower: {follower}; set that, or take {given[0]} out"
                )
        return self


FOLLOWERS = {"bearing": ("gain_per_rad", "node_m", "near_m"), "path": ("lookahead_m", "settle_m")}
"""Keys that belong to one follower only."""


DrivingFile = GaitFile | LearningFile | DirectFile | IterativeFile | HoldFile | ReplayFile
ControllerFile = Annotated[DrivingFile | FollowFile, Field(discriminator="kind")]
