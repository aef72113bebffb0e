"""The compiled least squares of all moments of a cycle, behind :mod:`fluoromap.triangulator.moments`.

Pixel noise is independent from electrode to electrode, and one displacement of the whole heart between the runs is common to
all. So the normal equations are blocks of 3 x 3 and a matrix of rank one, and no large matrix is inverted. Importing this
module loads numba and its first call compiles: import it where it is used.
"""

import numpy as np
from numba import njit


@njit(cache=True, nogil=True, error_model="numpy")
def step(matrices, points, pixels, weights, common, variance, own, shared, row):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Move all points by one Gauss-Newton step, in place.

    The result is the largest coordinate of the step.

    Parameters
    ----------
    matrices : (2, 3, 4)
        Camera matrices of view a and b.
    points : (p, N, 3)
        World, mm.
    pixels : (2, p, N, 2)
    weights : (2, p, N, 2, 2)
        Inverse covariances of the pixels.
    common : (p, N, 2, 2)
        Effect on the pixels, view by view, of the displacement of the whole heart.
    variance : float
        Of that displacement.
    own, shared, row : (p, N, 3, 4), (p, N, 3), (p, N, 4)
        Filled with the gain before the step: a point changes with the pixels by ``own`` of the same electrode and by ``shared``
        times ``row`` of all electrodes.
    """
    moments, electrodes = points.shape[:2]
    largest = 0.0
    jacobian, residual = np.empty((2, 2, 3)), np.empty((2, 2))
    normal, inverse = np.empty((3, 3)), np.empty((3, 3))
    pulled, weighted = np.empty(3), np.empty((3, 4))
    steps = np.empty((electrodes, 3))
    for p in range(moments):
        stiffness, along, pull, against = 0.0, 0.0, 0.0, 0.0
        for i in range(electrodes):
            x = points[p, i]
            normal[:] = 0.0
            pulled[:] = 0.0
            for view in range(2):
                m = matrices[view]
                depth = m[2, 0] * x[0] + m[2, 1] * x[1] + m[2, 2] * x[2] + m[2, 3]
                for c in range(2):
                    at = (m[c, 0] * x[0] + m[c, 1] * x[1] + m[c, 2] * x[2] + m[c, 3]) / depth
                    residual[view, c] = pixels[view, p, i, c] - at
                    for k in range(3):
                        jacobian[view, c, k] = (m[c, k] - at * m[2, k]) / depth
                for c in range(2):
                    pushed = 0.0
                    for d in range(2):
                        pushed += weights[view, p, i, c, d] * common[p, i, view, d]
                    row[p, i, 2 * view + c] = pushed
                    stiffness += pushed * common[p, i, view, c]
                    against += pushed * residual[view, c]
                    for k in range(3):
                        pulled[k] += pushed * jacobian[view, c, k]
                        total = 0.0
                        for d in range(2):
                            total += jacobian[view, d, k] * weights[view, p, i, d, c]
                        weighted[k, 2 * view + c] = total
                for k in range(3):
                    for j in range(3):
                        for c in range(2):
                            normal[k, j] += weighted[k, 2 * view + c] * jacobian[view, c, j]
            _invert(normal, inverse)
            for k in range(3):
                steps[i, k] = 0.0
                for c in range(4):
                    total = 0.0
                    for j in range(3):
                        total += inverse[k, j] * weighted[j, c]
                    own[p, i, k, c] = total
                    steps[i, k] += total * residual[c // 2, c % 2]
                total = 0.0
                for j in range(3):
                    total += inverse[k, j] * pulled[j]
                shared[p, i, k] = total
                along += total * pulled[k]
                pull += steps[i, k] * pulled[k]
            # What the electrode's own place explains of the common displacement.
            for c in range(4):
                total = 0.0
                for k in range(3):
                    total += own[p, i, k, c] * pulled[k]
                row[p, i, c] = total - row[p, i, c]
        left = variance / (1.0 + variance * stiffness)
        left = left / (1.0 - left * along)
        for i in range(electrodes):
            for k in range(3):
                shared[p, i, k] *= left
                moved = steps[i, k] + shared[p, i, k] * (pull - against)
                points[p, i, k] += moved
                largest = max(largest, abs(moved))
    return largest


@njit(cache=True, nogil=True, error_model="numpy", inline="always")
def _invert(matrix, inverse):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Invert a symmetric matrix (3, 3)."""
    a, b, c = matrix[0, 0], matrix[0, 1], matrix[0, 2]
    d, e, f = matrix[1, 1], matrix[1, 2], matrix[2, 2]
    inverse[0, 0] = d * f - e * e
    inverse[0, 1] = inverse[1, 0] = c * e - b * f
    inverse[0, 2] = inverse[2, 0] = b * e - c * d
    inverse[1, 1] = a * f - c * c
    inverse[1, 2] = inverse[2, 1] = b * c - a * e
    inverse[2, 2] = a * d - b * b
    inverse /= a * inverse[0, 0] + b * inverse[0, 1] + c * inverse[0, 2]


@njit(cache=True, nogil=True, error_model="numpy")
def covariances(own, shared, row, noise, effects):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Return the covariance (p, N, 3, 3) of each point.

    Parameters
    ----------
    own, shared, row : (p, N, 3, 4), (p, N, 3), (p, N, 4)
        The gain, see :func:`step`.
    noise : (2, p, N, 2, 2)
        Covariances of the pixels from errors of each electrode in each view by itself.
    effects : (p, N, 4, k)
        Effect on the pixels of k independent errors of standard deviation 1.
    """
    moments, electrodes, _, count = effects.shape
    found = np.empty((moments, electrodes, 3, 3))
    of_row, moved = np.empty(count), np.empty((3, count))
    noisy, mixed = np.empty((3, 4)), np.empty(3)
    for p in range(moments):
        of_row[:] = 0.0
        variance = 0.0
        for i in range(electrodes):
            for c in range(4):
                for k in range(count):
                    of_row[k] += row[p, i, c] * effects[p, i, c, k]
            for view in range(2):
                for c in range(2):
                    for d in range(2):
                        variance += row[p, i, 2 * view + c] * noise[view, p, i, c, d] * row[p, i, 2 * view + d]
        for i in range(electrodes):
            for a in range(3):
                for k in range(count):
                    total = shared[p, i, a] * of_row[k]
                    for c in range(4):
                        total += own[p, i, a, c] * effects[p, i, c, k]
                    moved[a, k] = total
                mixed[a] = 0.0
                for c in range(4):
                    view, at = c // 2, c % 2
                    total = 0.0
                    for d in range(2):
                        total += own[p, i, a, 2 * view + d] * noise[view, p, i, d, at]
                    noisy[a, c] = total
                    mixed[a] += total * row[p, i, c]
            for a in range(3):
                for b in range(a + 1):
                    total = variance * shared[p, i, a] * shared[p, i, b]
                    total += mixed[a] * shared[p, i, b] + shared[p, i, a] * mixed[b]
                    for c in range(4):
                        total += noisy[a, c] * own[p, i, b, c]
                    for k in range(count):
                        total += moved[a, k] * moved[b, k]
                    found[p, i, a, b] = found[p, i, b, a] = total
    return found
