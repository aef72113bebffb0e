"""The overlays as a multi-frame true colour secondary capture (PS3.3 A.8.5)."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from pydicom.dataset import Dataset
from pydicom.uid import MultiFrameTrueColorSecondaryCaptureImageStorage

from fluoromap_service.dicom.objects.identity import ResultSource, file_bytes, reference, set_identity


def pictures_file(source: ResultSource, number: int, pictures: NDArray[np.uint8]) -> bytes:
    """Return pictures of one size as a DICOM file.

    Parameters
    ----------
    source : ResultSource
    number : int
        Number of this object among those of the job, from 1.
    pictures : (frames, rows, columns, 3)
        Red, green and blue.
    """
    dataset = Dataset()
    name = f"overlays-{number}"
    set_identity(dataset, source, MultiFrameTrueColorSecondaryCaptureImageStorage, name, 9010 + number, "XA")
    dataset.ConversionType = "WSD"
    dataset.ImageType = ["DERIVED", "SECONDARY"]
    dataset.DerivationDescription = "Activation map drawn into fluoroscopy frames"
    dataset.BurnedInAnnotation = "YES"
    dataset.PatientOrientation = None
    frames, rows, columns, _ = pictures.shape
    dataset.SamplesPerPixel = 3
    dataset.PhotometricInterpretation = "RGB"
    dataset.PlanarConfiguration = 0
    dataset.Rows, dataset.Columns, dataset.NumberOfFrames = rows, columns, frames
    dataset.BitsAllocated = dataset.BitsStored = 8
    dataset.HighBit = 7
    dataset.PixelRepresentation = 0
    dataset.LossyImageCompression = "00"
    dataset.FrameTime = "1000"
    dataset.FrameIncrementPointer = 0x00181063
    dataset.SourceImageSequence = [reference(header) for header in source.headers]
    content = pictures.tobytes()
    dataset.PixelData = content + bytes(len(content) % 2)
    dataset["PixelData"].VR = "OB"
    return file_bytes(dataset)
