"""Samples: the values of several fields put together to points."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import product

import numpy as np

from srs_twin.errors import InputError
from srs_twin.sweep.file import MAX_POINTS, RangeFile, SamplingFile
from srs_twin.sweep.points import Value

Given = Mapping[str, Sequence[Value] | RangeFile]


def sample(vary: Given, sampling: SamplingFile) -> list[tuple[Value, ...]]:
    """Return the points, a row each with a value for each field.

    Raises:
        InputError: lists of unequal length, a range without a count, or too many points.
    """
    if sampling.kind in ("latin_hypercube", "sobol"):
        return _drawn(list(vary.values()), sampling)
    lists = [_listed(name, values) for name, values in vary.items()]
    if sampling.kind == "list":
        lengths = {name: len(values) for name, values in zip(vary, lists, strict=True)}
        if len(set(lengths.values())) > 1:
            told = ", ".join(f"{name} {length}" for name, length in lengths.items())
            raise InputError(f"sampling: list takes as many values of each field, but there are {told}")
        return list(zip(*lists, strict=True))
    count = 1
    for values in lists:
        count *= len(values)
    if count > MAX_POINTS:
        raise InputError(f"the grid has {count} points; at most {MAX_POINTS} are allowed")
    return list(product(*lists))


def _listed(name: str, values: Sequence[Value] | RangeFile) -> list[Value]:
    if not isinstance(values, RangeFile):
        return list(values)
    if values.count is None:
        raise InputError(f"{name}: a range needs a count here, or sampling: latin_hypercube or sobol")
    spaced = np.geomspace if values.scale == "log" else np.linspace
    return [float(value) for value in spaced(values.start, values.stop, values.count)]


def _drawn(fields: Sequence[Sequence[Value] | RangeFile], sampling: SamplingFile) -> list[tuple[Value, ...]]:
    """Spread points over the ranges; of a list, every value gets an equal share."""
    from scipy.stats import qmc

    assert sampling.count is not None, "checked by the file's model"
    engine = qmc.Sobol if sampling.kind == "sobol" else qmc.LatinHypercube
    unit = engine(d=len(fields), rng=sampling.seed or 0).random(sampling.count)
    columns = [_placed(values, shares) for values, shares in zip(fields, unit.T, strict=True)]
    return list(zip(*columns, strict=True))


def _placed(values: Sequence[Value] | RangeFile, shares: np.ndarray) -> list[Value]:
    if not isinstance(values, RangeFile):
        return [values[int(share * len(values))] for share in shares]
    if values.scale == "log":
        return [float(value) for value in values.start * (values.stop / values.start) ** shares]
    return [float(value) for value in values.start + (values.stop - values.start) * shares]
