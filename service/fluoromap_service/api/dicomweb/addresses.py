"""The addresses of DICOMweb resources (PS3.18 section 8.2)."""

from __future__ import annotations


def study_url(base: str, study_uid: str) -> str:
    """Return the address of a DICOM study; ``base`` is the service's address with a slash."""
    return f"{base}dicom-web/studies/{study_uid}"


def series_url(base: str, study_uid: str, series_uid: str) -> str:
    """Return the address of a series."""
    return f"{study_url(base, study_uid)}/series/{series_uid}"


def instance_url(base: str, study_uid: str, series_uid: str, uid: str) -> str:
    """Return the address of an instance."""
    return f"{series_url(base, study_uid, series_uid)}/instances/{uid}"
