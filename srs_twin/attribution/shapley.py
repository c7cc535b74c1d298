r"""Shapley's value: what each of several switches contributes when their effects depend on each other.

With v(S) what is seen when the switches S are on, switch i contributes on average over all n! orders

$$ \phi_i = \sum_{S \not\ni i} \frac{|S|!\,(n - |S| - 1)!}{n!}\,\bigl[v(S \cup i) - v(S)\bigr], $$

and the contributions add up to v(all) − v(none).
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np


@dataclass(frozen=True)
class Contribution:
    """What one switch contributes: its average over all orders, the least and the most of it."""

    value: np.ndarray
    low: np.ndarray
    high: np.ndarray


def subsets(names: Sequence[str]) -> list[frozenset[str]]:
    """Return all subsets, small ones first."""
    return [frozenset(some) for size in range(len(names) + 1) for some in combinations(names, size)]


def contributions(names: Sequence[str], seen: Mapping[frozenset[str], np.ndarray]) -> dict[str, Contribution]:
    """Return what each switch contributes.

    Args:
        names: the switches.
        seen: what is seen with each subset of them on; arrays of one shape.
    """
    n = len(names)
    found = {}
    for name in names:
        others = [each for each in names if each != name]
        steps = [(len(some), seen[some | {name}] - seen[some]) for some in subsets(others)]
        weights = [
            math.factorial(size) * math.factorial(n - size - 1) / math.factorial(n) for size, _ in steps
        ]
        value = np.sum([w * step for w, (_, step) in zip(weights, steps, strict=True)], axis=0)
        every = [step for _, step in steps]
        found[name] = Contribution(value, np.min(every, axis=0), np.max(every, axis=0))
    return found
