"""The cameras against a real C-arm: ``python benchmarks/real_c_arm.py DIR``.

DIR holds the eight runs of a static phantom of Vukicevic et al. and ``landmarks.json`` with ten points marked by hand; the source
is named in ``tests/plugins/geometry/real_c_arm.json``. The table shows the reprojection error of one set of static points over
four and over eight runs, with the table's position and without it, and with every other convention of signs and flips. Below are
the distances between landmarks from every pair of runs at least 30 degrees apart against those from the other runs. It shows
their error and the ratio of error to stated standard deviation (z): with the stated gantry, and after self-calibration.
"""

from __future__ import annotations

import itertools
import json
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, get_args

import numpy as np
from numpy.typing import NDArray

from fluoromap.catheters import DEFAULT_CATALOGUE
from fluoromap.contracts import Calibration
from fluoromap.geometry import Camera, Gantry, camera_from_gantry, ray_angle_deg
from fluoromap.triangulator.estimate import JointLeastSquares
from fluoromap.triangulator.self_calibration import StudyBelief, calibrate
from fluoromap.triangulator.study_equations import CalibrationSite
from fluoromap.triangulator.two_view_pixels import TwoViewPixels
from fluoromap.triangulator.uncertainty import UncertaintyParams, error_sources, pixel_noise_px2

Array = NDArray[np.float64]

Belief = Literal["stated", "study"]

NOISE_PX = 0.8
LEAST_ANGLE_DEG = 30.0
FIRST_RUNS = 4
PARAMS = UncertaintyParams(
    respiration_head_feet_sd_mm=0, respiration_other_sd_mm=0, respiration_drift_sd_mm=0, beat_sd_mm=0, bend_sd_mm=0,
    beat_amplitude_sd=0, beat_timing_sd=0, phase_pairing_sd=0,
)  # fmt: skip
"""A static phantom neither breathes nor beats."""


@dataclass(frozen=True, eq=False)
class StaticRun:
    """One run: its gantry, its table position (3,) along the world's axes in mm, and its landmarks name -> (u, v)."""

    gantry: Gantry
    table_mm: Array
    landmarks: dict[str, Array]

    def camera(self, origin_mm: Array | None) -> Camera:
        """Return the camera in the patient's frame.

        Its origin is the isocentre at table position ``origin_mm``; with None the table is ignored.
        """
        camera = camera_from_gantry(self.gantry)
        return camera if origin_mm is None else camera.translated(self.table_mm - origin_mm)


def runs_from_extract(text: str) -> list[StaticRun]:
    """Return the runs of the extract in the tests."""
    return [
        StaticRun(
            Gantry(
                run["primary_deg"], run["secondary_deg"], run["source_detector_mm"], run["source_isocentre_mm"],
                (run["spacing_mm"], run["spacing_mm"]), run["rows"], run["columns"],
            ),
            np.array(run["table_mm"]),
            {name: np.array(pixel) for name, pixel in run["landmarks"].items()},
        )
        for run in json.loads(text)["runs"]
    ]  # fmt: skip


def extract(folder: Path) -> dict[str, Any]:
    """Return header values, table positions and landmarks of the DICOM files of a folder."""
    import pydicom

    marked = json.loads((folder / "landmarks.json").read_text())["landmarks_px"]
    runs = []
    for number in range(1, 9):
        header = pydicom.dcmread(folder / f"ge_phantom_im{number}.dcm", stop_before_pixels=True)
        private = header.private_block(0x0019, "DLX_SERIE_01")
        # Lateral, vertical and longitudinal position are along +X, +Y and +Z.
        table = [float(private[element].value) for element in (0x23, 0x21, 0x22)]
        spacing = header.get("ImagerPixelSpacing")
        runs.append({
            "primary_deg": float(header.PositionerPrimaryAngle), "secondary_deg": float(header.PositionerSecondaryAngle),
            "source_detector_mm": float(header.DistanceSourceToDetector),
            "source_isocentre_mm": float(header.DistanceSourceToPatient),
            "spacing_mm": float(spacing[0]) if spacing else _field_mm(header) / int(header.Rows),
            "rows": int(header.Rows), "columns": int(header.Columns), "table_mm": table,
            "landmarks": {name: pixels[str(number)] for name, pixels in marked.items() if str(number) in pixels},
        })  # fmt: skip
    return {"runs": runs}


def _field_mm(header: Any) -> float:
    """Return the size of the field of view: FieldOfViewDimensions (0018,1149), else IntensifierSize (0018,1162)."""
    size = header.get("FieldOfViewDimensions") or header.get("IntensifierSize")
    return float(size[0] if isinstance(size, Sequence) and not isinstance(size, str) else size)


def static_points(cameras: Sequence[Camera], runs: Sequence[StaticRun]) -> tuple[dict[str, Array], float]:
    """Return landmarks of least reprojection error, and the error, RMS in px.

    Landmarks that fewer than two runs show are left out.
    """
    points, squares = {}, []
    for name in sorted({name for run in runs for name in run.landmarks}):
        shown = [(c, run.landmarks[name]) for c, run in zip(cameras, runs, strict=True) if name in run.landmarks]
        if len(shown) < 2:
            continue
        point = np.zeros(3)
        for _ in range(20):
            slope = np.concatenate([camera.jacobian(point) for camera, _ in shown])
            apart = np.concatenate([pixel - camera.project(point) for camera, pixel in shown])
            point = point + np.linalg.lstsq(slope, apart, rcond=None)[0]
        points[name] = point
        squares += [float(((pixel - camera.project(point)) ** 2).sum()) for camera, pixel in shown]
    return points, float(np.sqrt(np.mean(squares)))


def reprojection_px(runs: Sequence[StaticRun], with_table: bool) -> float:
    """Return the reprojection error of one set of static points, RMS in px."""
    origin = runs[0].table_mm if with_table else None
    return static_points([run.camera(origin) for run in runs], runs)[1]


def conventions(runs: Sequence[StaticRun]) -> dict[str, float]:
    """Return the reprojection error for each choice of signs and flips."""
    found = {}
    for primary, secondary, u, v in itertools.product((1, -1), repeat=4):
        cameras = []
        for run in runs:
            gantry = run.gantry
            turned = Gantry(
                primary * gantry.primary_deg, secondary * gantry.secondary_deg, gantry.source_detector_mm,
                gantry.source_isocentre_mm, gantry.pixel_spacing_mm, gantry.rows, gantry.columns, ((u, 0), (0, v)),
            )  # fmt: skip
            cameras.append(camera_from_gantry(turned).translated(run.table_mm - runs[0].table_mm))
        sign = {1: "+", -1: "-"}
        name = f"primary {sign[primary]} secondary {sign[secondary]} u {sign[u]} v {sign[v]}"
        found[name] = static_points(cameras, runs)[1]
    return found


@dataclass(frozen=True, eq=False)
class PairDistances:
    """Distances between landmarks from one pair of runs: errors (k,) in mm, and stated standard deviations (k,)."""

    runs: tuple[int, int]
    errors_mm: Array
    sd_mm: Array
    calibration: Calibration | None


def pair_distances(runs: Sequence[StaticRun], belief: Belief) -> list[PairDistances]:
    """Compare the distances from pairs of runs with those from other runs.

    The two runs of a pair are at least 30 degrees apart.

    The standard deviations contain pixel noise and the gantry's errors: "stated" takes those of the parameters, "study" those
    that self-calibration leaves, with its cameras.
    """
    origin = runs[0].table_mm
    cameras = [run.camera(origin) for run in runs]
    found = []
    for i, j in itertools.combinations(range(len(runs)), 2):
        others = [k for k in range(len(runs)) if k not in (i, j)]
        places, _ = static_points([cameras[k] for k in others], [runs[k] for k in others])
        names = sorted(set(runs[i].landmarks) & set(runs[j].landmarks) & set(places))
        if len(names) < 2 or ray_angle_deg(cameras[i], cameras[j]) < LEAST_ANGLE_DEG:
            continue
        pixels = _pixels(runs[i], runs[j], names)
        nominal = cameras[i], cameras[j]
        calibration, of_study = _calibrate(nominal, runs[i], runs[j], names)
        if calibration is None:
            continue
        pair = of_study.gantry.cameras(nominal) if belief == "study" else nominal
        gantry = of_study.gantry.covariance if belief == "study" else PARAMS.gantry_covariance()
        start = JointLeastSquares().start(pair, pixels)
        noise = pixel_noise_px2(pixels.covariances)
        sources = error_sources(pair, start, pixels.labels, DEFAULT_CATALOGUE, PARAMS, gantry, None)
        estimate = JointLeastSquares().estimate(pair, pixels, start, noise)
        joint = estimate.covariance_mm2(noise + sum(source.pixels_px2() for source in sources))
        errors, sds = [], []
        for a, b in itertools.combinations(range(len(names)), 2):
            apart = estimate.points_mm[a] - estimate.points_mm[b]
            length = float(np.linalg.norm(apart))
            errors.append(length - float(np.linalg.norm(places[names[a]] - places[names[b]])))
            spread = joint[a, :, a] + joint[b, :, b] - joint[a, :, b] - joint[b, :, a]
            sds.append(float(np.sqrt(apart @ spread @ apart)) / length)
        found.append(PairDistances((i + 1, j + 1), np.array(errors), np.array(sds), calibration))
    return found


def _pixels(a: StaticRun, b: StaticRun, names: Sequence[str]) -> TwoViewPixels:
    noise = np.broadcast_to(NOISE_PX**2 * np.eye(2), (len(names), 2, 2))
    labels = tuple(("mapping", number) for number in range(1, len(names) + 1))
    in_a, in_b = (np.array([run.landmarks[name] for name in names]) for run in (a, b))
    return TwoViewPixels(labels, (in_a, in_b), (noise, noise))


def _calibrate(
    cameras: tuple[Camera, Camera], a: StaticRun, b: StaticRun, names: Sequence[str]
) -> tuple[Calibration | None, StudyBelief]:
    """Calibrate a pair of runs; each landmark counts as a site."""
    sites = [CalibrationSite(cameras, _pixels(a, b, [name])) for name in names]
    return calibrate(sites, DEFAULT_CATALOGUE, frozenset(), PARAMS)


def main(folder: Path) -> None:
    """Print the table."""
    runs = runs_from_extract(json.dumps(extract(folder)))
    print("reprojection error of static landmarks, RMS px")
    print(f"  four runs {reprojection_px(runs[:FIRST_RUNS], True):6.2f}")
    print(
        f"  eight runs, table as stated {reprojection_px(runs, True):6.2f}, table ignored {reprojection_px(runs, False):6.2f}"
    )
    print("conventions, eight runs, RMS px")
    for name, error in sorted(conventions(runs).items(), key=lambda row: row[1]):
        print(f"  {name}: {error:6.2f}")
    print("landmark distances, pairs at least 30 degrees apart")
    beliefs: tuple[Belief, ...] = get_args(Belief)
    for belief in beliefs:
        pairs = pair_distances(runs, belief)
        errors = np.concatenate([pair.errors_mm for pair in pairs])
        sds = np.concatenate([pair.sd_mm for pair in pairs])
        opened = sum(pair.calibration is not None and pair.calibration.applied for pair in pairs)
        print(
            f"  gantry as {belief}: {len(pairs)} pairs, RMS "
            f"{np.sqrt(np.mean(errors**2)):.2f} mm, median {np.median(np.abs(errors)):.2f}, z "
            f"{np.sqrt(np.mean((errors / sds) ** 2)):.2f}, calibration applied at {opened}"
        )
        for pair in pairs:
            print(f"    runs {pair.runs}: RMS {np.sqrt(np.mean(pair.errors_mm**2)):.2f} mm")


if __name__ == "__main__":
    main(Path(sys.argv[1]))
