"""Parts of a scenario in SI: valves and chambers, sensors, plants."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING

from srs_twin.robot.spec import RobotSpec
from srs_twin.sensing import HallSensor, Sensor, Strip, make_sensor
from srs_twin.sensing.hall import SPAN

if TYPE_CHECKING:
    from srs_twin.pneumatics import Pneumatics


@dataclass(frozen=True)
class PneumaticsSettings:
    """Valves and chambers of both plants; all but `kind` are arguments of that kind in `pneumatics.KINDS`.

    Attributes:
        kind: "lag" or "orifice".
        leak_per_s: 1/s.
        valve_delay_s: s.
        critical_ratio: b, "orifice" only.
        flow_limit: m³/s at ambient pressure, "orifice" only; None: no limit.
        line_volume: m³, "orifice" only.
        line_begins: Pa, "orifice" only; None: the supply's.
    """

    kind: str = "lag"
    leak_per_s: float = 0.0
    valve_delay_s: float = 0.0
    critical_ratio: float = 0.3
    flow_limit: float | None = None
    line_volume: float = 50e-6
    line_begins: float | None = None

    def make(self, robot: RobotSpec, supply_pa: float, layout: str) -> Pneumatics:
        """Return fresh chambers of a robot."""
        from srs_twin.pneumatics import make_pneumatics

        options = asdict(self)
        kind = options.pop("kind")
        if kind == "lag":
            options = {name: options[name] for name in ("leak_per_s", "valve_delay_s")}
        return make_pneumatics(kind, robot, supply_pa=supply_pa, layout=layout, **options)


@dataclass(frozen=True)
class SensorSettings:
    """Curvature sensors of both plants; all but `kind` are arguments of `make_sensor` for the kind "hall".

    Attributes:
        kind: "ideal" or "hall".
        span: bends to both sides over which it is trimmed and calibrated, rad.
        distance: from the magnet to the element, m.
        orientation: of the magnet, "up" or "side".
        chamber: cross-section of the pressure chambers, "semicircular" or "rectangular".
        noise: RMS, V at the element's output.
        bits: of the converter.
        bias: V.
        gain_error: share of the gain.
    """

    kind: str = "ideal"
    span: float = SPAN
    distance: float = Strip.distance
    orientation: str = Strip.orientation
    chamber: str = Strip.chamber
    noise: float = HallSensor.noise
    bits: int | None = HallSensor.bits
    bias: float = HallSensor.bias
    gain_error: float = HallSensor.gain_error

    def make(self, robot: RobotSpec) -> Sensor:
        """Return the sensors of a robot.

        Raises:
            InputError: a sensor that cannot be trimmed or calibrated.
        """
        options = asdict(self)
        kind = options.pop("kind")
        return make_sensor(kind, robot, **(options if kind == "hall" else {}))


def default_tick(*, bench: bool, learning: bool = False) -> float:
    """Return the control tick, s, that suits gaits, a bench, or iterative learning.

    The last has to see the peaks of bends that ripple with a carrier of 17 ms.
    """
    if bench:
        return 0.001
    return 0.005 if learning else 0.02


@dataclass(frozen=True)
class AnalyticalSettings:
    """How the analytical model runs; all but `gaps` are arguments of `AnalyticalSnake`.

    Attributes:
        gaps: whether the robot's rigid gaps are part of the body.
        timestep: s.
        tick: s.
        model: "complete", "simplified" or "compliant".
        friction: "axis", "wheel", "viscous" or "ellipse".
        slip_speed: m/s.
        friction_torque: whether friction's moment about the centre of mass acts.
        inertia: "point", "connector" or "lumped".
    """

    gaps: bool = True
    timestep: float = 0.002
    tick: float = 0.02
    model: str = "complete"
    friction: str = "axis"
    slip_speed: float = 0.00025
    friction_torque: bool = True
    inertia: str = "point"


@dataclass(frozen=True)
class TwinSettings:
    """How the twin runs; all but `gaps` are arguments of `TwinSnake`.

    Attributes:
        gaps: whether the robot's rigid gaps are part of the body.
        timestep: s.
        tick: s.
        wheels: "rolling" or "skid".
        hinges_per_segment: bending hinges a segment.
    """

    gaps: bool = True
    timestep: float = 0.001
    tick: float = 0.02
    wheels: str = "rolling"
    hinges_per_segment: int = 2


PlantSettings = AnalyticalSettings | TwinSettings
