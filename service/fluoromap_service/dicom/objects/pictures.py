"""Pictures as multi-frame true colour secondary captures (PS3.3 A.8.5)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from pydicom.dataset import Dataset
from pydicom.uid import MultiFrameTrueColorSecondaryCaptureImageStorage

from fluoromap_service.dicom.objects.identity import RESEARCH, ResultSource, file_bytes, reference, set_identity


@dataclass(frozen=True, slots=True)
class PictureSeries:
    """The pictures of one object before anybody draws them.

    name : name of the object among those of the job. series_number : number of its series. description : content of the
    pictures, in a sentence. frames, rows, columns : number and size of the pictures, px.
    """

    name: str
    series_number: int
    description: str
    frames: int
    rows: int
    columns: int


def pictures_file(source: ResultSource, series: PictureSeries, pixels: NDArray[np.uint8] | None) -> bytes:
    """Return pictures as a DICOM file.

    Parameters
    ----------
    source : ResultSource
    series : PictureSeries
    pixels : (frames, rows, columns, 3) uint8 or None
        Red, green and blue; None leaves them out, for the header alone.
    """
    dataset = Dataset()
    set_identity(
        dataset,
        source,
        MultiFrameTrueColorSecondaryCaptureImageStorage,
        series.name,
        series.series_number,
        "XA",
    )
    dataset.ConversionType = "WSD"
    dataset.ImageType = ["DERIVED", "SECONDARY"]
    dataset.DerivationDescription = series.description
    dataset.ImageComments = RESEARCH
    dataset.BurnedInAnnotation = "YES"
    dataset.PatientOrientation = None
    dataset.SamplesPerPixel = 3
    dataset.PhotometricInterpretation = "RGB"
    dataset.PlanarConfiguration = 0
    dataset.Rows, dataset.Columns, dataset.NumberOfFrames = series.rows, series.columns, series.frames
    dataset.BitsAllocated = dataset.BitsStored = 8
    dataset.HighBit = 7
    dataset.PixelRepresentation = 0
    dataset.LossyImageCompression = "00"
    if series.frames > 1:
        dataset.FrameTime = "1000"
        dataset.FrameIncrementPointer = 0x00181063
    dataset.SourceImageSequence = [reference(header) for header in source.headers]
    if pixels is not None:
        content = pixels.tobytes()
        dataset.PixelData = content + bytes(len(content) % 2)
        dataset["PixelData"].VR = "OB"
    return file_bytes(dataset)
