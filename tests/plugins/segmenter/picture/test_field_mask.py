from dataclasses import replace

import numpy as np
import pytest
from scipy import ndimage

from fluoromap.contracts import PixelFacts, Shutter
from fluoromap.phantom import StudySpec, simulate_study
from fluoromap.segmenter.picture.collimator import within_collimator
from fluoromap.segmenter.picture.field_mask import find_field, inside_shutter
from fluoromap_service.dicom import open_frames, read_instance

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


@pytest.mark.parametrize("share", [0.55, 0.6])
def test_a_spine_with_a_straight_steep_edge_stays(share):
    """In a frontal view of high contrast it is as long and as steep as a collimator's edge, and nothing bright lies behind it."""
    u = np.arange(256)[None].repeat(256, axis=0)
    level = 1000 * (1 - (1 - share) / (1 + np.exp(u - 90.0)))
    field = find_field(Still(np.random.default_rng(1).poisson(level).astype(float)), FACTS)
    assert field.inside.all()


def test_a_blade_and_its_penumbra_are_cut(patient):
    patient[:, :30] *= 0.2
    field = find_field(Still(patient), FACTS)
    assert not field.inside[:, :32].any()
    assert field.inside[64:192, 48:200].all()


@pytest.mark.parametrize("share", [0.2, 0.02, 0.0])
def test_a_blade_is_cut_where_it_is_at_every_place(anatomies, share):
    """A sharp edge is steep over several pixels, which may not pass for a second edge."""
    misplaced = []
    for blade in range(60, 92):
        picture = anatomies["a"][1].astype(np.float32)
        picture[:, :blade] *= share
        inside = within_collimator(picture)
        first = np.argmax(inside[128:384], axis=1)
        misplaced += [blade] if np.abs(first - blade).max() > 6 else []
    assert misplaced == []


@pytest.mark.filterwarnings("error::RuntimeWarning")
def test_levels_below_zero_are_dark(patient):
    patient[:, 190:] = -50.0
    inside = within_collimator(patient.astype(np.float32))
    assert inside[:, :185].all()
    assert not inside[:, 195:].any()


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
    v, u = np.mgrid[0:64, 0:64].astype(float)
    polygon = inside_shutter(Shutter(polygon=((10, 10), (50, 10), (50, 40), (10, 40))), u, v)
    rectangle = inside_shutter(Shutter(rectangle=(10, 50, 10, 40)), u, v)
    assert np.count_nonzero(polygon ^ rectangle) <= 140
    circle = inside_shutter(Shutter(circle=(32, 32, 20)), u, v)
    assert circle.sum() == pytest.approx(np.pi * 400, rel=0.02)


def test_outside_is_filled_from_the_nearest_inside(patient):
    field = find_field(Still(patient), PixelFacts(False, 12, False, Shutter(circle=(128, 128, 100))))
    x = patient.astype(np.float32)
    x[~field.inside] = 1e9
    assert field.fill(x).max() < 2000


def _polygon(*sides):
    """Return the pixels of 512 x 512 inside all blades.

    A blade is (angle of the outward normal in degrees, distance from the middle).
    """
    v, u = np.mgrid[0:512, 0:512] - 255.5
    return np.logical_and.reduce(
        [u * np.cos(np.radians(angle)) + v * np.sin(np.radians(angle)) < distance for angle, distance in sides]
    )


def _circle(u0, v0, radius):
    v, u = np.mgrid[0:512, 0:512]
    return np.hypot(u - u0, v - v0) < radius


COLLIMATORS = {
    "rectangle": _polygon((180, 215), (0, 214), (270, 195), (90, 224)),
    "one blade": _polygon((180, 165)),
    "turned rectangle": _polygon((12, 200), (192, 200), (102, 210), (282, 210)),
    "turned by 45 degrees": _polygon((45, 230), (135, 230), (225, 230), (315, 230)),
    "one turned blade": _polygon((-20, 150)),
    "octagon": _polygon(*((angle, 230) for angle in range(0, 360, 45))),
    "corners": _polygon((45, 290), (135, 290), (225, 290), (315, 290)),
    "circle": _circle(262, 250, 240),
    "small circle": _circle(240, 270, 190),
    "circle and blades": _circle(256, 256, 245) & _polygon((180, 196), (90, 174)),
}


@pytest.fixture(scope="module")
def anatomies():
    """Electrodes, ribs, a spine and a diaphragm: three frames of each view of the phantom."""
    runs = simulate_study(StudySpec(seed=303, sites=1, frames=3, contrast=("LAT", "PA"))).sites[0].runs
    return {run.view: np.stack(list(run.frames)) for run in runs}


class Shown:
    def __init__(self, frames):
        self.frames, self.shape = frames, frames.shape[1:]

    def __len__(self):
        return len(self.frames)

    def __getitem__(self, index):
        return self.frames[index]


@pytest.mark.parametrize("view", ["a", "b"])
@pytest.mark.parametrize("leak", [0.02, 0.12, 0.25])
@pytest.mark.parametrize("name", COLLIMATORS)
def test_collimators_of_every_form_are_cut_and_anatomy_is_not(anatomies, name, leak, view):
    shape = COLLIMATORS[name]
    lit = leak + (1 - leak) * ndimage.gaussian_filter(shape.astype(float), 2.5)
    field = find_field(Shown((anatomies[view] * lit).astype(np.uint16)), FACTS)
    outside, deep = ~shape, ndimage.binary_erosion(shape, iterations=14, border_value=1)
    assert (field.inside & outside).sum() <= 0.002 * outside.sum()
    # An octagon may be taken for the circle in it, which costs its corners.
    assert (deep & ~field.inside).sum() <= 0.035 * deep.sum()
    assert not (field.candidates & ~ndimage.binary_erosion(shape, iterations=10, border_value=1)).any()


@pytest.mark.parametrize("view", ["a", "b"])
def test_without_a_collimator_nothing_is_cut(anatomies, view):
    assert find_field(Shown(anatomies[view]), FACTS).inside.all()


def test_the_mean_level_is_one_of_stored_pixels(patient):
    plain = find_field(Still(patient), FACTS)
    turned = find_field(Still(4095 - patient), replace(FACTS, monochrome1=True))
    assert turned.mean_level == pytest.approx(4095 - plain.mean_level, abs=1.0)


def _real(folder, name):
    path = folder / name
    facts = read_instance(path)
    return open_frames(path, facts), facts.pixels


def test_real_octagonal_collimator(sample_data):
    frames, facts = _real(sample_data, "xa_512x512x96_jpeg_baseline.dcm")
    field = find_field(frames, facts)
    # Measured in the picture: the left blade ends at column 43 and the picture at 492, the lower one begins at row 455,
    # the cut corners run at 45 degrees; the dark right half is heart and spine.
    assert not field.inside[:, :45].any()
    assert not field.inside[458:].any()
    assert not field.inside[:40, :40].any()
    assert not field.inside[:30, -60:].any()
    assert field.inside[110:340, 60:470].all()
    assert 0.62 < field.inside.mean() < 0.72


def test_real_round_field_with_and_without_its_shutter_attributes(sample_data):
    frames, facts = _real(sample_data, "rf_1024_shutter.dcm")
    told = find_field(frames, facts).inside
    fitted = find_field(frames, replace(facts, shutter=None)).inside
    v, u = np.mgrid[0 : told.shape[0], 0 : told.shape[1]]
    assert not told[np.hypot(u - 479, v - 479) > 470].any()
    assert told[np.hypot(u - 479, v - 479) < 450].all()
    assert (told & ~fitted).sum() < 0.03 * told.sum()
    assert (fitted & ~told).sum() < 0.05 * told.sum()
