import numpy as np
import pytest

from fluoromap.contracts import PixelFacts, Shutter
from fluoromap.segmenter.field_mask import find_field, inside_shutter

FACTS = PixelFacts(False, 12, False)


class Still:
    """A run of one picture."""

    def __init__(self, picture):
        self.picture, self.shape = picture.astype(np.uint16), picture.shape

    def __len__(self):
        return 20

    def __getitem__(self, index):
        return self.picture

    def __iter__(self):
        return iter([self.picture] * 20)


@pytest.fixture
def patient():
    """Bright left half, truly dark right half (a fifth of the level), noise."""
    rng = np.random.default_rng(1)
    u = np.arange(256)[None].repeat(256, axis=0)
    level = 1000 / (1 + 4 / (1 + np.exp(-(u - 140) / 25)))
    return rng.poisson(level).astype(float)


def test_a_dark_half_of_the_patient_stays(patient):
    assert find_field(Still(patient), FACTS).inside.all()


def test_a_blade_and_its_penumbra_are_cut(patient):
    patient[:, :30] *= 0.2
    field = find_field(Still(patient), FACTS)
    assert not field.inside[:, :32].any()
    assert field.inside[64:192, 48:200].all()


def test_a_circular_collimator_is_cut(patient):
    v, u = np.mgrid[0:256, 0:256]
    out = np.hypot(u - 132, v - 124) > 110
    patient[out] *= 0.15
    field = find_field(Still(patient), FACTS)
    assert not (field.inside & out).any()
    assert field.inside[np.hypot(u - 132, v - 124) < 90].all()


def test_shutter_attributes_are_believed(patient):
    facts = PixelFacts(False, 12, False, Shutter(rectangle=(40, 200, 50, 220)))
    field = find_field(Still(patient), facts)
    assert field.inside.sum() == pytest.approx((159 - 20) * (169 - 20), rel=0.03)
    assert not field.candidates[:, :60].any()


def test_shutter_shapes():
    polygon = inside_shutter(Shutter(polygon=((10, 10), (50, 10), (50, 40), (10, 40))), (64, 64))
    rectangle = inside_shutter(Shutter(rectangle=(10, 50, 10, 40)), (64, 64))
    assert np.count_nonzero(polygon ^ rectangle) <= 140
    circle = inside_shutter(Shutter(circle=(32, 32, 20)), (64, 64))
    assert circle.sum() == pytest.approx(np.pi * 400, rel=0.02)


def test_outside_is_filled_from_the_nearest_inside(patient):
    field = find_field(Still(patient), PixelFacts(False, 12, False, Shutter(circle=(128, 128, 100))))
    x = patient.astype(np.float32)
    x[~field.inside] = 1e9
    assert field.fill(x).max() < 2000
