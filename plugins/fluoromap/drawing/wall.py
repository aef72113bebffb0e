"""The chamber's wall in a picture: bands of pixels, outline, visible parts of lines."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from fluoromap.contracts import Array, BoolArray, ChamberMap, IntArray
from fluoromap.drawing.colours import NO_DATA_HATCH_RGB, NO_DATA_RGB, Scale
from fluoromap.drawing.raster import Raster

NO_DATA, HATCH, NOTHING = -1, -2, -3
"""Values of pixels without a band: no site is near; the hatch there; no wall, or a wall that is not coloured yet."""

_WITHIN = -4
"""Value of pixels whose face crosses a limit, until each pixel gets its own band."""


def pixel_bands(
    raster: Raster, chamber: ChamberMap, times: Scale, unit: float, until_ms: float | None = None
) -> NDArray[np.int32]:
    """Return the band of ``times`` of each pixel (rows, columns).

    A pixel without a band has ``NO_DATA``, ``HATCH`` or ``NOTHING``. With ``until_ms``, only the wall that is activated
    by that time has a band. ``unit`` is the size of the picture's details, 1 for a picture of 512 pixels. The negative
    values index the table of :func:`colour_table` from its end.
    """
    lat, cycle = _times_past_rim(chamber), chamber.cycle_length_ms

    def band(lat_ms: Array) -> NDArray[np.int64]:
        return times.band(lat_ms) if until_ms is None else np.where(lat_ms <= until_ms, times.band(lat_ms), NOTHING)

    covered, at_corners = chamber.covered[chamber.faces], band(lat)[chamber.faces]
    corners_covered: IntArray = covered.sum(axis=1)
    # All pixels of a face that crosses no limit have one band. Around a cycle, corners with equal bands may still differ
    # by nearly a cycle.
    one_band = (corners_covered == 3) & (np.ptp(at_corners, axis=1) == 0)
    if cycle is not None:
        one_band &= np.ptp(lat[chamber.faces], axis=1) < cycle / 2
    of_face = np.where(one_band, at_corners[:, 0], np.where(corners_covered > 0, _WITHIN, NO_DATA))
    rows, columns = raster.box
    face = raster.face[rows, columns].ravel()
    shown = np.append(of_face, NOTHING).astype(np.int32)[face]

    def pixels(places: IntArray) -> IntArray:
        """Return the pixels of the picture at places in the box, both in row-major order."""
        v, u = np.divmod(places, max(1, columns.stop - columns.start))
        in_picture: IntArray = (v + rows.start) * raster.face.shape[1] + (u + columns.start)
        return in_picture

    within = np.flatnonzero(shown == _WITHIN)
    shown[within] = band(raster.sample(pixels(within), lat, cycle))
    rim = within[corners_covered[face[within]] < 3]
    shown[rim[raster.sample(pixels(rim), chamber.covered.astype(np.float64)) <= 0.5]] = NO_DATA
    far = np.flatnonzero(shown == NO_DATA)
    v, u = np.divmod(pixels(far), raster.face.shape[1])
    shown[far[(u + v) % max(4, round(7 * unit)) < max(1, round(unit))]] = HATCH
    bands = np.full(raster.face.shape, NOTHING, dtype=np.int32)
    bands[rows, columns] = shown.reshape(bands[rows, columns].shape)
    return bands


def colour_table(times: Scale, nothing: tuple[int, int, int]) -> NDArray[np.uint8]:
    """Return the RGB table (bands + 3, 3) that :func:`pixel_bands` indexes."""
    table: NDArray[np.uint8] = np.concatenate(
        [times.band_colours(), np.array([nothing, NO_DATA_HATCH_RGB, NO_DATA_RGB], dtype=np.uint8)]
    )
    return table


def _times_past_rim(chamber: ChamberMap) -> Array:
    """Return the vertices' times, extended past the covered part.

    The times lie within one cycle. Vertices just past the rim get the mean of their covered neighbours. Otherwise a
    face on the rim would run through all bands down to 0.
    """
    lat, faces, cycle = chamber.lat_ms.copy(), chamber.faces, chamber.cycle_length_ms
    if not chamber.covered.any():
        return lat
    lat[~chamber.covered] = low = float(lat[chamber.covered].min())
    if cycle is not None:
        lat = low + (lat - low) % cycle
    known = chamber.covered[faces].astype(np.float64)
    # Times around a cycle have no mean, but their directions on a circle have one.
    turns = lat[faces].astype(np.complex128) if cycle is None else np.exp(2j * np.pi * (lat[faces] - low) / cycle)
    of_face = (known * turns).sum(axis=1)
    parts = [
        np.bincount(faces.ravel(), np.repeat(part, 3), minlength=len(lat)) for part in (of_face.real, of_face.imag)
    ]
    count = np.bincount(faces.ravel(), np.repeat(known.sum(axis=1), 3), minlength=len(lat))
    rim = ~chamber.covered & (count > 0)
    total = parts[0][rim] + 1j * parts[1][rim]
    if cycle is None:
        lat[rim] = total.real / count[rim]
    else:
        lat[rim] = low + np.angle(total) % (2 * np.pi) * cycle / (2 * np.pi)
    return lat


def outline_edges(faces: IntArray, facing: BoolArray) -> IntArray:
    """Return the edges (e, 2) between a face that faces the viewer and a face that does not."""
    first, second, third = faces[facing].T
    vertices = int(faces.max()) + 1
    # Sorting one number an edge is several times faster than sorting pairs.
    edges = [
        np.minimum(a, b) * vertices + np.maximum(a, b) for a, b in ((first, second), (second, third), (third, first))
    ]
    unique, count = np.unique(np.concatenate(edges), return_counts=True)
    return np.stack(np.divmod(unique[count == 1], vertices), axis=1)


def line_parts(flags: BoolArray) -> list[slice]:
    """Return the slices of a line's flagged parts.

    There is one slice of points for each connected part of flagged segments.
    """
    changes = np.flatnonzero(np.diff(np.concatenate([[0], flags.astype(np.int8), [0]])))
    return [slice(int(start), int(stop) + 1) for start, stop in changes.reshape(-1, 2)]
