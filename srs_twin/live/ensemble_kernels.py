"""Compiled loops over the members of the ensemble; see `ensemble.py`."""

from __future__ import annotations

import math

import numpy as np

from srs_twin.compute.compiled import allocating
from srs_twin.plants.analytical import compliant_kernels, kernels

OUTLIER = 4.0
"""Innovation, in standard deviations, above which a measurement gets a larger noise."""


@allocating
def advance(states, velocities, steps, moments, model):  # type: ignore[no-untyped-def]
    """Advance bodies in place; return whether each body completed all steps."""
    complete = np.empty(states.shape[0], dtype=np.bool_)
    marks = np.empty(0, dtype=np.int64)
    seen = np.empty((0, states.shape[1])), np.empty((0, velocities.shape[1]))
    for m in range(states.shape[0]):
        now = states[m], velocities[m]
        complete[m] = compliant_kernels.advance(now, steps, moments[m], marks, model, seen) == steps.shape[0]
    return complete


@allocating
def set_momenta(states, velocities, model):  # type: ignore[no-untyped-def]
    """Fill velocities and momenta of bodies from their velocities in the frames of their mean headings."""
    n, size = model[0].mass.shape[0], velocities.shape[1]
    segments, ahead = n - 1, compliant_kernels.BENDS
    momentum, force, moment = np.empty(size), np.empty(size), np.zeros(segments)
    work = compliant_kernels.work_arrays(n)
    for m in range(states.shape[0]):
        state, u = states[m], velocities[m]
        c, s = math.cos(state[kernels.HEADING]), math.sin(state[kernels.HEADING])
        state[kernels.STATE_VX], state[kernels.STATE_VY] = c * u[0] - s * u[1], s * u[0] + c * u[1]
        bend = state[ahead : ahead + segments]
        compliant_kernels.balance(bend, u, moment, 0.0, model, momentum, force, work)
        state[kernels.MOMENT] = momentum[2]
        for j in range(segments):
            state[ahead + segments + j] = momentum[3 + j]


@allocating
def correct(members, predicted, measured, variances, masks, correlated):  # type: ignore[no-untyped-def]  # noqa: D417
    """Correct the members by one measurement after another; return normalised innovations.

    Args:
        members: in place, shape (members, columns).
        predicted: measurements predicted by each member, in place, shape (members, measurements).
        measured: measurements, NaN where they are missing.
        variances: variances of the measurement noise.
        masks: localisation weights of each measurement, 0 to 1, shape (measurements, columns).
        correlated: whether a measurement also corrects the predictions of later ones.
    """
    count, width = members.shape
    normalised = np.full(measured.shape[0], np.nan)
    for k in range(measured.shape[0]):
        if np.isnan(measured[k]):
            continue
        mean = 0.0
        for m in range(count):
            mean += predicted[m, k] / count
        spread = 0.0
        for m in range(count):
            spread += (predicted[m, k] - mean) ** 2 / (count - 1)
        innovation = measured[k] - mean
        normalised[k] = innovation / math.sqrt(spread + variances[k])
        noise = max(variances[k], (innovation / OUTLIER) ** 2 - spread)
        total = spread + noise
        # Fraction of the gain that is applied to the deviations of the members (square root filter).
        reduction = 1 / (1 + math.sqrt(noise / total))
        for column in range(width):
            if masks[k, column] == 0.0:
                continue
            middle = 0.0
            for m in range(count):
                middle += members[m, column] / count
            covariance = own = 0.0
            for m in range(count):
                covariance += (predicted[m, k] - mean) * (members[m, column] - middle) / (count - 1)
                own += (members[m, column] - middle) ** 2 / (count - 1)
            # Squared sample correlations of few members are too large on average; subtract the expected
            # excess.
            square = covariance**2 / max(own * spread, 1e-300)
            significant = max(1 - (1 - square) / ((count - 2) * max(square, 1e-12)), 0.0)
            gain = masks[k, column] * significant * covariance / total
            for m in range(count):
                members[m, column] += gain * (innovation - reduction * (predicted[m, k] - mean))
        if correlated:
            for later in range(k + 1, measured.shape[0]):
                covariance = 0.0
                for m in range(count):
                    covariance += (predicted[m, k] - mean) * predicted[m, later] / (count - 1)
                gain = covariance / total
                for m in range(count):
                    predicted[m, later] += gain * (innovation - reduction * (predicted[m, k] - mean))
    return normalised
