"""Read-only arrays with a checked shape, for the fields of the contracts."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]
BoolArray = NDArray[np.bool_]
IntArray = NDArray[np.int64]


def frozen(value: ArrayLike, shape: tuple[int | None, ...], name: str, dtype: type = np.float64) -> NDArray[Any]:
    """Return a read-only copy of ``value`` after checking shape and numbers.

    A length of None in ``shape`` allows any length. Floating-point values must be finite. An array that is already a
    read-only copy is returned unchanged.

    Raises
    ------
    ValueError
        When shape or numbers are wrong. The message has the name of the field.
    """
    array: NDArray[Any]
    if isinstance(value, np.ndarray) and _is_frozen(value) and value.dtype == dtype:
        array = value
    else:
        # The order in memory is always by rows, so that an array read from the store equals the original in memory too.
        array = np.array(value, dtype=dtype, order="C")
    if array.shape != shape and (
        array.ndim != len(shape)
        or any(want is not None and have != want for have, want in zip(array.shape, shape, strict=True))
    ):
        raise ValueError(f"{name} has shape {array.shape}; it must have shape {shape}")
    if array.dtype.kind == "f" and np.count_nonzero(np.isfinite(array)) < array.size:
        raise ValueError(f"{name} contains numbers that are not finite")
    array.setflags(write=False)
    return array


def _is_frozen(array: NDArray[Any]) -> bool:
    """Return whether nobody can write to the array.

    Neither the array nor the memory that it shows is writeable.
    """
    if array.flags.writeable or not array.flags.c_contiguous:
        return False
    owner = array.base
    while isinstance(owner, np.ndarray):
        if owner.flags.writeable:
            return False
        owner = owner.base
    return owner is None or isinstance(owner, bytes)
