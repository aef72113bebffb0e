"""The chamber as VTK XML PolyData, arrays in base64 (VTK file formats, "XML File Formats", inline binary data)."""

from __future__ import annotations

import base64
import struct
from typing import Any
from xml.etree import ElementTree

import numpy as np
from numpy.typing import NDArray

from fluoromap.contracts import Array, ChamberMap

_TYPES = {"<f8": "Float64", "<f4": "Float32", "<i8": "Int64", "|u1": "UInt8"}


def vtp_bytes(chamber: ChamberMap, vertices_mm: Array, shift_mm: Array, statement: str) -> bytes:
    """Return the file: one piece with point data ``lat_ms``, ``lat_sd_ms``, ``covered``.

    Sites and unit are field data.
    """
    root = ElementTree.Element(
        "VTKFile", type="PolyData", version="1.0", byte_order="LittleEndian", header_type="UInt32"
    )
    data = ElementTree.SubElement(root, "PolyData")
    sites = chamber.sites
    field = ElementTree.SubElement(data, "FieldData")
    _text(field, "statement", [statement])
    _text(field, "site", [site.site for site in sites])
    for name, values in (
        ("site_position_mm", np.array([site.position_mm for site in sites]) + shift_mm),
        ("site_surface_mm", np.array([site.surface_mm for site in sites]) + shift_mm),
        ("site_lat_ms", np.array([site.lat_ms for site in sites])),
    ):
        _array(field, name, values.astype("<f8")).set("NumberOfTuples", str(len(sites)))

    faces = chamber.faces.astype("<i8")
    none = {"NumberOfVerts": "0", "NumberOfLines": "0", "NumberOfStrips": "0"}
    counts = {"NumberOfPoints": str(len(vertices_mm)), "NumberOfPolys": str(len(faces)), **none}
    piece = ElementTree.SubElement(data, "Piece", counts)
    point_data = ElementTree.SubElement(piece, "PointData", Scalars="lat_ms")
    _array(point_data, "lat_ms", np.where(chamber.covered, chamber.lat_ms, np.nan).astype("<f4"))
    _array(point_data, "lat_sd_ms", np.where(chamber.covered, chamber.lat_sd_ms, np.nan).astype("<f4"))
    _array(point_data, "covered", chamber.covered.astype("u1"))
    _array(ElementTree.SubElement(piece, "Points"), "Points", vertices_mm.astype("<f8"))
    polygons = ElementTree.SubElement(piece, "Polys")
    _array(polygons, "connectivity", faces.ravel())
    _array(polygons, "offsets", 3 * np.arange(1, len(faces) + 1, dtype="<i8"))
    ElementTree.indent(root)
    written: bytes = ElementTree.tostring(root, encoding="utf-8", xml_declaration=True)
    return written


def _array(parent: ElementTree.Element, name: str, values: NDArray[Any]) -> ElementTree.Element:
    element = ElementTree.SubElement(parent, "DataArray", type=_TYPES[values.dtype.str], Name=name, format="binary")
    if values.ndim == 2:
        element.set("NumberOfComponents", str(values.shape[1]))
    raw = values.tobytes()
    element.text = base64.b64encode(struct.pack("<I", len(raw)) + raw).decode("ascii")
    return element


def _text(parent: ElementTree.Element, name: str, values: list[str]) -> None:
    """Add strings as VTK writes them.

    VTK writes the codes of their bytes, with a 0 after each string.
    """
    codes = " ".join(str(code) for value in values for code in (*value.encode("utf-8"), 0))
    attributes = {"type": "String", "Name": name, "NumberOfTuples": str(len(values)), "format": "ascii"}
    ElementTree.SubElement(parent, "DataArray", attributes).text = codes
