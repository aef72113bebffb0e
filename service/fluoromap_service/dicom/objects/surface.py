"""The chamber's surface as encapsulated STL (PS3.3 A.85.1)."""

from __future__ import annotations

from pydicom.dataset import Dataset
from pydicom.uid import EncapsulatedSTLStorage

from fluoromap_service.dicom.objects.identity import ResultSource, code, file_bytes, reference, set_identity


def surface_file(source: ResultSource, stl: bytes) -> bytes:
    """Return the surface as a DICOM file.

    ``stl`` is in mm (LPS), from the origin of the job.
    """
    dataset = Dataset()
    set_identity(dataset, source, EncapsulatedSTLStorage, "chamber", 9020, "M3D")
    del dataset.BodyPartExamined  # The Encapsulated Document Series module has none (PS3.3 C.24.1).
    dataset.FrameOfReferenceUID = source.frame_of_reference
    dataset.PositionReferenceIndicator = None
    dataset.AcquisitionDateTime = f"{source.finished:%Y%m%d%H%M%S}+0000"
    dataset.BurnedInAnnotation = "NO"
    dataset.RecognizableVisualFeatures = "NO"
    dataset.DocumentTitle = dataset.ContentDescription = "Surface of the heart chamber"
    dataset.ConceptNameCodeSequence = [code("85040-4", "LN", "3D Model")]
    dataset.MeasurementUnitsCodeSequence = [code("mm", "UCUM", "mm")]
    dataset.ModelModification = dataset.ModelMirroring = "NO"
    dataset.ModelUsageCodeSequence = [code("129013", "DCM", "Planning Intent")]
    dataset.SourceInstanceSequence = [reference(header) for header in source.headers]
    dataset.ReferencedSeriesSequence = _series(source)
    dataset.MIMETypeOfEncapsulatedDocument = "model/stl"
    dataset.EncapsulatedDocument = stl + bytes(len(stl) % 2)
    dataset.EncapsulatedDocumentLength = len(stl)
    return file_bytes(dataset)


def _series(source: ResultSource) -> list[Dataset]:
    items: dict[str, Dataset] = {}
    for header in source.headers:
        if header.StudyInstanceUID != source.headers[0].StudyInstanceUID:
            continue
        if header.SeriesInstanceUID not in items:
            item = items[header.SeriesInstanceUID] = Dataset()
            item.SeriesInstanceUID = header.SeriesInstanceUID
            item.ReferencedInstanceSequence = []
        items[header.SeriesInstanceUID].ReferencedInstanceSequence.append(reference(header))
    return list(items.values())
