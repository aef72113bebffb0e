"""Hashes of values, equal for equal values: keys of results that depend on them."""

from __future__ import annotations

import dataclasses
import hashlib
import itertools
from collections.abc import Mapping
from enum import Enum
from typing import Any

import numpy as np
from pydantic import BaseModel

from fluoromap_service.store.codec import block_hash

_PLAIN = frozenset({str, int, float, bool, type(None)})


def digest(*inputs: Any) -> str:
    """Return a hash of values: equal for equal values of the same types.

    They may be numbers, strings, enums, arrays, tuples, mappings, dataclasses and pydantic models. A value that was read from
    the store counts with the hash of its stored form, without being decoded.
    """
    found = hashlib.sha256()
    for value in inputs:
        content = _digested(value)
        found.update(len(content).to_bytes(8, "little"))
        found.update(content)
    return found.hexdigest()


def _digested(value: Any) -> bytes:
    """Return bytes that are equal for equal values."""
    kind = type(value)
    if isinstance(value, Enum):
        return f"{kind.__qualname__}.{value.name}".encode()
    if kind in _PLAIN:
        return f"{kind.__name__}:{value!r}".encode()
    if isinstance(value, np.ndarray):
        return f"{value.dtype.str}{value.shape}".encode() + value.tobytes()
    if isinstance(value, np.generic):
        return _digested(value.item())
    if isinstance(value, Mapping):
        return f"mapping:{digest(*itertools.chain.from_iterable(sorted(value.items())))}".encode()
    if isinstance(value, (tuple, list)):
        return f"sequence:{digest(*value)}".encode()
    if isinstance(value, frozenset):
        return f"set:{digest(*sorted(value))}".encode()
    if isinstance(value, BaseModel):
        return f"{kind.__qualname__}:{value.model_dump_json()}".encode()
    if not dataclasses.is_dataclass(value):
        raise TypeError(f"the inputs hold a {kind.__name__}, which is never stored")
    stored = block_hash(value)
    if stored is not None:
        return f"stored:{stored}".encode()
    fields = digest(*(getattr(value, field.name) for field in dataclasses.fields(value)))
    return f"{kind.__qualname__}:{fields}".encode()
