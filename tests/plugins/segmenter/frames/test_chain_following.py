"""Chains fitted where they would be if they moved on, on drawn bands whose places are known."""

from dataclasses import replace

import numpy as np
import pytest

from fluoromap.catheters import DEFAULT_CATALOGUE, catheter_type
from fluoromap.contracts import Chain
from fluoromap.segmenter.frames.chain_following import follow_chains

PX_PER_MM = 5.0
NOISE = 0.02
REACH_PX = 5.0
INSIDE = np.ones((160, 260), np.bool_)
REFERENCE = DEFAULT_CATALOGUE["reference"]
ABLATION = catheter_type("ablation-4", "mapping")


def straight(catheter, v, shortening=1.0):
    along = catheter.arc_lengths_mm * PX_PER_MM * shortening
    return np.stack([60.0 + along, np.full(len(along), float(v))], axis=1)


def picture(*drawn):
    """Return a log image with the bands of (catheter, places) along u."""
    v, u = np.mgrid[: INSIDE.shape[0], : INSIDE.shape[1]].astype(np.float64)
    image = np.random.default_rng(5).normal(0.0, NOISE, v.shape)
    for catheter, places in drawn:
        for k, (at, across) in enumerate(places):
            half = 0.5 * (catheter.tip_mm if k == 0 else catheter.ring_mm) * PX_PER_MM
            band = np.clip(0.5 + (half - np.abs(u - at)) / 2.0, 0.0, 1.0)
            image -= 0.5 * band * (np.abs(v - across) < 5.5)
    return image.astype(np.float32)


def chain(places, name="reference"):
    count = len(places)
    return Chain(
        tuple(range(1, count + 1)), places, np.tile(4 * np.eye(2), (count, 1, 1)), np.linspace(0.5, 0.9, count), ((name, 1.0),),
        tip_odds=3.0,
    )  # fmt: skip


def follow(image, expected, catheters, inside=INSIDE):
    return follow_chains(image, expected, catheters, inside, PX_PER_MM, NOISE, REACH_PX)


def test_chains_are_found_at_their_places_and_keep_what_the_frame_before_says_of_them():
    places = [(REFERENCE, straight(REFERENCE, 40)), (ABLATION, straight(ABLATION, 100))]
    expected = [chain(places[0][1] + [1.2, -0.8]), chain(places[1][1] - [0.9, 1.1], "mapping")]
    found = follow(picture(*places), expected, [REFERENCE, ABLATION])
    for (_, truth), one, before in zip(places, found, expected, strict=True):
        error = one.pixels_uv - truth
        sd = np.sqrt(np.diagonal(one.covariance_px2, axis1=1, axis2=2))
        assert (np.abs(error[1:]) < 4.0 * sd[1:]).all()
        assert np.abs(error).max() < 1.0
        assert (one.kinds, one.tip_odds, one.electrodes) == (before.kinds, before.tip_odds, before.electrodes)
        assert np.array_equal(one.scores, before.scores)


def test_two_catheters_of_one_type_are_followed_together():
    places = [(REFERENCE, straight(REFERENCE, v)) for v in (40, 100)]
    found = follow(picture(*places), [chain(truth + 0.5) for _, truth in places], [REFERENCE, REFERENCE])
    for (_, truth), one in zip(places, found, strict=True):
        assert np.abs(one.pixels_uv - truth).max() < 0.5


def test_a_catheter_that_the_image_does_not_show_needs_a_search():
    places = straight(REFERENCE, 40)
    assert follow(picture(), [chain(places)], [REFERENCE]) is None
    other = straight(REFERENCE, 100)
    assert follow(picture((REFERENCE, places)), [chain(places), chain(other)], [REFERENCE, REFERENCE]) is None


def test_a_catheter_far_from_its_expected_place_needs_a_search():
    places = straight(REFERENCE, 40)
    image = picture((REFERENCE, places))
    assert follow(image, [chain(places + np.array([0.0, 3.0]))], [REFERENCE]) is not None
    assert follow(image, [chain(places + np.array([0.0, 8.0]))], [REFERENCE]) is None


def test_catheters_whose_electrodes_meet_need_a_search():
    places = straight(REFERENCE, 40), straight(REFERENCE, 46)
    image = picture(*((REFERENCE, each) for each in places))
    assert follow(image, [chain(each) for each in places], [REFERENCE] * 2) is None


def test_a_catheter_at_the_edge_of_the_field_needs_a_search():
    places = straight(REFERENCE, 40)
    inside = INSIDE.copy()
    inside[:, int(places[-1, 0]) - 2 :] = False
    assert follow(picture((REFERENCE, places)), [chain(places)], [REFERENCE], inside) is None
    outside = straight(REFERENCE, INSIDE.shape[0] + 3)
    assert follow(picture(), [chain(outside)], [REFERENCE]) is None


@pytest.mark.parametrize(("shortening", "followed"), [(0.7, True), (0.3, False)])
def test_a_catheter_seen_nearly_end_on_needs_a_search(shortening, followed):
    thin = replace(REFERENCE, tip_mm=0.8, ring_mm=0.8)
    places = straight(thin, 40, shortening)
    assert (follow(picture((thin, places)), [chain(places)], [thin]) is not None) == followed
