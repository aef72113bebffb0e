"""The actions of the Basic Application Level Confidentiality Profile (PS3.15 table E.1-1)."""

from __future__ import annotations

import csv
import functools
from enum import StrEnum
from importlib.resources import files

from pydicom.tag import BaseTag

EDITION = "2026d"
"""The edition of the standard whose table the service applies."""


class Action(StrEnum):
    """The action on an attribute (PS3.15 table E.1-1a)."""

    REMOVE = "X"
    EMPTY = "Z"
    DUMMY = "D"
    NEW_UID = "U"
    CLEAN_INSIDE = "C"
    """For a sequence of references: the items stay, with new UIDs."""


# A dummy value is permitted wherever the table offers it, and no object type forbids it. So it is the choice among several.
_CHOICES = {
    "X": Action.REMOVE, "Z": Action.EMPTY, "D": Action.DUMMY, "U": Action.NEW_UID, "X/Z": Action.EMPTY,
    "Z/D": Action.DUMMY, "X/D": Action.DUMMY, "X/Z/D": Action.DUMMY, "X/Z/U": Action.CLEAN_INSIDE,
}  # fmt: skip


@functools.cache
def basic_profile() -> dict[int, Action]:
    """Return the action for each tag of the table, by the tag's number."""
    text = files(__package__).joinpath("basic_profile.csv").read_text()
    return {int(row["tag"], 16): _CHOICES[row["action"]] for row in csv.DictReader(text.splitlines())}


def action_for(tag: BaseTag) -> Action | None:
    """Return the action for an attribute; None for one that the table does not name.

    Curves (50xx,xxxx), overlay data (60xx,3000) and overlay comments (60xx,4000) are removed, and all private attributes.
    """
    if tag.is_private or 0x5000 <= tag.group <= 0x50FF:
        return Action.REMOVE
    if 0x6000 <= tag.group <= 0x60FF and tag.element in (0x3000, 0x4000):
        return Action.REMOVE
    return basic_profile().get(int(tag))
