"""The allow-list of the DICOM listener."""

from __future__ import annotations

import pytest

from fluoromap_service.listener.allow_list import AllowList
from fluoromap_service.problem import Problem


@pytest.mark.parametrize(
    ("entries", "title", "address", "allowed"),
    [
        ("", "ANY", "203.0.113.9", True),
        ("PACS", "PACS", "203.0.113.9", True),
        ("PACS", "pacs", "203.0.113.9", False),
        ("MY PACS, XA1@10.1.0.0/16", "MY PACS", "192.0.2.1", True),
        ("MY PACS, XA1@10.1.0.0/16", "XA1 ", "10.1.255.3", True),
        ("XA1@10.1.0.0/16", "XA1", "10.2.0.1", False),
        ("XA1@10.1.2.3", "XA1", "::ffff:10.1.2.3", True),
        ("XA1@fe80::/10", "XA1", "fe80::1%eth0", True),
        ("XA1@fe80::/10", "XA1", "10.1.2.3", False),
    ],
)
def test_allowed_senders(entries: str, title: str, address: str, allowed: bool) -> None:
    assert AllowList.from_text(entries).allows(title, address) is allowed


@pytest.mark.parametrize("entry", ["A_TITLE_OF_17_CHAR", "XA1@room-1", "@10.1.2.3", "XA\\1", "XA1@10.1.2.3/99"])
def test_unusable_entries_are_refused(entry: str) -> None:
    with pytest.raises(Problem, match="not usable"):
        AllowList.from_text(entry)
