"""Ellipses where video coding has removed the noise: the unexplained rest of each profile says how sure a place is."""

from dataclasses import replace

import numpy as np
import pytest
from frame_sources import Frames
from scipy.ndimage import gaussian_filter

from fluoromap.catheters import DEFAULT_CATALOGUE, Catalogue, catheter_type
from fluoromap.contracts import Chain, PixelFacts, Run, Silent
from fluoromap.phantom import StudySpec, simulate_study
from fluoromap.segmenter.catheter_chain.plugin import CatheterChain
from fluoromap.segmenter.learned_chain.plugin import LearnedChain
from fluoromap.segmenter.places.ellipse import rest_gain
from fluoromap.segmenter.places.refinement import refine, unexplained_sd, with_unexplained_profile

PX_PER_MM = 4.0
CATHETER = DEFAULT_CATALOGUE["reference"]
INSIDE = np.ones((96, 160), np.bool_)


def noisy(sd: float, level: float = 120.0) -> Frames:
    random = np.random.default_rng(1)
    return Frames(np.round(level + sd * random.standard_normal((3, *INSIDE.shape))).astype(np.uint8))


def picture(artefact: float, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """Return a log image of the catheter and its places.

    Smooth artefacts of this size lie over it.
    """
    along = 30.0 + PX_PER_MM * CATHETER.arc_lengths_mm
    places = np.stack([along, np.full(len(along), 48.0)], axis=1)
    half = np.where(np.arange(len(along)) == 0, CATHETER.tip_mm, CATHETER.ring_mm) * PX_PER_MM / 2.0
    v, u = np.mgrid[:96, :160].astype(float)
    bands = np.zeros(u.shape)
    for (at_u, at_v), end in zip(places, half, strict=True):
        chord = np.sqrt(np.clip(1.0 - ((v - at_v) / PX_PER_MM) ** 2, 0.0, None))
        bands += chord * np.clip(0.5 + (end - np.abs(u - at_u)) / 2.0, 0.0, 1.0)
    noise = gaussian_filter(np.random.default_rng(seed).standard_normal(u.shape), 0.7)
    return (-bands + artefact * noise / noise.std()).astype(np.float32), places


def chain(places: np.ndarray, sd: float = 0.01) -> Chain:
    count = len(places)
    numbers = tuple(range(1, count + 1))
    return Chain(numbers, places, np.tile(sd**2 * np.eye(2), (count, 1, 1)), np.ones(count), (("reference", 1.0),))


def test_noise_of_some_grey_levels_speaks_for_itself():
    assert rest_gain(noisy(4.0), INSIDE, 8) == 0.0
    assert rest_gain(noisy(0.1), INSIDE, 12) == 0.0
    assert rest_gain(noisy(0.1), ~INSIDE, 8) == 0.0


def test_the_less_noise_is_left_the_more_the_rest_counts():
    without, little, some = (rest_gain(noisy(sd), INSIDE, 8) for sd in (0.2, 0.8, 2.0))
    assert without > little > some > 0.0


def test_neither_clipped_pixels_nor_a_blank_frame_look_coded():
    noise = 120.0 + 4.0 * np.random.default_rng(1).standard_normal((5, *INSIDE.shape))
    clipped = noise.copy()
    clipped[:, :, 40:] = 255.0
    assert rest_gain(Frames(np.round(clipped).astype(np.uint8)), INSIDE, 8) == 0.0
    noise[2] = 0.0
    assert rest_gain(Frames(np.round(noise).astype(np.uint8)), INSIDE, 8) == 0.0


def test_a_profile_that_is_explained_has_no_rest_and_one_with_artefacts_has():
    rests = []
    for artefact in (0.0, 0.05, 0.2):
        x, places = picture(artefact)
        axes, sd = unexplained_sd(x, places, CATHETER, chain(places).electrodes, PX_PER_MM)
        np.testing.assert_allclose(axes[:, 0], np.tile([1.0, 0.0], (len(places), 1)), atol=1e-9)
        np.testing.assert_allclose(axes[:, 1], np.tile([0.0, 1.0], (len(places), 1)), atol=1e-9)
        rests.append(float(np.median(sd)))
    assert rests[0] < rests[1] < rests[2]


def test_ellipses_hold_what_artefacts_displace():
    """The truth is where the rings were drawn; the places are those that fit best. The tips have no dome here."""
    held = []
    for seed in range(40):
        x, truth = picture(0.1, seed)
        nothing = np.zeros((1, len(truth)), np.bool_)
        fit = refine(x, truth[None], CATHETER, PX_PER_MM, 1e-4, nothing, nothing)
        found = replace(chain(fit.points_uv[0]), covariance_px2=fit.covariance_px2[0])
        (widened,) = with_unexplained_profile(x, (found,), DEFAULT_CATALOGUE, PX_PER_MM, 1.5)
        for one in (found, widened):
            off = one.pixels_uv - truth
            held.append((np.einsum("ni,nij,nj->n", off, np.linalg.inv(one.covariance_px2), off) < 5.99)[1:])
    before, after = np.mean(held[::2]), np.mean(held[1::2])
    assert before < 0.5
    assert after > 0.8


@pytest.mark.parametrize("what", ["manual", "no gain", "large", "one electrode"])
def test_other_ellipses_stay(what):
    x, places = picture(0.1)
    gain = 0.0 if what == "no gain" else 1.5
    one = replace(chain(places, 5.0 if what == "large" else 0.01), manual=what == "manual")
    if what == "one electrode":
        one = Chain((1,), places[:1], one.covariance_px2[:1], one.scores[:1], one.kinds)
    (kept,) = with_unexplained_profile(x, (one,), DEFAULT_CATALOGUE, PX_PER_MM, gain)
    np.testing.assert_array_equal(kept.covariance_px2, one.covariance_px2)


def test_the_profile_is_that_of_the_likely_catheter_and_its_tip():
    x, places = picture(0.0)
    longer = catheter_type("ablation-4", "mapping")
    numbers = chain(places).electrodes
    _, right = unexplained_sd(x, places, CATHETER, numbers, PX_PER_MM)
    _, wrong = unexplained_sd(x, places, longer, numbers, PX_PER_MM)
    assert wrong[0, 0] > 1.5 * right[0, 0]
    study = Catalogue((CATHETER, longer), "reference", "mapping")
    likely = replace(chain(places), kinds=(("mapping", 0.1), ("reference", 0.9)))
    (widened,) = with_unexplained_profile(x, (likely,), study, PX_PER_MM, 1.5)
    assert np.sqrt(widened.covariance_px2[0, 0, 0]) == pytest.approx(1.5 * right[0, 0])


@pytest.mark.parametrize("slope", [0.0, 0.01])
def test_coding_that_removes_an_electrode_leaves_a_large_ellipse(slope):
    _, places = picture(0.0)
    flat = np.broadcast_to(slope * np.arange(INSIDE.shape[1], dtype=np.float32), INSIDE.shape).copy()
    (widened,) = with_unexplained_profile(flat, (chain(places),), DEFAULT_CATALOGUE, PX_PER_MM, 1.5)
    np.testing.assert_allclose(np.sqrt(widened.covariance_px2[:, 1, 1]), 0.2 * PX_PER_MM)


@pytest.mark.parametrize("segmenter", [CatheterChain, LearnedChain])
def test_electrodes_of_smooth_pictures_have_larger_ellipses(monkeypatch, segmenter):
    spec = StudySpec(315, sites=1, frames=2, frame_rate_hz=60.0, heart="dog", contrast=("LAT", "PA"))
    lateral = simulate_study(spec).sites[0].runs[0]
    smooth = [gaussian_filter(frame.astype(float), 1.5) for frame in lateral.frames]
    highest = max(float(frame.max()) for frame in smooth)
    coded = Frames(np.array([np.round(200.0 * frame / highest) for frame in smooth]).astype(np.uint8))
    run = Run(coded, lateral.frame_times_ms, 512 / 178 * 2, PixelFacts(False, 8, False))
    found = segmenter().segment(run, DEFAULT_CATALOGUE, {}, Silent())
    monkeypatch.setattr("fluoromap.segmenter.runs.final_ellipses.rest_gain", lambda *_: 0.0)
    without = segmenter().segment(run, DEFAULT_CATALOGUE, {}, Silent())

    def sizes(entries):
        return np.array([np.linalg.det(one.covariance_px2) for entry in entries for one in entry.chains])

    assert np.median(sizes((*found.frames, found.diastole)) / sizes((*without.frames, without.diastole))) > 1.2


def test_where_no_band_shows_a_fifth_of_a_millimetre_is_enough():
    _, places = picture(0.0)
    empty = np.random.default_rng(2).standard_normal(INSIDE.shape).astype(np.float32)
    (widened,) = with_unexplained_profile(empty, (chain(places),), DEFAULT_CATALOGUE, PX_PER_MM, 1.5)
    largest = np.sqrt(np.linalg.eigvalsh(widened.covariance_px2).max())
    assert largest == pytest.approx(0.2 * PX_PER_MM)
