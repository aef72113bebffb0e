"""The arrays and blocks of a stored result, each different one once."""

from __future__ import annotations

import functools
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

ALIGNMENT = 8
"""Bytes of a word: each part of a stored result begins at a whole number of words."""


@dataclass(frozen=True, slots=True)
class Block:
    """The stored form of one value, and its hash."""

    sha256: str
    content: bytes


def whole(length: int) -> int:
    """Return a length rounded up to whole words."""
    return -(-length // ALIGNMENT) * ALIGNMENT


def padded(content: bytes) -> bytes:
    """Return the content with zeros up to whole words."""
    return content + bytes(whole(len(content)) - len(content))


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
            if self.finite and dtype.kind == "f" and not np.isfinite(np.frombuffer(content, dtype)).all():
                raise ValueError("the result holds a number that is not finite")
            parts.append(padded(content))
        return b"".join(parts)
