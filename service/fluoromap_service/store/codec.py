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
    TypeError
        When it holds anything else, which would not come back as it was.
    """
    content = to_json(_plain(value))
    if b"NaN" in content or b"Infinity" in content:
        # As a word it may stand in a text.
        try:
            from_json(content, allow_inf_nan=False)
        except ValueError:
            raise ValueError("the result holds a number that is not finite") from None
    return content


def decode(kind: type[T], content: bytes) -> T:
    """Decode what :func:`encode` made of a ``kind``; the dataclass checks itself as it is built."""
    decoded: T = _decoder(cast(Hashable, kind))(from_json(content))
    return decoded


def _plain(value: Any) -> Any:
    return _encoder(cast(Hashable, type(value)))(value)


@functools.cache
def _encoder(kind: Any) -> Callable[[Any], Any]:
    if dataclasses.is_dataclass(kind):
        names = tuple(field.name for field in dataclasses.fields(kind))
        return lambda value: {name: _plain(getattr(value, name)) for name in names}
    if issubclass(kind, np.ndarray):
        return _plain_array
    if issubclass(kind, np.generic):
        return lambda value: _plain(value.item())
    if issubclass(kind, Enum):
        return lambda value: value.value
    if issubclass(kind, tuple | list):
        return lambda value: [_plain(item) for item in value]
    if issubclass(kind, str | int | float | types.NoneType):
        return lambda value: value
    raise TypeError(f"a result holds a {kind.__name__}, which is never stored")


def _plain_array(value: np.ndarray[Any, np.dtype[Any]]) -> dict[str, Any]:
    if value.dtype.kind not in "biuf":
        raise TypeError(f"a result holds an array of {value.dtype}, which is never stored")
    return {"shape": value.shape, "values": value.ravel().tolist()}


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
