"""The DICOM objects of a job, from its plain results."""

from __future__ import annotations

import io
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image
from pydicom.dataset import Dataset

from fluoromap_service.dicom.indexed_header import IndexedHeader, read_indexed
from fluoromap_service.dicom.objects.identity import ResultSource, source_header
from fluoromap_service.dicom.objects.pictures import PictureSeries, pictures_file
from fluoromap_service.dicom.objects.report_site import ReportSite
from fluoromap_service.dicom.objects.surface import surface_file


@dataclass(frozen=True, slots=True)
class RunReference:
    """The UIDs by which an object refers to a source run."""

    sop_class_uid: str
    study_instance_uid: str
    series_instance_uid: str
    sop_instance_uid: str

    def dataset(self) -> Dataset:
        """Return the UIDs as a data set."""
        header = Dataset()
        header.SOPClassUID, header.SOPInstanceUID = self.sop_class_uid, self.sop_instance_uid
        header.StudyInstanceUID, header.SeriesInstanceUID = self.study_instance_uid, self.series_instance_uid
        return header


@dataclass(frozen=True, slots=True)
class ResultOrigin:
    """The job of the objects and its source runs.

    finished : end of the job, UTC. first_run : file of the first run, which gives patient and study. other_runs : in order.
    """

    job_id: str
    finished: datetime
    first_run: Path
    other_runs: tuple[RunReference, ...]

    def source(self) -> ResultSource:
        """Read the header of the first run."""
        headers = (source_header(self.first_run), *(run.dataset() for run in self.other_runs))
        return ResultSource(self.job_id, self.finished, headers)


def report_object(origin: ResultOrigin, sites: tuple[ReportSite, ...], volume_ml: float | None) -> bytes:
    """Return the structured report; ``volume_ml`` is None without a map."""
    # Importing highdicom takes a second: only a process that writes a report does it.
    from fluoromap_service.dicom.objects.report import report_file

    return report_file(origin.source(), sites, volume_ml)


def pictures_object(origin: ResultOrigin, series: PictureSeries, pictures: tuple[Path, ...]) -> bytes:
    """Return the secondary capture of drawn pictures, PNG files.

    Raises
    ------
    ValueError
        When the pictures have another number or size than ``series`` says.
    """
    pixels = np.stack([_pixels(path) for path in pictures])
    if pixels.shape != (series.frames, series.rows, series.columns, 3):
        raise ValueError(f"the pictures of {series.name} have the shape {pixels.shape}, which its header contradicts")
    return pictures_file(origin.source(), series, pixels)


def picture_headers(origin: ResultOrigin, series: tuple[PictureSeries, ...]) -> list[IndexedHeader]:
    """Return the headers of secondary captures that nobody has drawn."""
    source = origin.source()
    return [read_indexed(io.BytesIO(pictures_file(source, each, None))) for each in series]


def surface_object(origin: ResultOrigin, stl: Path) -> bytes:
    """Return the encapsulated STL; ``stl`` is the file of the surface."""
    return surface_file(origin.source(), stl.read_bytes())


def _pixels(path: Path) -> NDArray[np.uint8]:
    with Image.open(path) as picture:
        return np.asarray(picture.convert("RGB"), dtype=np.uint8)
