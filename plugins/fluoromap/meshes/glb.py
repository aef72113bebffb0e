"""The chamber as binary glTF 2.0 (Khronos glTF 2.0 specification, section 4, "GLB File Format").

glTF counts in metres, with +Y up and +Z forward (section 3.4 there). So the patient's head is up and the front is forward.
"""

from __future__ import annotations

import json
import struct
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fluoromap.contracts import Array, ChamberMap
from fluoromap.drawing.colours import vertex_colours

FLOAT, UNSIGNED_BYTE, UNSIGNED_INT = 5126, 5121, 5125
ARRAY_BUFFER, ELEMENT_ARRAY_BUFFER = 34962, 34963
JSON_CHUNK, BINARY_CHUNK = 0x4E4F534A, 0x004E4942

STATEMENT = "fluoromap chamber, unit m, axes +X left, +Y head, +Z front of the patient"
_METRES_PER_MM = 1e-3


def to_gltf_m(points_mm: Array) -> Array:
    """Return points (n, 3), mm along DICOM patient axes (LPS), in glTF's metres and axes."""
    left, back, head = points_mm.T
    return _METRES_PER_MM * np.stack([left, head, -back], axis=1)


def glb_bytes(chamber: ChamberMap, vertices_mm: Array) -> bytes:
    """Return the file: one mesh with colours and scalars.

    Unit and axes are ``extras``.
    """
    n = len(vertices_mm)
    colours = np.full((n, 4), 255, dtype=np.uint8)
    colours[:, :3] = vertex_colours(chamber)
    # Vertex attributes must be aligned to 4 bytes, hence a float for a truth value.
    attributes: dict[str, NDArray[Any]] = {
        "POSITION": to_gltf_m(vertices_mm).astype("<f4"),
        "COLOR_0": colours,
        "_LAT_MS": chamber.lat_ms.astype("<f4"),
        "_LAT_SD_MS": chamber.lat_sd_ms.astype("<f4"),
        "_COVERED": chamber.covered.astype("<f4"),
    }
    blocks = [*attributes.values(), chamber.faces.astype("<u4").ravel()]
    views, accessors, offset = [], [], 0
    for index, block in enumerate(blocks):
        indices = index == len(blocks) - 1
        target = ELEMENT_ARRAY_BUFFER if indices else ARRAY_BUFFER
        views.append({"buffer": 0, "byteOffset": offset, "byteLength": block.nbytes, "target": target})
        component = UNSIGNED_INT if indices else UNSIGNED_BYTE if block.dtype == np.uint8 else FLOAT
        kind = "SCALAR" if block.ndim == 1 else f"VEC{block.shape[1]}"
        accessor: dict[str, Any] = {"bufferView": index, "componentType": component, "count": len(block), "type": kind}
        if component == UNSIGNED_BYTE:
            accessor["normalized"] = True
        accessors.append(accessor)
        offset += block.nbytes
    position = attributes["POSITION"]
    accessors[0] |= {"min": position.min(axis=0).tolist(), "max": position.max(axis=0).tolist()}
    document = {
        "asset": {
            "version": "2.0",
            "generator": "fluoromap",
            "extras": {"note": STATEMENT, "unit": "m", "axes": ["left", "head", "front"]},
        },
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0, "name": "chamber"}],
        "meshes": [
            {
                "name": "chamber",
                "primitives": [
                    {
                        "attributes": {name: index for index, name in enumerate(attributes)},
                        "indices": len(attributes),
                        "material": 0,
                    }
                ],
            }
        ],
        "materials": [{"name": "wall", "pbrMetallicRoughness": {"metallicFactor": 0.0, "roughnessFactor": 1.0}}],
        "accessors": accessors,
        "bufferViews": views,
        "buffers": [{"byteLength": offset}],
    }
    text = json.dumps(document, separators=(",", ":")).encode("ascii")
    text += b" " * (-len(text) % 4)
    binary = b"".join(block.tobytes() for block in blocks)
    total = 12 + 8 + len(text) + 8 + len(binary)
    return b"".join([
        struct.pack("<4sII", b"glTF", 2, total),
        struct.pack("<II", len(text), JSON_CHUNK), text,
        struct.pack("<II", len(binary), BINARY_CHUNK), binary,
    ])  # fmt: skip
