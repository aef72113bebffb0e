"""Steps 1 to 4 against their equations, and against plain double-precision twins that go sweep by sweep."""

import math

import numpy as np
import pytest
from scipy import ndimage

from fluoromap.contracts import PixelFacts
from fluoromap.segmenter.four_step.blobs import components, find_blobs, otsu_threshold
from fluoromap.segmenter.four_step.complex_shock import complex_shock, to_grey_range
from fluoromap.segmenter.four_step.homomorphic import equivalent_sigma, homomorphic
from fluoromap.segmenter.four_step.morphology import disk_morphology
from fluoromap.segmenter.four_step.perona_malik import edge_scale, perona_malik
from fluoromap.segmenter.picture.gaussian_blur import gaussian
from fluoromap.segmenter.picture.log_image import LogTransform


def plain_homomorphic(x, low=0.5, high=2.0, slope=1.0, cutoff=8.0, mode="reflect"):
    sigma = x.shape[1] * math.sqrt(slope) / (math.pi * math.sqrt(2) * cutoff)
    blurred = ndimage.gaussian_filter(x.astype(float), sigma, mode=mode, truncate=8.0)
    return high * x - (high - low) * blurred


def plain_perona_malik(x, k, sweeps=15, step=0.2):
    x = x.astype(float)
    for _ in range(sweeps):
        p = np.pad(x, 1, mode="edge")
        differences = (p[:-2, 1:-1] - x, p[2:, 1:-1] - x, p[1:-1, :-2] - x, p[1:-1, 2:] - x)
        x = x + step * sum(d * np.exp(-((d / k) ** 2)) for d in differences)
    return x


def plain_complex_shock(
    x, sweeps=15, step=0.1, magnitude=0.5, tangential=0.5, theta=math.pi / 1000, feedback=0.5, sign=-1.0
):
    value = x.astype(complex)
    lam = magnitude * np.exp(1j * theta)
    for _ in range(sweeps):
        p = np.pad(value, 1, mode="edge")
        c = p[1:-1, 1:-1]
        east, west = (p[1:-1, 2:] - c).real, (c - p[1:-1, :-2]).real
        south, north = (p[2:, 1:-1] - c).real, (c - p[:-2, 1:-1]).real
        steepness = np.hypot(_minmod(east, west), _minmod(south, north))
        gu, gv = 0.5 * (east + west), 0.5 * (south + north)
        uu = p[1:-1, 2:] - 2 * c + p[1:-1, :-2]
        vv = p[2:, 1:-1] - 2 * c + p[:-2, 1:-1]
        uv = 0.25 * (p[2:, 2:] + p[:-2, :-2] - p[2:, :-2] - p[:-2, 2:])
        square = gu**2 + gv**2 + 1e-8
        along = (uu * gu**2 + 2 * uv * gu * gv + vv * gv**2) / square
        across = (uu * gv**2 - 2 * uv * gu * gv + vv * gu**2) / square
        shock = sign * 2 / math.pi * np.arctan(feedback * value.imag / theta) * steepness
        value = value + step * (shock + lam * along + tangential * across)
    return value.real


def _minmod(a, b):
    return np.where(a * b > 0, np.sign(a) * np.minimum(abs(a), abs(b)), 0.0)


def plain_disk(radius):
    v, u = np.ogrid[-radius : radius + 1, -radius : radius + 1]
    return u * u + v * v <= radius * radius


def plain_disk_morphology(x, background, opening):
    def dilate(a, r):
        return ndimage.grey_dilation(a, footprint=plain_disk(r), mode="constant", cval=-np.inf)

    def erode(a, r):
        return ndimage.grey_erosion(a, footprint=plain_disk(r), mode="constant", cval=np.inf)

    hat = erode(dilate(x, background), background) - x
    return dilate(erode(hat, opening), opening)


@pytest.fixture(scope="module")
def image():
    """A log image of smooth shading, dark spots and noise."""
    rng = np.random.default_rng(5)
    v, u = np.mgrid[0:160, 0:192]
    x = 6 + 0.4 * np.sin(u / 60) + 0.3 * np.cos(v / 45)
    for cu, cv in ((40, 50), (60, 55), (120, 100), (150, 90), (90, 120)):
        x = x - 0.8 * (np.hypot(u - cu, v - cv) < 5)
    return ndimage.gaussian_filter(x + rng.normal(0, 0.05, x.shape), 0.7).astype(np.float32)


def test_equation_4_is_a_constant_less_a_gaussian():
    """The Fourier filter H(D) of equation (4), D in cycles per width, equals the spatial form on a periodic image."""
    x = np.random.default_rng(0).normal(size=(128, 128))
    low, high, slope, cutoff = 0.5, 2.0, 1.3, 8.0
    d2 = (np.fft.fftfreq(128)[:, None] * 128) ** 2 + (np.fft.fftfreq(128)[None] * 128) ** 2
    transfer = (high - low) * (1 - np.exp(-slope * d2 / cutoff**2)) + low
    by_fourier = np.fft.ifft2(np.fft.fft2(x) * transfer).real
    sigma = equivalent_sigma(128, slope, cutoff)
    in_space = high * x - (high - low) * ndimage.gaussian_filter(x, sigma, mode="wrap", truncate=8.0)
    np.testing.assert_allclose(in_space, by_fourier, atol=1e-12)


def test_equation_4_agrees_with_its_plain_twin_and_keeps_the_mean(image):
    expected = plain_homomorphic(image) + 0.5 * image.mean()
    got = homomorphic(image)
    assert np.abs(got - expected).max() <= 2e-3 * np.ptp(expected)
    assert got.mean() == pytest.approx(image.mean(), abs=5e-3)


@pytest.mark.parametrize("sigma", [0.8, 3.0, 9.0, 20.0])
def test_gaussian(image, sigma):
    expected = ndimage.gaussian_filter(image.astype(float), sigma, mode="reflect", truncate=6)
    assert np.abs(gaussian(image, sigma) - expected).max() <= 2e-3 * np.ptp(image)


def test_equations_5_and_6_agree_with_their_plain_twin(image):
    k = edge_scale(image, np.ones(image.shape, bool))
    expected = plain_perona_malik(image, k)
    assert np.abs(perona_malik(image, k) - expected).max() <= 0.005 * np.ptp(expected)


def test_diffusion_conserves_the_mean_and_obeys_the_maximum_principle(image):
    out = perona_malik(image, 0.2)
    assert out.mean(dtype=float) == pytest.approx(image.mean(dtype=float), abs=1e-5)
    assert out.min() >= image.min() - 1e-5
    assert out.max() <= image.max() + 1e-5


def test_diffusion_dissolves_a_checkerboard_and_refuses_the_step_at_which_one_survives():
    board = (np.indices((64, 64)).sum(axis=0) % 2).astype(np.float32)
    out = perona_malik(board, k=50.0, sweeps=15, step=0.2)
    assert np.ptp(out[8:-8, 8:-8]) < 0.01
    survivor = np.abs(np.fft.fft2(plain_perona_malik(np.pad(board, 32, mode="wrap"), 1e3, 15, 0.25)[32:-32, 32:-32]))
    assert survivor[32, 32] == pytest.approx(np.abs(np.fft.fft2(board))[32, 32], rel=1e-3)
    with pytest.raises(ValueError, match="between 0 and"):
        perona_malik(board, 1.0, step=0.25)


def test_edge_scale_has_a_floor_where_quantisation_hides_the_noise_and_none_for_a_flat_frame():
    steps = np.repeat(np.arange(8, dtype=np.float32), 16)[None].repeat(64, axis=0)
    inside = np.ones(steps.shape, bool)
    assert edge_scale(steps, inside) == pytest.approx(7e-3, rel=0.1)
    assert edge_scale(np.full((64, 64), 3, np.float32), np.ones((64, 64), bool)) is None


@pytest.mark.parametrize("theta", [math.pi / 1000, 0.01])
def test_equation_7_agrees_with_its_plain_twin(image, theta):
    grey = to_grey_range(image, np.ones(image.shape, bool))
    expected = plain_complex_shock(grey, theta=theta)
    assert np.abs(complex_shock(grey, theta=theta) - expected).max() <= 1e-3 * np.ptp(expected)


def test_the_minus_sign_of_equation_7_sharpens():
    u = np.arange(96, dtype=np.float32)
    edge = (255 / (1 + np.exp(-(u - 48) / 3))).astype(np.float32)[None].repeat(48, axis=0)
    slope = np.abs(np.diff(edge[24])).max()
    # diffusion alone would flatten it, and with plus in front the shock would too
    sharpened = np.abs(np.diff(complex_shock(edge, sweeps=30)[24])).max()
    with_plus = np.abs(np.diff(plain_complex_shock(edge, sweeps=30, sign=1.0)[24])).max()
    assert sharpened > slope > with_plus


def test_shock_refuses_an_unstable_step():
    with pytest.raises(ValueError, match="step"):
        complex_shock(np.zeros((32, 32), np.float32), step=0.6)


def test_shock_refuses_a_theta_for_which_it_leaves_out_too_much():
    with pytest.raises(ValueError, match="theta"):
        complex_shock(np.zeros((32, 32), np.float32), theta=0.1)


def test_disk_morphology_is_exact(image):
    expected = plain_disk_morphology(image.astype(float), 9, 2)
    np.testing.assert_allclose(disk_morphology(image, 9, 2), expected, atol=3e-5 * np.ptp(image))


def test_otsu_agrees_with_scikit_image():
    from skimage.filters import threshold_otsu

    rng = np.random.default_rng(2)
    x = np.abs(np.where(rng.random((80, 80)) < 0.1, rng.normal(5, 0.5, (80, 80)), rng.normal(1, 0.3, (80, 80))))
    x = x.astype(np.float32)
    assert otsu_threshold(x, np.ones(x.shape, bool)) == pytest.approx(threshold_otsu(x, nbins=1024), abs=0.02)


def test_otsu_of_few_grey_levels_needs_no_class_means():
    inside = np.ones((20, 20), bool)
    assert otsu_threshold(np.zeros((20, 20), np.float32), inside) == 0.0
    assert otsu_threshold(np.ones((20, 20), np.float32), inside) == pytest.approx(1 / 1023)
    # The brightest pixel lies outside the mask, so that the upper bins are empty.
    two = np.where(np.arange(20) < 10, 100.0, 200.0).astype(np.float32)[None].repeat(20, axis=0)
    two[0, 0], inside[0, 0] = 1000.0, False
    assert 100 < otsu_threshold(two, inside) < 200


def test_components_agree_with_scikit_image():
    from skimage.measure import label, regionprops

    rng = np.random.default_rng(3)
    for share in (0.02, 0.4, 0.6, 0.95):
        x = rng.random((70, 93)).astype(np.float32)
        inside = np.hypot(*np.ogrid[-35:35, -46:47]) < 45
        bright = (x >= np.float32(1.0 - share)) & inside
        areas, centroids = components(bright)
        expected = regionprops(label(bright, connectivity=2))
        np.testing.assert_array_equal(areas, [region.area for region in expected])
        np.testing.assert_allclose(centroids[:, ::-1], [region.centroid for region in expected], atol=1e-9)


def test_whole_chain_finds_the_same_blobs_as_the_plain_one(image):
    inside = np.ones(image.shape, bool)
    k = edge_scale(homomorphic(image), inside)
    fast = disk_morphology(complex_shock(to_grey_range(perona_malik(homomorphic(image), k), inside)), 10, 2)
    diffused = plain_perona_malik(plain_homomorphic(image) + 0.5 * image.mean(), k)
    slow = plain_disk_morphology(plain_complex_shock(to_grey_range(diffused.astype(np.float32), inside)), 10, 2)
    got = find_blobs(fast, inside, inside, 10, 500)
    expected = find_blobs(slow.astype(np.float32), inside, inside, 10, 500)
    assert len(got) == len(expected) == 5
    np.testing.assert_allclose(got.centroids_uv, expected.centroids_uv, atol=0.1)
    truth = np.array([(40, 50), (60, 55), (150, 90), (120, 100), (90, 120)], float)
    nearest = np.linalg.norm(got.centroids_uv[:, None] - truth[None], axis=2).min(axis=1)
    assert nearest.max() < 0.5


def test_labels_of_a_lateral_frame_are_those_of_the_plain_chain(study):
    x = np.log(study.sites[0].runs[0].frames[3] + 1.0).astype(np.float32)
    inside = np.ones(x.shape, bool)
    k = edge_scale(homomorphic(x), inside)
    fast = disk_morphology(complex_shock(to_grey_range(perona_malik(homomorphic(x), k), inside)))
    diffused = plain_perona_malik(plain_homomorphic(x) + 0.5 * x.mean(), k)
    slow = plain_disk_morphology(plain_complex_shock(to_grey_range(diffused.astype(np.float32), inside)), 14, 2)
    slow = slow.astype(np.float32)
    np.testing.assert_array_equal(fast >= otsu_threshold(fast, inside), slow >= otsu_threshold(slow, inside))


def test_log_transform():
    facts = PixelFacts(logarithmic=False, bits_stored=12, monochrome1=False)
    pixels = np.array([[0, 1], [100, 4095]], np.uint16)
    np.testing.assert_allclose(LogTransform.of_run(facts, 900.0)(pixels), np.log(pixels + 1.0), rtol=1e-6)
    mean = pixels.astype(float) + 0.5
    np.testing.assert_allclose(LogTransform.of_run(facts, 900.0)(mean), np.log(mean + 1.0), rtol=1e-6)
    inverted = LogTransform.of_run(PixelFacts(False, 8, True), 155.0)
    assert inverted.offset == pytest.approx(2.0)
    np.testing.assert_allclose(inverted(np.array([[255, 0]], np.uint8)), [[math.log(2.0), math.log(257.0)]], rtol=1e-6)
    untouched = LogTransform.of_run(PixelFacts(True, 12, False), 900.0)
    np.testing.assert_allclose(untouched(pixels), pixels)
