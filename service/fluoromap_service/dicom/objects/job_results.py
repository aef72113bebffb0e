"""All DICOM objects of a job, from its plain results."""

from __future__ import annotations

from dataclasses import dataclass
from datetime import datetime
from pathlib import Path

import numpy as np
import pydicom
from numpy.typing import NDArray
from PIL import Image

from fluoromap_service.dicom.objects.identity import ResultSource
from fluoromap_service.dicom.objects.pictures import Pictures, pictures_file
from fluoromap_service.dicom.objects.report_site import ReportSite
from fluoromap_service.dicom.objects.surface import surface_file


@dataclass(frozen=True, slots=True)
class JobResults:
    """The results of a job that become DICOM objects.

    runs : files of the source runs. overlays : PNG files of the map on fluoroscopy. map_picture : PNG file of the map from
    six sides. stl : file of the surface. Without a map the last two are None.
    """

    job_id: str
    finished: datetime
    runs: tuple[Path, ...]
    sites: tuple[ReportSite, ...]
    volume_ml: float | None
    overlays: tuple[Path, ...]
    map_picture: Path | None
    stl: Path | None


def job_objects(results: JobResults) -> list[tuple[str, bytes]]:
    """Return name and content of each DICOM file of a job.

    The same results give the same bytes.
    """
    # Importing highdicom takes a second: only a process that writes a report does it.
    from fluoromap_service.dicom.objects.report import report_file

    headers = tuple(pydicom.dcmread(path, stop_before_pixels=True) for path in results.runs)
    source = ResultSource(results.job_id, results.finished, headers)
    objects = [("report.dcm", report_file(source, results.sites, results.volume_ml))]
    for number, pixels in enumerate(_by_size(results.overlays), start=1):
        drawn = Pictures(f"overlays-{number}", 9010 + number, "Activation map drawn into fluoroscopy frames", pixels)
        objects.append((f"{drawn.name}.dcm", pictures_file(source, drawn)))
    if results.map_picture is not None:
        (pixels,) = _by_size((results.map_picture,))
        drawn = Pictures("map", 9010, "Activation map of the chamber from six sides", pixels)
        objects.append(("map.dcm", pictures_file(source, drawn)))
    if results.stl is not None:
        objects.append(("chamber.dcm", surface_file(source, results.stl.read_bytes())))
    return objects


def _by_size(paths: tuple[Path, ...]) -> list[NDArray[np.uint8]]:
    """Return the pictures of each size as one array.

    All frames of an object have one size.
    """
    groups: dict[tuple[int, ...], list[NDArray[np.uint8]]] = {}
    for path in paths:
        with Image.open(path) as picture:
            pixels = np.asarray(picture.convert("RGB"), dtype=np.uint8)
        groups.setdefault(pixels.shape, []).append(pixels)
    return [np.stack(pictures) for pictures in groups.values()]
