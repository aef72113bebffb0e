"""Synthetic cine runs: drawn catheters that move with a heart, as labs store them, with the truth of every frame."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Literal

import numpy as np
from numpy.random import Generator
from numpy.typing import NDArray
from PIL import Image as PillowImage
from PIL import ImageFilter
from PIL.Image import Resampling
from scipy.fft import dctn, idctn
from scipy.ndimage import affine_transform
from skimage.exposure import equalize_adapthist

from fluoromap.catheters import Catalogue, Catheter, catheter_type
from fluoromap.contracts import Array
from fluoromap.segmenter.picture.gaussian_blur import gaussian
from fluoromap.training.anatomy import anatomy
from fluoromap.training.drawing import Canvas, Image
from fluoromap.training.drawn_catheters import design_of, draw_catheters
from fluoromap.training.exposure import random_exposure
from fluoromap.training.leads import draw_lead
from fluoromap.training.printing import compressed
from fluoromap.training.randomness import between, chance, scaled

Frames = NDArray[np.uint8]
Draw = Callable[[Generator, Canvas, float], object]
Storage = Literal["plain", "jpeg", "video"]
Display = Literal["plain", "sharp", "tiles", "screen"]

_BEAT_MS = 550.0, 1000.0
"""Length of a heart beat, 60 to 110 a minute."""
_SWING_MM = 1.0, 5.0
"""Amplitude of a catheter that the heart moves."""
_AT_REST = 0.12
"""Share of catheters that hardly move, as in the vena cava."""
_BLOCK = 8
"""Side of the blocks of MPEG-4 and H.264 video, pixels."""


@dataclass(frozen=True, slots=True)
class CineConditions:
    """The kind of a cine; what is left open is drawn.

    types : catheters of the picture, by their names in the catalogue of types. listed : those of the study's list; the same where
    None. things : what else is drawn, one by one, and whether it moves with the heart. leads : pacing or defibrillator leads.
    frames, rate_hz : number and rate of the frames. px_per_mm : range of the scale at the isocentre. size : rows and columns.
    step_px : range of the longest way of a catheter from frame to frame; None where a heart beat moves it.
    storage, display : how the lab stores and shows the frames. blur_px : deviation of the display's blur.
    """

    types: tuple[str, ...]
    listed: tuple[str, ...] | None = None
    things: tuple[tuple[Draw, bool], ...] = ()
    leads: int = 0
    frames: int = 8
    rate_hz: float = 15.0
    px_per_mm: tuple[float, float] = (2.8, 4.2)
    size: int = 288
    step_px: tuple[float, float] | None = None
    storage: Storage = "plain"
    display: Display = "plain"
    blur_px: float = 0.0


@dataclass(frozen=True, slots=True, eq=False)
class Cine:
    """A cine with its truth.

    pixels : (frames, size, size) uint8. times_ms : (frames,). logarithmic : whether grey values are those of attenuation.
    truth : catheter of the list -> (frames, electrodes, 2) pixels, electrode 1 (the tip) first. unlisted : the same for catheters
    that the list lacks, and for leads.
    """

    pixels: Frames
    times_ms: Array
    px_per_mm: float
    logarithmic: bool
    catalogue: Catalogue
    truth: Mapping[str, Array]
    unlisted: tuple[Array, ...]


@dataclass(slots=True, eq=False)
class _Layer:
    """Attenuation of a thing (size, size), its electrodes (n, 2), and its place in each frame as matrix and shift."""

    depth: Image
    electrodes_uv: Array
    name: str | None
    moves: list[tuple[Array, Array]] = field(default_factory=list)


def draw_cine(random: Generator, conditions: CineConditions) -> Cine:
    """Draw one cine.

    Parameters
    ----------
    random : Generator
        The cine depends on nothing else but the conditions.
    conditions : CineConditions
        The kind of cine.
    """
    size, px_per_mm = conditions.size, scaled(random, *conditions.px_per_mm)
    exposure = random_exposure(random)
    catalogue, named = _catalogue(conditions)
    times_ms: Array = np.arange(conditions.frames, dtype=np.float64) * (1000.0 / conditions.rate_hz)
    layers = []
    for catheter, name in named:
        canvas = Canvas.empty(size)
        drawn = draw_catheters(random, canvas, px_per_mm, [design_of(catheter)], exposure.metal)
        layers.append(_Layer(canvas.depth, drawn[:, :2], name, _moves(random, conditions, times_ms, px_per_mm)))
    for _ in range(conditions.leads):
        canvas = Canvas.empty(size)
        drawn = draw_lead(random, canvas, px_per_mm)
        layers.append(_Layer(canvas.depth, drawn[:, :2], None, _moves(random, conditions, times_ms, px_per_mm)))
    for draw, moving in conditions.things:
        canvas = Canvas.empty(size)
        draw(random, canvas, px_per_mm)
        moves = _moves(random, conditions, times_ms, px_per_mm) if moving else []
        layers.append(_Layer(canvas.depth, np.zeros((0, 2)), None, moves))
    body = anatomy(random, size, px_per_mm, exposure.frontal)
    focus, contrast = between(random, 0.3, 1.1), np.float32(between(random, 0.75, 1.0))
    show = _display(random, conditions)
    grey = []
    for frame in range(conditions.frames):
        things = sum((_placed(layer, frame, focus) for layer in layers), np.zeros((size, size), np.float32))
        attenuation = body + np.float32(contrast) * things
        attenuation -= attenuation.mean()
        intensity = np.exp(-np.clip(attenuation, -3.0, 6.0))
        scatter = np.float32(exposure.scatter)
        intensity = (intensity + scatter * gaussian(intensity, 15.0)) / (1.0 + scatter)
        intensity /= intensity.mean()
        grey.append(show(np.maximum(intensity + exposure.noise(random, intensity), 1e-3)))
    pixels, logarithmic = _levels(random, grey), show.logarithmic
    if conditions.storage == "jpeg":
        quality = int(between(random, 45.0, 96.0))
        pixels = np.stack([np.asarray(compressed(PillowImage.fromarray(frame), quality)) for frame in pixels])
    elif conditions.storage == "video":
        pixels = as_video(pixels, between(random, 4.0, 16.0))
    placed = [(layer.name, _electrodes(layer, conditions.frames)) for layer in layers if len(layer.electrodes_uv)]
    return Cine(
        pixels, times_ms, px_per_mm, logarithmic, catalogue,
        {name: uv for name, uv in placed if name is not None},
        tuple(uv for name, uv in placed if name is None),
    )  # fmt: skip


def as_video(pixels: Frames, step: float) -> Frames:
    """Return frames as a video coder keeps them.

    A coder predicts each frame from the one before and stores the rounded cosine transform of what is left, so noise below half
    a step is not new in each frame: it repeats. Motion is not searched.

    Parameters
    ----------
    pixels : (frames, rows, columns) uint8, rows and columns multiples of 8.
    step : grey levels to which coefficients are rounded; 4 is a good video, 16 a poor one.
    """
    count, rows, columns = pixels.shape
    across = np.add.outer(np.arange(_BLOCK), np.arange(_BLOCK))
    steps = step * (1.0 + 0.25 * across)
    last = np.full((rows, columns), 128.0)
    coded = np.empty_like(pixels)
    for index in range(count):
        blocks = (pixels[index] - last).reshape(rows // _BLOCK, _BLOCK, columns // _BLOCK, _BLOCK)
        kept = steps[:, None, :] * np.rint(dctn(blocks, axes=(1, 3), norm="ortho") / steps[:, None, :])
        last = np.clip(last + idctn(kept, axes=(1, 3), norm="ortho").reshape(rows, columns), 0.0, 255.0)
        coded[index] = np.rint(last)
    return coded


def _catalogue(conditions: CineConditions) -> tuple[Catalogue, list[tuple[Catheter, str | None]]]:
    """Return the study's list, and the catheters in the picture with their names.

    The name of a catheter that the list lacks is None.
    """
    listed = conditions.types if conditions.listed is None else conditions.listed
    catheters = tuple(catheter_type(kind, f"{kind} {number}") for number, kind in enumerate(listed))
    reference = catheters[0].name if len(catheters) > 1 else None
    left = list(zip(listed, (catheter.name for catheter in catheters), strict=True))
    named: list[tuple[Catheter, str | None]] = []
    for kind in conditions.types:
        found = next((entry for entry in left if entry[0] == kind), None)
        if found is not None:
            left.remove(found)
        named.append((catheter_type(kind, kind), None if found is None else found[1]))
    return Catalogue(catheters, reference, catheters[-1].name), named


def _moves(
    random: Generator, conditions: CineConditions, times_ms: Array, px_per_mm: float
) -> list[tuple[Array, Array]]:
    """Draw the motion of a thing.

    Each frame has a (2, 2) matrix about the picture's centre, and a shift in pixels.
    """
    still = chance(random, _AT_REST)
    swing = 0.05 if still else between(random, *_SWING_MM)
    turn, stretch = (0.0, 0.0) if still else (between(random, 0.0, 0.06), between(random, 0.0, 0.04))
    beat, phase = between(random, *_BEAT_MS), between(random, 0.0, 2.0 * math.pi)
    main = random.normal(size=2)
    main /= np.linalg.norm(main)
    side = 0.4 * random.normal(size=2)
    angle = 2.0 * math.pi * times_ms / beat + phase
    way = main * (np.sin(angle) + 0.35 * np.sin(2.0 * angle + 1.0))[:, None] + side * np.cos(angle)[:, None]
    shifts = way * swing * px_per_mm
    if conditions.step_px is not None and len(times_ms) > 1 and not still:
        longest = float(np.linalg.norm(np.diff(shifts, axis=0), axis=1).max())
        shifts *= between(random, *conditions.step_px) / max(longest, 1e-6)
    moves = []
    for one, shift in zip(angle.tolist(), shifts, strict=True):
        turned, size = turn * math.sin(one + 0.5), 1.0 + stretch * math.sin(one + 0.2)
        cosine, sine = size * math.cos(turned), size * math.sin(turned)
        moves.append((np.array([[cosine, -sine], [sine, cosine]]), shift))
    return moves


def _placed(layer: _Layer, frame: int, focus: float) -> Image:
    """Return the layer's attenuation where it is in a frame.

    A thing at rest is where it was drawn.
    """
    soft = np.maximum(gaussian(layer.depth, focus), 0.0)
    if not layer.moves:
        return soft
    matrix, shift = layer.moves[frame]
    centre = np.full(2, 0.5 * len(soft))
    # Arrays are (v, u), and the filter asks where a pixel of the result comes from.
    swapped = np.linalg.inv(matrix)[::-1, ::-1]
    offset = centre - swapped @ (centre + shift[::-1])
    return np.asarray(affine_transform(soft, swapped, offset=offset, order=1, mode="constant"), dtype=np.float32)


def _electrodes(layer: _Layer, frames: int) -> Array:
    centre = np.full(2, 0.5 * len(layer.depth))
    moves = layer.moves or [(np.eye(2), np.zeros(2))] * frames
    return np.stack([(layer.electrodes_uv - centre) @ matrix.T + centre + shift for matrix, shift in moves])


@dataclass(frozen=True, slots=True)
class _Shown:
    """What a lab's display does to intensities; the same for all frames of a run."""

    logarithmic: bool
    offset: float
    power: float
    sharpen: float
    radius_px: float
    display: Display
    blur_px: float
    fold_px: float

    def __call__(self, seen: Image) -> Image:
        grey = np.log(seen + np.float32(self.offset)) if self.logarithmic else seen ** np.float32(self.power)
        if self.sharpen:
            grey = grey + np.float32(self.sharpen) * (grey - gaussian(grey, self.radius_px))
        if self.display == "tiles":
            low, high = np.percentile(grey, [0.1, 99.9])
            grey = equalize_adapthist(np.clip((grey - low) / (high - low), 0.0, 1.0), len(grey) // 6, 0.02)
        if self.display == "screen":
            grey = self._photographed(grey)
        shown = gaussian(np.asarray(grey, np.float32), self.blur_px) if self.blur_px else grey
        return np.asarray(shown, dtype=np.float32)

    def _photographed(self, grey: Image) -> Image:
        """Return a photograph of a screen.

        The grid of the screen folds with that of the camera, and phones sharpen.
        """
        low, high = np.percentile(grey, [0.3, 99.7])
        levels = np.clip((grey - low) / (high - low), 0.0, 1.0)
        v, u = np.mgrid[: len(grey), : len(grey)]
        folds = 0.04 * np.cos(2.0 * math.pi * (u + 0.3 * v) / self.fold_px) * np.cos(2.0 * math.pi * v / self.fold_px)
        picture = PillowImage.fromarray((255.0 * np.clip(levels + folds, 0.0, 1.0)).astype(np.uint8))
        half = picture.resize((int(0.8 * picture.width),) * 2, Resampling.BILINEAR)
        picture = half.resize(picture.size, Resampling.BICUBIC).filter(ImageFilter.UnsharpMask(2, 80, 0))
        return np.asarray(picture, np.float32)


def _display(random: Generator, conditions: CineConditions) -> _Shown:
    sharpened = conditions.display == "sharp" or (conditions.display == "plain" and chance(random, 0.3))
    strength = between(random, 0.8, 2.5) if conditions.display == "sharp" else between(random, 0.2, 0.8)
    return _Shown(
        logarithmic=chance(random, 0.45),
        offset=scaled(random, 0.01, 0.3),
        power=between(random, 0.4, 1.3),
        sharpen=strength if sharpened else 0.0,
        radius_px=between(random, 0.8, 5.0),
        display=conditions.display,
        blur_px=conditions.blur_px,
        fold_px=between(random, 4.0, 12.0),
    )


def _levels(random: Generator, grey: Sequence[Image]) -> Frames:
    """Return 8 bit frames in the window of the first one.

    Some laboratories set it wide.
    """
    low, high = np.percentile(grey[0][::2, ::2], [0.3, 99.7])
    width = (high - low) * between(random, 1.0, 1.8) + 1e-9
    start = low - 0.5 * (width - (high - low))
    return np.stack([(255.0 * np.clip((each - start) / width, 0.0, 1.0)).astype(np.uint8) for each in grey])
