"""The lowest eigenpairs of a sparse matrix, and the eigenfunctions of surfaces with known ones."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.sparse import csc_array, diags_array
from scipy.spatial import ConvexHull

from fluoromap.fuser.laplace_beltrami import eigenfunctions, lowest_eigenpairs


def _grid_laplacian(rows: int, columns: int) -> tuple[csc_array, np.ndarray]:
    """Return the matrix of a grid with free edges, and its eigenvalues."""

    def path(n: int) -> np.ndarray:
        matrix = 2 * np.eye(n) - np.eye(n, k=1) - np.eye(n, k=-1)
        matrix[0, 0] = matrix[-1, -1] = 1
        return matrix

    matrix = np.kron(path(rows), np.eye(columns)) + np.kron(np.eye(rows), path(columns))
    along, across = (2 - 2 * np.cos(np.pi * np.arange(n) / n) for n in (rows, columns))
    return csc_array(matrix), np.sort((along[:, None] + across).ravel())


@pytest.mark.parametrize("highest", [0.2, 1.0, 5.0])
@pytest.mark.parametrize(("rows", "columns", "count"), [(25, 17, 30), (10, 6, 20)])
def test_the_lowest_eigenpairs_of_a_grid_are_those_of_the_closed_form(
    rows: int, columns: int, count: int, highest: float
) -> None:
    matrix, expected = _grid_laplacian(rows, columns)
    values, vectors = lowest_eigenpairs(matrix, np.ones(rows * columns), count, highest * expected[count - 1])
    np.testing.assert_allclose(values, expected[:count], atol=1e-10)
    np.testing.assert_allclose(matrix @ vectors, vectors * values, atol=1e-5 * expected[count])
    np.testing.assert_allclose(vectors.T @ vectors, np.eye(count), atol=1e-9)


def test_a_shift_that_is_an_eigenvalue_is_not_used() -> None:
    expected = np.arange(1200.0)
    # The best shift is 58 % of the highest: the eigenvalue 29.
    values, _ = lowest_eigenpairs(csc_array(diags_array(expected)), np.ones(1200), 50, 50.0)
    np.testing.assert_allclose(values, expected[:50], atol=1e-6)


def test_the_eigenvalues_of_a_sphere_are_those_of_the_spherical_harmonics() -> None:
    radius_mm, n = 25.0, 3000
    index = np.arange(n) + 0.5
    height, angle = 1 - 2 * index / n, np.pi * (1 + np.sqrt(5.0)) * index
    around = np.sqrt(1 - height**2)
    vertices = radius_mm * np.column_stack([around * np.cos(angle), around * np.sin(angle), height])
    values, functions = eigenfunctions(vertices, ConvexHull(vertices).simplices.astype(np.int64), 49)
    degrees = np.repeat(np.arange(7), 2 * np.arange(7) + 1)
    np.testing.assert_allclose(values * radius_mm**2, degrees * (degrees + 1), rtol=0.03, atol=1e-6)
    # The first is constant over an area of 4 pi r².
    np.testing.assert_allclose(np.abs(functions[:, 0]), 1 / np.sqrt(4 * np.pi * radius_mm**2), rtol=0.01)
