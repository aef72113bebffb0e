"""Wider ellipses of electrodes off the curve through the others of their chain."""

from dataclasses import replace

import numpy as np
import pytest

from fluoromap.catheters import Catalogue, catheter_type
from fluoromap.contracts import Chain
from fluoromap.segmenter.places.ellipse import with_shape

CHI2_95_2D = 5.991464547107979
PX_PER_MM = 4.0
TYPES = ("quadripolar-2-5-2", "decapolar-2-5-2", "circular-10")
CATALOGUE = Catalogue(tuple(catheter_type(name, name) for name in TYPES), TYPES[1], TYPES[0])


def bent(name: str, shortening: float = 0.8, radius_mm: float = 60.0) -> np.ndarray:
    """Return the middles of the electrodes along an arc that is seen shortened, (electrodes, 2)."""
    arc = CATALOGUE[name].arc_lengths_mm
    curvature = CATALOGUE[name].curvature_per_mm or 1.0 / radius_mm
    angle = arc * curvature
    return PX_PER_MM / curvature * np.stack([np.sin(angle), shortening * (1.0 - np.cos(angle))], axis=1) + 100.0


def chain_of(name: str, places: np.ndarray, sd_px: float = 0.1, missing: tuple[int, ...] = ()) -> Chain:
    seen = [index for index in range(len(places)) if index not in missing]
    covariance = np.tile(sd_px**2 * np.eye(2), (len(seen), 1, 1))
    numbers = tuple(index + 1 for index in seen)
    return Chain(numbers, places[seen], covariance, np.ones(len(seen)), ((name, 1.0),))


@pytest.mark.parametrize("name", TYPES)
@pytest.mark.parametrize("missing", [(), (2,)])
def test_electrodes_on_a_smooth_curve_keep_their_ellipses(name, missing):
    chain = chain_of(name, bent(name), missing=missing)
    (same,) = with_shape([chain], CATALOGUE, PX_PER_MM)
    np.testing.assert_allclose(same.covariance_px2, chain.covariance_px2)


@pytest.mark.parametrize("index", [0, 3, 9])
@pytest.mark.parametrize("direction", [(1.0, 0.0), (0.0, 1.0)])
def test_the_ellipse_of_a_displaced_electrode_holds_its_place(index, direction):
    places = bent("decapolar-2-5-2")
    displaced = places.copy()
    displaced[index] += 4.0 * np.array(direction)
    (wider,) = with_shape([chain_of("decapolar-2-5-2", displaced)], CATALOGUE, PX_PER_MM)
    error = displaced - places
    missed = np.einsum("ni,nij,nj->n", error, np.linalg.inv(wider.covariance_px2), error)
    assert missed[index] <= CHI2_95_2D
    sd = np.sqrt(wider.covariance_px2[:, 0, 0])
    assert sd[index] >= sd.max() - 1e-9
    # Electrodes that are far from it are as sure as before.
    assert np.count_nonzero(sd > 0.11) <= 4


def test_an_ellipse_grows_along_the_catheter_at_least_as_much_as_across():
    straight = bent("decapolar-2-5-2", radius_mm=1e6)
    sd = []
    for direction in ([3.0, 0.0], [0.0, 3.0]):
        displaced = straight.copy()
        displaced[4] += direction
        (wider,) = with_shape([chain_of("decapolar-2-5-2", displaced)], CATALOGUE, PX_PER_MM)
        sd.append(np.sqrt(np.diag(wider.covariance_px2[4])))
    # What displaced it along the catheter leaves it as sure across.
    assert sd[0][0] > 2.0
    assert sd[0][1] < 0.11
    assert 1.2 < sd[1][1] <= sd[1][0] + 1e-9


def test_what_is_known_to_be_unsure_gets_no_wider():
    places = bent("decapolar-2-5-2")
    places[4] += [0.0, 4.0]
    chain = chain_of("decapolar-2-5-2", places)
    unsure = chain.covariance_px2.copy()
    unsure[4] = 100.0 * np.eye(2)
    chain = replace(chain, covariance_px2=unsure)
    np.testing.assert_allclose(with_shape([chain], CATALOGUE, PX_PER_MM)[0].covariance_px2, unsure)


@pytest.mark.parametrize("name", TYPES)
@pytest.mark.parametrize("sd_px", [0.5, 1.5])
def test_ellipses_that_are_right_hold_95_percent_afterwards_too(name, sd_px):
    random = np.random.default_rng(4)
    places, held = bent(name), []
    for _ in range(200):
        error = random.normal(0.0, sd_px, places.shape)
        (same,) = with_shape([chain_of(name, places + error, sd_px)], CATALOGUE, PX_PER_MM)
        held.append(np.einsum("ni,nij,nj->n", error, np.linalg.inv(same.covariance_px2), error) <= CHI2_95_2D)
    assert 0.94 < np.mean(held) < 0.988


def test_chains_of_users_and_pairs_keep_their_ellipses():
    places = bent("quadripolar-2-5-2")
    places[1] += [0.0, 4.0]
    manual = replace(chain_of("quadripolar-2-5-2", places), manual=True)
    pair = chain_of("quadripolar-2-5-2", places, missing=(2, 3))
    assert with_shape([manual, pair], CATALOGUE, PX_PER_MM) == (manual, pair)
