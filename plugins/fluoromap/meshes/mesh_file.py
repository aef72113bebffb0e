"""The map as a mesh file: millimetres, DICOM patient axes (LPS), faces outward; GLB in metres with the head up.

The same map gives the same bytes.
"""

from __future__ import annotations

from typing import Literal, get_args

import numpy as np
from numpy.typing import ArrayLike

from fluoromap.contracts import Array, ChamberMap
from fluoromap.drawing.colours import vertex_colours
from fluoromap.fuser.surface import face_normals
from fluoromap.meshes.glb import glb_bytes
from fluoromap.meshes.vtp import vtp_bytes

MeshFormat = Literal["ply", "stl", "glb", "vtp", "mat", "csv"]

STATEMENT = "fluoromap chamber, unit mm, axes LPS (DICOM patient)"


def mesh_bytes(chamber: ChamberMap, format: MeshFormat, origin_shift_mm: ArrayLike = (0.0, 0.0, 0.0)) -> bytes:  # noqa: A002
    """Return the chamber as a mesh file.

    Parameters
    ----------
    chamber : ChamberMap
        Map relative to the reference catheter.
    format : {"ply", "stl", "glb", "vtp", "mat", "csv"}
        - PLY: binary, colours and the scalars ``lat_ms``, ``lat_sd_ms`` (NaN where not covered), ``covered``.
        - STL: binary, the shape alone.
        - GLB: colours, the same scalars as ``_LAT_MS``, ``_LAT_SD_MS`` (0 where not covered) and ``_COVERED``. Metres, +Y to
          the head and +Z to the front, as glTF demands.
        - VTP: the scalars, NaN where not covered, and the sites as field data.
        - MAT: OpenEP's structure.
        - CSV: a line for each vertex, the scalars empty where not covered.
    origin_shift_mm : (3,)
        Added to all positions: the reference catheter's position in the coordinates of the file.

    Raises
    ------
    ValueError
        For another format.
    """
    shift = np.asarray(origin_shift_mm, dtype=np.float64)
    vertices = chamber.vertices_mm + shift
    match format:
        case "ply":
            return _ply(chamber, vertices)
        case "stl":
            return _stl(chamber, vertices)
        case "glb":
            return glb_bytes(chamber, vertices)
        case "vtp":
            return vtp_bytes(chamber, vertices, shift, STATEMENT)
        case "mat":
            from fluoromap.meshes.openep import openep_bytes

            return openep_bytes(chamber, vertices, shift, STATEMENT)
        case "csv":
            return _csv(chamber, vertices)
    raise ValueError(f"unknown mesh format {format!r}; use one of {', '.join(get_args(MeshFormat))}")


def _ply(chamber: ChamberMap, vertices_mm: Array) -> bytes:
    vertex = np.dtype(
        [("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("red", "u1"), ("green", "u1"), ("blue", "u1"),
         ("lat_ms", "<f4"), ("lat_sd_ms", "<f4"), ("covered", "u1")]
    )  # fmt: skip
    rows = np.empty(len(vertices_mm), dtype=vertex)
    for axis, name in enumerate("xyz"):
        rows[name] = vertices_mm[:, axis]
    for channel, name in enumerate(("red", "green", "blue")):
        rows[name] = vertex_colours(chamber)[:, channel]
    rows["lat_ms"] = np.where(chamber.covered, chamber.lat_ms, np.nan)
    rows["lat_sd_ms"] = np.where(chamber.covered, chamber.lat_sd_ms, np.nan)
    rows["covered"] = chamber.covered
    faces = np.empty(len(chamber.faces), dtype=[("count", "u1"), ("corners", "<i4", (3,))])
    faces["count"] = 3
    faces["corners"] = chamber.faces
    types = {"<f4": "float", "|u1": "uchar"}
    properties = [f"property {types[vertex[name].str]} {name}" for name in vertex.names or ()]
    header = [
        "ply", "format binary_little_endian 1.0", f"comment {STATEMENT}",
        "comment lat_ms and lat_sd_ms are NaN where covered is 0",
        f"element vertex {len(rows)}", *properties,
        f"element face {len(faces)}", "property list uchar int vertex_indices", "end_header",
    ]  # fmt: skip
    return ("\n".join(header) + "\n").encode("ascii") + rows.tobytes() + faces.tobytes()


def _csv(chamber: ChamberMap, vertices_mm: Array) -> bytes:
    lines = ["x_mm,y_mm,z_mm,lat_ms,lat_sd_ms,covered"]
    rows = zip(vertices_mm, chamber.lat_ms, chamber.lat_sd_ms, chamber.covered.tolist(), strict=True)
    for (x, y, z), lat, sd, covered in rows:
        times = f"{lat:.3f},{sd:.3f},1" if covered else ",,0"
        lines.append(f"{x:.4f},{y:.4f},{z:.4f},{times}")
    return ("\r\n".join(lines) + "\r\n").encode("ascii")


def _stl(chamber: ChamberMap, vertices_mm: Array) -> bytes:
    normals = face_normals(vertices_mm, chamber.faces)
    triangles = np.zeros(
        len(chamber.faces), dtype=[("normal", "<f4", (3,)), ("corners", "<f4", (3, 3)), ("attribute", "<u2")]
    )
    triangles["normal"] = normals / np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)
    triangles["corners"] = vertices_mm[chamber.faces]
    count = np.array(len(triangles), dtype="<u4")
    # The header has 80 bytes and must not begin with "solid", which marks the ASCII variant.
    return STATEMENT.encode("ascii").ljust(80)[:80] + count.tobytes() + triangles.tobytes()
