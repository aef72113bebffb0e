"""Lag of a run's frames: a recursive noise filter mixes each frame with the ones before."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from fluoromap.contracts import Array, BoolArray, FrameSource, PixelFacts
from fluoromap.segmenter.picture.gaussian_blur import reduce_by
from fluoromap.segmenter.picture.grey_steps import usual_step
from fluoromap.segmenter.picture.log_image import Image

_TRIPLES, _BLOCK_PX = 3, 16
_STILL_SHARE = 0.6
_ALIKE = 0.5
"""Grey levels by which neighbouring pixels differ where most are alike."""
_LEAST_LAG, _MOST_LAG = 0.05, 0.9
_TINY = 1e-9
_FEWEST_FRAMES, _SAMPLED, _REDUCED = 4, 12, 2
_EMPTY = 0.9
"""Quantile of a pixel over time that shows the background behind moving things."""
_DARKEST = 0.9995
"""Quantile over a picture that is the darkness of its darkest moving thing."""
_DARK, _DARK_NOISE = 0.4, 10.0
"""Least darkness of a pixel that counts: as a share of the darkest, and over the noise."""
_LEAST_PIXELS = 50
"""Fewest dark pixels that say what the lag is."""
_NEARLY, _LATER = 0.8, 0.08
"""Noise is believed where all darkness keeps this share of its lag. Else it is believed where the later frame keeps so much more
darkness than the earlier frame had there."""
_LEFT, _LEFT_TOO, _SAME, _MOST_LEFT = 0.05, 0.15, 0.12, 0.65
"""Two quantiles of the share of darkness that pixels keep; how much they differ at most where things have left enough pixels; and
the largest share that is lag. Contrast medium flows away so slowly that pixels keep more."""


def measure_lag(frames: FrameSource, inside: BoolArray, pixels: PixelFacts) -> float:
    """Return the share of the frame before in each frame, 0 to 0.9.

    A filter y(t) = lag y(t - 1) + (1 - lag) x(t) leaves noise that is correlated in time. It also leaves a shadow where a dark
    thing was in the frame before, with that share of its darkness. The larger of both measures counts. But noise is not believed
    where moving things keep less, nor where neighbouring pixels are mostly alike: video coding repeats the noise of the frame
    before, and some filters spare what moves. Where nothing moves by its width, noise alone says what the lag is. Quantisation and
    compression add noise of their own, so that this is a lower bound. Less than four frames say too little: their lag is 0.

    Parameters
    ----------
    frames : FrameSource
    inside : (rows, columns) bool
        The exposed field.
    pixels : PixelFacts
        They say which values are dark.
    """
    if len(frames) < _FEWEST_FRAMES:
        return 0.0
    is_coded = usual_step(frames, inside, pixels.bits_stored) <= _ALIKE
    of_noise = 0.0 if is_coded else _lag_of_noise(frames, inside)
    left, arrived = _shares_of_darkness(frames, inside, pixels)
    if min(len(left), len(arrived)) < _LEAST_PIXELS:
        lag = of_noise
    else:
        lag = max(_lag_of_shadows(left, arrived), _believed(of_noise, left, arrived))
    return min(lag, _MOST_LAG) if lag >= _LEAST_LAG else 0.0


def _lag_of_noise(frames: FrameSource, inside: BoolArray) -> float:
    """Return the lag that noise has.

    Differences of frames two apart have 1 + lag times the variance of successive ones. The stillest blocks of the picture
    count.
    """
    whole = _block_means(inside.astype(np.float64)) == 1.0
    if not whole.any():
        return 0.0
    middles = np.unique(np.linspace(1, len(frames) - 2, _TRIPLES).round().astype(np.int64))
    one_apart, two_apart = [], []
    for middle in middles:
        before, at, after = (_fine_structure(frames[int(middle) + step]) for step in (-1, 0, 1))
        one_apart += [0.5 * (_block_means((at - before) ** 2) + _block_means((after - at) ** 2))[whole]]
        two_apart += [_block_means((after - before) ** 2)[whole]]
    one, two = np.median(one_apart, axis=0), np.median(two_apart, axis=0)
    still = (two <= np.quantile(two, _STILL_SHARE)) & (one > _TINY)
    return float(np.median(two[still] / one[still])) - 1.0 if still.any() else 0.0


def _shares_of_darkness(frames: FrameSource, inside: BoolArray, pixels: PixelFacts) -> tuple[Array, Array]:
    """Return the shares of darkness beside each frame.

    Those that dark pixels keep in the next frame, and those that they had in the frame before.
    """
    sign = -1.0 if pixels.monochrome1 else 1.0

    def reduced(frame: int) -> Image:
        return reduce_by(sign * frames[frame].astype(np.float32), _REDUCED)

    inside = inside[::_REDUCED, ::_REDUCED]
    later = np.unique(np.linspace(1, len(frames) - 1, min(_SAMPLED, len(frames) - 1)).round().astype(np.int64)).tolist()
    pairs = [(reduced(frame - 1), reduced(frame)) for frame in later]
    empty = np.quantile([after for _, after in pairs], _EMPTY, axis=0)
    differences = np.concatenate([np.abs(after - before)[inside] for before, after in pairs])
    noise = float(np.median(differences)) if len(differences) else 0.0

    def shared(dark: Image, beside: Image) -> Image:
        counts = inside & (dark > max(_DARK * float(np.quantile(dark, _DARKEST)), _DARK_NOISE * noise, _TINY))
        return beside[counts] / dark[counts]

    darkness = [(empty - before, empty - after) for before, after in pairs]
    left = np.concatenate([shared(before, after) for before, after in darkness])
    arrived = np.concatenate([shared(after, before) for before, after in darkness])
    return left, arrived


def _lag_of_shadows(left: Array, arrived: Array) -> float:
    """Return the least share of darkness that pixels keep.

    From one frame to the next it is the lag wherever something dark has moved away. The edges of what moves slowly keep a share
    too, and they show it backwards in time as well: lag does not. 0 where too few pixels agree or both directions do.
    """
    least, also = np.quantile(left, (_LEFT, _LEFT_TOO))
    is_lag = also - least < _SAME and np.quantile(arrived, _LEFT_TOO) < least < _MOST_LEFT
    return float(least) if is_lag else 0.0


def _believed(of_noise: float, left: Array, arrived: Array) -> float:
    """Return as much of the lag of noise as moving things allow.

    They allow it where all of them keep that share of their darkness, as what moves slowly does. Else they allow what they keep, if
    that is more than they show backwards in time.
    """
    if np.quantile(left, _LEFT) >= _NEARLY * of_noise:
        return of_noise
    least, before = np.quantile(left, _LEFT_TOO), np.quantile(arrived, _LEFT_TOO)
    return min(of_noise, float(least)) if least - before >= _LATER else 0.0


def _fine_structure(frame: NDArray[np.generic]) -> Array:
    """Return a frame without what is larger than two pixels."""
    x = frame.astype(np.float64)
    fine: Array = x - np.roll(x, 1, axis=1)
    return fine


def _block_means(x: Array) -> Array:
    rows, columns = (size // _BLOCK_PX for size in x.shape)
    blocks = x[: rows * _BLOCK_PX, : columns * _BLOCK_PX].reshape(rows, _BLOCK_PX, columns, _BLOCK_PX)
    means: Array = blocks.mean(axis=(1, 3))
    return means
