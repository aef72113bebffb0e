"""Stage results as bytes and back, exactly: equal values give equal bytes.

A stored result begins with three parts: eight bytes with the length of the second part, a MessagePack tree, and the numbers of all
arrays. The tree holds columns: all values of one field of all dataclasses of one kind lie together, and an array is its
number. Arrays of one type and shape lie together too, each different one once. So reading a value costs no Python call of
its own, and thousands of small arrays cost little.

Blocks follow the arrays. A block is the stored form of one value by itself: a dataclass that asks for it (``stored_apart``), or
a partial result that a later job may use again. A block is copied into another stored result unchanged. Its fields are decoded
when they are first read.
"""

from __future__ import annotations

import bisect
import dataclasses
import functools
import gc
import hashlib
import itertools
import math
import types
import typing
from collections import deque
from collections.abc import Callable, Hashable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from enum import Enum
from operator import attrgetter
from typing import Any, NoReturn, Protocol, cast

import msgspec
import numpy as np
from numpy.typing import NDArray

from fluoromap_service.store.array_pools import ALIGNMENT, ArrayPools, Block, padded, whole

T = typing.TypeVar("T")

LAYOUT = 3
"""The number of the layout of stored bytes. It is part of every form, so that results of another one are computed again."""

_FEW_ARRAYS = 32
"""Most arrays that are looked up one by one. For more of them, all arrays of the content are taken apart at once."""
_PLAIN = frozenset({str, int, float, bool, types.NoneType})
_SOURCE = "_stored_form"
_pack, _unpack = msgspec.msgpack.Encoder(), msgspec.msgpack.Decoder()
_Described = list[tuple[str, tuple[int, ...], list[int]]]
# form, arrays, blocks (hash, length), partial results (key, number of the block), one value with its fields as columns
_unpack_head = msgspec.msgpack.Decoder(
    tuple[str, _Described, list[tuple[str, int]], dict[str, int], tuple[int, list[msgspec.Raw]]]
)


class StoredOtherwise(ValueError):
    """The bytes are no stored result of this kind, or another version of the contracts stored them."""


def encode(value: Any, partial: Mapping[str, Block] = types.MappingProxyType({}), *, finite: bool = True) -> bytes:
    """Encode a dataclass of arrays, numbers, strings, enums, tuples and dataclasses.

    Parameters
    ----------
    value : dataclass
    partial : mapping of str to Block
        Partial results to store with it, by their keys; see :func:`partial_results`.
    finite : bool
        Whether to refuse numbers that are not finite.

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
    arrays = ArrayPools(finite)
    with _without_collector():
        tree = _fields_column(_plain_kind(kind)).encode([value], arrays)
        numbers = {key: arrays.add_block(block) for key, block in sorted(partial.items())}
        blocks = [(block.sha256, len(block.content)) for block in arrays.blocks]
        head = _pack.encode((form_of(_plain_kind(kind)), arrays.described(), blocks, numbers, tree))
    parts = [len(head).to_bytes(ALIGNMENT, "little"), padded(head), arrays.numbers()]
    return b"".join([*parts, *(padded(block.content) for block in arrays.blocks)])


def decode(kind: type[T], content: bytes) -> T:
    """Decode the bytes that :func:`encode` made of a ``kind``.

    The dataclasses do not check themselves again, because they did so before they were stored. Arrays are read-only. The
    fields of a value that is stored apart are decoded when they are first read.

    Raises
    ------
    StoredOtherwise
        When the bytes are no stored ``kind`` of these contracts.
    """
    stored = _Content(kind, content)
    made = object.__new__(kind)
    with _without_collector(), _stored_otherwise(kind):
        for name in stored.columns:
            object.__setattr__(made, name, stored.field(name))
    return made


def deferred(kind: type[T], sha256: str, read: Callable[[], bytes]) -> T:
    """Return a dataclass whose fields are decoded when they are first read.

    Parameters
    ----------
    kind : type
        A dataclass without slots.
    sha256 : str
        Hash of the stored form.
    read : callable
        Returns the stored form; called once, for the first field.
    """
    made: T = object.__new__(_deferred_kind(cast(Hashable, kind)))
    made.__dict__[_SOURCE] = _Source(kind, sha256, read)
    return made


def block_of(value: Any, *, finite: bool = True) -> Block:
    """Return the stored form of one value.

    The form of a value that is stored apart is made only once.
    """
    source = _source_of(value)
    if source is not None:
        return Block(source.sha256, source.content)
    content = encode(value, finite=finite)
    block = Block(hashlib.sha256(content).hexdigest(), content)
    if _is_apart(type(value)):
        value.__dict__[_SOURCE] = _Source(type(value), block.sha256, lambda: content)
    return block


def partial_results(content: bytes) -> Mapping[str, Block]:
    """Return the partial results that were stored with a result, by their keys.

    Raises
    ------
    StoredOtherwise
        When the bytes are no stored result of this layout.
    """
    with _stored_otherwise(object):
        return _Content(None, content).partial_results()


def form_of(kind: type[Any]) -> str:
    """Return the hash of a type's form, which changes when a contract or the layout does.

    The form is the layout, the names and types of its fields, whether it is stored apart, and the same of all dataclasses in it.
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
            found[hint.__qualname__] = [*fields, ("stored apart", "")] if _is_apart(hint) else fields
            for field in dataclasses.fields(hint):
                visit(hints[field.name])

    visit(kind)
    return hashlib.sha256(repr((LAYOUT, sorted(found.items()))).encode()).hexdigest()[:16]


def block_hash(value: Any) -> str | None:
    """Return the hash of the form of a value that is stored apart.

    None for another value. A value that was read from the store knows it, and is not decoded.
    """
    source = _source_of(value)
    if source is not None:
        return source.sha256
    return block_of(value).sha256 if _is_apart(type(value)) else None


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


@contextmanager
def _stored_otherwise(kind: type) -> Iterator[None]:
    """Turn the errors of bytes of another form into :class:`StoredOtherwise`."""
    try:
        yield
    except StoredOtherwise:
        raise
    except (msgspec.DecodeError, AttributeError, IndexError, KeyError, TypeError, ValueError) as error:
        raise StoredOtherwise(f"these bytes are no stored {kind}") from error


def _refuse(kind: type) -> NoReturn:
    raise TypeError(f"a result holds a {kind.__name__}, which is never stored")


def _check_types(values: Iterable[Any], *allowed: type) -> None:
    for kind in set(map(type, values)):
        if not issubclass(kind, allowed):
            _refuse(kind)


def _check_finite(numbers: Iterable[float]) -> None:
    if not all(map(math.isfinite, numbers)):
        raise ValueError("the result holds a number that is not finite")


class _Content:
    """The stored form of one value, taken apart. Its arrays are read when the first one is needed."""

    def __init__(self, kind: type | None, content: bytes) -> None:
        with _stored_otherwise(kind or object):
            self._kind, self._content = kind, content
            end = ALIGNMENT + int.from_bytes(content[:ALIGNMENT], "little")
            form, self._described, self._blocks, self._partial, (count, columns) = _unpack_head.decode(
                content[ALIGNMENT:end]
            )
            self._start = whole(end)
            if kind is None:
                return
            if form != form_of(kind) or count != 1:
                raise StoredOtherwise(f"another version of the contracts stored this {kind}")
            names = [name for name, _ in _fields_column(kind).fields]
            self.columns = dict(zip(names, columns, strict=True))

    def field(self, name: str) -> Any:
        """Decode one field."""
        assert self._kind is not None, "partial results have no fields of their own"
        column = dict(_fields_column(self._kind).fields)[name]
        (value,) = column.decode(_unpack.decode(self.columns[name]), self)
        return value

    def take(self, numbers: Sequence[int]) -> list[NDArray[Any]]:
        """Return arrays by their numbers."""
        if len(numbers) <= _FEW_ARRAYS and "_all_arrays" not in self.__dict__:
            return list(map(self._array, numbers))
        every = self._all_arrays
        return [every[number] for number in numbers]

    def _array(self, number: int) -> NDArray[Any]:
        for numbers, pool in self._pools:
            # Arrays are numbered as they come, so that the numbers of each pool rise.
            place = bisect.bisect_left(numbers, number)
            if place < len(numbers) and numbers[place] == number:
                found: NDArray[Any] = pool[place]
                return found
        raise StoredOtherwise(f"there is no array of the number {number}")

    @functools.cached_property
    def _all_arrays(self) -> list[NDArray[Any]]:
        by_number: dict[int, NDArray[Any]] = {}
        for numbers, pool in self._pools:
            by_number.update(zip(numbers, pool, strict=True))
        return [by_number[number] for number in range(len(by_number))]

    @functools.cached_property
    def _pools(self) -> list[tuple[list[int], NDArray[Any]]]:
        pools = []
        start = self._start
        for dtype, shape, numbers in self._described:
            pool = np.frombuffer(self._content, dtype, len(numbers) * math.prod(shape), start)
            pools.append((numbers, pool.reshape(len(numbers), *shape)))
            start += whole(pool.nbytes)
        return pools

    @functools.cached_property
    def _starts_of_blocks(self) -> list[int]:
        start = self._start
        for dtype, shape, numbers in self._described:
            start += whole(np.dtype(dtype).itemsize * math.prod(shape) * len(numbers))
        return [start, *itertools.accumulate((whole(length) for _, length in self._blocks), initial=start)][1:]

    def block(self, number: int) -> Block:
        """Return a block by its number."""
        sha256, length = self._blocks[number]
        start = self._starts_of_blocks[number]
        return Block(sha256, self._content[start : start + length])

    def partial_results(self) -> dict[str, Block]:
        """Return the partial results by their keys."""
        return {key: self.block(number) for key, number in self._partial.items()}


# --- values that are decoded when they are read ------------------------------------------------------------------------


class _Source:
    """The stored form of a value, read when it is first needed."""

    def __init__(self, kind: type, sha256: str, read: Callable[[], bytes]) -> None:
        self.kind, self.sha256, self._read = kind, sha256, read

    @functools.cached_property
    def content(self) -> bytes:
        return self._read()

    @functools.cached_property
    def _taken_apart(self) -> _Content:
        return _Content(self.kind, self.content)

    def field(self, name: str) -> Any:
        """Decode one field."""
        with _without_collector(), _stored_otherwise(self.kind):
            return self._taken_apart.field(name)


class _DeferredField:
    """A field that is decoded when it is first read; then the object itself holds it."""

    def __init__(self, name: str) -> None:
        self._name = name

    def __get__(self, owner: Any, kind: type) -> Any:
        if owner is None:
            return self
        value = owner.__dict__[self._name] = owner.__dict__[_SOURCE].field(self._name)
        return value


@functools.cache
def _deferred_kind(kind: Any) -> Any:
    fields = {field.name: _DeferredField(field.name) for field in dataclasses.fields(kind)}
    return type(kind.__name__, (kind,), {**fields, "__module__": kind.__module__, "_decoded": kind})


def _plain_kind(kind: Any) -> Any:
    """Return the dataclass behind one with deferred fields."""
    return kind.__dict__.get("_decoded", kind)


def _source_of(value: Any) -> _Source | None:
    return cast("_Source | None", getattr(value, "__dict__", {}).get(_SOURCE))


def _is_apart(kind: Any) -> bool:
    return bool(getattr(kind, "stored_apart", False))


# --- columns -----------------------------------------------------------------------------------------------------------


class _Column(Protocol):
    """The values of one type as MessagePack, and back."""

    def encode(self, values: Sequence[Any], arrays: ArrayPools) -> Any: ...

    def decode(self, stored: Any, arrays: _Content) -> list[Any]: ...


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
        return _ApartColumn(kind) if _is_apart(kind) else _fields_column(cast(Hashable, kind))
    if isinstance(kind, type) and issubclass(kind, Enum):
        return _EnumColumn(kind)
    return _PlainColumn()


@functools.cache
def _fields_column(kind: Any) -> _DataclassColumn:
    return _DataclassColumn(kind)


class _PlainColumn:
    """Numbers, strings, truth values and None, which MessagePack holds unchanged."""

    def encode(self, values: Sequence[Any], arrays: ArrayPools) -> Any:
        kinds = set(map(type, values))
        for kind in kinds - _PLAIN:
            if not issubclass(kind, np.generic):
                _refuse(kind)
            values = [value.item() if isinstance(value, np.generic) else value for value in values]
            return self.encode(values, arrays)
        if arrays.finite and float in kinds:
            _check_finite(values if len(kinds) == 1 else [value for value in values if type(value) is float])
        return values

    def decode(self, stored: Any, arrays: _Content) -> list[Any]:
        return cast(list[Any], stored)


class _EnumColumn:
    """Members of one enum, by their values."""

    def __init__(self, kind: type[Enum]) -> None:
        self._kind = kind
        self._members = {member.value: member for member in kind}

    def encode(self, values: Sequence[Any], arrays: ArrayPools) -> Any:
        _check_types(values, self._kind)
        return [value.value for value in values]

    def decode(self, stored: Any, arrays: _Content) -> list[Any]:
        return [self._members[value] for value in stored]


class _ArrayColumn:
    """Arrays, by their numbers."""

    def encode(self, values: Sequence[Any], arrays: ArrayPools) -> Any:
        _check_types(values, np.ndarray)
        return list(map(arrays.add, values))

    def decode(self, stored: Any, arrays: _Content) -> list[Any]:
        return arrays.take(stored)


class _OptionalColumn:
    """Values that may be missing: which are there, and these."""

    def __init__(self, present: _Column) -> None:
        self._present = present

    def encode(self, values: Sequence[Any], arrays: ArrayPools) -> Any:
        there = [value is not None for value in values]
        return there, self._present.encode([value for value in values if value is not None], arrays)

    def decode(self, stored: Any, arrays: _Content) -> list[Any]:
        there, present = stored
        following = iter(self._present.decode(present, arrays))
        return [next(following) if is_there else None for is_there in there]


class _SequenceColumn:
    """Tuples of any length: their lengths, and the members of all of them in one column."""

    def __init__(self, member: _Column) -> None:
        self._member = member

    def encode(self, values: Sequence[Any], arrays: ArrayPools) -> Any:
        _check_types(values, tuple, list)
        return list(map(len, values)), self._member.encode(list(itertools.chain.from_iterable(values)), arrays)

    def decode(self, stored: Any, arrays: _Content) -> list[Any]:
        lengths, members = stored
        following = iter(self._member.decode(members, arrays))
        return [tuple(itertools.islice(following, length)) for length in lengths]


class _TupleColumn:
    """Tuples with the same types at the same places: one column for each place."""

    def __init__(self, places: Sequence[_Column]) -> None:
        self._places = places

    def encode(self, values: Sequence[Any], arrays: ArrayPools) -> Any:
        _check_types(values, tuple, list)
        columns = list(zip(*values, strict=True)) or [()] * len(self._places)
        return [place.encode(column, arrays) for place, column in zip(self._places, columns, strict=True)]

    def decode(self, stored: Any, arrays: _Content) -> list[Any]:
        columns = [place.decode(column, arrays) for place, column in zip(self._places, stored, strict=True)]
        return list(zip(*columns, strict=True))


class _DataclassColumn:
    """Dataclasses of one kind: their number, and one column for each field."""

    def __init__(self, kind: type) -> None:
        self._kind = kind

    @functools.cached_property
    def fields(self) -> list[tuple[str, _Column]]:
        # A dataclass may hold others of its own kind, so its fields are looked up at the first value.
        hints = typing.get_type_hints(self._kind)
        return [(field.name, _column(hints[field.name])) for field in dataclasses.fields(cast(Any, self._kind))]

    def encode(self, values: Sequence[Any], arrays: ArrayPools) -> Any:
        if not values:
            return 0, []
        for kind in set(map(type, values)):
            if _plain_kind(kind) is not self._kind:
                _refuse(kind)
        return len(values), [column.encode(list(map(attrgetter(name), values)), arrays) for name, column in self.fields]

    def decode(self, stored: Any, arrays: _Content) -> list[Any]:
        count, columns = stored
        made = list(map(object.__new__, itertools.repeat(cast(Any, self._kind), count)))
        if made:
            for (name, column), items in zip(self.fields, columns, strict=True):
                _set_all(made, name, column.decode(items, arrays))
        return made


class _ApartColumn:
    """Dataclasses that are stored by themselves: the numbers of their blocks."""

    def __init__(self, kind: type) -> None:
        self._kind = kind

    def encode(self, values: Sequence[Any], arrays: ArrayPools) -> Any:
        _check_types(values, self._kind)
        return [arrays.add_block(block_of(value, finite=arrays.finite)) for value in values]

    def decode(self, stored: Any, arrays: _Content) -> list[Any]:
        blocks = [arrays.block(number) for number in stored]
        return [deferred(self._kind, block.sha256, functools.partial(_content_of, block)) for block in blocks]


def _content_of(block: Block) -> bytes:
    return block.content


def _set_all(objects: Sequence[Any], name: str, values: Sequence[Any]) -> None:
    """Set one field of many dataclasses, which may be frozen."""
    if len(objects) != len(values):
        raise ValueError(f"there are {len(values)} values of {name} for {len(objects)} objects")
    put: Callable[[Any, str, Any], None] = object.__setattr__
    deque(map(put, objects, itertools.repeat(name), values), maxlen=0)
