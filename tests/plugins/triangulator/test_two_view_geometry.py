"""Points from two views against truth, identities and the Cramer-Rao bound."""

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from fluoromap.contracts import Array, NamedChain, Observation, PhasePair
from fluoromap.geometry import Camera, Gantry, camera_from_gantry, ray_angle_deg
from fluoromap.matching.two_view import fundamental_matrix, signed_epipolar_px, triangulate_linear
from fluoromap.triangulator.estimate import triangulate_maximum_likelihood
from fluoromap.triangulator.two_view_pixels import pixels_in_both_views, pixels_of_pairs


def camera(primary: float, secondary: float = 0.0) -> Camera:
    return camera_from_gantry(Gantry(primary, secondary, 1000, 500, (178 / 512, 178 / 512), 512, 512))


def unit(n: int) -> Array:
    return np.broadcast_to(np.eye(2), (n, 2, 2)).copy()


angles = st.tuples(st.floats(-120, 120), st.floats(-45, 45))


@settings(max_examples=200)
@given(angles, angles, st.integers(0, 2**32 - 1))
def test_exact_projections_come_back_to_a_billionth_of_a_millimetre(
    first: tuple[float, float], second: tuple[float, float], seed: int
) -> None:
    a, b = camera(*first), camera(*second)
    assume(ray_angle_deg(a, b) >= 20)
    points = np.random.default_rng(seed).uniform(-40, 40, (12, 3))
    pixels_a, pixels_b = a.project(points), b.project(points)
    assert np.abs(triangulate_linear(a, b, pixels_a, pixels_b) - points).max() < 1e-9
    likeliest = triangulate_maximum_likelihood(a, b, pixels_a, pixels_b, unit(12), unit(12))
    assert np.abs(likeliest - points).max() < 1e-9
    assert np.abs(signed_epipolar_px(a, b, pixels_a, pixels_b)).max() < 1e-7


def test_no_electrodes_give_no_points() -> None:
    none = np.zeros((0, 2))
    assert triangulate_maximum_likelihood(camera(90), camera(0), none, none, unit(0), unit(0)).shape == (0, 3)


def test_fundamental_matrix_sends_the_other_source_to_nothing() -> None:
    a, b = camera(90, 10), camera(0, -15)
    fundamental = fundamental_matrix(a, b)
    epipole_a = a.matrix @ np.append(b.source_world_mm, 1)
    assert fundamental @ epipole_a == pytest.approx(np.zeros(3), abs=1e-6 * np.abs(fundamental).max())
    assert abs(np.linalg.det(fundamental / np.abs(fundamental).max())) < 1e-9


def bound_mm(cameras: tuple[Camera, Camera], points: Array, noise_px: float) -> float:
    """Return the RMS Cramer-Rao bound from the Fisher information of four independent pixel coordinates."""
    jacobian = np.concatenate([one.jacobian(points) for one in cameras], axis=1)
    information = np.einsum("nki,nkj->nij", jacobian, jacobian) / noise_px**2
    return float(np.sqrt(np.trace(np.linalg.inv(information), axis1=1, axis2=2).mean()))


@pytest.mark.parametrize("noise_px", [0.25, 0.5, 1.0])
def test_both_methods_reach_the_bound_at_ninety_degrees(noise_px: float) -> None:
    rng = np.random.default_rng(3)
    a, b = camera(90), camera(0)
    points = rng.uniform(-35, 35, (20_000, 3))
    pixels = [one.project(points) + rng.normal(0, noise_px, (len(points), 2)) for one in (a, b)]
    bound = bound_mm((a, b), points, noise_px)
    for found in (
        triangulate_linear(a, b, *pixels),
        triangulate_maximum_likelihood(a, b, *pixels, unit(len(points)), unit(len(points))),
    ):
        rms = np.sqrt(((found - points) ** 2).sum(axis=1).mean())
        assert 0.98 <= rms / bound <= 1.02
        assert rms == pytest.approx(0.1374 * noise_px / 0.5, rel=0.01)


def test_maximum_likelihood_weights_the_better_view_and_beats_the_linear_answer() -> None:
    rng = np.random.default_rng(4)
    a, b = camera(25), camera(0)
    points = rng.uniform(-35, 35, (5000, 3))
    sd = np.where(rng.random(len(points)) < 0.5, 0.3, 3.0)
    seen_a = a.project(points) + rng.normal(0, 0.3, (len(points), 2))
    seen_b = b.project(points) + rng.normal(0, 1, (len(points), 2)) * np.stack([np.full(len(sd), 0.3), sd], axis=1)
    covariance_b = np.zeros((len(points), 2, 2))
    covariance_b[:, 0, 0], covariance_b[:, 1, 1] = 0.09, sd**2
    likeliest = triangulate_maximum_likelihood(a, b, seen_a, seen_b, 0.09 * unit(len(points)), covariance_b)
    linear = triangulate_linear(a, b, seen_a, seen_b)
    assert ((likeliest - points) ** 2).sum() < 0.98 * ((linear - points) ** 2).sum()


def test_the_answer_has_the_least_reprojection_error_nearby() -> None:
    rng = np.random.default_rng(5)
    a, b = camera(60, 20), camera(0, -10)
    points = rng.uniform(-35, 35, (50, 3))
    pixels = [one.project(points) + rng.normal(0, 1, (50, 2)) for one in (a, b)]

    def cost(at: Array) -> Array:
        return sum(((one.project(at) - uv) ** 2).sum(axis=1) for one, uv in zip((a, b), pixels, strict=True))

    found = triangulate_maximum_likelihood(a, b, *pixels, unit(50), unit(50))
    for _ in range(20):
        assert (cost(found) <= cost(found + rng.normal(0, 0.01, (50, 3)))).all()


def test_pairs_gathered_together_show_the_same_pixels_as_each_by_itself() -> None:
    rng = np.random.default_rng(5)

    def view(frame: int, *chains: tuple[str, tuple[int, ...]]) -> Observation:
        return Observation(
            frame, 0.1 * frame, tuple(
                NamedChain(name, electrodes, rng.normal(size=(len(electrodes), 2)), np.stack([np.eye(2)] * len(electrodes)))
                for name, electrodes in chains
            ),
        )  # fmt: skip

    whole, part, other = ("mapping", (1, 2, 3)), ("mapping", (1, 3)), ("reference", (1, 2))
    shown = [
        ((whole, other), (whole, other)),
        ((whole,), (part,)),
        ((whole, other), (whole, other)),
        ((other,), ()),
        ((), ()),
    ]
    pairs = [PhasePair(0.1 * k, view(k, *a), view(k, *b)) for k, (a, b) in enumerate(shown)]
    for gathered, pair in zip(pixels_of_pairs(pairs), pairs, strict=True):
        alone = pixels_in_both_views(pair)
        assert gathered.labels == alone.labels
        for found, expected in ((gathered.pixels, alone.pixels), (gathered.covariances, alone.covariances)):
            assert all(np.array_equal(one, same) for one, same in zip(found, expected, strict=True))
