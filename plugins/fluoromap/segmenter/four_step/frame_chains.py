"""Chains of one image by the four steps: filters, linking, fit."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from pydantic import BaseModel, Field

from fluoromap.catheters import Catalogue
from fluoromap.contracts import Array, Chain, FrameChains
from fluoromap.reasons import Reason
from fluoromap.segmenter.chains.families import catheter_families
from fluoromap.segmenter.chains.linking import evidence, link_candidates
from fluoromap.segmenter.electrodes.proposals import probability_of_contrast
from fluoromap.segmenter.four_step.blobs import MOST_FOREGROUND, Blobs, find_blobs
from fluoromap.segmenter.four_step.complex_shock import complex_shock, to_grey_range
from fluoromap.segmenter.four_step.contrast import Contrast
from fluoromap.segmenter.four_step.homomorphic import homomorphic
from fluoromap.segmenter.four_step.morphology import disk_morphology
from fluoromap.segmenter.four_step.perona_malik import edge_scale, perona_malik
from fluoromap.segmenter.picture.field_mask import FieldMask
from fluoromap.segmenter.picture.gaussian_blur import reduce_by
from fluoromap.segmenter.picture.log_image import Image, pixel_noise
from fluoromap.segmenter.picture.shaft_image import ShaftImage
from fluoromap.segmenter.places.chain_fitting import fit_chains

MOST_BLOBS = 40
"""With more blobs than this the threshold has separated noise from the rest, not electrodes."""

_LEAST_LINE = 0.05
_OWN_MM = 0.6


class FourStepParams(BaseModel, extra="forbid"):
    """Parameters of the four-step segmenter; keep the defaults."""

    gamma_low: float = Field(
        0.5, ge=0.0, le=1.0, description="Homomorphic gain of slow shading, gamma_L of equation (4)."
    )
    gamma_high: float = Field(2.0, ge=1.0, le=10.0, description="Homomorphic gain of detail, gamma_H of equation (4).")
    slope: float = Field(
        1.0, gt=0.0, le=10.0, description="Sharpness c of the homomorphic filter's transition, equation (4)."
    )
    cutoff: float = Field(
        8.0, ge=2.0, le=64.0, description="Cutoff D0 of the homomorphic filter in cycles per image width, equation (4)."
    )
    diffusion_sweeps: int = Field(15, ge=0, le=100, description="Sweeps of Perona-Malik diffusion, equation (5).")
    edge_factor: float = Field(
        2.0, gt=0.0, le=20.0, description="Edge scale K of equation (6) in robust standard deviations of the noise."
    )
    shock_sweeps: int = Field(15, ge=0, le=100, description="Sweeps of the complex shock filter, equation (7).")
    background_mm: float = Field(
        2.43,
        ge=0.5,
        le=6.0,
        description="Radius of the closing disk at the isocentre; more than half an electrode's length.",
    )
    opening_mm: float = Field(
        0.35, ge=0.1, le=2.0, description="Radius of the opening disk at the isocentre; less than half a ring's length."
    )


@dataclass(frozen=True, slots=True, eq=False)
class FourStepDetector:
    """Detector of chains by the four steps, for one run."""

    catalogue: Catalogue
    field: FieldMask
    px_per_mm: float
    settings: FourStepParams

    def blobs(self, x: Image) -> tuple[Blobs, Image, float] | None:
        """Apply equations (4) to (7) and the disks to a log image.

        Returns
        -------
        tuple or None
            The blobs, the diffused image and K; None for a flat image.
        """
        inside, of = self.field.inside, self.settings
        # Each image takes the name of the previous one, so that its memory is freed: a growing heap goes back to the system
        # after every frame, and getting it again takes as long as a filter.
        image = homomorphic(x, of.gamma_low, of.gamma_high, of.slope, of.cutoff)
        k = edge_scale(image, inside, of.edge_factor)
        if k is None:
            return None
        diffused = image = perona_malik(image, k, of.diffusion_sweeps)
        image = to_grey_range(image, inside)
        image = complex_shock(image, of.shock_sweeps)
        image = disk_morphology(
            image,
            min(max(2, round(of.background_mm * self.px_per_mm)), max(2, min(x.shape) // 4)),
            max(1, round(of.opening_mm * self.px_per_mm)),
        )
        smallest, largest = 0.6 * self.px_per_mm**2, 24.0 * self.px_per_mm**2
        return find_blobs(image, inside, self.field.candidates, smallest, largest), diffused, k

    def find_chains(self, x: Image, frame: int, beside: Sequence[Image] = ()) -> FrameChains:
        """Return the chains of one log image, or the reason why there are none."""
        if min(x.shape) < 16:
            return FrameChains(frame, (), Reason.MANUAL_NEEDED)
        found = self.blobs(self.field.fill(x))
        if found is None:
            return FrameChains(frame, (), Reason.MANUAL_NEEDED)
        blobs, diffused, k = found
        if blobs.foreground > MOST_FOREGROUND or len(blobs) > MOST_BLOBS:
            return FrameChains(frame, (), Reason.MANUAL_NEEDED)
        contrast = Contrast.of_frame(x, self.field.inside, self.px_per_mm)
        shaft_image = ShaftImage(diffused, 1, max(_LEAST_LINE, 0.5 * k), self.px_per_mm)
        families = catheter_families(self.catalogue)
        points = _add_peaks(blobs.centroids_uv, contrast.peaks(self.field.candidates), self.px_per_mm)
        linked = link_candidates(
            points,
            evidence(probability_of_contrast(contrast.of(points))),
            np.zeros(len(points)),
            shaft_image,
            families,
            sure=len(blobs),
        )
        if not linked:
            return FrameChains(frame, (), Reason.MANUAL_NEEDED)
        noise = pixel_noise(reduce_by(x, 2), self.field.inside[::2, ::2])
        chains = [fitted.chain for fitted in fit_chains(x, points, linked, shaft_image, families, noise)]
        return FrameChains(frame, tuple(replace(chain, scores=contrast.of(chain.pixels_uv)) for chain in chains))

    def find_again(
        self,
        x: Image,
        chain: Chain,
        shift: Array,
        reach_px: float,
        taken: Sequence[Chain],
        frame: int | None = None,
        same_shape: bool = False,
        confirmed: bool = False,
    ) -> Chain | None:
        """Return None: the paper searches whole frames."""
        return None

    def find_moving(self, images: Sequence[Image], times_ms: Array, middle: int, frame: int) -> tuple[Chain, ...]:
        """Return nothing: the paper searches single frames."""
        return ()

    def shows_extra_catheter(self, x: Image, chains: Sequence[Chain]) -> bool:
        """Return False: blobs beside the chains may be anything."""
        return False


def _add_peaks(blobs_uv: Array, peaks_uv: Array, px_per_mm: float) -> Array:
    """Return the blobs, then the peaks that are not one of them.

    The blobs lack two kinds of electrodes: steeply foreshortened rings are narrower than the opening disk, and
    electrodes of crossing catheters merge into one component.
    """
    if not len(peaks_uv):
        return blobs_uv
    if len(blobs_uv):
        away = np.linalg.norm(peaks_uv[:, None, :] - blobs_uv[None, :, :], axis=2).min(axis=1)
        peaks_uv = peaks_uv[away > _OWN_MM * px_per_mm]
    return np.concatenate([blobs_uv, peaks_uv])
