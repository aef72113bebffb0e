"""Stage results as bytes and back, exactly: equal values give equal bytes.

A stored result has three parts: eight bytes with the length of the second part, a MessagePack tree, and the numbers of all
arrays. The tree holds columns: all values of one field of all dataclasses of one kind lie together, and an array is its
number. Arrays of one type and shape lie together too, each different one once. So reading a value costs no Python call of
its own, and thousands of small arrays cost little.
"""

from __future__ import annotations

import dataclasses
import functools
import gc
import hashlib
import itertools
import math
import types
import typing
from collections import deque
from collections.abc import Callable, Hashable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from enum import Enum
from operator import attrgetter
from typing import Any, NoReturn, Protocol, cast

import msgspec
import numpy as np
from numpy.typing import NDArray

T = typing.TypeVar("T")

LAYOUT = 2
"""The number of the layout of stored bytes. It is part of every form, so that results of another one are computed again."""

_ALIGNMENT = 8
_PLAIN = frozenset({str, int, float, bool, types.NoneType})
_pack, _unpack = msgspec.msgpack.Encoder(), msgspec.msgpack.Decoder()


class StoredOtherwise(ValueError):
    """The bytes are no stored result of this kind, or another version of the contracts stored them."""


def encode(value: Any) -> bytes:
    """Encode a dataclass of arrays, numbers, strings, enums, tuples and dataclasses.

    Raises
    ------
    ValueError
        When it holds a number that is not finite.
    TypeError
        When it holds anything else, which would not come back as it was.
    """
    kind = type(value)
    if not dataclasses.is_dataclass(kind):
        _refuse(kind)
    arrays = _Arrays()
    with _without_collector():
        tree = _column(cast(Hashable, kind)).encode([value], arrays)
        head = _pack.encode((form_of(kind), arrays.described(), tree))
    return len(head).to_bytes(_ALIGNMENT, "little") + _padded(head) + arrays.numbers()


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
            arrays = _stored_arrays(described, content, _whole(end))
            (decoded,) = _column(cast(Hashable, kind)).decode(tree, arrays)
    except (msgspec.DecodeError, AttributeError, IndexError, KeyError, TypeError, ValueError) as error:
        raise StoredOtherwise(f"these bytes are no stored {kind}") from error
    return cast(T, decoded)


def form_of(kind: type[Any]) -> str:
    """Return the hash of a type's form, which changes when a contract or the layout does.

    The form is the layout, the names and types of its fields, and those of all dataclasses in it.
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
    return hashlib.sha256(repr((LAYOUT, sorted(found.items()))).encode()).hexdigest()[:16]


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


def _refuse(kind: type) -> NoReturn:
    raise TypeError(f"a result holds a {kind.__name__}, which is never stored")


def _check_types(values: Iterable[Any], *allowed: type) -> None:
    for kind in set(map(type, values)):
        if not issubclass(kind, allowed):
            _refuse(kind)


def _check_finite(numbers: Iterable[float]) -> None:
    if not all(map(math.isfinite, numbers)):
        raise ValueError("the result holds a number that is not finite")


# --- arrays ------------------------------------------------------------------------------------------------------------


class _Arrays:
    """The different arrays of one value, numbered as they come and gathered by type and shape."""

    def __init__(self) -> None:
        self._numbers: dict[tuple[np.dtype[Any], tuple[int, ...], bytes], int] = {}

    def add(self, array: NDArray[Any]) -> int:
        """Add an array and return its number."""
        return self._numbers.setdefault((array.dtype, array.shape, array.tobytes()), len(self._numbers))

    @functools.cached_property
    def _pools(self) -> dict[tuple[np.dtype[Any], tuple[int, ...]], tuple[list[int], list[bytes]]]:
        pools: dict[tuple[np.dtype[Any], tuple[int, ...]], tuple[list[int], list[bytes]]] = {}
        for (dtype, shape, content), number in self._numbers.items():
            numbers, contents = pools.setdefault((dtype, shape), ([], []))
            numbers.append(number)
            contents.append(content)
        return pools

    def described(self) -> list[tuple[str, tuple[int, ...], list[int]]]:
        """Return type, shape and the arrays' numbers for each pool.

        Raises
        ------
        TypeError
            When an array holds no real numbers.
        """
        for dtype, _ in self._pools:
            if dtype.kind not in "biuf":
                raise TypeError(f"a result holds an array of {dtype}, which is never stored")
        return [(dtype.str, shape, numbers) for (dtype, shape), (numbers, _) in self._pools.items()]

    def numbers(self) -> bytes:
        """Return the numbers of all pools, each pool padded to whole words.

        Raises
        ------
        ValueError
            When one of them is not finite.
        """
        parts = []
        for (dtype, _), (_, contents) in self._pools.items():
            content = b"".join(contents)
            if dtype.kind == "f" and not np.isfinite(np.frombuffer(content, dtype)).all():
                raise ValueError("the result holds a number that is not finite")
            parts.append(_padded(content))
        return b"".join(parts)


def _stored_arrays(described: Any, content: bytes, start: int) -> list[NDArray[Any]]:
    """Return all arrays by their numbers; their values start at byte ``start``."""
    by_number: dict[int, NDArray[Any]] = {}
    for dtype, shape, numbers in described:
        pool = np.frombuffer(content, dtype, len(numbers) * math.prod(shape), start)
        by_number.update(zip(numbers, pool.reshape(len(numbers), *shape), strict=True))
        start += _whole(pool.nbytes)
    return [by_number[number] for number in range(len(by_number))]


# --- columns -----------------------------------------------------------------------------------------------------------


class _Column(Protocol):
    """The values of one type as MessagePack, and back."""

    def encode(self, values: Sequence[Any], arrays: _Arrays) -> Any: ...

    def decode(self, stored: Any, arrays: list[NDArray[Any]]) -> list[Any]: ...


@functools.cache
def _column(kind: Any) -> _Column:
    origin, arguments = typing.get_origin(kind), typing.get_args(kind)
    if origin in (types.UnionType, typing.Union):
        present = _column(next(option for option in arguments if option is not type(None)))
        return present if isinstance(present, _PlainColumn) else _OptionalColumn(present)
    if origin is np.ndarray:
        return _ArrayColumn()
    if origin is tuple:
        if arguments[1:] == (Ellipsis,):
            return _SequenceColumn(_column(arguments[0]))
        return _TupleColumn([_column(argument) for argument in arguments])
    if dataclasses.is_dataclass(kind) and isinstance(kind, type):
        return _DataclassColumn(kind)
    if isinstance(kind, type) and issubclass(kind, Enum):
        return _EnumColumn(kind)
    return _PlainColumn()


class _PlainColumn:
    """Numbers, strings, truth values and None, which MessagePack holds unchanged."""

    def encode(self, values: Sequence[Any], arrays: _Arrays) -> Any:
        kinds = set(map(type, values))
        for kind in kinds - _PLAIN:
            if not issubclass(kind, np.generic):
                _refuse(kind)
            values = [value.item() if isinstance(value, np.generic) else value for value in values]
            return self.encode(values, arrays)
        if float in kinds:
            _check_finite(values if len(kinds) == 1 else [value for value in values if type(value) is float])
        return values

    def decode(self, stored: Any, arrays: list[NDArray[Any]]) -> list[Any]:
        return cast(list[Any], stored)


class _EnumColumn:
    """Members of one enum, by their values."""

    def __init__(self, kind: type[Enum]) -> None:
        self._kind = kind
        self._members = {member.value: member for member in kind}

    def encode(self, values: Sequence[Any], arrays: _Arrays) -> Any:
        _check_types(values, self._kind)
        return [value.value for value in values]

    def decode(self, stored: Any, arrays: list[NDArray[Any]]) -> list[Any]:
        return [self._members[value] for value in stored]


class _ArrayColumn:
    """Arrays, by their numbers."""

    def encode(self, values: Sequence[Any], arrays: _Arrays) -> Any:
        _check_types(values, np.ndarray)
        return list(map(arrays.add, values))

    def decode(self, stored: Any, arrays: list[NDArray[Any]]) -> list[Any]:
        return [arrays[number] for number in stored]


class _OptionalColumn:
    """Values that may be missing: which are there, and these."""

    def __init__(self, present: _Column) -> None:
        self._present = present

    def encode(self, values: Sequence[Any], arrays: _Arrays) -> Any:
        there = [value is not None for value in values]
        return there, self._present.encode([value for value in values if value is not None], arrays)

    def decode(self, stored: Any, arrays: list[NDArray[Any]]) -> list[Any]:
        there, present = stored
        following = iter(self._present.decode(present, arrays))
        return [next(following) if is_there else None for is_there in there]


class _SequenceColumn:
    """Tuples of any length: their lengths, and the members of all of them in one column."""

    def __init__(self, member: _Column) -> None:
        self._member = member

    def encode(self, values: Sequence[Any], arrays: _Arrays) -> Any:
        _check_types(values, tuple, list)
        return list(map(len, values)), self._member.encode(list(itertools.chain.from_iterable(values)), arrays)

    def decode(self, stored: Any, arrays: list[NDArray[Any]]) -> list[Any]:
        lengths, members = stored
        following = iter(self._member.decode(members, arrays))
        return [tuple(itertools.islice(following, length)) for length in lengths]


class _TupleColumn:
    """Tuples with the same types at the same places: one column for each place."""

    def __init__(self, places: Sequence[_Column]) -> None:
        self._places = places

    def encode(self, values: Sequence[Any], arrays: _Arrays) -> Any:
        _check_types(values, tuple, list)
        columns = list(zip(*values, strict=True)) or [()] * len(self._places)
        return [place.encode(column, arrays) for place, column in zip(self._places, columns, strict=True)]

    def decode(self, stored: Any, arrays: list[NDArray[Any]]) -> list[Any]:
        columns = [place.decode(column, arrays) for place, column in zip(self._places, stored, strict=True)]
        return list(zip(*columns, strict=True))


class _DataclassColumn:
    """Dataclasses of one kind: their number, and one column for each field."""

    def __init__(self, kind: type) -> None:
        self._kind = kind

    @functools.cached_property
    def _fields(self) -> list[tuple[str, _Column]]:
        # A dataclass may hold others of its own kind, so its fields are looked up at the first value.
        hints = typing.get_type_hints(self._kind)
        return [(field.name, _column(hints[field.name])) for field in dataclasses.fields(cast(Any, self._kind))]

    def encode(self, values: Sequence[Any], arrays: _Arrays) -> Any:
        if not values:
            return 0, []
        for kind in set(map(type, values)) - {self._kind}:
            _refuse(kind)
        return len(values), [
            column.encode(list(map(attrgetter(name), values)), arrays) for name, column in self._fields
        ]

    def decode(self, stored: Any, arrays: list[NDArray[Any]]) -> list[Any]:
        count, columns = stored
        made = list(map(object.__new__, itertools.repeat(cast(Any, self._kind), count)))
        if made:
            for (name, column), items in zip(self._fields, columns, strict=True):
                _set_all(made, name, column.decode(items, arrays))
        return made


def _set_all(objects: Sequence[Any], name: str, values: Sequence[Any]) -> None:
    """Set one field of many dataclasses, which may be frozen."""
    if len(objects) != len(values):
        raise ValueError(f"there are {len(values)} values of {name} for {len(objects)} objects")
    put: Callable[[Any, str, Any], None] = object.__setattr__
    deque(map(put, objects, itertools.repeat(name), values), maxlen=0)
