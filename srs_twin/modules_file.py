"""What a robot file says of its modules: numbers of each, and spreads from which the rest is drawn.

A spread is a standard deviation. Each quantity is drawn from a stream of its own, so that one spread more
does not change what the others give; numbers beyond three standard deviations are taken at three. What is
drawn comes on top of what is listed: factors multiply, biases add.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import Field

from srs_twin.documents import Loc
from srs_twin.modules import Modules
from srs_twin.sourced import Record, between
from srs_twin.validation import Strict

Factor = Annotated[float, between(0.1, 10.0)]
Both = Annotated[list[Factor], Field(min_length=2, max_length=2)]
Chambers = Record[Annotated[list[Both], Field(min_length=1, max_length=63)], Literal["1"]]
Segments = Record[Annotated[list[Factor], Field(min_length=1, max_length=63)], Literal["1"]]
Bends = Record[
    Annotated[list[Annotated[float, between(-1.0, 1.0)]], Field(min_length=1, max_length=63)], Literal["rad"]
]
Share = Record[Annotated[float, between(0.0, 0.3)], Literal["1"]]
Spread = Record[Annotated[float, between(0.0, 0.5)], Literal["rad"]]

_MOST = 3.0

# Quantity → its spread. Their order is that of the streams: new ones go to the end.
_SPREADS = {
    "gain": "gain_spread",
    "tau_fill": "tau_spread",
    "tau_vent": "tau_spread",
    "bias": "bias_spread_rad",
    "sensor_gain": "sensor_gain_spread",
    "sensor_bias": "sensor_bias_spread_rad",
}


_PER_CHAMBER = "0.1 to 10 for the + and the - chamber of each segment"
_PER_SEGMENT = "0.1 to 10 for each segment"
_BENDS = "rad, -1 to 1 for each segment"


def _listed(text: str, numbers: str) -> Any:
    return Field(None, description=f"{text}, {numbers}, head first.")


def _drawn(of: str, range_text: str) -> Any:
    return Field(None, description=f"Standard deviation of {of}, {range_text}.")


class ModulesFile(Strict):
    """How each module departs from the nominal one."""

    gain: Chambers | None = _listed("Bend over pressure, times the nominal", _PER_CHAMBER)
    tau_fill: Chambers | None = _listed("tau_fill, times the nominal", _PER_CHAMBER)
    tau_vent: Chambers | None = _listed("tau_vent, times the nominal", _PER_CHAMBER)
    bias_rad: Bends | None = _listed("Bend without pressure", _BENDS)
    sensor_gain: Segments | None = _listed("Sensed over actual bend", _PER_SEGMENT)
    sensor_bias_rad: Bends | None = _listed("What is sensed of a straight segment", _BENDS)
    gain_spread: Share | None = _drawn("the chambers' gains", "0 to 0.3")
    tau_spread: Share | None = _drawn("the chambers' tau_fill and tau_vent", "0 to 0.3")
    bias_spread_rad: Spread | None = _drawn("the bends without pressure", "rad, 0 to 0.5")
    sensor_gain_spread: Share | None = _drawn("the sensors' gains", "0 to 0.3")
    sensor_bias_spread_rad: Spread | None = _drawn("the sensors' biases", "rad, 0 to 0.5")
    seed: Annotated[int, between(0, 2**32 - 1)] | None = Field(
        None, description="Of what is drawn, 0 to 4294967295 (default: the scenario's seed)."
    )

    def draw(self, segments: int, seed: int) -> Modules:
        """Return the modules.

        Args:
            segments: how many.
            seed: where the file names none.
        """
        seed = seed if self.seed is None else self.seed
        arrays = {}
        for stream, (name, spread_name) in enumerate(_SPREADS.items()):
            chambers, bends = name in ("gain", "tau_fill", "tau_vent"), name.endswith("bias")
            shape = (segments, 2) if chambers else (segments,)
            listed, spread = getattr(self, f"{name}_rad" if bends else name), getattr(self, spread_name)
            base = np.full(shape, 0.0 if bends else 1.0) if listed is None else np.array(listed.value)
            normal = np.random.default_rng([seed, stream]).standard_normal(shape)
            drawn = (spread.value if spread else 0.0) * np.clip(normal, -_MOST, _MOST)
            arrays[name] = base + drawn if bends else base * (1.0 + drawn)
        return Modules.of(**arrays)

    def contradictions(self, segments: int) -> Iterator[tuple[Loc, str]]:
        """Yield path and message of lists that do not fit the number of segments."""
        for name in type(self).model_fields:
            record = getattr(self, name)
            if (
                isinstance(record, Record)
                and isinstance(record.value, list)
                and len(record.value) != segments
            ):
                yield (
                    ("modules", name, "value"),
                    f"{len(record.value)} entries for {segments} segments; give {segments}, head first",
                )
