"""Mesh files, read by independent libraries."""

import base64
import csv
import io
import json
import struct
from xml.etree import ElementTree

import meshio
import numpy as np
import pytest
import scipy.io
import trimesh

from fluoromap.drawing.colours import NO_DATA_RGB, vertex_colours
from fluoromap.meshes.mesh_file import mesh_bytes

FORMATS = ("ply", "stl", "glb", "vtp", "mat", "csv")
SHIFT = np.array([7.0, -3.0, 110.0])


@pytest.mark.parametrize("name", FORMATS)
def test_same_map_same_bytes(sparse_ball, name):
    assert mesh_bytes(sparse_ball, name) == mesh_bytes(sparse_ball, name)


@pytest.mark.parametrize("name", ["ply", "stl", "vtp", "mat"])
def test_unit_and_axes_are_stated(sparse_ball, name):
    data = mesh_bytes(sparse_ball, name)
    codes = " ".join(str(code) for code in b"unit mm, axes LPS").encode()
    assert b"unit mm, axes LPS" in data or codes in data


def test_unknown_format_is_refused(ball):
    with pytest.raises(ValueError, match="obj"):
        mesh_bytes(ball, "obj")  # type: ignore[arg-type]


def in_mm_lps(points_m):
    """Return points of a glTF viewer along the patient's axes, mm.

    The viewer places them in metres with +Y up and +Z forward.
    """
    left, up, forward = np.transpose(points_m)
    return 1e3 * np.stack([left, -forward, up], axis=1)


@pytest.mark.parametrize("name", ["ply", "stl", "glb"])
def test_trimesh_reads_a_closed_outward_surface(sparse_ball, name):
    read = trimesh.load(io.BytesIO(mesh_bytes(sparse_ball, name, SHIFT)), file_type=name, force="mesh")
    read.merge_vertices(merge_norm=True, merge_tex=True)
    if name == "glb":
        # A heart of 57 m would show here: glTF's unit is the metre.
        assert read.extents.max() < 0.2
        read.vertices = in_mm_lps(read.vertices)
    assert read.is_watertight
    assert read.is_winding_consistent
    assert read.volume == pytest.approx(sparse_ball.volume_ml * 1e3, rel=1e-4)
    np.testing.assert_allclose(read.bounds[0], sparse_ball.vertices_mm.min(axis=0) + SHIFT, atol=1e-4)


def test_glb_says_its_unit_and_axes(sparse_ball):
    data = mesh_bytes(sparse_ball, "glb")
    (length,) = struct.unpack_from("<I", data, 12)
    extras = json.loads(data[20 : 20 + length])["asset"]["extras"]
    assert (extras["unit"], extras["axes"]) == ("m", ["left", "head", "front"])


@pytest.mark.parametrize("name", ["ply", "stl"])
def test_meshio_reads_the_same_shape(sparse_ball, tmp_path, name):
    path = tmp_path / f"chamber.{name}"
    path.write_bytes(mesh_bytes(sparse_ball, name, SHIFT))
    read = meshio.read(path)
    corners = read.points[read.cells_dict["triangle"]]
    np.testing.assert_allclose(corners, (sparse_ball.vertices_mm + SHIFT)[sparse_ball.faces], atol=1e-4)


def test_ply_carries_times_errors_and_colours(sparse_ball, tmp_path):
    path = tmp_path / "chamber.ply"
    path.write_bytes(mesh_bytes(sparse_ball, "ply"))
    data = meshio.read(path).point_data
    covered = sparse_ball.covered
    np.testing.assert_array_equal(data["covered"].astype(bool), covered)
    for name in ("lat_ms", "lat_sd_ms"):
        np.testing.assert_allclose(data[name][covered], getattr(sparse_ball, name)[covered], rtol=1e-5, atol=1e-5)
        assert np.isnan(data[name][~covered]).all()
    # meshio reads "uchar" as a signed number.
    colours = np.column_stack([data[name] for name in ("red", "green", "blue")]).astype(np.uint8)
    np.testing.assert_array_equal(colours, vertex_colours(sparse_ball))
    assert (colours[~covered] == NO_DATA_RGB).all()


def test_glb_carries_colours_and_times(sparse_ball):
    scene = trimesh.load(io.BytesIO(mesh_bytes(sparse_ball, "glb")), file_type="glb", process=False)
    (mesh,) = scene.geometry.values()
    np.testing.assert_array_equal(mesh.visual.vertex_attributes["color"][:, :3], vertex_colours(sparse_ball))
    np.testing.assert_array_equal(mesh.faces, sparse_ball.faces)
    np.testing.assert_allclose(in_mm_lps(mesh.vertices), sparse_ball.vertices_mm, atol=1e-4)
    np.testing.assert_allclose(np.ravel(mesh.vertex_attributes["_LAT_MS"]), sparse_ball.lat_ms, atol=1e-4)
    np.testing.assert_array_equal(np.ravel(mesh.vertex_attributes["_COVERED"]) > 0.5, sparse_ball.covered)


def test_glb_chunks_are_aligned_as_the_format_asks(sparse_ball):
    data = mesh_bytes(sparse_ball, "glb")
    magic, version, length = struct.unpack_from("<4sII", data)
    (text,) = struct.unpack_from("<I", data, 12)
    assert (magic, version, length) == (b"glTF", 2, len(data))
    assert text % 4 == 0
    assert length % 4 == 0


def vtp_array(root: ElementTree.Element, name: str) -> np.ndarray:
    element = root.find(f".//DataArray[@Name='{name}']")
    assert element is not None
    assert element.get("format") == "binary"
    raw = base64.b64decode(element.text or "")
    assert struct.unpack_from("<I", raw)[0] == len(raw) - 4
    dtype = {"Float64": "<f8", "Float32": "<f4", "Int64": "<i8", "UInt8": "u1"}[element.get("type") or ""]
    return np.frombuffer(raw[4:], dtype=dtype).reshape(-1, int(element.get("NumberOfComponents", "1"))).squeeze()


def test_vtp_holds_surface_times_and_sites(sparse_ball):
    root = ElementTree.fromstring(mesh_bytes(sparse_ball, "vtp", SHIFT))
    piece = root.find("./PolyData/Piece")
    assert root.get("type") == "PolyData"
    assert piece is not None
    assert int(piece.get("NumberOfPoints", "0")) == len(sparse_ball.vertices_mm)
    assert int(piece.get("NumberOfPolys", "0")) == len(sparse_ball.faces)
    np.testing.assert_array_equal(vtp_array(root, "Points"), sparse_ball.vertices_mm + SHIFT)
    np.testing.assert_array_equal(vtp_array(root, "connectivity").reshape(-1, 3), sparse_ball.faces)
    np.testing.assert_array_equal(np.diff(vtp_array(root, "offsets")), 3)
    covered = vtp_array(root, "covered").astype(bool)
    np.testing.assert_array_equal(covered, sparse_ball.covered)
    lat = vtp_array(root, "lat_ms")
    np.testing.assert_allclose(lat[covered], sparse_ball.lat_ms[covered], atol=1e-4)
    assert np.isnan(lat[~covered]).all()
    np.testing.assert_allclose(
        vtp_array(root, "site_position_mm"), [site.position_mm + SHIFT for site in sparse_ball.sites]
    )
    codes = root.find(".//DataArray[@Name='site']")
    assert codes is not None
    names = bytes(int(code) for code in (codes.text or "").split()).decode().split("\0")[:-1]
    assert names == [site.site for site in sparse_ball.sites]


def test_vtk_reads_the_vtp(sparse_ball, tmp_path):
    from vtkmodules.util.numpy_support import vtk_to_numpy
    from vtkmodules.vtkIOXML import vtkXMLPolyDataReader

    path = tmp_path / "chamber.vtp"
    path.write_bytes(mesh_bytes(sparse_ball, "vtp"))
    reader = vtkXMLPolyDataReader()
    reader.SetFileName(str(path))
    reader.Update()
    surface = reader.GetOutput()
    assert surface.GetNumberOfPolys() == len(sparse_ball.faces)
    np.testing.assert_allclose(vtk_to_numpy(surface.GetPoints().GetData()), sparse_ball.vertices_mm, atol=1e-5)
    covered = vtk_to_numpy(surface.GetPointData().GetArray("covered")).astype(bool)
    np.testing.assert_array_equal(covered, sparse_ball.covered)
    lat_ms = vtk_to_numpy(surface.GetPointData().GetArray("lat_ms"))
    np.testing.assert_allclose(lat_ms[covered], sparse_ball.lat_ms[covered], atol=1e-4)


def test_openep_reads_shape_times_and_sites(sparse_ball):
    read = scipy.io.loadmat(io.BytesIO(mesh_bytes(sparse_ball, "mat", SHIFT)), simplify_cells=True)["userdata"]
    surface, electric = read["surface"], read["electric"]
    np.testing.assert_allclose(surface["triRep"]["X"], sparse_ball.vertices_mm + SHIFT, atol=1e-9)
    np.testing.assert_array_equal(surface["triRep"]["Triangulation"], sparse_ball.faces + 1)
    covered = sparse_ball.covered
    lat, bipolar = surface["act_bip"].T
    np.testing.assert_allclose(lat[covered], sparse_ball.lat_ms[covered], atol=1e-9)
    assert np.isnan(lat[~covered]).all()
    assert np.isnan(bipolar).all()
    assert electric["tags"].tolist() == [site.site for site in sparse_ball.sites]
    positions = np.array([site.position_mm for site in sparse_ball.sites]) + SHIFT
    np.testing.assert_allclose(electric["egmX"], positions, atol=1e-9)
    annotations = electric["annotations"]
    samples = annotations["mapAnnot"] - annotations["referenceAnnot"]
    np.testing.assert_allclose(samples, [site.lat_ms for site in sparse_ball.sites], atol=0.5)
    low, high = annotations["woi"].T
    assert ((low <= samples) & (samples <= high)).all()
    assert annotations["referenceAnnot"].min() >= 1
    assert (annotations["mapAnnot"] <= electric["egm"].shape[1]).all()
    outward = ((surface["normals"] * (sparse_ball.vertices_mm - sparse_ball.vertices_mm.mean(axis=0))).sum(axis=1)) > 0
    assert outward.all()


def test_openep_has_every_field_that_its_python_reader_asks_for(sparse_ball):
    """openep-py reads these fields without a default, and drops mapping points whose signals are NaN or missing."""
    content = io.BytesIO(mesh_bytes(sparse_ball, "mat", SHIFT))
    read = scipy.io.loadmat(content, squeeze_me=True, simplify_cells=True, struct_as_record=False)["userdata"]
    original = read["rf"]["originaldata"]
    for name in ("time", "power", "impedance", "distaltemp"):
        assert np.size(original["ablparams"][name]) == 0
    for name in ("time", "force", "axialangle", "lateralangle", "position"):
        assert np.size(original["force"][name]) == 0
    electric, sites = read["electric"], len(sparse_ball.sites)
    for name in ("electrodeNames_bip", "electrodeNames_uni", "names", "tags"):
        assert (electric[name].astype(str) != "").all()
    assert electric["electrodeNames_uni"].shape == (sites, 2)
    for name in ("egm", "egmUni", "egmX", "egmUniX", "egmRef", "ecg", "egmSurfX", "barDirection"):
        assert np.isfinite(electric[name].astype(float)).all()
    for name in ("woi", "mapAnnot", "referenceAnnot"):
        assert len(electric["annotations"][name].astype(int)) == sites
    for name in ("time", "value"):
        assert [float(value) for value in electric["impedances"][name]]
    assert read["surface"]["triRep"]["Triangulation"].astype(int).min() == 1
    for name, columns in (("act_bip", 2), ("uni_imp_frc", 3)):
        assert len(read["surface"][name].T.astype(float)) == columns
    for name in ("egm", "egmUni", "egmRef", "ecg"):
        assert len(electric[name]) == sites
        assert np.isfinite(electric[name]).all()
        assert (electric[name] == 0).all()
    np.testing.assert_allclose(electric["egmUniX"][:, :, 0], electric["egmX"])
    for name in ("electrodeNames_bip", "electrodeNames_uni", "names", "tags", "include"):
        assert len(electric[name]) == sites
    assert electric["voltages"]["unipolar"].shape == (sites, 2)
    assert electric["annotations"]["mapAnnot"].astype(int).tolist() == electric["annotations"]["mapAnnot"].tolist()
    assert any("electrograms are 0" in note for note in read["notes"])


def test_csv_has_a_line_a_vertex(sparse_ball):
    lines = list(csv.DictReader(io.StringIO(mesh_bytes(sparse_ball, "csv", SHIFT).decode())))
    positions = np.array([[float(line[f"{axis}_mm"]) for axis in "xyz"] for line in lines])
    np.testing.assert_allclose(positions, sparse_ball.vertices_mm + SHIFT, atol=1e-4)
    assert [line["covered"] == "1" for line in lines] == sparse_ball.covered.tolist()
    assert all(line["lat_ms"] == "" for line in lines if line["covered"] == "0")
    known = [float(line["lat_ms"]) for line in lines if line["covered"] == "1"]
    np.testing.assert_allclose(known, sparse_ball.lat_ms[sparse_ball.covered], atol=1e-3)
