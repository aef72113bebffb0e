"""Final places: thin-walled rings that are seen obliquely show openings, whose dark ends a fit of bands takes for electrodes."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from fluoromap.catheters import Catalogue, catheter_type
from fluoromap.contracts import Chain
from fluoromap.segmenter.judge.acceptance import UNSEEN
from fluoromap.segmenter.places.cylinder_fit import fit_cylinders
from fluoromap.segmenter.places.oblique_places import place_obliquely
from fluoromap.segmenter.places.refinement import refine, usual_radius_mm

PX_PER_MM = 4.0
CATHETER = catheter_type("decapolar-2-8-2", "cs")
CATALOGUE = Catalogue((CATHETER, catheter_type("quadripolar-2-5-2", "rv")), "cs", "rv")
NOTHING = np.zeros(CATHETER.electrodes, np.bool_)


def picture_of(
    shortening: float | np.ndarray, noise: float = 0.01, px_per_mm: float = PX_PER_MM, inner: float = 0.9
) -> tuple[np.ndarray, np.ndarray]:
    """Return a log image of rings along a line, and their middles (electrodes, 2).

    Points on the walls of the rings are projected: each lies at an angle round the axis and at a depth. ``shortening`` : visible
    over true length, of all electrodes or of each. ``inner`` : the least distance from the axis, as a share of the radius.
    """
    random = np.random.default_rng(5)
    each = np.broadcast_to(shortening, CATHETER.electrodes)
    gaps_mm = np.diff(CATHETER.arc_lengths_mm) * 0.5 * (each[1:] + each[:-1])
    along = np.concatenate([[0.0], np.cumsum(gaps_mm)]) * px_per_mm
    places = np.stack([40.0 + along, np.full(len(along), 40.0)], axis=1)
    shape = 80, int(places[-1, 0]) + 40
    image = np.zeros(shape)
    for index, (u, v) in enumerate(places):
        half_mm = 0.5 * (CATHETER.tip_mm if index == 0 else CATHETER.ring_mm)
        axial, angle = random.uniform(-half_mm, half_mm, 60_000), random.uniform(0.0, 2 * np.pi, 60_000)
        radius = random.uniform(inner, 1.0, 60_000)
        right = axial * each[index] + radius * np.cos(angle) * np.sqrt(1.0 - each[index] ** 2)
        down = radius * np.sin(angle)
        seen, _, _ = np.histogram2d(
            v + down * px_per_mm,
            u + right * px_per_mm,
            bins=[np.arange(shape[0] + 1) - 0.5, np.arange(shape[1] + 1) - 0.5],
        )
        image -= seen * half_mm
    image *= 0.8 / -gaussian_filter(image, 0.8).min()
    return (gaussian_filter(image, 0.8) + random.normal(0.0, noise, shape)).astype(np.float32), places


def chain_at(places: np.ndarray) -> Chain:
    count = len(places)
    covariance = np.tile(0.01 * np.eye(2), (count, 1, 1))
    return Chain(tuple(range(1, count + 1)), places, covariance, np.ones(count), (("cs", 0.9), ("rv", 0.1)))


def found_in(image: np.ndarray, places: np.ndarray) -> np.ndarray:
    return refine(image, places[None], CATHETER, PX_PER_MM, 0.01, NOTHING[None], NOTHING[None]).points_uv[0]


def largest_error(found: np.ndarray, places: np.ndarray) -> float:
    return float(np.linalg.norm(found - places, axis=1)[1:].max())


@pytest.mark.parametrize("shortening", [0.65, 0.75, 0.85])
def test_oblique_rings_in_pairs_are_where_they_are(shortening):
    image, places = picture_of(shortening)
    (placed,) = place_obliquely(image, [chain_at(found_in(image, places))], CATALOGUE, PX_PER_MM)
    assert np.linalg.norm(placed.pixels_uv - places, axis=1)[1:].max() < 0.6


# At half their length, electrodes of a pair would change places in turn.
@pytest.mark.parametrize(
    ("shortening", "shift_mm"),
    [
        (0.5, "all"),
        (0.5, "pairs apart"),
        *((each, way) for each in (0.65, 0.8) for way in ("all", "pairs apart", "in turn")),
    ],
)
def test_places_on_dark_ends_of_openings_move_to_the_middles_of_the_rings(shortening, shift_mm):
    image, places = picture_of(shortening)
    opening_mm = np.sqrt(1.0 - shortening**2)
    count = np.arange(CATHETER.electrodes)
    way = {"all": np.ones(len(count)), "in turn": count % 3 - 1.0, "pairs apart": np.where(count % 2, 1.0, -1.0)}[
        shift_mm
    ]
    way[0] = 0.0
    wrong = places + np.stack([0.9 * opening_mm * way * PX_PER_MM, np.zeros(len(count))], axis=1)
    (placed,) = place_obliquely(image, [chain_at(wrong)], CATALOGUE, PX_PER_MM)
    before, after = (
        np.linalg.norm(found - places, axis=1)[1:].max() / PX_PER_MM for found in (wrong, placed.pixels_uv)
    )
    assert after < 0.15 < before


@pytest.mark.parametrize(("first", "last"), [(1.0, 0.65), (0.7, 1.0)])
def test_a_part_of_a_catheter_may_be_oblique_and_larger_than_described(first, last):
    """The catheter as a whole is as long as its description: it lies nearer to the X-ray source, and turns."""
    shortening = np.linspace(first, last, CATHETER.electrodes)
    image, places = picture_of(shortening, px_per_mm=1.15 * PX_PER_MM)
    way = np.where(np.arange(CATHETER.electrodes) % 2, 1.0, -1.0) * (np.arange(CATHETER.electrodes) > 0)
    wrong = places + np.stack([0.9 * np.sqrt(1.0 - shortening**2) * way * PX_PER_MM, 0.0 * way], axis=1)
    (placed,) = place_obliquely(image, [chain_at(wrong)], CATALOGUE, PX_PER_MM)
    assert largest_error(placed.pixels_uv, places) < 0.15 * PX_PER_MM < largest_error(wrong, places)


@pytest.mark.parametrize(("inner", "is_solid"), [(0.9, False), (0.0, True)])
def test_rings_without_openings_are_known(inner, is_solid):
    """Bands fit them well, so more has to speak for other places."""
    image, places = picture_of(0.5, inner=inner)
    fit = fit_cylinders(image, places, CATHETER, PX_PER_MM, usual_radius_mm(CATHETER), NOTHING)
    assert fit.is_solid == is_solid


def test_bands_that_end_perpendicular_to_the_shaft_stay_where_they_are():
    v, u = np.mgrid[:80, :240].astype(np.float64)
    places = np.stack([40.0 + CATHETER.arc_lengths_mm * 0.75 * PX_PER_MM, np.full(CATHETER.electrodes, 40.0)], axis=1)
    image = np.random.default_rng(3).normal(0.0, 0.02, v.shape)
    for index, (at, _) in enumerate(places):
        half = 0.375 * (CATHETER.tip_mm if index == 0 else CATHETER.ring_mm) * PX_PER_MM
        image -= 0.5 * np.clip(0.5 + (half - np.abs(u - at)) / 2.0, 0.0, 1.0) * (np.abs(v - 40.0) < 4.0)
    chain = chain_at(places)
    assert place_obliquely(image.astype(np.float32), [chain], CATALOGUE, PX_PER_MM) == (chain,)


def test_what_a_user_set_and_parts_of_a_catheter_stay():
    image, places = picture_of(0.75)
    found = chain_at(found_in(image, places))
    part = replace(
        found,
        electrodes=found.electrodes[:9],
        pixels_uv=found.pixels_uv[:9],
        covariance_px2=found.covariance_px2[:9],
        scores=found.scores[:9],
    )
    for chain in (replace(found, manual=True), part):
        assert place_obliquely(image, [chain], CATALOGUE, PX_PER_MM) == (chain,)


def test_electrodes_that_move_are_less_sure_and_unseen_ones_stay():
    image, places = picture_of(0.75)
    found = chain_at(found_in(image, places))
    scores = np.where(np.arange(CATHETER.electrodes) == 4, UNSEEN, 1.0)
    (placed,) = place_obliquely(image, [replace(found, scores=scores)], CATALOGUE, PX_PER_MM)
    way = np.linalg.norm(placed.pixels_uv - found.pixels_uv, axis=1)
    assert way[4] == pytest.approx(0.0, abs=0.05)
    assert way[5] > 0.5
    more = placed.covariance_px2 - found.covariance_px2
    along, across = more[:, 0, 0], more[:, 1, 1]
    assert 0.3 * way[5] < np.sqrt(along[5]) < way[5]
    # The line that they move along bends.
    assert 0.0 < across[5] < along[5]
    assert np.linalg.norm(more[4]) < 0.01
