"""Sources of parts from outside the package: plug-in files, and an installed distribution."""

from __future__ import annotations

import textwrap
from pathlib import Path

CONTROLLER = '''
from __future__ import annotations

from typing import Literal

import numpy as np

import srs_twin as srs


class Damped(srs.Controller):
    """Gait whose amplitude the gain reduces: the valves vent for a share of each period."""

    layouts = ("3/2", "in_out")

    def __init__(
        self,
        frequency: float,
        gain: float = 0.2,
        *,
        side: Literal["left", "right"] = "left",
        limit: float | None = 0.5,
        layouts: int = 3,
        top: float = float("inf"),
        weights: np.ndarray | None = None,
    ) -> None:
        self.frequency = frequency
        self.gain = gain
        self.side, self.limit, self.top, self.weights = side, limit, top, weights

    def reset(self, spec, tick, *, seed=0):
        self._gait = srs.Gait(self.frequency, rest_fraction=self.gain)
        self._gait.reset(spec, tick, seed=seed)

    def step(self, state):
        return self._gait.step(state)
'''

SECTION = '''
from srs_twin.scenario.controllers import ControllerSection
from srs_twin.scenario.fields import quantity


class DampedSection(ControllerSection):
    """Section of `Damped` with units and bounds."""

    constructors = (Damped,)

    frequency_hz: float = quantity(0.01, 50.0)
    """Gait frequency."""
    gain: float = quantity(0.0, 0.9)
    """Share of the period in which the valves vent."""
'''

PARTS = '''
import numpy as np

from srs_twin.pneumatics import LagPneumatics
from srs_twin.sensing import Sensor


class Leaky(LagPneumatics):
    """Chambers that leak."""

    def __init__(self, spec, *, supply_pa: float, layout: str, loss: float = 0.5) -> None:
        super().__init__(spec, supply_pa=supply_pa, layout=layout, leak_per_s=loss)


class Shifted(Sensor):
    """Sensor with an offset."""

    kind = "shifted"

    def __init__(self, offset_rad: float) -> None:
        self.offset_rad = offset_rad

    def read(self, bend, time, seed):
        return np.asarray(bend) + self.offset_rad
'''

METRICS = """
import numpy as np

from srs_twin.comparison.sampling import MetricGroup


def measure(trajectory):
    return {"heading_range_rad": float(np.ptp(trajectory["heading"]))}


GROUP = MetricGroup(
    meanings={"heading_range_rad": "range of the heading over the whole run"},
    measure=measure,
    short_table=("heading_range_rad",),
    relative=frozenset({"heading_range_rad"}),
)
"""

FORMAT = '''
from dataclasses import replace

from srs_twin.recordings.formats.base import Format, length_unit, marker_rows, marker_table


class Tagged(Format):
    """Table with a first line ``#tagged UNIT`` and tabs."""

    name = "Tagged TSV"

    def recognizes(self, start):
        return start.first_line.startswith("#tagged")

    def read(self, file, unstated):
        file = replace(file, separator="\\t")
        (first, *_), names = file.head(2)
        unit = length_unit(file, first.removeprefix("#tagged").strip(), 1)
        columns = range(1, len(names), 3)
        time, points, _, notes = marker_rows(file, 2, len(names), columns)
        labels = [names[k].removesuffix("_x") for k in columns]
        return marker_table(file, self.name, time, points, labels, notes, unit=unit)
'''

SCENARIO = """\
robot: gen2
duration_s: 1
controller: {kind: KIND, frequency: 2.0}
"""


def tagged_recording(path: Path) -> Path:
    """Write a recording in the format of `FORMAT`."""
    rows = [
        [f"{k / 100:.2f}", *(f"{k + 50 * m}\t{m}\t20" for m in range(5))]
        for k in range(200)
    ]
    head = [
        "#tagged mm",
        "\t".join(["time", *(f"m{m}_{axis}" for m in range(5) for axis in "xyz")]),
    ]
    path.write_text("\n".join([*head, *map("\t".join, rows)]) + "\n")
    return path


def write_package(folder: Path, name: str) -> None:
    """Write the sources of a distribution with a controller, a metric and a format, and its entry points."""
    package = folder / name
    package.mkdir(parents=True)
    (package / "__init__.py").write_text("")
    (package / "control.py").write_text(CONTROLLER)
    (package / "metrics.py").write_text(METRICS)
    (package / "formats.py").write_text(FORMAT)


def entry_points(name: str) -> str:
    """Return the entry points of the distribution, as in entry_points.txt."""
    return textwrap.dedent(f"""\
        [srs_twin.controllers]
        damped = {name}.control:Damped
        [srs_twin.metrics]
        heading = {name}.metrics:GROUP
        [srs_twin.formats]
        tagged = {name}.formats:Tagged
        """)


def install(site: Path, name: str, version: str = "1.0") -> None:
    """Put the distribution into a folder as an installer does: sources and a dist-info folder."""
    write_package(site, name)
    info = site / f"{name}-{version}.dist-info"
    info.mkdir()
    (info / "METADATA").write_text(
        f"Metadata-Version: 2.1\nName: {name}\nVersion: {version}\n"
    )
    (info / "entry_points.txt").write_text(entry_points(name))
    files = [*(site / name).glob("*.py"), *info.iterdir()]
    (info / "RECORD").write_text(
        "".join(f"{file.relative_to(site)},,\n" for file in files)
    )
