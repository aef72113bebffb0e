"""The kept mesh files of a job's map."""

from __future__ import annotations

from enum import StrEnum

from fluoromap_service.results.dependencies import mesh_dependencies
from fluoromap_service.results.maps import FinishedMap
from fluoromap_service.results.origins import Origin
from fluoromap_service.store.renderings import KeptFile, kept_rendering


class MeshFormat(StrEnum):
    """File formats of the mesh."""

    PLY = "ply"
    STL = "stl"
    GLB = "glb"
    VTP = "vtp"
    MAT = "mat"
    CSV = "csv"


MESH_MEDIA_TYPES = {
    MeshFormat.PLY: "model/ply",
    MeshFormat.STL: "model/stl",
    MeshFormat.GLB: "model/gltf-binary",
    MeshFormat.VTP: "model/vnd.vtp+xml",
    MeshFormat.MAT: "application/x-matlab-data",
    MeshFormat.CSV: "text/csv",
}


def mesh_of(job_id: str, finished: FinishedMap, mesh_format: MeshFormat, origin: Origin) -> KeptFile:
    """Return the kept mesh file of a map; make it when there is none."""

    def make() -> bytes:
        from fluoromap.meshes.mesh_file import mesh_bytes

        return mesh_bytes(finished.chamber, mesh_format.value, finished.shift_mm(origin))

    return kept_rendering(job_id, mesh_dependencies(finished.sha256, mesh_format, origin), make)
