"""The form in which names are stored and compared."""

from __future__ import annotations

import unicodedata
from typing import Annotated, Any

from pydantic import BeforeValidator


def normal_name(text: str) -> str:
    """Return a name in Unicode's composed form, NFC (UAX 15).

    A name may arrive with letters and accents apart, as macOS writes file names: it looks the same and is the same name.
    """
    return unicodedata.normalize("NFC", text)


def _normal(value: Any) -> Any:
    return normal_name(value) if isinstance(value, str) else value


NORMAL_FORM = BeforeValidator(_normal)
"""Makes a text of a request the composed form; limits of length count that form."""
Name = Annotated[str, NORMAL_FORM]
"""A name in a request."""
