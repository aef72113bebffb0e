"""The version of the drawing code changes together with the drawn pixels."""

import hashlib
import itertools

import numpy as np

from fluoromap.contracts import Array, ChamberMap, SurfaceSite
from fluoromap.drawing import VERSION
from fluoromap.drawing.map_picture import draw_map_views
from fluoromap.drawing.overlay import Look, draw_overlay
from fluoromap.geometry import Gantry, camera_from_gantry
from fluoromap.reasons import Reason

KNOWN = {
    "1": {
        "overlay": "8931cab202dc0af09cdb7e9ae3152a38780998c10ff18ddf13396f56ef3075ec",
        "map picture": "288022cc20352a3f2780253e7ab09b74ee0b167421dc16ca737ad49995dea47f",
    },
    "2": {
        "overlay": "8931cab202dc0af09cdb7e9ae3152a38780998c10ff18ddf13396f56ef3075ec",
        "map picture": "288022cc20352a3f2780253e7ab09b74ee0b167421dc16ca737ad49995dea47f",
    },
    "3": {
        "overlay": "d39d7ec81c9304149de4146cfc6657473c3dedafbbca6fdc246a40c4510255a2",
        "map picture": "7aac6152c4e046f263d20050c6025a7a16f4034570f74a5e01569ade7821a3f2",
    },
    "4": {
        "overlay": "d39d7ec81c9304149de4146cfc6657473c3dedafbbca6fdc246a40c4510255a2",
        "map picture": "7aac6152c4e046f263d20050c6025a7a16f4034570f74a5e01569ade7821a3f2",
    },
}
"""SHA-256 of the coarsened pixels under each version. After a change of the drawing raise VERSION and add a line here."""

BLOCK_PX, STEP = 16, 4


def octahedral_sphere(splits: int) -> tuple[Array, np.ndarray]:
    """Return a unit sphere made of an octahedron's faces.

    Vertices (n, 3) are rounded to 1e-6, faces (f, 3) are outward.
    """
    faces: list[Array] = []
    for signs in itertools.product((1.0, -1.0), repeat=3):
        x, y, z = np.diag(signs)
        steps = [(i, j) for i in range(splits) for j in range(splits - i)]
        for i, j in steps:
            corner = [((splits - a - b) * x + a * y + b * z) / splits for a, b in ((i, j), (i + 1, j), (i, j + 1))]
            faces.append(np.array(corner))
            if i + j < splits - 1:
                others = ((i + 1, j), (i + 1, j + 1), (i, j + 1))
                faces.append(np.array([((splits - a - b) * x + a * y + b * z) / splits for a, b in others]))
    corners = np.array(faces)
    inward = np.linalg.det(corners) < 0
    corners[inward] = corners[inward][:, ::-1]
    unit = corners / np.linalg.norm(corners, axis=2, keepdims=True)
    vertices, index = np.unique(unit.reshape(-1, 3).round(6), axis=0, return_inverse=True)
    return vertices, index.reshape(-1, 3)


def fixed_map() -> ChamberMap:
    """Return a map from plain arithmetic.

    So it is the same on every machine.
    """
    unit, faces = octahedral_sphere(8)
    wall = unit * [24.0, 22.0, 34.0]
    sites = tuple(
        SurfaceSite(f"S{k + 1:02d}", 0.97 * wall[v], wall[v], 1.0, float(wall[v, 0].round()), 0.5, reasons)
        for k, (v, reasons) in enumerate(
            [(10, ()), (60, ()), (110, ()), (150, (Reason.LAT_OUTLIER,)), (200, ()), (240, ())]
        )
    )
    covered = wall[:, 2] > -20.0
    return ChamberMap(
        vertices_mm=wall, faces=faces, lat_ms=np.where(covered, wall[:, 0], 0.0), lat_sd_ms=np.where(covered, 2.0, 0.0),
        covered=covered, sites=sites, earliest=(("S01", 1.0),), total_activation_time_ms=48.0, leave_one_out_rms_ms=2.0,
        volume_ml=75.0, area_cm2=88.0, coverage=0.8,
    )  # fmt: skip


def coarse_sha256(picture: np.ndarray) -> str:
    """Return the hash of block means in coarse steps.

    A pixel that differs between processors does not change it.
    """
    rows, columns = (side // BLOCK_PX * BLOCK_PX for side in picture.shape[:2])
    blocks = picture[:rows, :columns].reshape(rows // BLOCK_PX, BLOCK_PX, columns // BLOCK_PX, BLOCK_PX, 3)
    sums = blocks.sum(axis=(1, 3), dtype=np.int64)
    return hashlib.sha256((sums // (STEP * BLOCK_PX**2)).astype(np.uint8).tobytes()).hexdigest()


def test_changed_pixels_need_a_new_version() -> None:
    chamber = fixed_map()
    camera = camera_from_gantry(Gantry(30.0, 10.0, 1000.0, 500.0, (0.6953125, 0.6953125), 512, 512))
    frame = (np.arange(512 * 512) // 512 // 4 + 60).astype(np.uint8).reshape(512, 512)
    look = Look(covariances_mm2={"S02": np.diag([1.0, 4.0, 2.0])})
    pixels = {
        "overlay": coarse_sha256(draw_overlay(frame, camera, chamber, [5.0, -5.0, 0.0], "S05", None, look)),
        "map picture": coarse_sha256(draw_map_views(chamber)),
    }
    assert pixels == KNOWN.get(VERSION), "the drawing changed: raise fluoromap.drawing.VERSION and add its hashes here"
