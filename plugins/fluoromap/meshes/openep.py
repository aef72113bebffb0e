"""The map as OpenEP's MATLAB structure ``userdata``."""

from __future__ import annotations

import io
from typing import Any

import numpy as np
from scipy.io import savemat
from scipy.spatial import cKDTree

from fluoromap.contracts import Array, ChamberMap, IntArray
from fluoromap.fuser.surface import face_normals

SAMPLES_PER_S = 1000.0
WINDOW_MARGIN_MS = 50
_TEXT_BYTES = 116
"""Length of the descriptive text at the start of a MAT-file, level 5."""


def openep_bytes(chamber: ChamberMap, vertices_mm: Array, shift_mm: Array, statement: str) -> bytes:
    """Return the map as a MAT-file (level 5) with one variable, ``userdata``, in OpenEP's structure.

    - ``surface.triRep`` is a struct with ``X`` and ``Triangulation`` (from 1).
    - ``surface.act_bip`` holds activation time in ms, NaN where no site is near, and bipolar voltage, which is unknown: NaN.
    - ``electric`` holds one mapping point for each site: ``egmX`` its position, ``egmSurfX`` its point on the surface, and
      its annotation in samples (1 ms) from the reference's.
    - ``egm``, ``egmUni``, ``egmRef`` and ``ecg`` are 0 over the window of interest: electrograms are not part of a map, but
      OpenEP's readers drop mapping points without signals. ``notes`` says so.
    - ``rf`` has all its fields and no ablation.
    - ``surface.lat_sd_ms`` and ``surface.covered`` are additions to OpenEP's fields.

    Parameters
    ----------
    chamber : ChamberMap
    vertices_mm : (n, 3)
        The map's vertices in the coordinates of the file.
    shift_mm : (3,)
        Added to the sites' positions, for the same coordinates.
    statement : str
        Unit and axes, written at the start of the file and into ``notes``.

    References
    ----------
    S. E. Williams et al., "OpenEP: a cross-platform electroanatomic mapping data format and analysis platform for
    electrophysiology research", Front. Physiol. 12, 646023 (2021).
    """
    stream = io.BytesIO()
    userdata = {
        "notes": _cells(
            [
                statement,
                "made from fluoroscopy: positions are single moments at diastole; times in ms",
                "all electrograms are 0: they are not part of this map",
            ]
        ),
        "surface": _surface(chamber, vertices_mm),
        "electric": _electric(chamber, vertices_mm, shift_mm),
        "rf": {"originaldata": _no_ablation()},
    }
    options: dict[str, Any] = {"format": "5", "long_field_names": True, "oned_as": "column", "do_compression": True}
    savemat(stream, {"userdata": userdata}, **options)  # type: ignore[arg-type]
    # SciPy writes the time of day here, but the same map must give the same bytes.
    text = f"MATLAB 5.0 MAT-file, {statement}".encode("ascii").ljust(_TEXT_BYTES)[:_TEXT_BYTES]
    return text + stream.getvalue()[_TEXT_BYTES:]


def _surface(chamber: ChamberMap, vertices_mm: Array) -> dict[str, Any]:
    known = np.where(chamber.covered, chamber.lat_ms, np.nan)
    unknown = np.full(len(known), np.nan)
    return {
        "triRep": {"X": vertices_mm, "Triangulation": (chamber.faces + 1).astype(np.float64)},
        "isVertexAtRim": np.zeros(len(known)),
        "act_bip": np.stack([known, unknown], axis=1),
        "uni_imp_frc": np.stack([unknown, unknown, unknown], axis=1),
        "normals": _vertex_normals(vertices_mm, chamber.faces),
        "lat_sd_ms": np.where(chamber.covered, chamber.lat_sd_ms, np.nan),
        "covered": chamber.covered.astype(np.float64),
    }


def _electric(chamber: ChamberMap, vertices_mm: Array, shift_mm: Array) -> dict[str, Any]:
    sites = chamber.sites
    names = _cells([site.site for site in sites])
    lat = np.array([site.lat_ms for site in sites])
    window = (np.floor(lat.min()) - WINDOW_MARGIN_MS, np.ceil(lat.max()) + WINDOW_MARGIN_MS)
    # Samples are counted from 1; the window starts with the first sample.
    reference = 1 - window[0]
    surface_mm = np.array([site.surface_mm for site in sites]) + shift_mm
    nearest = cKDTree(vertices_mm).query(surface_mm)[1]
    signals = np.zeros((len(sites), int(window[1] - window[0]) + 1))
    position_mm = np.array([site.position_mm for site in sites]) + shift_mm
    per_site = np.full((len(sites), 1), np.nan)
    return {
        "tags": names,
        "names": names,
        "include": np.ones((len(sites), 1)),
        "sampleFrequency": SAMPLES_PER_S,
        # Not empty: an empty text reads back as an array, which openep-py cannot make a text.
        "electrodeNames_bip": _cells(["unknown"] * len(sites)),
        "electrodeNames_uni": np.full((len(sites), 2), "unknown", dtype=object),
        "egmX": position_mm,
        "egmUniX": np.stack([position_mm, position_mm], axis=2),
        "egmSurfX": surface_mm,
        "barDirection": _vertex_normals(vertices_mm, chamber.faces)[nearest],
        "egm": signals,
        "egmUni": np.stack([signals, signals], axis=2),
        "egmRef": signals,
        "ecg": signals,
        "annotations": {
            "woi": np.tile(window, (len(sites), 1)),
            "referenceAnnot": np.full((len(sites), 1), reference),
            "mapAnnot": (reference + np.round(lat))[:, None],
        },
        "voltages": {"bipolar": per_site, "unipolar": np.full((len(sites), 2), np.nan)},
        "impedances": {"time": per_site, "value": per_site},
    }


def _no_ablation() -> dict[str, Any]:
    """Return the ablation data of a study without ablation.

    Every field that OpenEP's readers ask for exists and is empty.
    """
    none = np.zeros((0, 1))
    return {
        "ablparams": dict.fromkeys(("time", "power", "impedance", "distaltemp"), none),
        "force": {**dict.fromkeys(("time", "force", "axialangle", "lateralangle"), none), "position": np.zeros((0, 3))},
    }


def _vertex_normals(vertices_mm: Array, faces: IntArray) -> Array:
    """Return outward unit normals (n, 3): the mean over the faces around a vertex, weighted by area."""
    of_faces = face_normals(vertices_mm, faces)
    total = np.zeros_like(vertices_mm)
    for corner in range(3):
        np.add.at(total, faces[:, corner], of_faces)
    normals: Array = total / np.maximum(np.linalg.norm(total, axis=1, keepdims=True), 1e-12)
    return normals


def _cells(texts: list[str]) -> np.ndarray[tuple[int, int], np.dtype[np.object_]]:
    """Return a MATLAB cell array with one text a row."""
    cells = np.empty((len(texts), 1), dtype=object)
    cells[:, 0] = texts
    return cells
