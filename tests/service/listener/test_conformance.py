"""The tables of ``docs/dicom-conformance.md`` are those of the code."""

from __future__ import annotations

import inspect
import re
from pathlib import Path

from fastapi.routing import APIRoute
from pydicom.dataset import Dataset
from pydicom.uid import UID

from fluoromap_service.api.dicomweb import rendered, retrieve, search, store
from fluoromap_service.dicom.deidentification.dataset import deidentify
from fluoromap_service.dicom.deidentification.profile import EDITION, basic_profile
from fluoromap_service.dicom.deidentification.pseudonyms import Dates, Pseudonyms
from fluoromap_service.dicom.header import MACROS
from fluoromap_service.dicom.store_statuses import StoreStatus
from fluoromap_service.listener import server
from fluoromap_service.settings import Settings

PAGE = (Path(__file__).parents[3] / "docs" / "dicom-conformance.md").read_text()


def section(heading: str) -> str:
    """Return the text from a heading to the next one."""
    return re.split(r"^#+ ", PAGE.split(f"# {heading}\n", 1)[1], maxsplit=1, flags=re.M)[0]


def status_meanings() -> dict[StoreStatus, str]:
    """Return the sentence under each status in the source."""
    source = inspect.getsource(StoreStatus)
    return {StoreStatus[name]: text for name, text in re.findall(r'^    ([A-Z_]+) = .*\n    """(.+)"""$', source, re.M)}


def test_storage_classes() -> None:
    rows = re.findall(r"^\| (.+) \| `([\d.]+)` \| SCP \|$", section("Storage"), re.M)
    assert rows == [(UID(uid).name, uid) for uid in server.STORAGE_CLASSES]


def test_transfer_syntaxes() -> None:
    rows = re.findall(r"^\| (.+) \| `([\d.]+)` \|$", section("Storage"), re.M)
    assert rows == [(UID(uid).name, uid) for uid in server.TRANSFER_SYNTAXES]


def test_functional_groups() -> None:
    rows = re.findall(r"^\| (\w+Sequence) \| (.+) \|$", section("Geometry"), re.M)
    assert rows == [(macro, ", ".join(keywords)) for macro, keywords in MACROS.items()]


def test_options_of_deidentification() -> None:
    listed = set(re.findall(r"^\| .+ \| `(\d{6})` \| .+ \|$", section("De-identification"), re.M))
    written = set()
    for dates in Dates:
        dataset = Dataset()
        block = dataset.private_block(0x0019, "DLX_SERIE_01", create=True)
        block.add_new(0x21, "DS", "84")
        deidentify(dataset, Pseudonyms(b"secret", "patient", "", dates))
        written |= {item.CodeValue for item in dataset.DeidentificationMethodCodeSequence}
    assert listed == written


def test_edition_of_deidentification() -> None:
    (stated,) = re.findall(r"edition\s(\w+): (\d+) attributes", section("De-identification"))
    assert stated == (EDITION, str(len(basic_profile())))


def test_statuses() -> None:
    rows = re.findall(r"^\| `([0-9A-F]{4})` \| (.+) \|$", section("Statuses of C-STORE"), re.M)
    assert rows == [(f"{status:04X}", status_meanings()[status]) for status in StoreStatus]


def transactions() -> list[tuple[str, str, str]]:
    """Return name, method and path of each DICOMweb route."""
    modules = {"store": store, "search": search, "retrieve": retrieve, "render": rendered}
    return [
        (name, method, route.path)
        for name, module in modules.items()
        for route in module.router.routes
        if isinstance(route, APIRoute)
        for method in sorted(route.methods)
    ]


def test_transactions() -> None:
    rows = re.findall(r"^\| (store|search|retrieve|render) \| (\w+) \| `(.+)` \|$", section("DICOMweb"), re.M)
    assert rows == transactions()


def test_items() -> None:
    rows = dict(re.findall(r"^\| (.+) \| `(\w+)`", section("Implementation"), re.M))
    fields = Settings.model_fields
    assert rows == {
        "default AE title": fields["dicom_aet"].default,
        "default port": str(fields["dicom_port"].default),
        "largest PDU received": str(server.PDU_BYTES),
        "associations at the same time, by default": str(fields["dicom_associations"].default),
        "idle association is ended after": f"{server.IDLE_SECONDS:.0f}",
    }
