"""The torso behind the catheters: heart shadow, diaphragm, ribs, spine, ECG wires, soft tissue.

Sizes are millimetres at the isocentre; attenuation is in log units.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import uniform_filter
from scipy.special import expit

from fluoromap.geometry import Gantry, camera_from_gantry
from fluoromap.phantom.appearance import Appearance

Image = NDArray[np.float32]

_SCATTER_MM = 7.8
_RIBS = 5
_WIRES = 2


@dataclass(frozen=True, eq=False)
class Torso:
    """Photons at each pixel without catheters; the image's mean is 1.

    primary : (rows, columns) unscattered share, which catheters attenuate. scatter : (rows, columns) scattered share.
    """

    primary: Image
    scatter: Image


def torso(
    gantry: Gantry,
    appearance: Appearance,
    anatomy: np.random.Generator,
    tissue: np.random.Generator,
    breathing_mm: float,
) -> Torso:
    """Draw the torso of one run.

    Parameters
    ----------
    gantry, appearance
        The view; the spine is upright in the image.
    anatomy, tissue : Generator
        ``anatomy`` draws bones and wires, the same in all runs of a view. ``tissue`` draws soft tissue, new in each run.
    breathing_mm : float
        Displacement of heart and diaphragm towards the head by breathing.
    """
    attenuation = _attenuation(gantry, appearance, anatomy, tissue, breathing_mm)
    px_per_mm = camera_from_gantry(gantry).px_per_mm
    primary = np.exp(-attenuation)
    primary /= primary.mean()
    scatter = primary
    # Three running means approximate a Gaussian of standard deviation width / 2; their cost does not depend on the width.
    for _ in range(3):
        scatter = uniform_filter(scatter, round(2 * _SCATTER_MM * px_per_mm), mode="nearest")
    scatter = scatter * (appearance.scatter_to_primary / scatter.mean())
    whole = 1 + appearance.scatter_to_primary
    return Torso((primary / whole).astype(np.float32), (scatter / whole).astype(np.float32))


def _attenuation(
    gantry: Gantry,
    appearance: Appearance,
    anatomy: np.random.Generator,
    tissue: np.random.Generator,
    breathing_mm: float,
) -> Image:
    scale = camera_from_gantry(gantry).px_per_mm
    x = ((np.arange(gantry.columns, dtype=np.float32) - (gantry.columns - 1) / 2) / np.float32(scale))[None, :]
    y = ((np.arange(gantry.rows, dtype=np.float32) - (gantry.rows - 1) / 2) / np.float32(scale))[:, None]
    half_width, half_height = float(x.max()), float(y.max())

    image = appearance.texture * _tissue(gantry.rows, gantry.columns, tissue)
    image = image + 0.25 * anatomy.uniform(0.3, 1) * y / half_height + 0.2 * anatomy.uniform(-1, 1) * x / half_width
    image += _heart_shadow(x, y, anatomy, breathing_mm)
    image += _diaphragm(x, y, anatomy, breathing_mm)
    for _ in range(_RIBS):
        image += _rib(x, y, anatomy)
    if appearance.spine:
        image += _spine(x, y, anatomy)
    for _ in range(_WIRES):
        image += _wire(x, y, anatomy)
    return np.asarray(image, dtype=np.float32)


def _tissue(rows: int, columns: int, rng: np.random.Generator) -> Image:
    """Draw noise whose amplitude falls as frequency to the power -1.4.

    It has mean 0 and standard deviation 1.
    """
    frequency = np.hypot(np.fft.fftfreq(rows)[:, None], np.fft.rfftfreq(columns)[None, :])
    amplitude = np.maximum(frequency, 2 / max(rows, columns)) ** -1.4
    amplitude[0, 0] = 0
    texture = np.fft.irfft2(np.fft.rfft2(rng.normal(size=(rows, columns))) * amplitude, s=(rows, columns))
    return np.asarray(texture / texture.std(), dtype=np.float32)


def _heart_shadow(x: Image, y: Image, rng: np.random.Generator, breathing_mm: float) -> Image:
    centre_x, centre_y = rng.normal(0, 5), 4 + rng.normal(0, 4) - breathing_mm
    half_x, half_y = rng.uniform(33, 45), rng.uniform(30, 40)
    radius = np.sqrt(((x - centre_x) / half_x) ** 2 + ((y - centre_y) / half_y) ** 2)
    return 0.45 * _step(1 - radius, 0.035)


def _diaphragm(x: Image, y: Image, rng: np.random.Generator, breathing_mm: float) -> Image:
    dome = 30 - breathing_mm + 7 * np.sin((x - rng.uniform(-45, 45)) / 28)
    return 0.5 * _step(y - dome, 1.05)


def _rib(x: Image, y: Image, rng: np.random.Generator) -> Image:
    from_axis = np.abs(y - (rng.uniform(-52, 53) + rng.uniform(-0.45, 0.45) * x + rng.uniform(-2.3e-3, 2.3e-3) * x**2))
    half_width = rng.uniform(3.8, 5.9)
    cortex = np.exp(-0.5 * ((from_axis - half_width) / 0.52) ** 2)
    return np.asarray(0.10 * _step(half_width - from_axis, 0.35) + 0.07 * cortex, dtype=np.float32)


def _spine(x: Image, y: Image, rng: np.random.Generator) -> Image:
    """Draw vertebral bodies and discs.

    Each body has two pedicles, dark ovals of about an electrode's contrast.
    """
    middle, pitch = rng.normal(0, 4.3), rng.uniform(16.5, 20)
    first = rng.uniform(0, pitch)
    from_middle = np.abs(x - middle)
    image = 0.45 * _step(13 - from_middle, 0.7) + np.zeros_like(y)
    from_body = np.abs((y + first) % pitch - pitch / 2)
    image += 0.18 * _step(12.5 - from_middle, 0.52) * _step(0.36 * pitch - from_body, 0.52)
    pedicle_x = np.abs(from_middle - 6.6) / 2.26
    pedicle_y = from_body / 2.96
    image += 0.14 * np.exp(-((pedicle_x**2 + pedicle_y**2) ** 2))
    return np.asarray(image, dtype=np.float32)


def _wire(x: Image, y: Image, rng: np.random.Generator) -> Image:
    from_x, from_y = x - rng.uniform(-44, 44), y - rng.uniform(-44, 44)
    angle = rng.uniform(0, np.pi)
    along = from_x * np.cos(angle) + from_y * np.sin(angle)
    across = from_x * np.sin(angle) - from_y * np.cos(angle) + 2.1 * np.sin(along / 15.6)
    return np.asarray(0.10 * np.exp(-0.5 * (across / 0.226) ** 2), dtype=np.float32)


def _step(value: NDArray[np.floating[Any]], width: float) -> Image:
    """Return a smooth step from 0 to 1, over about ``width``.

    It is 0 where ``value`` is negative.
    """
    return np.asarray(expit(value / np.float32(width)), dtype=np.float32)
