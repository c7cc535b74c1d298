r"""Headings of the connectors, from two markers at each or from one.

With two markers a connector its heading is that of the line through them (Algorithm 1), turned by the quarter
turns that lie between that line and the body.

With one, a segment's chord lies along the mean heading of its ends, so the directions α_j of the chords give
all headings but for one number a frame, the ε by which they may turn in opposite senses:

$$ \theta_{j+1} = 2\alpha_j - \theta_j, \qquad q_j = q_j^0 + 2\,(-1)^{j-1}\varepsilon. $$

The lengths of the chords, which shorten as segments bend, and a second marker on the head tell it:

$$ \varepsilon = \arg\min \sum_j \frac{(L(q_j) + c_j - d_j)^2}{2\sigma^2}
   + \frac{\varepsilon^2}{\sigma_\varepsilon^2} + \frac{(\theta_1 - \vartheta)^2}{\sigma_\vartheta^2}, $$

where q⁰ bends least, d_j are the measured lengths, and c_j what the robot's segments are longer than its file
says. Near a straight body the lengths say little: there ε is known to about 0.1 rad without the head's second
marker.
"""

from __future__ import annotations

import numpy as np

from srs_twin.errors import InputError
from srs_twin.identification.chain import some_frames
from srs_twin.shape import chords, pair_heading
from srs_twin.spec import Geometry

NOISE = 5e-4
"""σ, assumed error of a marker's position, m."""

PRIOR = 0.3
"""σ_ε, rad: a gait of one wave over the body has hardly any. Where the head's heading is measured, none."""

_ASKEW = np.radians(25.0)
_ROUNDS, _STEPS = 8, 6
_STARTS = np.linspace(-0.6, 0.6, 9)


def chord_directions(position: np.ndarray) -> np.ndarray:
    """Return the directions from each connector to the one before it, unwrapped, (frames, segments), rad."""
    angle = pair_heading(position[:, 1:], position[:, :-1])
    return np.unwrap(np.unwrap(angle, axis=1)[:, :1], axis=0) + np.unwrap(angle, axis=1) - angle[:, :1]


def from_pairs(name: str, first: np.ndarray, second: np.ndarray) -> tuple[np.ndarray, int]:
    """Return headings of the connectors, and on how many of the frames' pairs the markers had changed names.

    Args:
        name: of the file.
        first: one marker of each connector, head first, shape (frames, N, 2), m.
        second: the other.

    Returns:
        Shape (frames, N), rad, each within a quarter turn of the body; a number.

    Raises:
        InputError: a pair lies neither along nor across the body.
    """
    direction = chord_directions((first + second) / 2)
    body = np.concatenate(
        [direction[:, :1], (direction[:, 1:] + direction[:, :-1]) / 2, direction[:, -1:]], axis=1
    )
    angle = pair_heading(first, second)
    # Of doubled angles: a line has no front end.
    mean = np.angle(np.exp(2j * some_frames(angle - body)).mean(axis=0)) / 2
    ahead = np.cos(some_frames(angle - body) - mean).mean(axis=0) < 0
    mean = mean + np.pi * ahead
    quarters = np.rint(mean / (np.pi / 2))
    askew = np.abs(mean - quarters * np.pi / 2)
    if askew.max() > _ASKEW:
        k = int(askew.argmax())
        raise InputError(
            f"{name}: the two markers at connector {k + 1} lie {np.degrees(mean[k]):.0f}° from the body; "
            "along it or "
            "across it is wanted"
        )
    heading = angle - quarters * np.pi / 2
    # Modulo half a turn: the two markers of a pair may have changed names, and the connector heads ahead.
    off = (heading - body + np.pi / 2) % np.pi - np.pi / 2
    turned = np.abs((heading - body - off + np.pi) % (2 * np.pi) - np.pi) > 1.0
    return np.unwrap(body + off, axis=0), int(turned.sum())


def from_positions(
    position: np.ndarray, geometry: Geometry, head: np.ndarray | None = None, head_error: float = np.inf
) -> tuple[np.ndarray, np.ndarray]:
    """Return headings of the connectors, and c_j.

    Args:
        position: shape (frames, N, 2), m.
        geometry: of the robot.
        head: measured heading of the first connector, shape (frames,), rad, on any turn; None: not measured.
        head_error: its standard error, rad.

    Returns:
        Shape (frames, N), rad; shape (segments,), m.
    """
    alpha = chord_directions(position)
    distance = np.linalg.norm(np.diff(position, axis=1), axis=-1)
    sign = (-1.0) ** np.arange(alpha.shape[1])
    theta = _least_bent(alpha, sign)
    bend = theta[:, :-1] - theta[:, 1:]
    aim, weight, prior = np.zeros(len(bend)), 0.0, PRIOR**-2
    if head is not None:
        prior = 0.0
        aim = (head - theta[:, 0] + np.pi) % (2 * np.pi) - np.pi
        weight = 1.0 / head_error**2
    longer = np.zeros(bend.shape[1])
    epsilon = _best_start(bend, sign, distance, longer, geometry, aim, weight)
    for _ in range(_ROUNDS):
        for _ in range(_STEPS):
            length, slope, _ = chords(
                bend + 2 * sign * epsilon[:, None], geometry.segment_length, geometry.rigid_gap
            )
            miss, lever = length + longer - distance, 2 * sign * slope
            down = (miss * lever).sum(axis=1) / (2 * NOISE**2) + epsilon * prior + (epsilon - aim) * weight
            curve = (lever**2).sum(axis=1) / (2 * NOISE**2) + prior + weight
            epsilon = epsilon - np.clip(down / curve, -0.2, 0.2)
        length = chords(bend + 2 * sign * epsilon[:, None], geometry.segment_length, geometry.rigid_gap)[0]
        longer = np.median(distance - length, axis=0)
    swing = (-1.0) ** np.arange(theta.shape[1])
    return theta + swing * epsilon[:, None], longer


def _least_bent(alpha: np.ndarray, sign: np.ndarray) -> np.ndarray:
    """Return the headings that bend least among those that the chords allow, (frames, N), rad."""
    theta = np.zeros((alpha.shape[0], alpha.shape[1] + 1))
    theta[:, 0] = alpha[:, 0]
    for j in range(alpha.shape[1]):
        theta[:, j + 1] = 2 * alpha[:, j] - theta[:, j]
    epsilon = -((theta[:, :-1] - theta[:, 1:]) * sign).mean(axis=1) / 2
    swing = (-1.0) ** np.arange(theta.shape[1])
    return np.asarray(theta + swing * epsilon[:, None])


def _best_start(
    bend: np.ndarray,
    sign: np.ndarray,
    distance: np.ndarray,
    longer: np.ndarray,
    geometry: Geometry,
    aim: np.ndarray,
    weight: float,
) -> np.ndarray:
    """Return the ε of a coarse grid that fits each frame best, shape (frames,): there are many minima."""
    costs = []
    for start in _STARTS:
        length = chords(bend + 2 * sign * start, geometry.segment_length, geometry.rigid_gap)[0]
        miss = ((length + longer - distance) ** 2).sum(axis=1) / (2 * NOISE**2)
        costs.append(miss + start**2 / PRIOR**2 + (start - aim) ** 2 * weight)
    return np.asarray(_STARTS[np.argmin(costs, axis=0)])
