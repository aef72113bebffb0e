"""The contracts' dataclasses as JSON bytes and back, exactly: equal values give equal bytes.

Each type's fields are looked up once: a study's results hold thousands of small dataclasses.
"""

from __future__ import annotations

import dataclasses
import functools
import types
import typing
from collections.abc import Callable, Hashable
from enum import Enum
from typing import Any, cast

import numpy as np
from pydantic_core import from_json, to_json

T = typing.TypeVar("T")
Decoder = Callable[[Any], Any]


def encode(value: Any) -> bytes:
    """Encode a dataclass of arrays, numbers, strings, enums, tuples and dataclasses.

    Raises
    ------
    ValueError
        When it holds a number that is not finite.
    """
    content = to_json(value, fallback=_array)
    if b"NaN" in content or b"Infinity" in content:
        # As a word it may stand in a text; as a number it is refused.
        from_json(content, allow_inf_nan=False)
    return content


def decode(kind: type[T], content: bytes) -> T:
    """Decode what :func:`encode` made of a ``kind``; the dataclass checks itself as it is built."""
    decoded: T = _decoder(cast(Hashable, kind))(from_json(content))
    return decoded


def _array(value: Any) -> Any:
    if isinstance(value, np.ndarray):
        return {"shape": value.shape, "values": value.ravel().tolist()}
    if isinstance(value, np.generic):
        return value.item()
    raise TypeError(f"a result holds a {type(value).__name__}, which is never stored")


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
