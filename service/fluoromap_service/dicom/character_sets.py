"""Texts of a header from their bytes, by the character sets that the header declares or meant to declare."""

from __future__ import annotations

import re
from dataclasses import dataclass

from pydicom.charset import ESC, STAND_ALONE_ENCODINGS, decode_bytes, default_encoding, python_encoding

UTF_8 = "ISO_IR 192"
"""The defined term of Unicode in UTF-8, which holds the characters of every other set."""
_NOT_DEFINED = frozenset({"ISO_IR 6", "ISO 2022 58", "ISO 2022 GBK"})
"""Terms that pydicom knows and the standard does not define."""
_RESETS = frozenset(b"^=\\\r\n\f\t")
"""Characters after which a text is in its first character set again (PS3.5 section 6.1.2.5.3)."""
_ESCAPE = re.compile(r"\x1b[ -/]+[0-~]")


def _letters(term: str) -> str:
    """Return what distinguishes a term: one without ISO, 2022, blanks and underscores."""
    return re.sub("[^A-Z0-9]", "", term.upper()).removeprefix("ISO").removeprefix("2022")


_ENCODINGS = {_letters(term): encoding for term, encoding in python_encoding.items()} | {
    "UTF8": "utf-8", "88591": "latin_1", "LATIN1": "latin_1", "646": default_encoding, "ASCII": default_encoding,
}  # fmt: skip
_EXTENSIONS = tuple(encoding for term, encoding in python_encoding.items() if term.startswith("ISO 2022"))


@dataclass(frozen=True, slots=True)
class CharacterSets:
    """The character sets of a data set.

    encodings : Python's names; the first holds for texts without escape sequence. defined : whether each declared term is one
    of PS3.3 section C.12.1.1.2.
    """

    encodings: tuple[str, ...] = (default_encoding, *_EXTENSIONS)
    defined: bool = True

    @classmethod
    def declared(cls, terms: str) -> CharacterSets:
        """Return the sets of a value of SpecificCharacterSet (0008,0005).

        Another spelling of a term counts as the term. An unknown term counts as none. Escape sequences name their set
        themselves, declared or not.
        """
        names = [term.strip(" \0") for term in terms.split("\\")]
        first = names[0]
        defined = all(name in python_encoding and name not in _NOT_DEFINED for name in names) and not (
            len(names) > 1 and first in STAND_ALONE_ENCODINGS
        )
        return cls((_ENCODINGS.get(_letters(first), default_encoding), *_EXTENSIONS), defined)

    def text(self, value: bytes) -> tuple[str, bool]:
        """Return a text, and whether it is what the declared sets say.

        A text that they do not explain is read as UTF-8, and as Latin 1 where it is no UTF-8: the two sets that systems write
        without a declaration.
        """
        if value.isascii() and ESC not in value:
            return value.decode("ascii"), True
        if ESC in value or self.encodings[0] != default_encoding:
            text = decode_bytes(value, self.encodings, set(_RESETS))
            if "\ufffd" not in text:
                return _ESCAPE.sub("", text), True
        try:
            return value.decode("utf-8"), False
        except UnicodeDecodeError:
            return value.decode("latin_1"), False
