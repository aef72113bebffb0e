"""Chains fitted to the image: which catheter they are, where its tip is, and no two electrodes at one dark place."""

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from fluoromap.catheters import Catalogue, catheter_type
from fluoromap.segmenter.chains.families import catheter_families
from fluoromap.segmenter.chains.linking import CandidateChain
from fluoromap.segmenter.picture.shaft_image import ShaftImage
from fluoromap.segmenter.places.chain_fitting import fit_chains

PX_PER_MM = 3.5
CATHETER = catheter_type("quadripolar-2-5-2", "reference")
CATALOGUE = Catalogue((CATHETER, catheter_type("decapolar-2-5-2", "mapping")), "reference", "mapping")
ALONG_PX = 60.0 + np.concatenate([[0.0], np.cumsum(CATHETER.spacing_mm)]) * PX_PER_MM


def fitted(shown, candidates_u):
    """Fit a quadripolar catheter of which the image shows some electrodes."""
    v, u = np.mgrid[:120, :180].astype(np.float64)
    image = np.random.default_rng(5).normal(0.0, 0.02, v.shape)
    half = 0.5 * CATHETER.ring_mm * PX_PER_MM
    for electrode in shown:
        band = np.clip(0.5 + (half - np.abs(u - ALONG_PX[electrode])) / 2.0, 0.0, 1.0)
        image -= 0.5 * band * (np.abs(v - 60.0) < 3.5)
    x = image.astype(np.float32)
    candidates = np.stack([candidates_u, np.full(4, 60.0)], axis=1)
    families = tuple(one for one in catheter_families(CATALOGUE) if one.catheter.electrodes == 4)
    linked = [CandidateChain((0, 1, 2, 3), 0, 5.0)]
    (one,) = fit_chains(x, candidates, linked, ShaftImage(x, 1, 0.1, PX_PER_MM), families, 0.02)
    return one.chain


def test_the_electrodes_of_a_clear_catheter_are_fitted():
    chain = fitted(range(4), ALONG_PX + np.array([1.0, -1.0, 1.0, -1.0]))
    places = np.sort(chain.pixels_uv[:, 0])
    assert places == pytest.approx(ALONG_PX, abs=0.5)


def test_an_electrode_that_would_take_its_neighbour_s_place_stays_where_it_was_proposed():
    near = ALONG_PX.copy()
    near[1] = ALONG_PX[0] + 4.0
    chain = fitted([0, 2, 3], near)
    order = np.argsort(chain.pixels_uv[:, 0])
    gaps = np.diff(chain.pixels_uv[order, 0])
    assert gaps.min() >= 0.15 * min(CATHETER.spacing_mm) * PX_PER_MM
    spread = np.sqrt(np.trace(chain.covariance_px2[order], axis1=1, axis2=2))
    assert spread[1] > spread[[0, 2, 3]].max()


def test_the_shaft_says_more_of_the_tip_than_the_length_of_short_bands():
    catheter = catheter_type("quadripolar-5-5-5", "reference")
    along = 60.0 + np.concatenate([[0.0], np.cumsum(catheter.spacing_mm)]) * PX_PER_MM
    v, u = np.mgrid[:120, :220].astype(np.float64)
    image = np.random.default_rng(5).normal(0.0, 0.02, v.shape)
    image -= 0.15 * ((u > along[0]) & (np.abs(v - 60.0) < 2.5))
    # The last ring is as long as the catalogue says of the tip.
    for at, length_mm in zip(along, (1.0, 1.0, 1.0, 2.0), strict=True):
        band = np.clip(0.5 + (0.5 * length_mm * PX_PER_MM - np.abs(u - at)) / 2.0, 0.0, 1.0)
        image -= 0.5 * band * (np.abs(v - 60.0) < 3.5)
    x = image.astype(np.float32)
    candidates = np.stack([along, np.full(4, 60.0)], axis=1)
    families = catheter_families(Catalogue((catheter,), None, "reference"))
    (one,) = fit_chains(
        x, candidates, [CandidateChain((0, 1, 2, 3), 0, 5.0)], ShaftImage(x, 1, 0.1, PX_PER_MM), families, 0.02
    )
    assert one.chain.pixels_uv[:, 0] == pytest.approx(along, abs=1.5)


def metal_picture(catheter, shortening, turned):
    """Return a log image of oblique metal, and the electrodes' middles.

    The middles (electrodes, 2) are those from the tip on. Points in the metal are projected. Rings are hollow, and so is a short
    tip. A long tip is solid and ends in a dome. The tip is at the right if ``turned``.
    """
    random = np.random.default_rng(7)
    solid = catheter.tip_mm > 3.0
    radius_mm = 1.165 if solid else 1.0
    shape = 80, 220
    image = np.zeros(shape)
    along = catheter.arc_lengths_mm * shortening * PX_PER_MM
    places = np.stack([60.0 + (along[-1] - along if turned else along), np.full(len(along), 40.0)], axis=1)
    for number, place in enumerate(places):
        is_solid = solid and number == 0
        half_mm = 0.5 * (catheter.ring_mm if number else catheter.tip_mm)
        axial, angle = random.uniform(-half_mm, half_mm, 60_000), random.uniform(0.0, 2.0 * np.pi, 60_000)
        radial = radius_mm * np.sqrt(random.uniform(0.0 if is_solid else 0.86**2, 1.0, 60_000))
        if is_solid:
            in_dome = np.hypot(radial, np.maximum(-axial - (half_mm - radius_mm), 0.0)) <= radius_mm
            axial, angle, radial = axial[in_dome], angle[in_dome], radial[in_dome]
        right = axial * shortening + radial * np.cos(angle) * np.sqrt(1.0 - shortening**2)
        seen, _, _ = np.histogram2d(
            place[1] + radial * np.sin(angle) * PX_PER_MM,
            place[0] + (-right if turned else right) * PX_PER_MM,
            bins=[np.arange(size + 1) - 0.5 for size in shape],
        )
        # A solid tip is not as dark as all of its metal, because soft rays do not pass it.
        image -= half_mm * (0.6 if is_solid else 1.0) * seen
    image = gaussian_filter(image, 0.8)
    return (0.8 * image / -image.min() + random.normal(0.0, 0.02, shape)).astype(np.float32), places


@pytest.mark.parametrize("shortening", [0.5, 0.65, 0.8])
@pytest.mark.parametrize("turned", [False, True])
@pytest.mark.parametrize("shown", ["ablation", "his"])
def test_hollow_rings_seen_obliquely_are_no_tips(shown, turned, shortening):
    catheters = (catheter_type("quadripolar-2-5-2", "his"), catheter_type("ablation-4", "ablation"))
    catalogue = Catalogue(catheters, "his", "ablation")
    image, places = metal_picture(catalogue[shown], shortening, turned)
    candidates = places + np.random.default_rng(3).normal(0.0, 0.7, places.shape)
    linked = [CandidateChain((3, 2, 1, 0), 0, 5.0)]
    flat = ShaftImage(np.zeros_like(image), 1, 0.1, PX_PER_MM)
    (one,) = fit_chains(image, candidates, linked, flat, catheter_families(catalogue), 0.02)
    assert one.chain.probability(shown) > 0.5
    # The tip of a quadripolar catheter is hardly longer than its rings.
    if shown == "ablation":
        to_tip, to_last = np.linalg.norm(one.chain.pixels_uv[0] - places[[0, -1]], axis=1)
        assert to_tip < to_last
