"""Step 3 of the four-step filter: complex shock filter, equation (7)."""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from fluoromap.contracts import BoolArray
from fluoromap.segmenter.picture.log_image import Image, central_range


def to_grey_range(x: Image, inside: BoolArray) -> Image:
    """Map the 0.5th to 99.5th percentile inside the mask linearly to 0..255.

    This is the scale of :func:`complex_shock`: the gain ``feedback`` of equation (7) depends on the scale. Values
    beyond the percentiles are not clipped.
    """
    ends = central_range(x, inside)
    low, high = ends if ends is not None else (0.0, 255.0)
    mapped: Image = x * np.float32(255.0 / (high - low))
    mapped -= np.float32(255.0 * low / (high - low))
    return mapped


def complex_shock(
    x: Image,
    sweeps: int = 15,
    step: float = 0.1,
    magnitude: float = 0.5,
    theta: float = math.pi / 1000,
    feedback: float = 0.5,
) -> Image:
    """Apply the complex shock filter, eq. (7) of the paper; return the real part.

    With lambda = r exp(i theta), R the real part and J = imaginary part / theta::

        R_t = -(2/pi) atan(a J) |grad R| + r cos(theta) R_nn - r theta sin(theta) J_nn + lt R_ee
        J_t = r cos(theta) J_nn + (r sin(theta) / theta) R_nn + lt J_ee

    n is the direction along the gradient, e across it. The minus sign makes the dark side of an edge darker; a plus would
    blur. |grad R| uses minmod differences, all other terms central differences. The border values are repeated.

    The paper's lambda tilde equals r, and theta is small. Two simplifications follow. r cos(theta) is taken as r, so
    that the diffusion of R and of J is r times their Laplacians. The feedback of J_nn on R is left out. For theta up to
    0.01 both are less than 1e-4 of the remaining terms, and change the result by less than 1e-4 of its range.

    Parameters
    ----------
    x : (rows, columns) float32
        Grey levels 0..255, see :func:`to_grey_range`.
    sweeps : int
    step : float
        At most 1 / (4 r).
    magnitude, theta, feedback : float
        r (and lambda tilde), theta and a of the paper.

    Returns
    -------
    (rows, columns) float32
    """
    if not 0 < step <= 0.25 / magnitude:
        raise ValueError(f"the step of the shock filter is {step}: it must lie between 0 and {0.25 / magnitude}")
    if not 0 < theta <= 0.01:
        raise ValueError(f"theta of the shock filter is {theta}: it must lie between 0 and 0.01")
    rows, columns = x.shape
    real = np.empty((rows + 2 * sweeps, columns + 2), np.float32)
    imaginary = np.empty_like(real)
    start = real[2 * sweeps :]
    start[:, 1:-1] = x
    start[:, 0], start[:, -1] = x[:, 0], x[:, -1]
    imaginary[2 * sweeps :] = 0
    drive = step * feedback * magnitude * math.sin(theta) / theta
    _sharpen(real, imaginary, sweeps, np.float32(step), np.float32(step * magnitude), np.float32(drive))
    return np.ascontiguousarray(real[:rows, 1:-1])


@njit(inline="always")
def _minmod(a, b):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Return the middle one of a, b and 0."""
    return max(min(a, b), min(max(a, b), np.float32(0)))


@njit(cache=True, nogil=True, fastmath=True, error_model="numpy")
def _sharpen_row(r, r_north, r_south, j, j_north, j_south, real, imaginary, step, flow, drive):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Do one sweep over one row.

    ``r`` is R and ``j`` is a times J, a being the feedback coefficient of equation (7). Both are given in this row and in
    its neighbours. All rows have one extra pixel at both ends. (2/pi) atan(x) is computed as x P(|x|) / Q(|x|) to 1e-4,
    with quadratic P and cubic Q of the same limit. It shares one division with the second derivative along the gradient.
    Gradients are twice as large here, which cancels.
    """
    n = r.size - 2
    r_west, r_here, r_east = r[:n], r[1:-1], r[2:]
    r_north_west, r_up, r_north_east = r_north[:n], r_north[1:-1], r_north[2:]
    r_south_west, r_down, r_south_east = r_south[:n], r_south[1:-1], r_south[2:]
    j_west, j_here, j_east, j_up, j_down = j[:n], j[1:-1], j[2:], j_north[1:-1], j_south[1:-1]
    new_real, new_imaginary = real[1:-1], imaginary[1:-1]
    half, one, four = np.float32(0.5), np.float32(1), np.float32(4)
    tail = np.float32(1.00184694)
    for u in range(n):
        here, bend = r_here[u], j_here[u]
        east, west = r_east[u] - here, here - r_west[u]
        south, north = r_down[u] - here, here - r_up[u]
        mu, mv = _minmod(east, west), _minmod(south, north)
        gu, gv = east + west, south + north
        uu, vv = east - west, south - north
        uv = (r_south_east[u] - r_north_east[u]) + (r_north_west[u] - r_south_west[u])
        along = gu * gu * uu + gv * gv * vv + half * (gu * gv) * uv
        square = gu * gu + gv * gv + np.float32(4e-8)
        size = abs(bend)
        upper = bend * (np.float32(0.63997758) + size * (np.float32(1.0077312) + size * tail))
        lower = one + size * (np.float32(1.64843262) + size * (np.float32(1.64882102) + size * tail))
        inverse = one / (square * lower)
        shock = np.sqrt(mu * mu + mv * mv) * (upper * square * inverse)
        new_real[u] = here + flow * (uu + vv) - step * shock
        around = j_east[u] + j_west[u] + j_down[u] + j_up[u] - four * bend
        new_imaginary[u] = bend + flow * around + drive * (along * lower * inverse)


@njit(cache=True, nogil=True, fastmath=True, error_model="numpy")
def _sharpen(real, imaginary, sweeps, step, flow, drive):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Do all sweeps as one wavefront.

    A sweep moves each row two rows up in the buffer, where no values are needed any more. So neighbours still hold the
    values from before the sweep, and no row is copied.
    """
    rows = real.shape[0] - 2 * sweeps
    n = real.shape[1] - 2
    for front in range(rows + sweeps - 1):
        for sweep in range(max(0, front - rows + 1), min(sweeps, front + 1)):
            v = front - sweep
            c = v + 2 * (sweeps - sweep)
            up = c - 1 if v > 0 else c
            down = c + 1 if v < rows - 1 else c
            new_real, new_imaginary = real[c - 2], imaginary[c - 2]
            _sharpen_row(
                real[c], real[up], real[down], imaginary[c], imaginary[up], imaginary[down],
                new_real, new_imaginary, step, flow, drive,
            )  # fmt: skip
            new_real[0], new_real[n + 1] = new_real[1], new_real[n]
            new_imaginary[0], new_imaginary[n + 1] = new_imaginary[1], new_imaginary[n]
