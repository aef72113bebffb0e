"""New UIDs, a name and a shift of dates for one patient, from a secret that never leaves the hospital."""

from __future__ import annotations

import hashlib
import hmac
import re
from dataclasses import dataclass
from datetime import date, timedelta
from enum import StrEnum

LARGEST_SHIFT_DAYS = 3650
DUMMY_DATE = "19000101"


class Dates(StrEnum):
    """What happens to dates and times."""

    REMOVE = "remove"
    SHIFT = "shift"
    KEEP = "keep"


@dataclass(frozen=True, slots=True)
class Pseudonyms:
    """The replacements for the identifiers of one patient.

    The same secret and the same patient always give the same replacements, so that exports fit each other.

    secret : known to the exporting service alone. patient : text that names the patient, only hashed. subject : new name and
    ID; empty takes one from the hash. dates : what happens to dates.
    """

    secret: bytes
    patient: str
    subject: str
    dates: Dates

    @property
    def name(self) -> str:
        """The patient's new name and ID."""
        return self.subject or f"SUBJECT-{self._digest('subject', self.patient).hex()[:8].upper()}"

    @property
    def shift_days(self) -> int:
        """The shift of all dates of this patient, 1 to 3650 days into the past; 0 unless dates are shifted."""
        if self.dates is not Dates.SHIFT:
            return 0
        return -1 - int.from_bytes(self._digest("days", self.patient)[:8]) % LARGEST_SHIFT_DAYS

    def uid(self, original: str) -> str:
        """Return the UID in place of another.

        It is under the root 2.25 (PS3.5 annex B.2).
        """
        return f"2.25.{int.from_bytes(self._digest('uid', original)[:16])}"

    def moved(self, text: str) -> str:
        """Return a date, or a date with a time, on its new day.

        ``text`` begins with YYYYMMDD. Another text is no date, and becomes empty.
        """
        if not re.fullmatch(r"[0-9]{8}[0-9.+-]*", text.strip()):
            return ""
        try:
            day = date(int(text[:4]), int(text[4:6]), int(text[6:8])) + timedelta(days=self.shift_days)
        except (ValueError, OverflowError):
            return ""
        return f"{day:%Y%m%d}{text[8:]}"

    def _digest(self, kind: str, text: str) -> bytes:
        return hmac.digest(self.secret, f"{kind}\0{text}".encode(), hashlib.sha256)
