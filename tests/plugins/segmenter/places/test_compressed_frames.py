"""Stated places hold in compressed pictures: compression hides noise from its measurement and moves electrodes all the same."""

import numpy as np
import pytest
from frame_sources import Frames, displayed
from scipy.ndimage import gaussian_filter

from fluoromap.catheters import DEFAULT_CATALOGUE
from fluoromap.contracts import PixelFacts, Run, Silent
from fluoromap.geometry import Gantry
from fluoromap.phantom import StudySpec, simulate_study
from fluoromap.segmenter.catheter_chain.plugin import CatheterChain
from fluoromap.segmenter.electrodes.blob_response import BlobResponse
from fluoromap.segmenter.learned_chain.plugin import LearnedChain

CHI2_95_2D = 5.991464547107979
PX_PER_MM = 4.1
FRAMES, SEEDS = 4, (9711, 9713)


def gantry(primary_deg):
    spacing = 2.0 / PX_PER_MM
    return Gantry(primary_deg, 0.0, 1000.0, 500.0, (spacing, spacing), 512, 512)


@pytest.fixture(scope="module")
def simulated():
    return [
        simulate_study(
            StudySpec(seed, sites=1, frames=FRAMES, frame_rate_hz=60.0, heart="dog", gantries=(gantry(90), gantry(0)))
        )
        .sites[0]
        .runs[0]
        for seed in SEEDS
    ]


def stated_and_missed(segmenter, runs, quality):
    """Return the stated variances and the errors over them, both (n,)."""
    stated, missed = [], []
    for run in runs:
        frames = Frames([displayed(run.frames[k], quality) for k in range(FRAMES)])
        shown = Run(frames, run.frame_times_ms, PX_PER_MM, PixelFacts(True, 8, False))
        for entry in segmenter.segment(shown, DEFAULT_CATALOGUE, {}, Silent()).frames:
            for chain in entry.chains:
                for points in run.truth.pixels_uv.values():
                    error = chain.pixels_uv - points[entry.frame][[number - 1 for number in chain.electrodes]]
                    if np.linalg.norm(error, axis=1).max() < 5.0:
                        stated += (np.trace(chain.covariance_px2, axis1=1, axis2=2) / 2).tolist()
                        missed += np.einsum("ni,nij,nj->n", error, np.linalg.inv(chain.covariance_px2), error).tolist()
    return np.array(stated), np.array(missed)


@pytest.mark.parametrize("segmenter", [CatheterChain(), LearnedChain()], ids=["catheter-chain", "learned-chain"])
def test_ellipses_hold_the_truth_at_any_compression(segmenter, simulated):
    sd = {}
    for quality in (90, 35):
        stated, missed = stated_and_missed(segmenter, simulated, quality)
        assert len(missed) >= 0.8 * 12 * FRAMES * len(SEEDS)
        assert np.mean(missed <= CHI2_95_2D) >= 0.92
        assert np.median(missed) > 0.25
        sd[quality] = np.sqrt(np.median(stated))
    assert sd[35] >= 0.9 * sd[90]


def test_noise_that_compression_hides_still_displaces(simulated):
    plain, compressed = (displayed(simulated[0].frames[0], quality).astype(np.float32) for quality in (100, 35))
    inside = np.ones(plain.shape, np.bool_)
    fine, coarse = (BlobResponse.of_image(x, inside, 1.0, PX_PER_MM) for x in (plain, compressed))
    assert coarse.pixel_noise < 0.6 * fine.pixel_noise
    assert 0.8 < coarse.position_noise / fine.position_noise < 1.3


def test_structures_displace_electrodes_in_a_mean_of_many_frames_too():
    draw = np.random.default_rng(5)
    structures = gaussian_filter(draw.normal(0.0, 1.0, (512, 512)), 5.0)
    structures *= 0.02 / structures.std()
    noise = draw.normal(0.0, 0.1, structures.shape)
    inside = np.ones(structures.shape, np.bool_)
    of_frame, of_mean, without_structures = (
        BlobResponse.of_image(x.astype(np.float32), inside, 1.0, 6.0).position_noise
        for x in (structures + noise, structures + noise / 10, noise / 10)
    )
    assert of_mean > 2.0 * without_structures
    assert of_mean > 0.2 * of_frame
