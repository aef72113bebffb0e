"""Stage results as bytes and back, exactly: equal values give equal bytes.

A stored result begins with three parts: eight bytes with the length of the second part, a compressed MessagePack tree, and the
numbers of all arrays. The tree holds columns: all values of one field of all dataclasses of one kind lie together, and an array is
its number. Arrays of one type and shape lie together too, each different one once. So reading a value costs no Python call of
its own, and thousands of small arrays cost little.

Blocks follow the arrays. A block is the stored form of one value by itself: a dataclass that asks for it (``stored_apart``), or
a partial result that a later job may use again. A block is copied into another stored result unchanged. Its fields are decoded
when they are first read.

A value also has a plain form, without compression and without the content of its blocks. Its hash identifies the value, so that
keys with values and blocks do not depend on the compressor. Nobody stores it.
"""

from __future__ import annotations

import bisect
import dataclasses
import functools
import gc
import hashlib
import itertools
import math
import threading
import types
import typing
import zlib
from collections import OrderedDict, deque
from collections.abc import Callable, Hashable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from enum import Enum
from operator import attrgetter
from typing import Any, NoReturn, Protocol, cast

import msgspec
import numpy as np
from numpy.typing import NDArray

from fluoromap_service.store.array_pools import (
    ArrayPools,
    Block,
    PackedPool,
    Pool,
    SharedArrays,
    from_steps,
    packed_arrays,
    packed_length,
    steps_between,
)

T = typing.TypeVar("T")

LAYOUT = 4
"""The number of the layout. It is part of every form, so that results of another one are computed again."""

_LENGTH_BYTES = 8
"""Bytes of the length with which a stored form begins."""
_LEVEL = 1
"""Compression level of the tree."""

_LEAST_SEARCHED_BYTES = 256
"""Fewest bytes of one type and shape in a partial result that are searched for arrays of the result."""
_FEW_ARRAYS = 32
"""Most arrays that are looked up one by one. For more of them, all arrays of the content are taken apart at once."""
_PLAIN = frozenset({str, int, float, bool, types.NoneType})
_SOURCE = "_stored_form"
_pack, _unpack = msgspec.msgpack.Encoder(), msgspec.msgpack.Decoder()
_Blocks = list[tuple[str, int]]  # hash, length
_Partial = dict[str, int]  # key, number of the block
_Tree = tuple[int, list[msgspec.Raw]]  # one value with its fields as columns
_Places = dict[tuple[np.dtype[Any], tuple[int, ...]], dict[bytes, tuple[int, int]]]
"""For arrays of each type and shape, by their bytes: number of a block, and number of the array in the block."""
_unpack_head = msgspec.msgpack.Decoder(tuple[str, list[PackedPool], list[SharedArrays], _Blocks, _Partial, _Tree])


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
    return _Encoded(value, finite).packed(partial)


def plain_form(value: Any) -> bytes:
    """Return the plain form of a value.

    It belongs into the key of a result that depends on the value. Nothing decodes it.

    Raises
    ------
    ValueError, TypeError
        As :func:`encode`.
    """
    return _Encoded(value, finite=True).plain()


class _Encoded:
    """A value as a tree of columns and arrays."""

    def __init__(self, value: Any, finite: bool) -> None:
        kind = type(value)
        if not dataclasses.is_dataclass(kind):
            _refuse(kind)
        self._form = form_of(_plain_kind(kind))
        self._arrays = ArrayPools(finite)
        with _without_collector():
            tree = _fields_column(_plain_kind(kind)).encode([value], self._arrays)
            self._tree = msgspec.Raw(_pack.encode(tree))
        self._pools = self._arrays.pools

    def plain(self) -> bytes:
        """Return the plain form."""
        pools = [(pool.dtype.str, pool.shape, pool.numbers) for pool in self._pools]
        blocks = [block.sha256 for block in self._arrays.blocks]
        head = _pack.encode((self._form, pools, blocks, self._tree))
        return b"".join([head, *(pool.content for pool in self._pools)])

    def packed(self, partial: Mapping[str, Block]) -> bytes:
        """Return the stored form, with partial results."""
        own = len(self._arrays.blocks)
        numbers = {key: self._arrays.add_block(block) for key, block in sorted(partial.items())}
        every = self._arrays.blocks
        # The blocks of the value itself hold arrays that are apart from its other ones.
        pools, shared = _take_out(self._pools, {number: every[number] for number in numbers.values() if number >= own})
        described = [pool.packed() for pool in pools]
        blocks = [(block.sha256, len(block.content)) for block in every]
        head = _pack.encode((self._form, [pool for pool, _ in described], shared, blocks, numbers, self._tree))
        head = zlib.compress(head, _LEVEL)
        parts = [len(head).to_bytes(_LENGTH_BYTES, "little"), head, *(content for _, content in described)]
        return b"".join([*parts, *(block.content for block in every)])


def _take_out(pools: list[Pool], blocks: Mapping[int, Block]) -> tuple[list[Pool], list[SharedArrays]]:
    """Take out the arrays that blocks hold too.

    Parameters
    ----------
    blocks : mapping of int to Block
        Blocks by their numbers. An array of several blocks belongs to the first of them.

    Returns
    -------
    The other arrays, and those that were taken out.
    """
    searched = {(pool.dtype, pool.shape) for pool in pools if pool.may_share()}
    if not searched:
        return pools, []
    # One table for all blocks: a search in each of them would take the square of the number of sites.
    known: _Places = {kind: {} for kind in searched}
    for number, block in blocks.items():
        if not searched.isdisjoint(_searched_kinds.of(block)):
            _Content(None, block.content).add_places(number, known)
    others, found = list[Pool](), dict[int, list[tuple[int, int]]]()
    for pool in pools:
        rest, shared = pool.without(known.get((pool.dtype, pool.shape), {}))
        for own, (number, there) in shared:
            found.setdefault(number, []).append((own, there))
        if rest.numbers:
            others.append(rest)
    return others, [_shared_arrays(number, sorted(found[number])) for number in blocks if number in found]


class _SearchedKinds:
    """The types and shapes of the arrays in blocks that are searched, by the hashes of the blocks.

    After a correction nearly all blocks are those of the job before.
    """

    _REMEMBERED = 8192

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._remembered: OrderedDict[str, frozenset[tuple[np.dtype[Any], tuple[int, ...]]]] = OrderedDict()

    def of(self, block: Block) -> frozenset[tuple[np.dtype[Any], tuple[int, ...]]]:
        """Return the types and shapes of a block's arrays."""
        with self._lock:
            known = self._remembered.get(block.sha256)
        if known is None:
            known = _Content(None, block.content).searched_kinds()
        with self._lock:
            self._remembered[block.sha256] = known
            self._remembered.move_to_end(block.sha256)
            while len(self._remembered) > self._REMEMBERED:
                self._remembered.popitem(last=False)
        return known


_searched_kinds = _SearchedKinds()


def _shared_arrays(block: int, numbers: Sequence[tuple[int, int]]) -> SharedArrays:
    own, there = zip(*numbers, strict=True)
    return block, steps_between(own), steps_between(there)


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


def undecoded(value: T) -> T:
    """Return a copy of a deferred value without decoded fields.

    The fields of the copy take memory only as long as the copy. A value that was not read from the store is returned unchanged.
    """
    source = _source_of(value)
    return value if source is None else deferred(_plain_kind(type(value)), source.sha256, lambda: source.content)


def block_of(value: Any, *, finite: bool = True) -> Block:
    """Return the stored form of one value.

    The form of a value that is stored apart is made only once.
    """
    source = _source_of(value)
    if source is not None:
        return Block(source.sha256, source.content)
    encoded = _Encoded(value, finite)
    content = encoded.packed({})
    block = Block(hashlib.sha256(encoded.plain()).hexdigest(), content)
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
    for name, one in _dataclasses_in(kind).items():
        hints = typing.get_type_hints(one)
        fields = [(field.name, str(hints[field.name])) for field in dataclasses.fields(one)]
        found[name] = [*fields, ("stored apart", "")] if _is_apart(one) else fields
    return hashlib.sha256(repr((LAYOUT, sorted(found.items()))).encode()).hexdigest()[:16]


def _dataclasses_in(kind: Any) -> dict[str, Any]:
    """Return the dataclasses of a type's form by their names."""
    found: dict[str, Any] = {}

    def visit(hint: Any) -> None:
        for argument in typing.get_args(hint):
            visit(argument)
        if dataclasses.is_dataclass(hint) and isinstance(hint, type) and hint.__qualname__ not in found:
            found[hint.__qualname__] = hint
            hints = typing.get_type_hints(hint)
            for field in dataclasses.fields(hint):
                visit(hints[field.name])

    visit(kind)
    return found


def prepare(kind: type[Any]) -> None:
    """Look up the types of a kind, for which its first reading would wait."""
    form_of(kind)
    for one in _dataclasses_in(kind).values():
        _ = _fields_column(one).fields
        if _is_apart(one):
            form_of(one)
            _deferred_kind(one)


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
    except (
        msgspec.DecodeError, zlib.error, AttributeError, IndexError, KeyError, TypeError, ValueError,
    ) as error:  # fmt: skip
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
    """The stored form of one value, taken apart. The arrays of one type and shape are read when one of them is needed."""

    def __init__(self, kind: type | None, content: bytes) -> None:
        with _stored_otherwise(kind or object):
            self._kind, self._content = kind, content
            end = _LENGTH_BYTES + int.from_bytes(content[:_LENGTH_BYTES], "little")
            head = zlib.decompress(content[_LENGTH_BYTES:end])
            form, pools, shared, blocks, self._partial, (count, columns) = _unpack_head.decode(head)
            self._pools: list[_StoredPool | _SharedPool] = []
            for pool in pools:
                read = functools.partial(packed_arrays, content, pool, end)
                self._pools.append(_StoredPool(np.dtype(pool[0]), pool[1], from_steps(pool[2]), read))
                end += packed_length(pool)
            for number, own, known in shared:
                self._pools.append(_SharedPool(self, number, from_steps(own), from_steps(known)))
            starts = itertools.accumulate((length for _, length in blocks), initial=end)
            self._blocks = [(sha256, start, length) for (sha256, length), start in zip(blocks, starts, strict=False)]
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
        for pool in self._pools:
            # Arrays are numbered as they come, so that the numbers of each pool rise.
            place = bisect.bisect_left(pool.numbers, number)
            if place < len(pool.numbers) and pool.numbers[place] == number:
                return pool.arrays[place]
        raise StoredOtherwise(f"there is no array of the number {number}")

    @functools.cached_property
    def _all_arrays(self) -> list[NDArray[Any]]:
        by_number: dict[int, NDArray[Any]] = {}
        for pool in self._pools:
            by_number.update(zip(pool.numbers, pool.arrays, strict=True))
        return [by_number[number] for number in range(len(by_number))]

    def searched_kinds(self) -> frozenset[tuple[np.dtype[Any], tuple[int, ...]]]:
        """Return the types and shapes of which :meth:`add_places` adds arrays."""
        return frozenset(
            (pool.dtype, pool.shape) for pool in self._pools if isinstance(pool, _StoredPool) and pool.is_searched()
        )

    def add_places(self, block: int, known: _Places) -> None:
        """Add the arrays of this block to the known ones.

        Only the types and shapes of the known arrays are added. A few small arrays are left out: reading them would take longer
        than storing them again.
        """
        for pool in self._pools:
            places = (
                known.get((pool.dtype, pool.shape)) if isinstance(pool, _StoredPool) and pool.is_searched() else None
            )
            if places is not None:
                for array, number in zip(pool.arrays, pool.numbers, strict=True):
                    places.setdefault(array.tobytes(), (block, number))

    def block(self, number: int) -> Block:
        """Return a block by its number."""
        sha256, start, length = self._blocks[number]
        return Block(sha256, self._content[start : start + length])

    def partial_results(self) -> dict[str, Block]:
        """Return the partial results by their keys."""
        return {key: self.block(number) for key, number in self._partial.items()}


class _StoredPool:
    """Arrays of one type and shape by rising numbers, read when one of them is needed."""

    def __init__(
        self, dtype: np.dtype[Any], shape: tuple[int, ...], numbers: list[int], read: Callable[[], NDArray[Any]]
    ) -> None:
        self.dtype, self.shape, self.numbers, self._read = dtype, shape, numbers, read

    def is_searched(self) -> bool:
        """Return whether another value may share enough of its arrays."""
        return self.dtype.itemsize * math.prod(self.shape) * len(self.numbers) >= _LEAST_SEARCHED_BYTES

    @functools.cached_property
    def arrays(self) -> list[NDArray[Any]]:
        """The arrays, in the order of their numbers."""
        return list(self._read())


class _SharedPool:
    """Arrays by rising numbers that a partial result of the same content holds."""

    def __init__(self, content: _Content, block: int, numbers: list[int], known: list[int]) -> None:
        self.numbers = numbers
        self._content, self._block, self._known = content, block, known

    @functools.cached_property
    def arrays(self) -> list[NDArray[Any]]:
        """The arrays, in the order of their numbers."""
        return _Content(None, self._content.block(self._block).content).take(self._known)


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
