"""What the pictures share of the chamber's wall: its colours in a raster, its outline, the lit parts of a line."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from fluoromap.contracts import Array, BoolArray, ChamberMap, IntArray
from fluoromap.fuser.colours import NO_DATA_HATCH_RGB, NO_DATA_RGB, Scale
from fluoromap.fuser.raster import Raster


def pixel_colours(
    raster: Raster, chamber: ChamberMap, times: Scale, unit: float, until_ms: float | None = None
) -> tuple[NDArray[np.float32], BoolArray, BoolArray]:
    """Of the p pixels that show the wall, in row-major order: RGB (p, 3), coloured (p,), on the "no data" hatch (p,).

    Coloured is what is covered and, where ``until_ms`` is given, activated by then. ``unit`` is the size of the picture's
    details, 1 for a picture of 512 pixels.
    """
    covered = raster.sample(chamber.covered.astype(np.float64)) > 0.5
    lat = raster.sample(_times_past_rim(chamber), chamber.cycle_length_ms)
    colours = times.band_colours()[times.band(lat)].astype(np.float32)
    v, u = raster.pixels
    hatched = ~covered & ((u + v) % max(4, round(7 * unit)) < max(1, round(unit)))
    colours[~covered] = NO_DATA_RGB
    colours[hatched] = NO_DATA_HATCH_RGB
    if until_ms is not None:
        covered &= lat <= until_ms
    return colours, covered, hatched


def _times_past_rim(chamber: ChamberMap) -> Array:
    """Times at the vertices, those just past the covered part taking the mean of their covered neighbours: else a face on
    the rim would run through all bands down to 0."""
    lat, faces, cycle = chamber.lat_ms.copy(), chamber.faces, chamber.cycle_length_ms
    if not chamber.covered.any():
        return lat
    lat[~chamber.covered] = low = float(lat[chamber.covered].min())
    known = chamber.covered[faces].astype(np.float64)
    # Round a cycle times have no mean but their directions on a circle have.
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
    """Edges (e, 2) between a face that faces the viewer and one that does not."""
    edges = np.sort(faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1)
    vertices = int(faces.max()) + 1
    # One number an edge sorts several times faster than a pair.
    unique, of_edge = np.unique(edges[:, 0] * vertices + edges[:, 1], return_inverse=True)
    rim = unique[np.bincount(of_edge, np.repeat(facing, 3), minlength=len(unique)) == 1]
    return np.stack(np.divmod(rim, vertices), axis=1)


def runs(flags: BoolArray) -> list[slice]:
    """Slices of a line's points, one for each run of segments whose flag is set."""
    changes = np.flatnonzero(np.diff(np.concatenate([[0], flags.astype(np.int8), [0]])))
    return [slice(int(start), int(stop) + 1) for start, stop in changes.reshape(-1, 2)]
