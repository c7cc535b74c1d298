r"""Upper bound of the work that the air can do in a run.

The air exerts the moment $k\,(q_f - b)$ on a segment, with the stiffness $k$, the free
bend $q_f$ and the rest bend $b$. If the run begins at rest with relaxed segments, the
work of the air follows from the recorded work $W = \int \sum_j T_j\,\dot q_{f,j}\,dt$,
the bends $q$ and the torques $T \approx k\,(q_f - q)$:

$$ W_a = W + \sum_j \tfrac12 k (q_j - b_j)^2 - \sum_j \frac{T_j^2}{2k}. $$

A volume $V$ of air at the gauge pressure $p$ cannot do more work than in an isothermal
expansion to the ambient pressure, $p V\,(1 + P_a/p)\,\ln(1 + p/P_a)$. A delayed moment
of compressed chambers can drive oscillations that exceed this bound
(docs/pneumatics.md#damping-with-orifices).
"""

from __future__ import annotations

import math

import numpy as np

from srs_twin.errors import DivergedError
from srs_twin.plants.base import PneumaticPlant
from srs_twin.pneumatics.chambers import AMBIENT_PA, chamber_gains
from srs_twin.trajectory import Trajectory


def excessive_air_work(plant: PneumaticPlant, run: Trajectory) -> DivergedError | None:
    """Return an error if the air did more work than it can, or None.

    The pressures of the plant depend on the actual bends. Runs that begin with bent
    segments are not checked. The attribute `trajectory` of the error contains the
    samples before the excess.
    """
    supply = plant.supply_pa
    if supply == 0.0:
        return None
    spec = plant.spec
    stiffness = spec.bending.stiffness
    bend = run.stack("bend")
    elastic = 0.5 * stiffness * (bend - plant.pneumatics.rest_bend) ** 2
    strain = run.stack("torque") ** 2 / (2 * stiffness)
    work = run["work"] - run["work"][0] + (elastic - strain).sum(axis=1)

    chamber = spec.chamber
    one_fill = supply * chamber.dead_volume
    if elastic[0].sum() > one_fill:
        return None
    stored = plant.pneumatics.line_energy
    for side in ("plus", "minus"):
        stored += run.stack(f"pressure_{side}")[0].sum() * chamber.dead_volume
    ratio = supply / AMBIENT_PA
    expansion = (1 + 1 / ratio) * math.log1p(ratio)
    # The moment per pressure may exceed the volume per bend in a robot file.
    moment = stiffness * float(chamber_gains(spec).max())
    leverage = max(1.0, moment / chamber.displacement)
    drawn = run["pneumatic_energy"] - run["pneumatic_energy"][0]
    limit = leverage * expansion * (stored + drawn)
    is_excessive = work > limit + one_fill
    if not is_excessive.any():
        return None
    k = int(np.argmax(is_excessive))
    error = DivergedError(
        plant.name,
        float(run.time[k]),
        f"the air has done {work[k]:.3g} J of work, but can do only {limit[k]:.3g} J;"
        " the bends may have too little damping"
        " (docs/pneumatics.md#damping-with-orifices)",
    )
    error.trajectory = run.between(run.time[0], run.time[k - 1])
    return error
