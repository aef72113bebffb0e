"""How a scene is exposed: photons, scatter, contrast of metal, size of the detector's pixels, storage."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.random import Generator

from fluoromap.segmenter.picture.gaussian_blur import gaussian
from fluoromap.segmenter.picture.resampling import resampled
from fluoromap.training.drawing import Image
from fluoromap.training.randomness import between, chance, scaled

_POOR = 0.45
_STORED_PLAIN = 0.7
_PRINTED = 0.22
_FRONTAL_CLEAR = 0.3
_DETECTORS = 1.0, 1.0, 1.25, 1.3, 1.4, 1.6, 1.8, 2.0
_GRAIN_FROM_PX = 0.35


@dataclass(frozen=True, slots=True)
class Exposure:
    """Exposure of one scene.

    photons : mean count in a pixel of the scene. scatter : scattered over primary photons. metal : range of the attenuation of
    electrodes, log units. detector : detector pixels in a pixel of the scene, along a row. grain_px : blur of the noise by
    detector and processing. gain : of the noise, above 1 where processing sharpens it. frontal : through ribs and spine.
    plain : stored as the detector read it, 12 bits without window, sharpening and compression. printed : copied from a publication,
    where it is not plain.
    """

    photons: float
    scatter: float
    metal: tuple[float, float]
    detector: float
    grain_px: float
    gain: float
    frontal: bool
    plain: bool
    printed: bool

    def noise(self, random: Generator, intensity: Image) -> Image:
        """Draw the quantum noise of an intensity whose mean is 1.

        A detector of smaller pixels is reduced to the scene's by area means, as the segmenter does it.
        """
        size = len(intensity)
        if self.detector > 1.0:
            fine = random.standard_normal((int(size * self.detector) + 2,) * 2, dtype=np.float32)
            noise = resampled(fine, 1.0 / self.detector)[:size, :size] * np.float32(self.detector)
        else:
            noise = random.standard_normal(intensity.shape, dtype=np.float32)
        noise *= np.sqrt(np.maximum(intensity, 1e-3) / np.float32(self.photons))
        return gaussian(noise, self.grain_px) * np.float32(self.gain) if self.grain_px > _GRAIN_FROM_PX else noise


def random_exposure(random: Generator) -> Exposure:
    """Draw an exposure, any clear one or a poor one.

    A poor one is that of a thick body: few photons, much scatter.
    """
    if chance(random, _POOR):
        plain = chance(random, _STORED_PLAIN)
        return Exposure(
            photons=scaled(random, 60.0, 700.0),
            scatter=between(random, 0.8, 4.0),
            metal=(1.0, 8.0),
            detector=float(random.choice(_DETECTORS)),
            grain_px=between(random, 0.0, 0.6 if plain else 1.2),
            gain=between(random, 0.9, 1.2),
            frontal=chance(random, 0.7),
            plain=plain,
            printed=chance(random, _PRINTED),
        )
    return Exposure(
        photons=scaled(random, 60.0, 10000.0),
        scatter=between(random, 0.0, 1.2) ** 2,
        metal=(0.2, 2.3),
        detector=1.0,
        grain_px=between(random, 0.0, 1.2),
        gain=between(random, 0.8, 2.0),
        frontal=chance(random, _FRONTAL_CLEAR),
        plain=False,
        printed=chance(random, _PRINTED),
    )
