"""The contracts' dataclasses as JSON bytes and back, exactly: equal values give equal bytes.

Each type's fields are looked up once: a study's results hold thousands of small dataclasses.
"""

from __future__ import annotations

import dataclasses
import functools
import json
import types
import typing
from collections.abc import Callable, Hashable
from enum import Enum
from typing import Any, cast

import numpy as np

T = typing.TypeVar("T")
Decoder = Callable[[Any], Any]


def encode(value: Any) -> bytes:
    """Encode a dataclass of arrays, numbers, strings, enums, tuples and dataclasses."""
    return json.dumps(_plain(value), allow_nan=False, separators=(",", ":"), ensure_ascii=False).encode()


def decode(kind: type[T], content: bytes) -> T:
    """Decode what :func:`encode` made of a ``kind``; the dataclass checks itself as it is built."""
    decoded: T = _decoder(cast(Hashable, kind))(json.loads(content))
    return decoded


def _plain(value: Any) -> Any:
    names = _field_names(cast(Hashable, type(value)))
    if names is not None:
        return {name: _plain(getattr(value, name)) for name in names}
    if isinstance(value, np.ndarray):
        return {"shape": list(value.shape), "values": value.ravel().tolist()}
    if isinstance(value, np.generic):
        return value.item()
    if isinstance(value, Enum):
        return value.value
    if isinstance(value, tuple | list):
        return [_plain(item) for item in value]
    if isinstance(value, dict):
        return {str(key): _plain(item) for key, item in sorted(value.items())}
    return value


@functools.cache
def _field_names(kind: Any) -> tuple[str, ...] | None:
    """The fields of a dataclass; None for any other type."""
    return tuple(field.name for field in dataclasses.fields(kind)) if dataclasses.is_dataclass(kind) else None


@functools.cache
def _decoder(kind: Any) -> Decoder:
    origin, arguments = typing.get_origin(kind), typing.get_args(kind)
    if origin in (types.UnionType, typing.Union):
        present = _decoder(next(option for option in arguments if option is not type(None)))
        return lambda value: None if value is None else present(value)
    if origin is np.ndarray:
        return lambda value: np.array(value["values"]).reshape(value["shape"])
    if origin is tuple:
        if len(arguments) == 2 and arguments[1] is Ellipsis:
            each = _decoder(arguments[0])
            return lambda value: tuple(each(item) for item in value)
        members = tuple(_decoder(argument) for argument in arguments)
        return lambda value: tuple(member(item) for member, item in zip(members, value, strict=True))
    if dataclasses.is_dataclass(kind) and isinstance(kind, type):
        return _dataclass_decoder(kind)
    if isinstance(kind, type) and issubclass(kind, Enum):
        return kind
    return lambda value: value


def _dataclass_decoder(kind: type) -> Decoder:
    # Looked up at the first value: a dataclass may hold others of its own kind.
    fields = functools.cache(lambda: {name: _decoder(hint) for name, hint in typing.get_type_hints(kind).items()})

    def decoded(value: Any) -> Any:
        decoders = fields()
        return kind(**{name: decoders[name](item) for name, item in value.items()})

    return decoded
