"""Algebra of spatial vectors and tree-structured matrices in numba and Warp.

In spatial vectors, the rotational components come first. The reference point of a
spatial vector is the centre of mass of the snake, as for MuJoCo's `cdof`. Symmetric
matrices have the sparsity pattern of the joint-space inertia matrix M (`Sparsity`).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from srs_twin.compute.compiled import kernel_only


class Sparsity(NamedTuple):
    """Sparsity pattern of the lower triangle of M, and damping matrices.

    Each row has one entry for every ancestor of its degree of freedom. The last entry
    of a row is the diagonal entry.

    Attributes:
        row_length, row_start: number of entries in each row and index of its first
            entry, shape (nv,).
        column: column index of each entry, shape (nM,).
        parent: parent of each degree of freedom, or −1 at the root, shape (nv,).
        damping, damping_excess: damping matrices C and h D − C (`contact_loaded`),
            shape (nM,), kg or kg·m².
    """

    row_length: np.ndarray
    row_start: np.ndarray
    column: np.ndarray
    parent: np.ndarray
    damping: np.ndarray
    damping_excess: np.ndarray


@kernel_only
def dot(a, b):  # type: ignore[no-untyped-def]
    """Return the inner product of two spatial vectors."""
    return (
        a[0] * b[0]
        + a[1] * b[1]
        + a[2] * b[2]
        + a[3] * b[3]
        + a[4] * b[4]
        + a[5] * b[5]
    )


@kernel_only
def inner(a, b):  # type: ignore[no-untyped-def]
    """Return the inner product of two vectors."""
    total = float(0.0)
    for i in range(a.shape[0]):
        total += a[i] * b[i]
    return total


@kernel_only
def clear(array):  # type: ignore[no-untyped-def]
    """Set a matrix to zero."""
    for i in range(array.shape[0]):
        for k in range(array.shape[1]):
            array[i, k] = 0.0


@kernel_only
def add_product(sparsity, matrix, x, out):  # type: ignore[no-untyped-def]
    """Add the product of a symmetric matrix and the vector x to `out`."""
    for i in range(x.shape[0]):
        row = sparsity.row_start[i]
        last = sparsity.row_start[i] + sparsity.row_length[i] - 1
        for k in range(row, last):
            out[i] += matrix[k] * x[sparsity.column[k]]
            out[sparsity.column[k]] += matrix[k] * x[i]
        out[i] += matrix[last] * x[i]


@kernel_only
def point_jacobian(row, x, y, z, ex, ey, ez):  # type: ignore[no-untyped-def]
    """Compute the Jacobian row for the velocity of a point along a unit vector."""
    row[0] = y * ez - z * ey
    row[1] = z * ex - x * ez
    row[2] = x * ey - y * ex
    row[3] = ex
    row[4] = ey
    row[5] = ez


@kernel_only
def spatial_velocities(cdof, sparsity, velocity, motion):  # type: ignore[no-untyped-def]
    """Compute the spatial velocity of the body that each degree of freedom moves."""
    for i in range(velocity.shape[0]):
        p = sparsity.parent[i]
        for k in range(6):
            motion[i, k] = cdof[i, k] * velocity[i]
            if p >= 0:
                motion[i, k] += motion[p, k]


@kernel_only
def project(cdof, sparsity, force, out):  # type: ignore[no-untyped-def]
    """Sum spatial forces towards the root, and write the generalised forces to `out`.

    The sums replace the values in `force`.
    """
    for i in range(out.shape[0] - 1, -1, -1):
        out[i] = dot(cdof[i], force[i])
        p = sparsity.parent[i]
        if p >= 0:
            for k in range(6):
                force[p, k] += force[i, k]


@kernel_only
def project_jacobian(cdof, sparsity, derivative, force, matrix):  # type: ignore[no-untyped-def]
    """Sum spatial derivatives towards the root, and add their projection to a matrix.

    As in the composite-rigid-body algorithm, the sum of all derivatives beyond a degree
    of freedom is projected onto this degree of freedom and its ancestors. The function
    overwrites the derivatives, shape (nv, 6, 6), and the work array `force`, shape (nv,
    6). The matrix has the shape (nM,).
    """
    for i in range(sparsity.row_length.shape[0] - 1, -1, -1):
        d = cdof[i]
        composite = derivative[i]
        p = sparsity.parent[i]
        row = sparsity.row_start[i]
        reaction = force[i]
        for a in range(6):
            reaction[a] = dot(composite[a], d)
        for k in range(row, row + sparsity.row_length[i]):
            matrix[k] += dot(reaction, cdof[sparsity.column[k]])
        if p >= 0:
            for a in range(6):
                for b in range(6):
                    derivative[p, a, b] += composite[a, b]


@kernel_only
def factor(matrix, sparsity):  # type: ignore[no-untyped-def]
    """Factor a matrix with the pattern of M into LᵀDL, in place and without fill-in."""
    # The elimination of a row changes only the rows of its ancestors. The rows are
    # therefore eliminated from the ends of the chain to the root.
    for k in range(sparsity.row_length.shape[0] - 1, -1, -1):
        row = sparsity.row_start[k]
        last = sparsity.row_length[k] - 1
        inverse_pivot = 1.0 / matrix[row + last]
        for a in range(last - 1, -1, -1):
            factor = matrix[row + a] * inverse_pivot
            ancestor = sparsity.row_start[sparsity.column[row + a]]
            for b in range(a + 1):
                matrix[ancestor + b] -= factor * matrix[row + b]
            matrix[row + a] = factor


@kernel_only
def substitute(matrix, sparsity, x):  # type: ignore[no-untyped-def]
    """Solve LᵀDL x = b in place, where `x` initially contains b."""
    for i in range(x.shape[0] - 1, -1, -1):
        for k in range(
            sparsity.row_start[i], sparsity.row_start[i] + sparsity.row_length[i] - 1
        ):
            x[sparsity.column[k]] -= matrix[k] * x[i]
    for i in range(x.shape[0]):
        last = sparsity.row_start[i] + sparsity.row_length[i] - 1
        value = x[i] / matrix[last]
        for k in range(sparsity.row_start[i], last):
            value -= matrix[k] * x[sparsity.column[k]]
        x[i] = value
