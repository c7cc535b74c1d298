r"""Completion: frames on which a marker was not seen, from those that were and from what the body can do.

The body is laid through the markers that were seen (σ), near the bends that a spline through the complete
frames has (σ_q), and, where too little was seen to tell, near where the hidden markers were interpolated
(σ_h):

$$ \min_{x, y, \theta_1, q}\; \sum_m \frac{|p_m - \hat p_m|^2}{\sigma_m^2}
   + \sum_j \frac{(q_j - \hat q_j)^2}{\sigma_q^2}, \qquad
   p_{j+1} = p_j - L(q_j)\,e^{i\alpha_j}, \quad \alpha_j = \theta_j - q_j/2, \quad
   \theta_{j+1} = \theta_j - q_j. $$

Points are complex numbers here.
"""

from __future__ import annotations

import numpy as np

from srs_twin.identification.headings import NOISE
from srs_twin.shape import chords
from srs_twin.spec import Geometry

BENDS = 0.15
"""σ_q, rad."""

HIDDEN = 1e-2
"""σ_h, m."""

_STEPS = 6


def completed(
    time: np.ndarray,
    points: np.ndarray,
    missing: np.ndarray,
    connector: np.ndarray,
    position: np.ndarray,
    theta: np.ndarray,
    geometry: Geometry,
    longer: np.ndarray,
) -> tuple[np.ndarray, np.ndarray]:
    """Return places and headings of the connectors, those anew that a marker which was not seen tells of.

    Args:
        time: shape (frames,), s.
        points: markers, interpolated where they were not seen, shape (frames, markers, 2), m.
        missing: where that is, shape (frames, markers).
        connector: on which connector each marker is, from 0, shape (markers,).
        position: connectors by the markers, interpolated ones as well, shape (frames, N, 2), m.
        theta: their headings, shape (frames, N), rad.
        geometry: of the robot.
        longer: by how much its segments are longer than that, shape (segments,), m.
    """
    torn = missing.any(axis=1)
    if not torn.any() or (~torn).sum() < 4:
        return position, theta
    from scipy.interpolate import CubicSpline

    place, mark = position @ [1, 1j], points @ [1, 1j]
    local = (mark - place[:, connector]) * np.exp(-1j * theta[:, connector])
    arm = np.median(local[~torn].real, axis=0) + 1j * np.median(local[~torn].imag, axis=0)
    # Headings by interpolated markers may be any: two of a pair come close to each other.
    turns = CubicSpline(time[~torn], theta[~torn])(time[torn])
    aim = turns[:, :-1] - turns[:, 1:]
    weight = np.where(missing[torn], HIDDEN**-2, NOISE**-2)
    state = np.concatenate([place[torn, :1].real, place[torn, :1].imag, turns[:, :1], aim], axis=1)
    for _ in range(_STEPS):
        seat, lever, _, _ = _laid(state, arm, connector, geometry, longer)
        miss = mark[torn] - seat
        # Normal equations of each frame: real and imaginary part of every marker.
        normal = np.einsum("fmu,fm,fmv->fuv", lever.conj(), weight, lever).real
        right = np.einsum("fmu,fm,fm->fu", lever.conj(), weight, miss).real
        bends = np.arange(3, state.shape[1])
        normal[:, bends, bends] += BENDS**-2
        right[:, 3:] += (aim - state[:, 3:]) * BENDS**-2
        state = state + np.clip(np.linalg.solve(normal, right[..., None])[..., 0], -0.3, 0.3)
    _, _, nodes, headings = _laid(state, arm, connector, geometry, longer)
    hidden = np.stack([missing[torn][:, connector == k].any(axis=1) for k in range(theta.shape[1])], axis=1)
    # Places that were measured stay; so do headings, where each connector has its own.
    stays = ~hidden & (np.bincount(connector).min() > 1)
    position, theta = position.copy(), theta.copy()
    laid = np.stack([nodes.real, nodes.imag], axis=-1)
    position[torn] = np.where(hidden[..., None], laid, position[torn])
    theta[torn] = np.where(stays, theta[torn], headings)
    return position, theta


def _laid(
    state: np.ndarray, arm: np.ndarray, connector: np.ndarray, geometry: Geometry, longer: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Return markers and how they move with the state, and connectors with their headings.

    Args:
        state: x, y, θ_1 and bends, shape (frames, 2 + N).
        arm: from a connector to its marker in the connector's frame, shape (markers,), m.
        connector: of each marker, from 0.
        geometry: of the robot.
        longer: as in `completed`.

    Returns:
        Shapes (frames, markers), (frames, markers, 2 + N), (frames, N) and (frames, N).
    """
    bend = state[:, 3:]
    length, slope, _ = chords(bend, geometry.segment_length, geometry.rigid_gap)
    length = length + longer
    zero = np.zeros((len(state), 1))
    headings = state[:, 2:3] - np.concatenate([zero, np.cumsum(bend, axis=1)], axis=1)
    along = np.exp(1j * (headings[:, :-1] - bend / 2))
    first = state[:, :1] + 1j * state[:, 1:2]
    nodes = first - np.concatenate([zero, np.cumsum(length * along, axis=1)], axis=1)
    reach = arm * np.exp(1j * headings[:, connector])
    marks = nodes[:, connector] + reach
    lever = np.zeros((*marks.shape, state.shape[1]), dtype=complex)
    lever[..., 0], lever[..., 1] = 1, 1j
    lever[..., 2] = 1j * (marks - first)
    for k in range(bend.shape[1]):
        # What lies behind segment k turns about its rear end, which moves with the chord.
        behind = connector > k
        end = (-slope[:, k] + 0.5j * length[:, k]) * along[:, k]
        turned = end[:, None] - 1j * (marks - nodes[:, k + 1 : k + 2])
        lever[:, behind, 3 + k] = turned[:, behind]
    return marks, lever, nodes, headings
