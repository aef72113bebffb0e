"""The arrays and blocks of a stored result, each different one once, and the compression of the arrays.

Nothing is lost: arrays come back bit for bit. Three things make them small:

- Of symmetric matrices only the upper halves are stored.
- The first bytes of all numbers lie together, then the second bytes, and so on. Neighbouring numbers have similar signs and
  exponents, so these bytes compress well. The last bytes of a measured number are noise: they are stored uncompressed, which
  saves the time of trying.
- An array that a partial result of the same file holds too is stored only there.
"""

from __future__ import annotations

import functools
import itertools
import math
import zlib
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

_LEAST_PACKED_BYTES = 4096
"""Smaller pools are stored plain. A study has thousands of them, and reading a compressed pool takes longer than it saves."""
_LEAST_SHARED_BYTES = 4096
"""In smaller pools a search for arrays of partial results saves nothing."""
_MOST_BITS = 7.5
"""Bytes with more information than this are stored uncompressed: trying them takes time and saves little."""
_LEVEL = 1
"""Compression level. Higher ones save little more and take longer."""

Place = TypeVar("Place")

PackedPool = tuple[str, tuple[int, ...], list[int], bool, list[int]]
"""Type, shape of one array, steps between the numbers of the arrays, whether only upper halves are stored, and the stored length of
each byte of the numbers. Without lengths the numbers are stored plain."""
SharedArrays = tuple[int, list[int], list[int]]
"""Number of a block, steps between the numbers of arrays, and steps between the numbers that these arrays have in the block."""


@dataclass(frozen=True, slots=True)
class Block:
    """The stored form of one value, and the hash of its plain form."""

    sha256: str
    content: bytes


class ArrayPools:
    """The different arrays and blocks of one value, numbered as they come. Arrays are gathered by type and shape."""

    def __init__(self, finite: bool) -> None:
        self.finite = finite
        self._numbers: dict[tuple[np.dtype[Any], tuple[int, ...], bytes], int] = {}
        self._blocks: dict[str, tuple[int, Block]] = {}

    def add(self, array: NDArray[Any]) -> int:
        """Add an array and return its number."""
        return self._numbers.setdefault((array.dtype, array.shape, array.tobytes()), len(self._numbers))

    def add_block(self, block: Block) -> int:
        """Add a block and return its number."""
        return self._blocks.setdefault(block.sha256, (len(self._blocks), block))[0]

    @property
    def blocks(self) -> list[Block]:
        """All blocks by their numbers."""
        return [block for _, block in self._blocks.values()]

    @functools.cached_property
    def pools(self) -> list[Pool]:
        """The arrays of each type and shape.

        Raises
        ------
        TypeError
            When an array holds no real numbers.
        ValueError
            When a number is not finite.
        """
        gathered: dict[tuple[np.dtype[Any], tuple[int, ...]], tuple[list[int], list[bytes]]] = {}
        for (dtype, shape, content), number in self._numbers.items():
            numbers, contents = gathered.setdefault((dtype, shape), ([], []))
            numbers.append(number)
            contents.append(content)
        for dtype, _ in gathered:
            if dtype.kind not in "biuf":
                raise TypeError(f"a result holds an array of {dtype}, which is never stored")
        pools = [
            Pool(dtype, shape, numbers, b"".join(contents)) for (dtype, shape), (numbers, contents) in gathered.items()
        ]
        if self.finite and not all(pool.is_finite() for pool in pools):
            raise ValueError("the result holds a number that is not finite")
        return pools


@dataclass(frozen=True, slots=True)
class Pool:
    """Arrays of one type and shape, by rising numbers. content : their numbers, array by array."""

    dtype: np.dtype[Any]
    shape: tuple[int, ...]
    numbers: list[int]
    content: bytes

    def is_finite(self) -> bool:
        """Return whether all numbers are finite."""
        return self.dtype.kind != "f" or bool(np.isfinite(np.frombuffer(self.content, self.dtype)).all())

    def packed(self) -> tuple[PackedPool, bytes]:
        """Return the description of the pool, and its content in fewer bytes."""
        numbers = np.frombuffer(self.content, self.dtype)
        halved = _are_symmetric(numbers, self.shape)
        if halved:
            side = self.shape[-1]
            numbers = numbers.reshape(-1, side, side)[:, *_upper_half(side)].ravel()
        parts = _pack(numbers) if numbers.nbytes >= _LEAST_PACKED_BYTES else []
        described = self.dtype.str, self.shape, steps_between(self.numbers), halved, list(map(len, parts))
        return described, b"".join(parts) if parts else numbers.tobytes()

    def without(self, known: dict[bytes, Place]) -> tuple[Pool, list[tuple[int, Place]]]:
        """Take out the arrays whose contents are known.

        Returns
        -------
        The other arrays; the numbers of the known arrays with the places where they are known.
        """
        if not known:
            return self, []
        size = self.dtype.itemsize * math.prod(self.shape)
        numbers, contents, shared = list[int](), list[bytes](), list[tuple[int, Place]]()
        for index, number in enumerate(self.numbers):
            content = self.content[index * size : (index + 1) * size]
            place = known.get(content)
            if place is None:
                numbers.append(number)
                contents.append(content)
            else:
                shared.append((number, place))
        return Pool(self.dtype, self.shape, numbers, b"".join(contents)), shared

    def may_share(self) -> bool:
        """Return whether a search for its arrays in partial results may save bytes."""
        return len(self.content) >= _LEAST_SHARED_BYTES


def packed_arrays(content: bytes, pool: PackedPool, start: int) -> NDArray[Any]:
    """Return the arrays of a packed pool as one read-only array.

    ``start`` is the place of its first byte in the content.

    Raises
    ------
    ValueError, zlib.error
        When the bytes are not those that :meth:`Pool.packed` returned.
    """
    name, shape, steps, halved, lengths = pool
    dtype, count = np.dtype(name), _stored_count(pool)
    stored = content[start : start + packed_length(pool)]
    numbers = _unpack(stored, lengths, count, dtype) if lengths else stored
    found = np.frombuffer(numbers, dtype, count)
    if halved:
        # The memory of a bytes object is read-only for good, so nobody has to copy the arrays.
        found = np.frombuffer(_with_lower_halves(found, shape[-1]).tobytes(), dtype)
    return found.reshape(len(steps), *shape)


def packed_length(pool: PackedPool) -> int:
    """Return the stored bytes of a packed pool."""
    name, _, _, _, lengths = pool
    return sum(lengths) if lengths else np.dtype(name).itemsize * _stored_count(pool)


def steps_between(numbers: Sequence[int]) -> list[int]:
    """Return the first number and the steps to the following ones, which compress better."""
    return [after - before for before, after in itertools.pairwise([0, *numbers])]


def from_steps(steps: Sequence[int]) -> list[int]:
    """Return the numbers with these steps."""
    return list(itertools.accumulate(steps))


def _are_symmetric(numbers: NDArray[Any], shape: tuple[int, ...]) -> bool:
    """Return whether all are symmetric matrices, bit for bit."""
    if len(shape) < 2 or shape[-1] != shape[-2] or shape[-1] < 2 or not numbers.size:
        return False
    bits = numbers.view(f"u{numbers.dtype.itemsize}") if numbers.dtype.itemsize in (1, 2, 4, 8) else numbers
    matrices = bits.reshape(-1, *shape[-2:])
    return bool((matrices == matrices.transpose(0, 2, 1)).all())


def _stored_count(pool: PackedPool) -> int:
    """Return how many numbers are stored."""
    _, shape, steps, halved, _ = pool
    one = math.prod(shape[:-2]) * len(_upper_half(shape[-1])[0]) if halved else math.prod(shape)
    return len(steps) * one


@functools.cache
def _upper_half(side: int) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Return the rows and columns of the upper half of a matrix, with its diagonal."""
    return np.triu_indices(side)


def _with_lower_halves(upper: NDArray[Any], side: int) -> NDArray[Any]:
    """Return symmetric matrices (n, side, side) from all numbers of their upper halves."""
    rows, columns = _upper_half(side)
    places = np.empty((side, side), np.intp)
    places[rows, columns] = places[columns, rows] = np.arange(len(rows))
    return np.asarray(upper.reshape(-1, len(rows))[:, places])


def _pack(numbers: NDArray[Any]) -> list[bytes]:
    """Return each byte of the numbers, compressed where that saves something."""
    return [_fewer_bytes(each) for each in _bytes_of(numbers).T.copy()]


def _bytes_of(numbers: NDArray[Any]) -> NDArray[np.uint8]:
    return numbers.view(np.uint8).reshape(-1, numbers.dtype.itemsize)


def _fewer_bytes(content: NDArray[np.uint8]) -> bytes:
    shares = np.bincount(content, minlength=256) / len(content)
    shares = shares[shares > 0]
    if -(shares * np.log2(shares)).sum() <= _MOST_BITS:
        stream = zlib.compressobj(_LEVEL, zlib.DEFLATED, -zlib.MAX_WBITS)
        compressed = stream.compress(content.data) + stream.flush()
        if len(compressed) < len(content):
            return compressed
    return content.tobytes()


def _unpack(content: bytes, lengths: Sequence[int], count: int, dtype: np.dtype[Any]) -> bytes:
    """Return the bytes of ``count`` numbers, the opposite of :func:`_pack`."""
    unpacked = np.empty((dtype.itemsize, count), np.uint8)
    start = 0
    for column, length in zip(unpacked, lengths, strict=True):
        part = content[start : start + length]
        start += length
        if length < count:
            part = zlib.decompressobj(-zlib.MAX_WBITS).decompress(part, count)
        if len(part) != count:
            raise ValueError(f"{len(part)} numbers are stored; the description says {count}")
        column[:] = np.frombuffer(part, np.uint8)
    return unpacked.T.tobytes()
