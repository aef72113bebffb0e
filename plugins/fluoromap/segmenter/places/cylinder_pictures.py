"""Pictures of electrodes as cylinders: how much metal a ray crosses.

A ring is a tube round the shaft. Seen obliquely, it shows its two openings: ellipses that are dark where rays run along the wall,
and bright between. A tip is solid and ends in a dome.
"""

from __future__ import annotations

import math

from numba import njit

from fluoromap.contracts import Array

STEP_PX = 0.5
"""From row to row of a picture, along the axis. From column to column, across it, is one pixel."""
_TIP = -1.0
_LEAST_PX = 0.25
_ALONG_PX, _ACROSS_PX = 0.5, 0.4


@njit(cache=True, nogil=True, fastmath=True, error_model="numpy")
def _through_cylinder(along, across, half, radius, cosine, sine):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Return the length of a ray in a solid cylinder.

    At a distance across the axis, the cylinder's section is a rectangle in the plane of the ray and the axis. Seen obliquely, the
    length in it rises, stays, and falls again along the axis.
    """
    if abs(across) >= radius:
        return 0.0
    chord = math.sqrt(radius * radius - across * across)
    end, opening = max(half * cosine, _LEAST_PX), max(chord * sine, _LEAST_PX)
    overlap = min(end, along + opening) - max(-end, along - opening)
    return max(overlap, 0.0) * (half / end) * (chord / opening)


@njit(cache=True, nogil=True, fastmath=True, error_model="numpy")
def _through_electrode(along, across, half, radius, inner, cosine, sine):  # type: ignore[no-untyped-def]  # pragma: no cover
    if inner < 0.0:
        back = 0.5 * radius * cosine
        seen = _through_cylinder(along - back, across, max(half - 0.5 * radius, _LEAST_PX), radius, cosine, sine)
        from_centre = along + (half - radius) * cosine
        square = radius * radius - across * across - from_centre * from_centre
        return max(seen, 2.0 * math.sqrt(square)) if square > 0.0 else seen
    return _through_cylinder(along, across, half, radius, cosine, sine) - _through_cylinder(
        along, across, half, inner * radius, cosine, sine
    )


@njit(cache=True, nogil=True, fastmath=True, error_model="numpy")
def draw_electrode(picture, half, radius, inner, is_tip, cosine):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Write the picture of an electrode, whose middle is that of the picture.

    Parameters
    ----------
    picture : (2 m + 1, 2 n + 1) float64
        Length of the rays in metal, pixels; 0 before. A row goes across the axis; the first rows are nearer to the catheter's tip.
    half, radius : float
        Half the electrode's length, and its radius, pixels.
    inner : float
        Inner radius of a ring, as a share of its radius; 0 for a solid one.
    is_tip : bool
        Whether it is a tip: solid, with a dome.
    cosine : float
        Of the angle between the axis and the image: visible over true length.
    """
    sine = math.sqrt(max(1.0 - cosine * cosine, 0.0))
    m, n = picture.shape[0] // 2, picture.shape[1] // 2
    inside = _TIP if is_tip else inner
    last = min(m, reached_rows(half, radius, cosine))
    for row in range(m - last, m + last + 1 if is_tip else m + 1):
        for column in range(n + 1):
            along, across = (row - m) * STEP_PX, float(column - n)
            total = 0.0
            for way in range(4):
                u = along + (_ALONG_PX if way & 1 else -_ALONG_PX)
                v = across + (_ACROSS_PX if way & 2 else -_ACROSS_PX)
                total += _through_electrode(u, v, half, radius, inside, cosine, sine)
            # Both sides of an electrode look alike, and both ends of a ring.
            picture[row, column] = picture[row, 2 * n - column] = 0.25 * total
            if not is_tip:
                picture[2 * m - row, column] = picture[2 * m - row, 2 * n - column] = 0.25 * total


@njit(cache=True, nogil=True, fastmath=True, error_model="numpy")
def reached_rows(half, radius, cosine):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Return how many rows an electrode's picture reaches to each side.

    See :func:`draw_electrode`. Other rows are empty.
    """
    opening = radius * math.sqrt(max(1.0 - cosine * cosine, 0.0))
    return int((max(half * cosine, _LEAST_PX) + max(opening, _LEAST_PX) + _ALONG_PX) / STEP_PX) + 1


def half_length_px(half_px: Array, radius_px: float, cosine: Array) -> Array:
    """Return half the visible lengths of electrodes, with their openings, pixels."""
    seen: Array = half_px * cosine + radius_px * (1.0 - cosine * cosine) ** 0.5
    return seen
