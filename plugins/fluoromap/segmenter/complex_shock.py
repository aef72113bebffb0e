"""Step 3 of the four-step filter: complex shock filter, equation (7)."""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from fluoromap.contracts import BoolArray
from fluoromap.segmenter.log_image import Image


def to_grey_range(x: Image, inside: BoolArray) -> Image:
    """Linear map that brings the 0.5th to 99.5th percentile inside the mask to 0..255, the scale of :func:`complex_shock`.

    The gain ``feedback`` of equation (7) is not free of scale. Values beyond the percentiles are kept, not clipped.
    """
    values = x[::4, ::4][inside[::4, ::4]]
    low, high = (float(value) for value in np.percentile(values, [0.5, 99.5]))
    scale = 255.0 / (high - low) if high > low else 1.0
    mapped: Image = (x - np.float32(low)) * np.float32(scale)
    return mapped


def complex_shock(
    x: Image,
    sweeps: int = 15,
    step: float = 0.1,
    magnitude: float = 0.5,
    tangential: float = 0.5,
    theta: float = math.pi / 1000,
    feedback: float = 0.5,
) -> Image:
    """Complex shock filter, equation (7), on a 0..255 grey scale; returns the real part.

    With lambda = r exp(i theta), R the real part and J = imaginary part / theta::

        R_t = -(2/pi) atan(a J) |grad R| + r cos(theta) R_nn - r theta sin(theta) J_nn + lt R_ee
        J_t = r cos(theta) J_nn + (r sin(theta) / theta) R_nn + lt J_ee

    n runs along the gradient, e across it. The minus sign makes the dark side of an edge darker; plus would blur. |grad R|
    uses minmod differences, everything else central ones. The border repeats itself.

    Parameters
    ----------
    x : (rows, columns) float32
        Grey levels, see :func:`to_grey_range`.
    sweeps : int
    step : float
        At most 1 / (4 max(r, lt)).
    magnitude, tangential, theta, feedback : float
        r, lambda tilde, theta and a of the paper.

    Returns
    -------
    (rows, columns) float32
    """
    if not 0 < step <= 0.25 / max(magnitude, tangential):
        raise ValueError("the step of the shock filter must lie between 0 and 1 / (4 max(magnitude, tangential))")
    rows, columns = x.shape
    real = np.empty((rows + 2 * sweeps, columns + 2), np.float32)
    imaginary = np.empty_like(real)
    start = real[2 * sweeps :]
    start[:, 1:-1] = x
    start[:, 0], start[:, -1] = x[:, 0], x[:, -1]
    imaginary[2 * sweeps :] = 0
    _sharpen(
        real,
        imaginary,
        sweeps,
        np.float32(step),
        np.float32(magnitude * math.cos(theta) - tangential),
        np.float32(magnitude * math.sin(theta) / theta),
        np.float32(magnitude * math.sin(theta) * theta),
        np.float32(tangential),
        np.float32(feedback),
    )
    return np.ascontiguousarray(real[:rows, 1:-1])


@njit(inline="always")
def _minmod(a, b):  # type: ignore[no-untyped-def]  # pragma: no cover
    zero = np.float32(0)
    return max(zero, min(a, b)) + min(zero, max(a, b))


@njit(inline="always")
def _two_over_pi_atan(x):  # type: ignore[no-untyped-def]  # pragma: no cover
    """(2/pi) atan(x) to 1e-5 by an odd polynomial (Abramowitz and Stegun 4.4.49); library calls break vectorisation."""
    size = abs(x)
    one = np.float32(1)
    z = min(size, one / max(size, one))
    w = z * z
    series = np.float32(0.0208351) * w - np.float32(0.0851330)
    series = series * w + np.float32(0.1801410)
    series = series * w - np.float32(0.3302995)
    series = (series * w + np.float32(0.9998660)) * z * np.float32(2 / math.pi)
    series = one - series if size > one else series
    return series if x >= 0 else -series


@njit(cache=True, nogil=True, fastmath=True, error_model="numpy")
def _sharpen_row(  # type: ignore[no-untyped-def]  # pragma: no cover
    rw, rc, re, rnw, rn, rne, rsw, rs, rse, jw, jc, je, jnw, jn, jne, jsw, js, jse, real, imaginary,
    step, excess, drive, coupling, tangential, feedback,
):  # fmt: skip
    """One sweep over one row. r* and j* are R and J at the compass neighbours (c: the pixel itself), as shifted rows.

    With I_ee = Laplace I - I_nn only the n direction is formed: ``excess`` is r cos(theta) - lt.
    """
    half, quarter, two = np.float32(0.5), np.float32(0.25), np.float32(2)
    for u in range(real.size):
        r = rc[u]
        j = jc[u]
        east = re[u] - r
        west = r - rw[u]
        south = rs[u] - r
        north = r - rn[u]
        mu = _minmod(east, west)
        mv = _minmod(south, north)
        gu = half * (east + west)
        gv = half * (south + north)
        inverse = np.float32(1) / (gu * gu + gv * gv + np.float32(1e-8))
        wuu = gu * gu * inverse
        wvv = gv * gv * inverse
        wuv = two * gu * gv * inverse
        ruu = east - west
        rvv = south - north
        ruv = quarter * (rse[u] + rnw[u] - rne[u] - rsw[u])
        rnn = wuu * ruu + wuv * ruv + wvv * rvv
        juu = je[u] + jw[u] - two * j
        jvv = js[u] + jn[u] - two * j
        juv = quarter * (jse[u] + jnw[u] - jne[u] - jsw[u])
        jnn = wuu * juu + wuv * juv + wvv * jvv
        shock = _two_over_pi_atan(feedback * j) * np.sqrt(mu * mu + mv * mv)
        real[u] = r + step * (excess * rnn + tangential * (ruu + rvv) - coupling * jnn - shock)
        imaginary[u] = j + step * (excess * jnn + tangential * (juu + jvv) + drive * rnn)


@njit(cache=True, nogil=True, fastmath=True, error_model="numpy")
def _sharpen(real, imaginary, sweeps, step, excess, drive, coupling, tangential, feedback):  # type: ignore[no-untyped-def]  # pragma: no cover
    """All sweeps as one wavefront. A sweep leaves each row two rows higher in the buffer, where nothing is needed any more,
    so that neighbours still hold the values from before the sweep and no row is copied."""
    rows = real.shape[0] - 2 * sweeps
    n = real.shape[1] - 2
    for front in range(rows + sweeps - 1):
        for sweep in range(max(0, front - rows + 1), min(sweeps, front + 1)):
            v = front - sweep
            c = v + 2 * (sweeps - sweep)
            up = c - 1 if v > 0 else c
            down = c + 1 if v < rows - 1 else c
            r, rn, rs = real[c], real[up], real[down]
            j, jn, js = imaginary[c], imaginary[up], imaginary[down]
            new_r, new_j = real[c - 2], imaginary[c - 2]
            _sharpen_row(
                r[:n], r[1:-1], r[2:], rn[:n], rn[1:-1], rn[2:], rs[:n], rs[1:-1], rs[2:],
                j[:n], j[1:-1], j[2:], jn[:n], jn[1:-1], jn[2:], js[:n], js[1:-1], js[2:],
                new_r[1:-1], new_j[1:-1], step, excess, drive, coupling, tangential, feedback,
            )  # fmt: skip
            new_r[0], new_r[n + 1] = new_r[1], new_r[n]
            new_j[0], new_j[n + 1] = new_j[1], new_j[n]
