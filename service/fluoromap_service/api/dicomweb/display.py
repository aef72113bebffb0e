"""A frame as PNG or JPEG for display: window, region and size by the parameters of DICOMweb (PS3.18 section 8.3.5)."""

from __future__ import annotations

import io
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from PIL import Image
from pydicom.pixels.utils import pixel_array

from fluoromap.drawing.png import encode_png
from fluoromap_service.dicom.codestream import Pixels
from fluoromap_service.dicom.facts import InstanceFacts, Pair
from fluoromap_service.dicom.frames import open_frames

WindowFunction = Literal["LINEAR", "LINEAR_EXACT", "SIGMOID"]
MediaType = Literal["image/jpeg", "image/png"]
LARGEST_SIDE_PX = 8192
JPEG_QUALITY = 90


@dataclass(frozen=True, slots=True)
class Window:
    """A display window in stored values (PS3.3 C.11.2.1.2 and C.11.2.1.3)."""

    centre: float
    width: float
    function: WindowFunction = "LINEAR"


@dataclass(frozen=True, slots=True)
class Viewport:
    """The size of the picture in pixels, and the part of the frame that it shows (PS3.18 section 8.3.5.1.3).

    region : left, top, width and height in pixels of the frame; None takes the whole frame. A negative width or height
    flips the picture.
    """

    width: int
    height: int
    region: tuple[float, float, float, float] | None = None


@dataclass(frozen=True, slots=True)
class Display:
    """The parameters of a rendered frame; None leaves the choice to the service."""

    media_type: MediaType = "image/jpeg"
    window: Window | None = None
    viewport: Viewport | None = None
    quality: int = JPEG_QUALITY


def render_run(path: Path, facts: InstanceFacts, inverted: bool, frame: int, display: Display) -> bytes:
    """Return a frame of a run for display.

    Parameters
    ----------
    path : Path
    facts : InstanceFacts
    inverted : bool
        Whether the photometric interpretation is MONOCHROME1: the smallest value is white.
    frame : int
        From 0.
    display : Display
        Without a window, the file's own window counts, otherwise the frame's 0.5th to 99.5th percentile.
    """
    pixels = open_frames(path, facts)[frame]
    shown = np.rint(255 * _windowed(pixels, display.window or _default_window(pixels, facts.window))).astype(np.uint8)
    return _picture(255 - shown if inverted else shown, display)


def render_result(path: Path, frame: int, display: Display) -> bytes:
    """Return a frame of a secondary capture for display.

    It has no window. ``frame`` counts from 0.
    """
    return _picture(pixel_array(path, index=frame), display)


def result_frame_bytes(path: Path, frame: int) -> bytes:
    """Return the pixels of a frame of a secondary capture.

    ``frame`` counts from 0.
    """
    return bytes(pixel_array(path, index=frame).tobytes())


def _default_window(pixels: Pixels, stated: Pair | None) -> Window:
    if stated is not None:
        return Window(*stated)
    low, high = (float(value) for value in np.percentile(pixels.astype(np.float32), (0.5, 99.5)))
    return Window((low + high) / 2, max(high - low, 1e-3), "LINEAR_EXACT")


def _windowed(pixels: Pixels, window: Window) -> NDArray[np.float32]:
    """Return the pixels from 0 to 1, black to white."""
    values = pixels.astype(np.float32)
    if window.function == "SIGMOID":
        exponent = np.clip(-4 * (values - window.centre) / window.width, -80, 80)
        return np.asarray(1 / (1 + np.exp(exponent)), dtype=np.float32)
    # LINEAR counts whole values, so that its ends lie half a value inside.
    exact = window.function == "LINEAR_EXACT"
    centre, width = (window.centre, window.width) if exact else (window.centre - 0.5, window.width - 1)
    return np.asarray(np.clip((values - centre) / max(width, 1e-3) + 0.5, 0, 1), dtype=np.float32)


def _picture(pixels: NDArray[np.uint8], display: Display) -> bytes:
    shown = pixels if display.viewport is None else _fitted(pixels, display.viewport)
    if display.media_type == "image/png":
        return encode_png(shown)
    stream = io.BytesIO()
    Image.fromarray(shown).save(stream, "JPEG", quality=display.quality)
    return stream.getvalue()


def _fitted(pixels: NDArray[np.uint8], viewport: Viewport) -> NDArray[np.uint8]:
    """Scale a part of a frame into the viewport; keep its proportions."""
    left, top, width, height = viewport.region or (0.0, 0.0, float(pixels.shape[1]), float(pixels.shape[0]))
    scale = min(viewport.width / abs(width), viewport.height / abs(height))
    size = max(1, round(abs(width) * scale)), max(1, round(abs(height) * scale))
    box = (left, top, left + abs(width), top + abs(height))
    shown = np.asarray(Image.fromarray(pixels).resize(size, Image.Resampling.BILINEAR, box=box), dtype=np.uint8)
    return np.ascontiguousarray(shown[:: -1 if height < 0 else 1, :: -1 if width < 0 else 1])
