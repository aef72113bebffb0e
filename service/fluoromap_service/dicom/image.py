"""The meaning of the stored pixels: intensity relationship, bits, display window and shutter."""

from __future__ import annotations

from fluoromap.contracts import PixelFacts, Shutter
from fluoromap_service.dicom.facts import HeaderWarning, Pair
from fluoromap_service.dicom.header import Header

_Rectangle = tuple[float, float, float, float]
_Circle = tuple[float, float, float]


def pixel_facts(header: Header, rows: int, columns: int, bits_stored: int, warnings: list[HeaderWarning]) -> PixelFacts:
    """Return the meaning of the pixels.

    ``bits_stored`` is measured, because BitsStored (0028,0101) may be wrong. PixelIntensityRelationship (0028,1040) is LIN,
    LOG or DISP, PS3.3 C.8.7.1.1.2. GE also writes DRM: prepared for display, with a compressed dynamic range.
    PixelIntensityRelationshipSign (0028,1041) is -1 where high values mean few photons, PS3.3 C.8.19.6.2. It counts before the
    PhotometricInterpretation, which says how the picture is displayed.
    """
    relationship = header.text("PixelIntensityRelationship")
    if relationship not in ("LIN", "LOG", "DISP", "DRM"):
        warnings.append(HeaderWarning.PIXEL_INTENSITY_UNKNOWN)
    sign = header.number("PixelIntensityRelationshipSign")
    return PixelFacts(
        logarithmic=relationship != "LIN",
        bits_stored=bits_stored,
        monochrome1=header.text("PhotometricInterpretation") == "MONOCHROME1" if sign not in (-1, 1) else sign == -1,
        shutter=_shutter(header, rows, columns, warnings),
    )


LEAST_GREYS = 0.25
"""Part of a display window that the possible pixel values must fill; below it the picture is nearly black or white.

A window for 16 bits over pixels of 12 bits shows 16 of 256 greys. A window that is meant for other units lies beside all values.
"""


def window(header: Header, bits_stored: int, warnings: list[HeaderWarning]) -> Pair | None:
    """Return the first display window (centre, width): WindowCenter (0028,1050), WindowWidth (0028,1051).

    A window that shows hardly any of the values that pixels of ``bits_stored`` bits can have is ignored.
    """
    centre, width = header.number("WindowCenter"), header.number("WindowWidth")
    if centre is None or width is None or width < 1:
        return None
    low, high = max(centre - width / 2, 0), min(centre + width / 2, (1 << bits_stored) - 1)
    if high - low < LEAST_GREYS * (width - 1):
        warnings.append(HeaderWarning.WINDOW_IGNORED)
        return None
    return centre, width


def r_wave_frames(header: Header, frames: int, warnings: list[HeaderWarning]) -> tuple[int, ...]:
    """Return the frames of R waves, counted from 0, ascending.

    RWavePointer (0028,6040) counts from 1.
    """
    pointers = {int(value) - 1 for value in header.numbers("RWavePointer")}
    inside = tuple(sorted(frame for frame in pointers if 0 <= frame < frames))
    if len(inside) < len(pointers):
        warnings.append(HeaderWarning.R_WAVES_IGNORED)
    return inside


def _shutter(header: Header, rows: int, columns: int, warnings: list[HeaderWarning]) -> Shutter | None:
    """Return the exposed part of the image, in pixels from 0.

    Collimator (0018,1700) ff. and display shutter (0018,1600) ff., PS3.3 C.8.7.4 and C.7.6.11; both count from 1.
    """
    rectangle: _Rectangle | None = None
    circle: _Circle | None = None
    polygon: tuple[Pair, ...] | None = None
    for kind in ("Collimator", "Shutter"):
        for shape in header.texts(f"{kind}Shape"):
            match shape:
                case "RECTANGULAR" if edges := _rectangle(header, kind, rows, columns):
                    rectangle = _overlap(rectangle, edges)
                case "CIRCULAR" if found := _circle(header, kind):
                    circle = min(circle or found, found, key=lambda each: each[2])
                case "POLYGONAL" if vertices := _polygon(header, kind):
                    polygon = vertices
                case _:
                    warnings.append(HeaderWarning.SHUTTER_IGNORED)
    if rectangle is not None and not (rectangle[0] < rectangle[1] and rectangle[2] < rectangle[3]):
        warnings.append(HeaderWarning.SHUTTER_IGNORED)
        rectangle = None
    if rectangle is None and circle is None and polygon is None:
        return None
    return Shutter(rectangle, circle, polygon)


def _rectangle(header: Header, kind: str, rows: int, columns: int) -> _Rectangle | None:
    edges = [
        header.number(f"{kind}{edge}Edge")
        for edge in ("LeftVertical", "RightVertical", "UpperHorizontal", "LowerHorizontal")
    ]
    left, right, upper, lower = edges
    if left is None or right is None or upper is None or lower is None or left >= right or upper >= lower:
        return None
    if right <= 1 or lower <= 1 or left >= columns or upper >= rows:
        return None
    return left - 1, right - 1, upper - 1, lower - 1


def _circle(header: Header, kind: str) -> _Circle | None:
    centre, radius = header.numbers(f"CenterOfCircular{kind}"), header.number(f"RadiusOfCircular{kind}")
    if len(centre) != 2 or radius is None or radius <= 0:
        return None
    row, column = centre
    return column - 1, row - 1, radius


def _polygon(header: Header, kind: str) -> tuple[Pair, ...] | None:
    numbers = header.numbers(f"VerticesOfThePolygonal{kind}")
    if len(numbers) < 6 or len(numbers) % 2:
        return None
    pairs = zip(numbers[::2], numbers[1::2], strict=True)
    return tuple((column - 1, row - 1) for row, column in pairs)


def _overlap(first: _Rectangle | None, second: _Rectangle) -> _Rectangle:
    if first is None:
        return second
    return max(first[0], second[0]), min(first[1], second[1]), max(first[2], second[2]), min(first[3], second[3])
