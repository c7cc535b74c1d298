"""Noise without state: a number that depends on the seed, the segment and the time, and on nothing else.

So a sensor says the same to a controller that reads it once a tick and to a recorder that reads a whole
run at once, on one thread or many. The numbers of one segment are SplitMix64 (Steele, Lea, Flood, 2014),
read at the places 2n and 2n + 1 of its sequence, n the time in slots of 0.1 ms, and made normal by Box and
Muller's transform. Each (seed, segment) starts elsewhere in the sequence.

A controller asks for one moment after another, each of which would cost as much as a thousand at once. So
single moments are looked up in blocks of slots that are kept.
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np

from srs_twin.errors import InputError

SLOT = 1e-4
"""Readings within a slot are the same, those of different slots independent, s."""

_GOLDEN = np.uint64(0x9E3779B97F4A7C15)
_FIRST = np.uint64(0xBF58476D1CE4E5B9)
_SECOND = np.uint64(0x94D049BB133111EB)
_LATEST = 2.0**53 * SLOT
_BLOCK = 1024  # slots


def standard_normal(seed: int, time: np.ndarray | float, segments: int) -> np.ndarray:
    """Return standard normal numbers, shape (…, segments).

    Args:
        seed: any whole number; equal ones modulo 2⁶⁴ give the same.
        time: s, shape (…,), taken to the nearest slot.
        segments: how many; the first ones do not depend on it.

    Raises:
        InputError: a time that is not finite, or too long for whole slots.
    """
    time = np.asarray(time, dtype=float)
    if not (np.abs(time) < _LATEST).all():
        raise InputError(f"sensor noise has no time that is not finite or beyond {_LATEST:g} s")
    slot = np.rint(time / SLOT).astype(np.int64)
    if slot.size == 1:
        number, place = divmod(slot.item(), _BLOCK)
        return _block(int(seed) % 2**64, number, segments)[place].reshape(*slot.shape, segments)
    return _at(int(seed) % 2**64, slot, segments)


@lru_cache(maxsize=64)
def _block(seed: int, number: int, segments: int) -> np.ndarray:
    """Return the numbers of the slots of a block, shape (_BLOCK, segments)."""
    found = _at(seed, np.arange(number * _BLOCK, (number + 1) * _BLOCK), segments)
    found.setflags(write=False)  # the next who asks gets the same
    return found


def _at(seed: int, slot: np.ndarray, segments: int) -> np.ndarray:
    """Return the numbers of slots, int64 of shape (…,); shape (…, segments)."""
    # Arrays, not scalars: NumPy warns of a scalar's overflow, which is meant here.
    start = _mixed(np.full(segments, seed, dtype=np.uint64) + _GOLDEN)
    start = _mixed(start ^ (np.arange(1, segments + 1, dtype=np.uint64) * _GOLDEN))
    place = start + (slot.view(np.uint64)[..., None] << np.uint64(1)) * _GOLDEN
    radius = (_mixed(place) >> np.uint64(11)).astype(float) + 1  # 1 … 2⁵³, never 0
    turn = (_mixed(place + _GOLDEN) >> np.uint64(11)).astype(float)
    normal: np.ndarray = np.sqrt(-2 * np.log(radius * 2.0**-53)) * np.cos(2 * np.pi * 2.0**-53 * turn)
    return normal


def _mixed(word: np.ndarray) -> np.ndarray:
    """Return SplitMix64's output for a state: each bit of it depends on each bit of the state."""
    word = (word ^ (word >> np.uint64(30))) * _FIRST
    word = (word ^ (word >> np.uint64(27))) * _SECOND
    return word ^ (word >> np.uint64(31))
