"""Lag of a recursive noise filter: measured from noise and shadows, taken out of the frames, part of the ellipses of what moves."""

import numpy as np
import pytest
from frame_sources import Frames as FrameList
from scipy.ndimage import gaussian_filter

from fluoromap.catheters import Catalogue, catheter_type
from fluoromap.contracts import Chain, FrameChains, PixelFacts, Run, Silent
from fluoromap.geometry import Gantry
from fluoromap.phantom import StudySpec, simulate_study
from fluoromap.segmenter.learned_chain.plugin import LearnedChain
from fluoromap.segmenter.picture.lag import measure_lag
from fluoromap.segmenter.picture.shadowless_frames import ShadowlessFrames
from fluoromap.segmenter.places.ellipse import with_lag

PIXELS = PixelFacts(logarithmic=False, bits_stored=16, monochrome1=False)
EVERYWHERE = np.ones((128, 128), np.bool_)


class Frames(list):
    shape = 128, 128


def filtered(lag: float, count: int = 8, quantised: bool = False) -> Frames:
    """Return noise after a recursive filter, on a slope, beside a dark bar that moves."""
    random = np.random.default_rng(1)
    slope = np.linspace(400.0, 900.0, 128)[None]
    state, frames = None, Frames()
    for frame in range(count + 20):
        exposure = random.poisson(np.broadcast_to(slope, (128, 128))).astype(np.float64)
        exposure[:, 8 * (frame % 8) : 8 * (frame % 8) + 10] *= 0.5
        state = exposure if state is None else lag * state + (1.0 - lag) * exposure
        frames.append((np.round(state / 16.0) if quantised else state).astype(np.float32))
    return Frames(frames[20:])


def repeated(noise_sd: float, step: int) -> FrameList:
    """Return pictures of eight bits with noise that repeats.

    A dark bar moves by ``step`` a frame.
    """
    random = np.random.default_rng(5)
    noise, frames = random.standard_normal((128, 128)), []
    for frame in range(12):
        noise = 0.8 * noise + 0.6 * random.standard_normal((128, 128))
        exposure = np.full((128, 128), 150.0)
        exposure[40:80, 20 + step * frame : 28 + step * frame] *= 0.5
        frames.append(np.round(gaussian_filter(exposure, 1.0) + noise_sd * noise).astype(np.uint8))
    return FrameList(frames)


@pytest.mark.parametrize("lag", [0.0, 0.2, 0.5, 0.7])
def test_lag_is_measured_beside_what_moves(lag):
    assert lag - 0.1 < measure_lag(filtered(lag), EVERYWHERE, PIXELS) <= lag + 0.03


def test_noise_alone_says_it_where_nothing_moves():
    still = [frame[:, 80:] for frame in filtered(0.5)]
    assert measure_lag(FrameList(still), EVERYWHERE[:, 80:], PIXELS) == pytest.approx(0.5, abs=0.05)


@pytest.mark.parametrize("step", [2, 8])
def test_noise_that_video_coding_repeats_is_no_lag(step):
    """The bar is where it is, but the noise beside it is that of the frame before."""
    assert measure_lag(repeated(3.0, step), EVERYWHERE, PixelFacts(False, 8, False)) == 0.0


def test_noise_of_pictures_whose_neighbours_are_alike_says_nothing():
    """Nothing moves that could say more."""
    eight = PixelFacts(False, 8, False)
    assert measure_lag(repeated(0.4, 0), EVERYWHERE, eight) == 0.0
    assert measure_lag(repeated(3.0, 0), EVERYWHERE, eight) > 0.5


def test_what_moves_slowly_does_not_refute_the_noise():
    slow = shadowed(0.4, 1)
    random = np.random.default_rng(9)
    state, frames = random.standard_normal((128, 128)), []
    for frame in slow:
        state = 0.4 * state + 0.6 * random.standard_normal((128, 128))
        frames.append(np.round(40.0 * frame + 20.0 * state).astype(np.uint16))
    assert measure_lag(FrameList(frames), EVERYWHERE, PIXELS) == pytest.approx(0.4, abs=0.05)


def test_quantisation_makes_it_a_lower_bound():
    assert 0.1 < measure_lag(filtered(0.5, quantised=True), EVERYWHERE, PIXELS) <= 0.5


@pytest.mark.parametrize("count", [1, 2, 3])
def test_few_frames_and_frames_without_noise_have_none(count):
    assert measure_lag(filtered(0.5, count), EVERYWHERE, PIXELS) == 0.0
    assert measure_lag(Frames([np.full((128, 128), 7, np.uint8)] * 5), EVERYWHERE, PIXELS) == 0.0
    assert measure_lag(filtered(0.5), ~EVERYWHERE, PIXELS) == 0.0


def shadowed(lag: float, step: int, level: float = 120.0, monochrome1: bool = False) -> Frames:
    """Return filtered pictures of 8 bits.

    A dark bar of eight pixels moves by ``step`` from frame to frame. Their noise is finer than a grey level, so that it says
    nothing of the lag.
    """
    random = np.random.default_rng(3)
    state, frames = None, Frames()
    for frame in range(12):
        exposure = level + 0.05 * random.standard_normal((128, 128))
        exposure[40:80, 20 + step * frame : 28 + step * frame] *= 0.5
        state = exposure if state is None else lag * state + (1.0 - lag) * exposure
        frames.append(np.round(255 - state if monochrome1 else state).astype(np.uint8))
    return frames


@pytest.mark.parametrize("monochrome1", [False, True])
@pytest.mark.parametrize("lag", [0.0, 0.25, 0.5])
def test_lag_is_measured_where_something_dark_was(lag, monochrome1):
    pixels = PixelFacts(logarithmic=False, bits_stored=8, monochrome1=monochrome1)
    frames = shadowed(lag, 8, monochrome1=monochrome1)
    assert measure_lag(frames, EVERYWHERE, pixels) == pytest.approx(lag, abs=0.03)


def test_what_hardly_moves_shows_no_lag():
    assert measure_lag(shadowed(0.0, 1), EVERYWHERE, PIXELS) == 0.0


@pytest.mark.parametrize("view", [0, 1])
def test_what_moves_slowly_leaves_no_lag(view):
    gantries = tuple(Gantry(primary, 0.0, 1000.0, 500.0, (2 / 4.1, 2 / 4.1), 512, 512) for primary in (90.0, 0.0))
    spec = StudySpec(9723, sites=1, frames=8, frame_rate_hz=60.0, heart="dog", gantries=gantries)
    run = simulate_study(spec).sites[0].runs[view]
    assert measure_lag(run.frames, np.ones((512, 512), np.bool_), PIXELS) == 0.0


def test_contrast_that_flows_away_is_no_lag():
    random = np.random.default_rng(7)
    frames = Frames()
    for frame in range(16):
        exposure = random.normal(1000.0, 5.0, (128, 128))
        exposure[40:80, 30:40] -= 600.0 * 0.8**frame
        frames.append(np.round(exposure).astype(np.uint16))
    assert measure_lag(frames, EVERYWHERE, PIXELS) == 0.0


@pytest.mark.parametrize("step", [2, 8])
def test_the_shadow_is_taken_out_and_the_pixels_keep_their_type(step):
    with_shadow, without = shadowed(0.45, step), shadowed(0.0, step)
    corrected = ShadowlessFrames(with_shadow, 0.45, 8)
    assert (corrected.shape, len(corrected), len(list(corrected))) == ((128, 128), 12, 12)
    for frame in (0, 5, 11, 6):
        assert corrected[frame].dtype == np.uint8
        np.testing.assert_allclose(corrected[frame].astype(float), without[frame], atol=2.0)
    assert np.abs(with_shadow[5].astype(float) - without[5]).max() > 20.0


def test_noise_that_the_filter_has_removed_does_not_come_back():
    frames = filtered(0.5, quantised=False)
    noise = [np.round(frame).astype(np.uint16) for frame in frames]
    corrected = ShadowlessFrames(Frames(noise), 0.5, 16)
    still = np.s_[:, 80:]
    before, after = ((frames_[4][still] - frames_[5][still].astype(float)).std() for frames_ in (noise, corrected))
    assert after < 1.25 * before


def test_values_stay_within_their_bits():
    frames = Frames([np.full((128, 128), level, np.uint16) for level in (0, 0, 4000)])
    frames[2][:, 64:] = 0
    frames[1][:, :64] = 4000
    corrected = ShadowlessFrames(frames, 0.5, 12)
    assert max(int(frame.max()) for frame in corrected) <= 4095


def chain(u: float, track: int = 0, manual: bool = False) -> Chain:
    points = np.array([[u, 10.0], [u + 10.0, 10.0]])
    return Chain((1, 2), points, np.tile(0.01 * np.eye(2), (2, 1, 1)), np.ones(2), (("cs", 1.0),), track, manual)


def test_ellipses_are_wider_along_the_motion_only():
    run = [
        FrameChains(0, (chain(10.0),)),
        FrameChains(1, (chain(11.0),)),
        FrameChains(2, (chain(31.0), chain(50.0, 1))),
    ]
    first, second, third = with_lag(run, 0.25, 4.0)
    # Half a pixel, at the first frame too; never more than 0.2 mm.
    for entry, sd in ((first, 0.5), (second, 0.5), (third, 0.8)):
        assert entry.chains[0].covariance_px2[1] == pytest.approx(np.diag([0.01 + sd**2, 0.01]))
    assert third.chains[1] is run[2].chains[1]
    assert with_lag(run, 0.0, 4.0) == tuple(run)


def test_what_a_user_set_keeps_its_ellipses():
    run = [FrameChains(0, (chain(10.0),)), FrameChains(1, (chain(14.0, manual=True),))]
    assert with_lag(run, 0.5, 4.0)[1] == run[1]


def test_electrodes_are_found_where_they_are_beside_their_shadows():
    catalogue = Catalogue((catheter_type("decapolar-2-5-2", "cs"),), None, "cs")
    cs, px_per_mm = catalogue["cs"], 3.5
    random = np.random.default_rng(4)
    v, u = np.mgrid[0:256, 0:256].astype(np.float64)
    direction = np.array([np.cos(0.6), np.sin(0.6)])
    state, frames, truth = None, [], []
    for frame in range(10):
        tip = np.array([70.0, 50.0]) + np.array([22.0, -14.0]) * np.sin(1.3 * frame)
        along = (u - tip[0]) * direction[0] + (v - tip[1]) * direction[1]
        across = (v - tip[1]) * direction[0] - (u - tip[0]) * direction[1]
        passed = np.where((np.abs(across) < 3.0) & (along > 0), 0.9, 1.0)
        arcs = cs.arc_lengths_mm * px_per_mm
        for index, arc in enumerate(arcs):
            half = 0.5 * px_per_mm * (cs.tip_mm if index == 0 else cs.ring_mm)
            passed = np.where((np.abs(along - arc) < half) & (np.abs(across) < 3.5), 0.35, passed)
        exposure = random.poisson(400.0 * gaussian_filter(passed, 0.7)).astype(np.float64)
        state = exposure if state is None else 0.45 * state + 0.55 * exposure
        frames.append(np.round(state).astype(np.uint16))
        truth.append(tip + arcs[:, None] * direction)
    run = Run(FrameList(frames), np.arange(10) * 133.3, px_per_mm, PixelFacts(False, 12, False))
    found = LearnedChain().segment(run, catalogue, {}, Silent()).frames
    for entry, places in zip(found[1:], truth[1:], strict=True):
        (chain_,) = entry.chains
        np.testing.assert_allclose(chain_.pixels_uv, places[np.array(chain_.electrodes) - 1], atol=2.5)
