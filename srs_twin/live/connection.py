r"""Local connection: how a body on wheels goes by bending; what wheels alone do not tell is learnt.

Where momentum hardly counts, a body moves by its change of shape, whatever the pace (Kelly and Murray 1995):

$$ ξ = A(q) \, \dot q , \qquad A = A_w(q) + \sum_k W_k \, φ_k(\tanh(q / q_0)) , \quad
φ(x) = (1, x_i, x_i x_j, x_i x_j x_k) , $$

ξ forth, aside and turning. A_w is the way of least friction for wheels whose friction is in proportion to
speed. W is what a robot does otherwise: a gait that turns goes less far than a straight one to either side,
which takes cubic terms. It is learnt from one frame of motion capture to the next by least squares
with a prior: then bends alone tell for a while where the robot goes.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from itertools import combinations_with_replacement
from typing import Any

import numpy as np

from srs_twin.io.saved_state import Stateful
from srs_twin.robot.geometry import body_shape, relative_headings
from srs_twin.robot.spec import RobotSpec

PRIOR, _UNLIKE = 0.1, (0.01, 0.05)
"""How large entries of W may be, rad a rad; by what a robot goes besides what is known, rad a rad of bending,
at the least (what cubics miss no frame tells) and at the most."""
_LARGE = 0.7
"""q₀, rad: powers of larger bends do not grow, so that what was learnt of small ones does no harm there."""
_BLOCK, _KEPT_BLOCKS, _FORGETS = 30, 10, 3000
"""Frames after which W is found anew, blocks of these and frames that count."""
_NOISE, _DRIFT = 0.02, (0.001, 0.001, 0.02)
"""What a frame's heading (rad) and what moves a frame (m, m, rad) are off by, before that is known."""
_RECURS = 1.3
"""What a cubic misses comes again with every stroke: by so much more than chance is W off."""
_SMALL = 1e-4


class LocalConnection(Stateful):
    """How one robot goes by bending.

    Attributes:
        weights: W, a row for each product of φ and a bend's change, columns forth, aside (m), turning (rad).
    """

    state_attributes = ("weights", "_gram", "_sums", "_noise", "_drift", "_frames", "_block")

    def __init__(self, spec: RobotSpec, mass: np.ndarray) -> None:
        """Know the wheels.

        Args:
            spec: the robot.
            mass: of each connector with its share of the segments, kg.
        """
        n = spec.segments
        self._spec, self._mass = spec, mass
        self._powers = [np.array(list(combinations_with_replacement(range(n), power))) for power in (1, 2, 3)]
        count = n * (1 + sum(map(len, self._powers)))
        self.weights: np.ndarray = np.zeros((count, 3))
        self._gram, self._sums = np.zeros((count, count)), np.zeros((count, 3))
        self._noise, self._drift = _NOISE**2, np.square(_DRIFT)
        self._frames, self._block = 0, np.zeros(3)
        self._root: np.ndarray = np.eye(count) * PRIOR / _NOISE

    def snapshot(self) -> LocalConnection:
        """Return the connection as it is now, for another thread; it cannot learn."""
        made = object.__new__(LocalConnection)
        # `learn` and `recall` put new arrays in the place of these and never change them.
        for name in ("_spec", "_mass", "_powers", "weights", "_root", "_drift"):
            setattr(made, name, getattr(self, name))
        return made

    def parts(self, before: np.ndarray, after: np.ndarray) -> np.ndarray:
        """Return φ ⊗ dq of bends (rad) that went from here to there, shape (rows of W,)."""
        return np.outer(self._products((before + after) / 2), after - before).ravel()

    def at(self, bends: np.ndarray) -> np.ndarray:
        """Return A: forth, aside (m/rad), turning (rad/rad), shape (3, segments)."""
        products = self._products(bends)
        learnt = self.weights.reshape(len(products), self._spec.segments, 3)
        return self.of_wheels(bends) + np.einsum("k,kjc->cj", products, learnt)

    def of_wheels(self, bends: np.ndarray) -> np.ndarray:
        """Return A_w, as `at`."""
        g, mu, n = self._spec.geometry, self._spec.friction, self._spec.segments
        shapes = body_shape(bends + _SMALL * np.eye(n + 1, n, -1), self._mass, g.segment_length, g.rigid_gap)
        place, moves = shapes[0], (shapes[1:] - shapes[0]) / _SMALL
        heading = relative_headings(bends)
        ahead = np.stack([np.cos(heading), np.sin(heading)], axis=-1)
        ways = np.stack([math.sqrt(mu.mu_t) * ahead, math.sqrt(mu.mu_n) * ahead[:, ::-1] * [-1.0, 1.0]])
        turns = np.stack([-place[:, 1], place[:, 0]], axis=-1)
        body = np.concatenate([ways, np.sum(ways * turns, axis=-1, keepdims=True)], axis=-1).reshape(-1, 3)
        own = np.einsum("kic,jic->kij", ways, moves).reshape(-1, n)
        return np.asarray(-np.linalg.lstsq(body, own, rcond=None)[0])

    def unsure(self, parts: np.ndarray, draws: np.ndarray) -> np.ndarray:
        """Return what robots go by otherwise that W may belong to as well, shape (robots, 3).

        Args:
            parts: of their bends.
            draws: standard normal, which robot it is, shape (robots, rows of W, 3).
        """
        wide = _RECURS * parts @ self._root
        told = math.sqrt(self._drift[2]) * float(np.linalg.norm(wide))
        least, most = np.multiply(_UNLIKE, np.linalg.norm(parts[: self._spec.segments]))
        share = min(max(told, least), most) / max(told, 1e-12)
        return np.asarray(share * np.sqrt(self._drift) * np.einsum("f,rfc->rc", wide, draws))

    def learn(self, parts: np.ndarray, missed: np.ndarray) -> None:
        """Take what a robot went by (m, m, rad) besides A_w dq from one frame to the next."""
        self._gram *= 1 - 1 / _FORGETS
        self._sums *= 1 - 1 / _FORGETS
        self._gram += np.outer(parts, parts)
        self._sums += np.outer(parts, missed)
        off = missed - parts @ self.weights
        self._noise += (off[2] ** 2 - self._noise) / 100
        self._block += off
        self._frames += 1
        if self._frames % _BLOCK:
            return
        # What one frame is off by the next one takes back: only sums tell how far one drifts.
        kept = max(min(self._frames // _BLOCK, _KEPT_BLOCKS), 2)
        self._drift = self._drift + (self._block**2 / _BLOCK - self._drift) / kept
        self._block = np.zeros(3)
        self.weights = np.asarray(np.linalg.solve(self._normal(), self._sums))

    def load_state_dict(self, memory: Mapping[str, Any]) -> None:
        """Take a memory, as all that remember do."""
        super().load_state_dict(memory)
        if self._frames >= _BLOCK:
            self._normal()

    def _normal(self) -> np.ndarray:
        """Return the normal equations' matrix with the prior; keep its inverse's root, W's spread."""
        gram: np.ndarray = self._gram + self._noise / PRIOR**2 * np.eye(len(self._gram))
        self._root = np.asarray(np.linalg.inv(np.linalg.cholesky(gram)).T)
        return gram

    def _products(self, bends: np.ndarray) -> np.ndarray:
        bends = np.tanh(bends / _LARGE)
        return np.concatenate([[1.0], *(bends[each].prod(axis=1) for each in self._powers)])
