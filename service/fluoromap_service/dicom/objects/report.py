"""The structured report: a Comprehensive 3D SR with the measurement report of TID 1500 (PS3.16)."""

from __future__ import annotations

import warnings

import numpy as np
from highdicom.sr import (
    CodedConcept,
    Comprehensive3DSR,
    DeviceObserverIdentifyingAttributes,
    GraphicTypeValues3D,
    ImageRegion3D,
    Measurement,
    MeasurementReport,
    MeasurementsAndQualitativeEvaluations,
    ObservationContext,
    ObserverContext,
    PlanarROIMeasurementsAndQualitativeEvaluations,
    TrackingIdentifier,
)
from pydicom.sr.codedict import codes
from pydicom.valuerep import DT

from fluoromap_service.dicom.objects.identity import (
    MANUFACTURER,
    RESEARCH,
    ResultSource,
    file_bytes,
    set_dates,
    set_deidentification,
    set_equipment,
)
from fluoromap_service.dicom.objects.report_site import ReportSite

# highdicom's warnings quote the patient's name.
warnings.filterwarnings("ignore", module=r"highdicom\.")

_ELECTRODE = CodedConcept("electrode", "99FLUOROMAP", "Tip electrode of the mapping catheter")
_ACTIVATION_TIME = CodedConcept("lat", "99FLUOROMAP", "Local activation time")
_POSITION_SD = CodedConcept("position_sd", "99FLUOROMAP", "Largest standard deviation of the position")
_VOLUME = CodedConcept("118565006", "SCT", "Volume")
_MILLILITRE = CodedConcept("mL", "UCUM", "milliliter")


def report_file(source: ResultSource, sites: tuple[ReportSite, ...], volume_ml: float | None) -> bytes:
    """Return the structured report of a job as a DICOM file.

    Each site is a group (TID 1410) with its point in the frame of reference of the job.
    """
    groups: list[PlanarROIMeasurementsAndQualitativeEvaluations | MeasurementsAndQualitativeEvaluations] = [
        _site_group(source, site) for site in sites
    ]
    if volume_ml is not None:
        groups.append(
            MeasurementsAndQualitativeEvaluations(
                tracking_identifier=TrackingIdentifier(source.uid("chamber"), "chamber"),
                measurements=[Measurement(_VOLUME, round(volume_ml, 1), _MILLILITRE)],
            )
        )
    device = DeviceObserverIdentifyingAttributes(uid=source.uid("device"), name=MANUFACTURER)
    content = MeasurementReport(
        observation_context=ObservationContext(observer_device_context=ObserverContext(codes.DCM.Device, device)),
        procedure_reported=CodedConcept("44491008", "SCT", "Fluoroscopy"),
        imaging_measurements=groups,
        title=codes.DCM.ImagingMeasurementReport,
    )
    report = Comprehensive3DSR(
        evidence=source.headers,
        content=content,
        series_instance_uid=source.uid("report", "series"),
        series_number=9001,
        sop_instance_uid=source.uid("report"),
        instance_number=1,
        series_description=RESEARCH,
        manufacturer=MANUFACTURER,
        is_complete=True,
        is_final=False,
        is_verified=False,
    )
    set_deidentification(report, source)
    set_equipment(report)
    set_dates(report, source)
    # highdicom adds itself with the time of the writing.
    report.ContributingEquipmentSequence[-1].ContributionDateTime = DT(source.finished)
    return file_bytes(report)


def _site_group(source: ResultSource, site: ReportSite) -> PlanarROIMeasurementsAndQualitativeEvaluations:
    measurements = [Measurement(_POSITION_SD, round(site.sd_mm, 3), codes.UCUM.Millimeter)]
    if site.lat_ms is not None:
        measurements.append(Measurement(_ACTIVATION_TIME, round(site.lat_ms, 3), codes.UCUM.Millisecond))
    return PlanarROIMeasurementsAndQualitativeEvaluations(
        tracking_identifier=TrackingIdentifier(source.uid("site", site.site), site.site),
        referenced_region=ImageRegion3D(
            graphic_type=GraphicTypeValues3D.POINT,
            graphic_data=np.array([site.position_mm]),
            frame_of_reference_uid=source.frame_of_reference,
        ),
        finding_type=_ELECTRODE,
        measurements=measurements,
    )
