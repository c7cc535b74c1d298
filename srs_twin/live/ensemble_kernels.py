"""The ensemble's loops over members, compiled; see `ensemble.py`."""

from __future__ import annotations

import math

import numpy as np

from srs_twin.compute.compiled import allocating, compiled
from srs_twin.plants.analytical import compliant_kernels, kernels
from srs_twin.plants.analytical.floor import FloorFriction

OUTLIER = 4.0
"""Standard deviations from which on a number counts as if it were that much noisier."""


@allocating
def advance(states, velocities, steps, moments, springs, mu, solid, floor):  # type: ignore[no-untyped-def]
    """Advance bodies in place; say which of them made all steps."""
    fine = np.empty(states.shape[0], dtype=np.bool_)
    marks = np.empty(0, dtype=np.int64)
    seen = np.empty((0, states.shape[1])), np.empty((0, velocities.shape[1]))
    for m in range(states.shape[0]):
        model = solid, (springs[m, 0], springs[m, 1]), _with_mu(floor, mu[m])
        now = states[m], velocities[m]
        fine[m] = compliant_kernels.advance(now, steps, moments[m], marks, model, seen) == steps.shape[0]
    return fine


@compiled
def _with_mu(floor, mu):  # type: ignore[no-untyped-def]
    """Return a floor with another μ_t."""
    return FloorFriction(
        floor.case, floor.track, mu, floor.mu_n, floor.slip, floor.drag, floor.load_transfer, floor.gravity,
        floor.pull_x, floor.pull_y,
    )  # fmt: skip


@allocating
def set_momenta(states, velocities, springs, solid, floor):  # type: ignore[no-untyped-def]
    """Fill velocities and momenta of bodies from their velocities in the frames of their mean headings."""
    n, size = solid.mass.shape[0], velocities.shape[1]
    segments, ahead = n - 1, compliant_kernels.BENDS
    momentum, force, moment = np.empty(size), np.empty(size), np.zeros(segments)
    work = compliant_kernels.work_arrays(n)
    for m in range(states.shape[0]):
        state, u = states[m], velocities[m]
        c, s = math.cos(state[kernels.HEADING]), math.sin(state[kernels.HEADING])
        state[kernels.STATE_VX], state[kernels.STATE_VY] = c * u[0] - s * u[1], s * u[0] + c * u[1]
        model = solid, (springs[m, 0], springs[m, 1]), floor
        bend = state[ahead : ahead + segments]
        compliant_kernels.balance(bend, u, moment, 0.0, model, momentum, force, work)
        state[kernels.MOMENT] = momentum[2]
        for j in range(segments):
            state[ahead + segments + j] = momentum[3 + j]


@allocating
def correct(members, predicted, told, variances, masks, together):  # type: ignore[no-untyped-def]  # noqa: D417
    """Take numbers one after another (module docstring); return by what each is off, in standard deviations.

    Args:
        members: in place, shape (members, columns).
        predicted: what each member would measure, in place, shape (members, numbers).
        told: the numbers, NaN where there are none.
        variances: of their noise.
        masks: how far each corrects a column, 0 to 1, shape (numbers, columns).
        together: whether a number also corrects what later ones are predicted to be.
    """
    count, width = members.shape
    off = np.full(told.shape[0], np.nan)
    for k in range(told.shape[0]):
        if np.isnan(told[k]):
            continue
        mean = 0.0
        for m in range(count):
            mean += predicted[m, k] / count
        spread = 0.0
        for m in range(count):
            spread += (predicted[m, k] - mean) ** 2 / (count - 1)
        apart = told[k] - mean
        off[k] = apart / math.sqrt(spread + variances[k])
        noise = max(variances[k], (apart / OUTLIER) ** 2 - spread)
        total = spread + noise
        # The square root filter's share of the gain by which members come nearer to their mean.
        share = 1 / (1 + math.sqrt(noise / total))
        for column in range(width):
            if masks[k, column] == 0.0:
                continue
            middle = 0.0
            for m in range(count):
                middle += members[m, column] / count
            together_with = own = 0.0
            for m in range(count):
                together_with += (predicted[m, k] - mean) * (members[m, column] - middle) / (count - 1)
                own += (members[m, column] - middle) ** 2 / (count - 1)
            # Of a correlation r that so many members show, what is beyond chance.
            found = together_with**2 / max(own * spread, 1e-300)
            believed = max(1 - (1 - found) / ((count - 2) * max(found, 1e-12)), 0.0)
            gain = masks[k, column] * believed * together_with / total
            for m in range(count):
                members[m, column] += gain * (apart - share * (predicted[m, k] - mean))
        if together:
            for later in range(k + 1, told.shape[0]):
                together_with = 0.0
                for m in range(count):
                    together_with += (predicted[m, k] - mean) * predicted[m, later] / (count - 1)
                gain = together_with / total
                for m in range(count):
                    predicted[m, later] += gain * (apart - share * (predicted[m, k] - mean))
    return off
