"""The imaging chain: from centre lines of catheters and a torso to stored pixels."""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterator, Sequence

import numpy as np
from numpy.typing import NDArray

from fluoromap.geometry import Camera
from fluoromap.phantom import kernels
from fluoromap.phantom.appearance import Appearance
from fluoromap.phantom.shaft import Shaft, arc_lengths_mm
from fluoromap.phantom.torso import Torso

Array = NDArray[np.float64]
Image = NDArray[np.float32]

BITS_STORED = 12
MEAN_GREY = 1400.0
DETECTOR_BLUR_PX = 0.75
ELECTRONIC_NOISE = 1.5
# The line integral of a shaft nearly along the ray is limited: no real catheter runs straight at the detector.
_LEAST_SIN2 = 0.12
# Exact arc lengths need all points of a centre line; drawing needs only every second.
_EVERY = 2


class RenderedFrames:
    """Frames of one run, rendered on access.

    The order of access does not change a frame.

    The object holds only the function that renders a frame. It gives no access to the truth.
    """

    def __init__(self, shape: tuple[int, int], count: int, render: Callable[[int], NDArray[np.uint16]]) -> None:
        self._shape = shape
        self._count = count
        self._render = render

    @property
    def shape(self) -> tuple[int, int]:
        """(rows, columns)."""
        return self._shape

    def __len__(self) -> int:
        return self._count

    def __getitem__(self, index: int) -> NDArray[np.uint16]:
        """Render the stored pixels (rows, columns) of frame ``index``, 12 bits in 16.

        Frames are counted from 0, negative ones from the end.

        Raises
        ------
        IndexError
            Where the run has no such frame.
        """
        if not -self._count <= index < self._count:
            raise IndexError(f"no frame {index}: the run has {self._count} frames, counted from 0")
        return self._render(index % self._count)

    def __iter__(self) -> Iterator[NDArray[np.uint16]]:
        for index in range(self._count):
            yield self._render(index)


def transmission(camera: Camera, shafts: Sequence[Shaft], lines_mm: Sequence[Array], appearance: Appearance) -> Image:
    """Return the share (rows, columns) of primary photons that pass the catheters.

    Parameters
    ----------
    camera : Camera
        The true view, gantry errors included.
    shafts : sequence of Shaft
    lines_mm : sequence of ndarray, shape (t, k, 3)
        Each catheter's centre line at the ``t`` instants of one exposure, which are averaged.
    appearance : Appearance
    """
    ss = kernels.SUPERSAMPLING
    rows, columns = camera.rows, camera.columns
    thickness = np.zeros((rows * ss, columns * ss), np.float32)
    touched = np.zeros((rows, columns), np.uint8)
    absorbed = np.zeros((rows, columns), np.float32)
    instants = len(lines_mm[0])
    samples = [_line_samples(camera, lines) for lines in lines_mm]
    for instant in range(instants):
        for shaft, lines in zip(shafts, samples, strict=True):
            kernels.add_tube(
                thickness,
                touched,
                lines[instant],
                shaft.bands_mm.astype(np.float32),
                shaft.radius_mm,
                shaft.solid_tip,
                appearance.platinum_per_mm,
                appearance.shaft,
            )
        kernels.absorb(thickness, touched, absorbed, 1 / instants)
    return 1 - absorbed


def _line_samples(camera: Camera, lines_mm: Array) -> Image:
    """Return the kernel's input (t, k, 5) for centre lines (t, k, 3).

    The columns are u, v, arc length, px per mm and 1/sin of the angle to the ray.
    """
    along = arc_lengths_mm(lines_mm)[:, ::_EVERY]
    lines_mm = lines_mm[:, ::_EVERY]
    pixels = camera.project(lines_mm)
    depth = camera.depth_mm(lines_mm)
    px_per_mm = camera.px_per_mm * float(camera.depth_mm(np.zeros(3))) / depth
    tangents = np.gradient(lines_mm, axis=1)
    rays = lines_mm - camera.source_world_mm
    cosine = (tangents * rays).sum(axis=2) / (np.linalg.norm(tangents, axis=2) * np.linalg.norm(rays, axis=2))
    sin2 = np.maximum(1 - cosine**2, _LEAST_SIN2)
    parts = [pixels[..., 0], pixels[..., 1], along, px_per_mm, 1 / np.sqrt(sin2)]
    return np.stack(parts, axis=2).astype(np.float32)


def expected_photons(torso: Torso, passed: Image, appearance: Appearance, dose: float) -> Image:
    """Return the mean photon count (rows, columns) for the share ``passed`` that the catheters let through."""
    photons: Image = (torso.primary * passed + torso.scatter) * np.float32(appearance.photons * dose)
    return photons


def detect(expected: Image, photons_at_mean: float, key: int) -> NDArray[np.uint16]:
    """Return the stored image of an exposure.

    Photons are counted, blurred by the detector, read out with noise and rounded. The gain maps ``photons_at_mean`` to the
    same grey level at any dose, as a system's exposure control does. ``key`` : 64 bits that identify the exposure; the same
    key gives the same noise.
    """
    photons, electronic = np.empty_like(expected), np.empty_like(expected)
    middle, tail = _normal_quantiles()
    kernels.count_photons(expected, np.uint64(key), ELECTRONIC_NOISE, middle, tail, photons, electronic)
    image = np.empty(expected.shape, np.uint16)
    gain = MEAN_GREY / photons_at_mean
    kernels.read_out(photons, electronic, _blur_taps(), gain, (1 << BITS_STORED) - 1, image)
    return image


@functools.cache
def _normal_quantiles() -> tuple[Image, Image]:
    return kernels.normal_quantiles()


@functools.cache
def _blur_taps() -> Image:
    offsets = np.arange(4)
    taps = np.exp(-0.5 * (offsets / DETECTOR_BLUR_PX) ** 2)
    taps /= taps[0] + 2 * taps[1:].sum()
    return taps.astype(np.float32)
