"""Pictures as multi-frame true colour secondary captures (PS3.3 A.8.5)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from pydicom.dataset import Dataset
from pydicom.uid import MultiFrameTrueColorSecondaryCaptureImageStorage

from fluoromap_service.dicom.objects.identity import RESEARCH, ResultSource, file_bytes, reference, set_identity


@dataclass(frozen=True, eq=False)
class Pictures:
    """The pictures of one object.

    name : name of the object among those of the job. series_number : number of its series. description : content of the
    pictures, in a sentence. pixels : (frames, rows, columns, 3) uint8 red, green and blue.
    """

    name: str
    series_number: int
    description: str
    pixels: NDArray[np.uint8]


def pictures_file(source: ResultSource, pictures: Pictures) -> bytes:
    """Return pictures of one size as a DICOM file."""
    dataset = Dataset()
    set_identity(
        dataset,
        source,
        MultiFrameTrueColorSecondaryCaptureImageStorage,
        pictures.name,
        pictures.series_number,
        "XA",
    )
    dataset.ConversionType = "WSD"
    dataset.ImageType = ["DERIVED", "SECONDARY"]
    dataset.DerivationDescription = pictures.description
    dataset.ImageComments = RESEARCH
    dataset.BurnedInAnnotation = "YES"
    dataset.PatientOrientation = None
    frames, rows, columns, _ = pictures.pixels.shape
    dataset.SamplesPerPixel = 3
    dataset.PhotometricInterpretation = "RGB"
    dataset.PlanarConfiguration = 0
    dataset.Rows, dataset.Columns, dataset.NumberOfFrames = rows, columns, frames
    dataset.BitsAllocated = dataset.BitsStored = 8
    dataset.HighBit = 7
    dataset.PixelRepresentation = 0
    dataset.LossyImageCompression = "00"
    if frames > 1:
        dataset.FrameTime = "1000"
        dataset.FrameIncrementPointer = 0x00181063
    dataset.SourceImageSequence = [reference(header) for header in source.headers]
    content = pictures.pixels.tobytes()
    dataset.PixelData = content + bytes(len(content) % 2)
    dataset["PixelData"].VR = "OB"
    return file_bytes(dataset)
