"""Eigenfunctions of a surface: its waves, from the longest on."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from scipy.linalg import eigh, qr
from scipy.sparse import coo_array, csc_array, diags_array
from scipy.sparse.linalg import splu

from fluoromap.contracts import Array, IntArray
from fluoromap.fuser.surface import face_areas_mm2

_TOLERANCE = 1e-6
"""Relative residual of an eigenvalue, far below the uncertainty of the times."""
_BLOCK = 4
"""Vectors in a block of the Krylov space. A block of one costs more time a vector; large blocks need more vectors."""
_BASIS = 2.05
"""Size of the Krylov space at the first test, as a multiple of the number of eigenpairs."""
_LARGEST_BASIS = 8
"""The largest size of the Krylov space, as such a multiple."""
_SHIFTS = (0.58, -1e-3)
"""Shifts as shares of the highest eigenvalue, the best first. With the last one the matrix is always positive definite."""
_MOST_BELOW = 0.8
"""Largest share of the wanted eigenvalues below a shift: the search takes longest for those that are farthest from it."""
_SOLVED, _GROWTH = 1e-9, 1e4
"""Bounds of a solution's relative residual and growth. Close to an eigenvalue the growth would hide all others in rounding."""


def eigenfunctions(vertices_mm: Array, faces: IntArray, count: int) -> tuple[Array, Array]:
    """Return the lowest eigenvalues and eigenfunctions of the Laplace-Beltrami operator.

    They come from linear finite elements. The eigenfunctions have unit square integral.

    Parameters
    ----------
    vertices_mm, faces : (n, 3), (f, 3)
        A closed surface.
    count : int
        Number m of the eigenfunctions.

    Returns
    -------
    ndarray (m,), ndarray (n, m)
        Eigenvalues, rising, 1/mm², and the eigenfunctions at the vertices, 1/mm.
    """
    n = len(vertices_mm)
    corners = vertices_mm[faces]
    edges = np.roll(corners, -1, axis=1) - np.roll(corners, 1, axis=1)
    doubled = 2 * face_areas_mm2(vertices_mm, faces)
    # Needle-shaped faces, as in a hull of nearly coplanar sites, would otherwise make the matrix ill-conditioned.
    doubled = np.maximum(doubled, 1e-3 * (edges**2).sum(axis=2).max(axis=1))
    stiffness = np.einsum("fix,fjx->fij", edges, edges) / (2 * doubled)[:, None, None]
    where = (np.repeat(faces, 3, axis=1).ravel(), np.tile(faces, 3).ravel())
    matrix = coo_array((stiffness.ravel(), where), shape=(n, n)).tocsc()
    mass = np.bincount(faces.ravel(), np.repeat(doubled / 6, 3), minlength=n)
    scale = 1 / np.sqrt(mass)
    symmetric = csc_array(diags_array(scale) @ matrix @ diags_array(scale))
    # Weyl's law: about area * lambda / 4 pi eigenvalues lie below lambda.
    values, vectors = lowest_eigenpairs(symmetric, np.sqrt(mass), count, 4 * np.pi * count / float(mass.sum()))
    return np.maximum(values, 0.0), vectors * scale[:, None]


def lowest_eigenpairs(matrix: csc_array, start: Array, count: int, highest: float) -> tuple[Array, Array]:
    """Return the lowest eigenvalues (m,), rising, and eigenvectors (n, m) of a symmetric matrix without negative ones.

    With a shift in the middle of the wanted eigenvalues, these are the largest of the inverse on both sides of 0. They come
    from the block Lanczos method with orthogonalisation: Golub & Van Loan, Matrix Computations, 4th ed., section 10.3.6.
    Blocks make one matrix product of many products of vectors, which ARPACK computes one by one.

    Parameters
    ----------
    matrix : (n, n)
    start : (n,)
        First vector; the others of its block are random, and the same each time.
    count : int
        Number m of the eigenvalues.
    highest : float
        About the highest of these. Only the time depends on it.
    """
    n = len(start)
    if n < 4 * count + _BLOCK:
        values, vectors = eigh(matrix.toarray())
        return values[:count], vectors[:, :count]
    apply, shift, below = _inverse(matrix, [share * highest for share in _SHIFTS], int(_MOST_BELOW * count))
    room = min(n, _LARGEST_BASIS * count)
    basis, projected = np.empty((n, room), order="F"), np.zeros((room, room))
    block = np.column_stack([start, np.random.default_rng(0).normal(size=(n, _BLOCK - 1))])
    basis[:, :_BLOCK] = qr(block, mode="economic")[0]
    size, enough = 0, int(_BASIS * count)
    while size + 2 * _BLOCK <= room:
        old, own = slice(max(size - _BLOCK, 0), size), slice(size, size + _BLOCK)
        size += _BLOCK
        new = apply(basis[:, own])
        new -= basis[:, old] @ projected[own, old].T
        projected[own, own] = basis[:, own].T @ new
        new -= basis[:, own] @ projected[own, own]
        # Rounding brings back directions of earlier blocks. A step enlarges them by the growth at most, so that every other block
        # may keep them: they stay far below the tolerance.
        if size // _BLOCK % 2 or size >= enough:
            new -= basis[:, :size] @ (basis[:, :size].T @ new)
        following, coupling = qr(new, mode="economic", check_finite=False)
        if size >= enough:
            inverse, axes = eigh(projected[:size, :size], lower=True, check_finite=False)
            # Rising eigenvalues: first those below the shift, whose inverses are negative.
            lowest = np.concatenate([np.arange(below)[::-1], np.arange(size)[::-1][: count - below]])
            inverse, axes = inverse[lowest], axes[:, lowest]
            if (np.linalg.norm(coupling @ axes[-_BLOCK:], axis=0) < _TOLERANCE * np.abs(inverse)).all():
                return shift + 1 / inverse, basis[:, :size] @ axes
            enough = size + count // 8
        own = slice(size, size + _BLOCK)
        basis[:, own], projected[own, size - _BLOCK : size] = following, coupling
    raise np.linalg.LinAlgError("the eigenfunctions of the surface do not converge")


def _inverse(matrix: csc_array, shifts: list[float], most_below: int) -> tuple[Callable[[Array], Array], float, int]:
    """Return the inverse of the matrix minus the first shift that serves.

    Returns
    -------
    callable, float, int
        The function that multiplies the inverse and vectors (n, b), the shift, and the number of eigenvalues below it.
    """
    n = matrix.shape[0]
    tried = np.random.default_rng(1).normal(size=n)
    for shift in shifts:
        shifted = csc_array(matrix - shift * diags_array(np.ones(n)))
        try:
            # An ordering for symmetric matrices has half the fill-in of the general ordering.
            factor: Any = splu(
                shifted, permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options={"SymmetricMode": True}
            )
        except RuntimeError:
            continue  # exactly singular
        solved = factor.solve(tried)
        residual, growth = (np.linalg.norm(each) / np.linalg.norm(tried) for each in (shifted @ solved - tried, solved))
        # With pivots on the diagonal, Sylvester's law of inertia counts the eigenvalues below the shift.
        below = int(np.count_nonzero(factor.U.diagonal() < 0))
        if (
            residual < _SOLVED
            and growth * abs(shift) < _GROWTH
            and below <= most_below
            and (factor.perm_r == factor.perm_c).all()
        ):
            return factor.solve, shift, below
    raise np.linalg.LinAlgError("the stiffness of the surface is singular")
