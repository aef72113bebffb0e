"""Stage results as bytes and back, exactly: equal values give equal bytes.

A stored result has three parts: eight bytes with the length of the second part, a MessagePack tree, and the numbers of all
arrays. In the tree a dataclass is the list of its fields, and an array is the number of its pool and its place there. A pool
holds the arrays of one type and shape, each different one once. So thousands of small arrays cost little to read.
"""

from __future__ import annotations

import dataclasses
import functools
import gc
import hashlib
import math
import types
import typing
from collections.abc import Callable, Hashable, Iterable, Iterator
from contextlib import contextmanager
from enum import Enum
from operator import attrgetter
from typing import Any, cast

import msgspec
import numpy as np
from numpy.typing import NDArray

T = typing.TypeVar("T")

Encoder = Callable[[Any, "_Pools"], Any]
Decoder = Callable[[Any, list[NDArray[Any]]], Any]

_ALIGNMENT = 8
_pack, _unpack = msgspec.msgpack.Encoder(), msgspec.msgpack.Decoder()


class StoredOtherwise(ValueError):
    """The bytes are no stored result of this kind, or another version of the contracts stored them."""


class _Pools:
    """The arrays of one value, gathered by type and shape."""

    def __init__(self) -> None:
        self._pools: dict[tuple[str, tuple[int, ...]], tuple[int, dict[bytes, int]]] = {}

    def add(self, array: NDArray[Any]) -> tuple[int, int]:
        """Add an array; return the number of its pool and its place there."""
        key = array.dtype.char, array.shape
        if key not in self._pools:
            if array.dtype.kind not in "biuf":
                raise TypeError(f"a result holds an array of {array.dtype}, which is never stored")
            self._pools[key] = len(self._pools), {}
        number, places = self._pools[key]
        return number, places.setdefault(array.tobytes(), len(places))

    def described(self) -> list[tuple[str, tuple[int, ...], int]]:
        """Return type, shape and length of each pool."""
        return [(np.dtype(char).str, shape, len(places)) for (char, shape), (_, places) in self._pools.items()]

    def numbers(self) -> bytes:
        """Return the numbers of all pools, each pool padded to whole words.

        Raises
        ------
        ValueError
            When one of them is not finite.
        """
        parts = []
        for (char, _), (_, places) in self._pools.items():
            content = b"".join(places)
            if np.dtype(char).kind == "f" and not np.isfinite(np.frombuffer(content, char)).all():
                raise ValueError("the result holds a number that is not finite")
            parts.append(_padded(content))
        return b"".join(parts)


def encode(value: Any) -> bytes:
    """Encode a dataclass of arrays, numbers, strings, enums, tuples and dataclasses.

    Raises
    ------
    ValueError
        When it holds a number that is not finite.
    TypeError
        When it holds anything else, which would not come back as it was.
    """
    pools = _Pools()
    kind = type(value)
    with _without_collector():
        (tree,) = _encode_all((value,), pools)
        head = _pack.encode((form_of(kind), pools.described(), tree))
    return len(head).to_bytes(_ALIGNMENT, "little") + _padded(head) + pools.numbers()


def decode(kind: type[T], content: bytes) -> T:
    """Decode the bytes that :func:`encode` made of a ``kind``.

    The dataclasses do not check themselves again, because they did so before they were stored. Arrays are read-only.

    Raises
    ------
    StoredOtherwise
        When the bytes are no stored ``kind`` of these contracts.
    """
    try:
        end = _ALIGNMENT + int.from_bytes(content[:_ALIGNMENT], "little")
        with _without_collector():
            form, described, tree = _unpack.decode(content[_ALIGNMENT:end])
        if form != form_of(kind):
            raise StoredOtherwise(f"another version of the contracts stored this {kind}")
        pools, start = [], _whole(end)
        for dtype, shape, length in described:
            pool = np.frombuffer(content, dtype, length * math.prod(shape), start)
            pools.append(pool.reshape(length, *shape))
            start += _whole(pool.nbytes)
        with _without_collector():
            decoder = _decoder(cast(Hashable, kind))
            decoded: T = tree if decoder is None else decoder(tree, pools)
    except (msgspec.DecodeError, TypeError, ValueError, IndexError) as error:
        raise StoredOtherwise(f"these bytes are no stored {kind}") from error
    return decoded


def form_of(kind: type[Any]) -> str:
    """Return the hash of a type's form, which changes when a contract does.

    The form is the names and types of its fields, and those of all dataclasses in it.
    """
    return _form_of(cast(Hashable, kind))


@functools.cache
def _form_of(kind: Any) -> str:
    found: dict[str, list[tuple[str, str]]] = {}

    def visit(hint: Any) -> None:
        for argument in typing.get_args(hint):
            visit(argument)
        if dataclasses.is_dataclass(hint) and isinstance(hint, type) and hint.__qualname__ not in found:
            hints = typing.get_type_hints(hint)
            fields = [(field.name, str(hints[field.name])) for field in dataclasses.fields(hint)]
            found[hint.__qualname__] = fields
            for field in dataclasses.fields(hint):
                visit(hints[field.name])

    visit(kind)
    return hashlib.sha256(repr(sorted(found.items())).encode()).hexdigest()[:16]


def _whole(length: int) -> int:
    return -(-length // _ALIGNMENT) * _ALIGNMENT


def _padded(content: bytes) -> bytes:
    return content + bytes(_whole(len(content)) - len(content))


@contextmanager
def _without_collector() -> Iterator[None]:
    """Pause the cyclic garbage collector.

    It would walk through thousands of fresh small objects in vain.
    """
    enabled = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if enabled:
            gc.enable()


class _Encoders(dict[type, Encoder | None]):
    """Type -> its encoder, made at the first value of the type; None where MessagePack holds the value unchanged."""

    def __missing__(self, kind: type) -> Encoder | None:
        self[kind] = made = self._encoder(kind)
        return made

    def _encoder(self, kind: type) -> Encoder | None:
        if dataclasses.is_dataclass(kind):
            members = attrgetter(*(field.name for field in dataclasses.fields(kind)))
            if len(dataclasses.fields(kind)) == 1:
                return lambda value, pools: _encode_all((members(value),), pools)
            return lambda value, pools: _encode_all(members(value), pools)
        if issubclass(kind, np.ndarray):
            return lambda value, pools: pools.add(value)
        if issubclass(kind, np.generic):
            return lambda value, pools: _encode_all((value.item(),), pools)[0]
        if issubclass(kind, Enum):
            return lambda value, pools: value.value
        if issubclass(kind, tuple | list):
            return _encode_all
        if issubclass(kind, float):
            return _finite
        if issubclass(kind, str | int | types.NoneType):
            return None
        raise TypeError(f"a result holds a {kind.__name__}, which is never stored")


_encoders = _Encoders()


def _encode_all(values: Iterable[Any], pools: _Pools) -> list[Any]:
    encoders = _encoders
    return [value if (encoder := encoders[type(value)]) is None else encoder(value, pools) for value in values]


def _finite(value: float, pools: _Pools) -> float:
    if not math.isfinite(value):
        raise ValueError("the result holds a number that is not finite")
    return value


@functools.cache
def _decoder(kind: Any) -> Decoder | None:
    """Return the decoder of a type; None where MessagePack gives the value back unchanged."""
    origin, arguments = typing.get_origin(kind), typing.get_args(kind)
    if origin in (types.UnionType, typing.Union):
        present = _decoder(next(option for option in arguments if option is not type(None)))
        return present and (lambda value, pools: None if value is None else present(value, pools))
    if origin is np.ndarray:
        return lambda value, pools: pools[value[0]][value[1]]
    if origin is tuple:
        return _tuple_decoder(arguments)
    if dataclasses.is_dataclass(kind) and isinstance(kind, type):
        return _dataclass_decoder(kind)
    if isinstance(kind, type) and issubclass(kind, Enum):
        members = {member.value: member for member in kind}
        return lambda value, pools: members[value]
    return None


def _tuple_decoder(arguments: tuple[Any, ...]) -> Decoder:
    if len(arguments) == 2 and arguments[1] is Ellipsis:
        each = _decoder(arguments[0])
        if each is None:
            return lambda value, pools: tuple(value)
        return lambda value, pools: tuple([each(item, pools) for item in value])
    decoders = [_decoder(argument) for argument in arguments]
    return lambda value, pools: tuple(
        [item if decoder is None else decoder(item, pools) for decoder, item in zip(decoders, value, strict=True)]
    )


def _dataclass_decoder(kind: type) -> Decoder:
    build, put = object.__new__, object.__setattr__
    fields: list[tuple[str, Decoder | None]] = []

    def decoded(value: Any, pools: list[NDArray[Any]]) -> Any:
        if not fields:
            # A dataclass may hold others of its own kind, so its fields are looked up at the first value.
            hints = typing.get_type_hints(kind)
            fields.extend((field.name, _decoder(hints[field.name])) for field in dataclasses.fields(kind))
        made: Any = build(kind)
        for (name, decoder), item in zip(fields, value, strict=True):
            put(made, name, item if decoder is None else decoder(item, pools))
        return made

    return decoded
