"""The orientation of the stored image: flips and quarter turns, from the header and into it.

An image is upright when a frontal view shows the patient's left on its right and the head on top: its axes are the first two
of :func:`fluoromap.geometry.view_axes`. ``image_axes`` takes offsets (u, v) of that image to offsets of the stored image.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from fluoromap.geometry.gantry import UPRIGHT, ImageAxes, view_axes

Array = NDArray[np.float64]

_LETTERS = {"L": (0, 1), "R": (0, -1), "P": (1, 1), "A": (1, -1), "H": (2, 1), "F": (2, -1)}
# The name of a direction has its main letter, and the letters of axes to which it leans by more than about 12 degrees.
_LEAN = 0.2
# PatientOrientation names directions to within about 30 degrees in each axis.
_AGREEMENT = 0.6

_TURN: Array = np.array([[0, -1], [1, 0]], dtype=np.float64)
_FLIP: Array = np.array([[-1, 0], [0, 1]], dtype=np.float64)


def image_axes_from_field_of_view(rotation_deg: float, flipped: bool) -> ImageAxes | None:
    """Return the image axes of a field of view.

    First FieldOfViewRotation (0018,7032), clockwise, then FieldOfViewHorizontalFlip (0018,7034); PS3.3 C.8.11.4. None when the
    rotation is no multiple of 90 degrees.
    """
    turns = rotation_deg / 90
    if turns != round(turns):
        return None
    axes = np.linalg.matrix_power(_TURN, round(turns) % 4)
    return _as_axes(_FLIP @ axes if flipped else axes)


def field_of_view_of(image_axes: ImageAxes) -> tuple[int, bool]:
    """Return FieldOfViewRotation and FieldOfViewHorizontalFlip of image axes."""
    for turns, flipped in itertools.product(range(4), (False, True)):
        if image_axes_from_field_of_view(90.0 * turns, flipped) == image_axes:
            return 90 * turns, flipped
    raise ValueError(
        f"image_axes is {image_axes}; it must be a turn by 0, 90, 180 or 270 degrees, with or without a flip"
    )


def image_axes_from_orientation(
    orientation: Sequence[str], primary_deg: float, secondary_deg: float
) -> ImageAxes | None:
    """Return the image axes that agree best with PatientOrientation (0020,0020).

    Parameters
    ----------
    orientation : two str
        Direction of the rows (+u) and of the columns (+v) in letters of L, R, P, A, H, F, the main one first.

    Returns
    -------
    ImageAxes or None
        None when the letters fit no flip or turn of these gantry angles.
    """
    named = [_direction(letters) for letters in orientation]
    if len(named) != 2 or named[0] is None or named[1] is None:
        return None
    letters = np.stack([named[0], named[1]])
    upright = view_axes(primary_deg, secondary_deg)[:2]
    candidates = [
        np.linalg.matrix_power(_TURN, turns) if not flip else _FLIP @ np.linalg.matrix_power(_TURN, turns)
        for flip in (False, True)
        for turns in range(4)
    ]
    agreements = [np.sum(letters * (axes @ upright), axis=1) for axes in candidates]
    best = max(range(len(candidates)), key=lambda index: float(agreements[index].sum()))
    return _as_axes(candidates[best]) if agreements[best].min() >= _AGREEMENT else None


def patient_orientation(primary_deg: float, secondary_deg: float, image_axes: ImageAxes = UPRIGHT) -> tuple[str, str]:
    """Return PatientOrientation (0020,0020) of a stored image."""
    rows, columns = np.array(image_axes, dtype=np.float64) @ view_axes(primary_deg, secondary_deg)[:2]
    return _letters(rows), _letters(columns)


def _letters(direction: Array) -> str:
    order = sorted(range(3), key=lambda axis: -abs(float(direction[axis])))
    return "".join(
        "LPH"[axis] if direction[axis] > 0 else "RAF"[axis] for axis in order if abs(float(direction[axis])) > _LEAN
    )


def _direction(letters: str) -> Array | None:
    direction = np.zeros(3)
    for position, letter in enumerate(letters.strip().upper()):
        if letter not in _LETTERS or position > 2:
            return None
        axis, sign = _LETTERS[letter]
        if direction[axis]:
            return None
        direction[axis] = sign * 0.5**position
    length = float(np.linalg.norm(direction))
    return direction / length if length else None


def _as_axes(matrix: Array) -> ImageAxes:
    rounded = np.rint(matrix).astype(int).tolist()
    return ((rounded[0][0], rounded[0][1]), (rounded[1][0], rounded[1][1]))
