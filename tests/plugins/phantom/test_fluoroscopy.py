"""Fairness of the rendered frames: they are not easier to segment than they should be."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter, map_coordinates
from scipy.stats import poisson

from fluoromap.catheters import DEFAULT_CATALOGUE
from fluoromap.geometry import Camera, camera_from_gantry
from fluoromap.phantom import APPEARANCES, FRONTAL, LATERAL, StudySpec, kernels, simulate_study
from fluoromap.phantom.fluoroscopy import MEAN_GREY, detect, transmission
from fluoromap.phantom.shaft import Shaft
from fluoromap.phantom.torso import torso

LAT, PA = APPEARANCES["LAT"], APPEARANCES["PA"]


def _straight(name: str, tilt_deg: float = 0.0, centre: tuple[float, float] = (0.0, 0.0)) -> tuple[Shaft, np.ndarray]:  # type: ignore[type-arg]
    """Return a straight catheter in the frontal view's isocentre plane.

    The tip points to the patient's feet.
    """
    tilt = np.radians(tilt_deg)
    heading = np.array([np.sin(tilt), 0.0, np.cos(tilt)])
    tip = np.array([centre[0], 0.0, centre[1]])
    radius, solid = (1.17, True) if name == "mapping" else (1.0, False)
    ends = (tip, tip + 30 * heading, tip + 60 * heading, tip + 90 * heading)
    shaft = Shaft.through(DEFAULT_CATALOGUE[name], radius, solid, *ends)
    return shaft, shaft.lines_mm(np.zeros((1, 3)))


def _camera() -> Camera:
    return camera_from_gantry(FRONTAL)


@pytest.mark.parametrize("appearance", [LAT, PA])
def test_attenuation_of_ring_tip_and_shaft(appearance: object) -> None:
    assert appearance in (LAT, PA)
    look = LAT if appearance is LAT else PA
    camera = _camera()
    shaft, line = _straight("mapping", 0.0, (0.04, -20.0))
    thickness = -np.log(transmission(camera, [shaft], [line], look))

    def at(along_mm: float) -> float:
        u, v = camera.project(line[0, 0] + np.array([0.0, 0.0, along_mm]))
        return float(map_coordinates(thickness, [[v], [u]], order=1)[0])

    # Two walls of 14 % of the radius; a tip nearly all metal; the bare shaft.
    assert at(4.65 + 2.0) == pytest.approx(look.platinum_per_mm * 2 * 0.14 * 1.17, rel=0.06)
    assert at(2.0) > 0.85 * look.platinum_per_mm * 2 * 1.17
    assert at(30.0) == pytest.approx(look.shaft, rel=0.05)
    assert thickness[:, :200].max() == 0


def test_no_seams_in_a_bent_shaft() -> None:
    tip = np.array([-10.0, 0.0, -15.0])
    shaft = Shaft.through(
        DEFAULT_CATALOGUE["reference"], 1.0, False, tip, tip + np.array([0.0, 0.0, 25.0]), np.array([25.0, 0.0, 25.0]),
        np.array([30.0, 0.0, -60.0]),
    )  # fmt: skip
    line = shaft.lines_mm(np.zeros((1, 3)))
    thickness = -np.log(transmission(_camera(), [shaft], [line], LAT))
    bare = line[0, 50:140]
    u, v = _camera().project(bare).T
    along = map_coordinates(thickness, [v, u], order=1)
    assert along.std() < 0.03 * along.mean()
    assert along.mean() == pytest.approx(LAT.shaft, rel=0.05)


@pytest.mark.parametrize("name", ["reference", "mapping"])
@pytest.mark.parametrize("tilt_deg", [0.0, 37.0, 90.0])
def test_electrode_projections_are_the_middles_of_their_bands(name: str, tilt_deg: float) -> None:
    camera = _camera()
    shaft, line = _straight(name, tilt_deg, (-7.3, -6.1))
    absorbed = 1 - transmission(camera, [shaft], [line], LAT)
    heading = camera.project(line[0, 40]) - camera.project(line[0, 0])
    heading /= np.linalg.norm(heading)
    electrodes = camera.project(shaft.electrodes_mm(line)[0])
    for electrode, centre in enumerate(electrodes):
        half_mm = DEFAULT_CATALOGUE[name].tip_mm / 2 if electrode == 0 else DEFAULT_CATALOGUE[name].ring_mm / 2
        reach = half_mm * camera.px_per_mm + 5
        offsets = np.arange(-reach, reach, 0.1)
        u, v = (centre + offsets[:, None] * heading).T
        profile = map_coordinates(absorbed, [v, u], order=1)
        dark = offsets[profile > 0.5 * profile.max()]
        assert abs(dark.mean()) < 0.5
        assert dark[-1] - dark[0] == pytest.approx(2 * half_mm * camera.px_per_mm, abs=1.5)


def test_electrodes_of_a_moving_heart_are_the_dark_places() -> None:
    study = simulate_study(StudySpec(11, sites=3, frames=6, contrast=("LAT", "LAT")))
    darker = []
    for site in study.sites:
        for run in site.runs:
            image = gaussian_filter(np.log(run.frames[2].astype(float)), 1.0)
            for points in run.truth.pixels_uv.values():
                u, v = points[2].T
                at = map_coordinates(image, [v, u], order=1)
                ring = [
                    map_coordinates(image, [v + 16 * np.sin(a), u + 16 * np.cos(a)], order=1)
                    for a in np.linspace(0, 2 * np.pi, 12, endpoint=False)
                ]
                darker.extend(np.median(ring, axis=0) - at)
    assert np.mean(np.array(darker) > 0.1) > 0.95


@pytest.mark.parametrize(("contrast", "photons"), [("LAT", 500.0), ("PA", 90.0)])
def test_mean_counts_and_grey_level(contrast: str, photons: float) -> None:
    look = APPEARANCES[contrast]  # type: ignore[index]
    assert look.photons == photons
    study = simulate_study(StudySpec(2, sites=1, frames=2, contrast=(contrast, contrast)))  # type: ignore[arg-type]
    image = study.sites[0].runs[0].frames[0]
    assert image.dtype == np.uint16
    assert image.shape == (512, 512)
    assert image.max() <= 4095
    assert image.mean() == pytest.approx(MEAN_GREY, rel=0.02)
    # Counts from the noise itself: variance over mean of a flat exposure, before the detector's blur, is one photon.
    counts = np.full((512, 512), photons, np.float32)
    flat = detect(counts, photons, 5) / MEAN_GREY * photons
    taps = np.exp(-0.5 * (np.arange(-3, 4) / 0.75) ** 2)
    taps /= taps.sum()
    assert flat.mean() == pytest.approx(photons, rel=1e-3)
    assert flat.var() == pytest.approx(photons * (taps**2).sum() ** 2 + 1.5**2, rel=0.02)


@pytest.mark.parametrize(("contrast", "low", "high"), [("LAT", 7.0, 30.0), ("PA", 1.0, 4.0)])
def test_contrast_to_noise_of_a_ring(contrast: str, low: float, high: float) -> None:
    """Compare a 6F ring with the shadow beside it, on single pixels of rendered frames."""
    ratios = []
    for seed in range(3):
        spec = StudySpec(seed, sites=2, frames=1, contrast=(contrast, contrast))  # type: ignore[arg-type]
        for site in simulate_study(spec).sites:
            run = site.runs[0]
            image = run.frames[0].astype(float)
            u, v = run.truth.pixels_uv["reference"][0, 1:].T
            at = map_coordinates(image, [v, u], order=1)
            angles = np.linspace(0, 2 * np.pi, 40, endpoint=False)
            around = np.array(
                [map_coordinates(image, [v + 14 * np.sin(a), u + 14 * np.cos(a)], order=0) for a in angles]
            )
            spread = 1.4826 * np.median(np.abs(around - np.median(around, axis=0)), axis=0)
            ratios.extend((np.median(around, axis=0) - at) / spread)
    assert low < np.median(ratios) < high


def test_scatter_and_texture_of_the_background() -> None:
    for look, gantry in ((LAT, LATERAL), (PA, FRONTAL)):
        behind = torso(gantry, look, np.random.default_rng(1), np.random.default_rng(2), 0.0)
        assert behind.scatter.mean() / behind.primary.mean() == pytest.approx(look.scatter_to_primary, rel=1e-4)
        assert (behind.scatter + behind.primary).mean() == pytest.approx(1.0, rel=1e-4)
        fine = behind.scatter - gaussian_filter(behind.scatter, 10)
        assert fine.std() < 0.02 * behind.scatter.mean()
        assert 0.15 < np.log(behind.primary).std() < 0.8


def test_tissue_differs_between_runs_bones_do_not() -> None:
    first = torso(FRONTAL, PA, np.random.default_rng(1), np.random.default_rng(2), 0.0)
    again = torso(FRONTAL, PA, np.random.default_rng(1), np.random.default_rng(2), 0.0)
    other = torso(FRONTAL, PA, np.random.default_rng(1), np.random.default_rng(3), 0.0)
    assert np.array_equal(first.primary, again.primary)
    difference = np.log(first.primary) - np.log(other.primary)
    assert difference.std() == pytest.approx(PA.texture * np.sqrt(2), rel=0.2)


@pytest.mark.parametrize("mean", [0.3, 4.0, 29.0, 31.0, 90.0, 500.0])
def test_photon_counts_are_poisson(mean: float) -> None:
    expected = np.full((600, 600), mean, np.float32)
    photons, electronic = np.empty_like(expected), np.empty_like(expected)
    kernels.count_photons(expected, np.uint64(12345), 1.5, *kernels.normal_quantiles(), photons, electronic)
    counts = photons.astype(float).ravel()
    n = counts.size
    assert (counts == np.round(counts)).all()
    assert abs(counts.mean() - mean) < 4.5 * np.sqrt(mean / n)
    assert counts.var() == pytest.approx(mean, rel=0.012)
    skewness = ((counts - counts.mean()) ** 3).mean() / counts.std() ** 3
    assert skewness == pytest.approx(mean**-0.5, abs=0.02)
    low, high = poisson.ppf([0.001, 0.999], mean)
    bins = np.arange(low, high + 1)
    seen = np.array([(counts == k).mean() for k in bins])
    wanted = poisson.pmf(bins, mean)
    assert np.abs(np.cumsum(seen) - np.cumsum(wanted)).max() < 0.005
    assert electronic.std() == pytest.approx(1.5, rel=0.01)
    assert abs(np.corrcoef(counts, electronic.ravel())[0, 1]) < 0.01
    assert abs(np.corrcoef(counts[1:], counts[:-1])[0, 1]) < 0.01


def test_a_frame_is_the_same_in_any_order_of_access() -> None:
    spec = StudySpec(8, sites=2, frames=6)
    once, again = simulate_study(spec), simulate_study(spec)
    wanted = once.sites[1].runs[0].frames[4]
    for index in (0, 5, 2):
        again.sites[0].runs[1].frames[index]
        again.sites[1].runs[0].frames[index]
    assert np.array_equal(wanted, again.sites[1].runs[0].frames[4])
    assert np.array_equal(wanted, list(again.sites[1].runs[0].frames)[4])
    assert np.array_equal(wanted, again.sites[1].runs[0].frames[-2])
    others = [once.sites[0].runs[0].frames[4], once.sites[1].runs[1].frames[4], once.sites[1].runs[0].frames[3]]
    assert all(not np.array_equal(wanted, other) for other in others)
    assert not np.array_equal(wanted, simulate_study(StudySpec(9, sites=2, frames=6)).sites[1].runs[0].frames[4])


def test_frames_offer_images_and_nothing_else() -> None:
    frames = simulate_study(StudySpec(8, sites=1, frames=3)).sites[0].runs[0].frames
    assert {name for name in dir(frames) if not name.startswith("_")} == {"shape"}
    assert (frames.shape, len(frames)) == ((512, 512), 3)
    with pytest.raises(IndexError, match="3 frames"):
        frames[3]


def test_a_lower_dose_keeps_the_grey_level_and_adds_noise() -> None:
    noise = []
    for dose in (1.0, 0.25):
        frames = simulate_study(StudySpec(8, sites=1, frames=2, dose=dose)).sites[0].runs[0].frames
        first, second = (frame.astype(float) for frame in frames)
        assert first.mean() == pytest.approx(MEAN_GREY, rel=0.02)
        noise.append(np.median(np.abs(second - first)))
    # Photon noise doubles, electronic noise adds to it.
    assert 2.0 < noise[1] / noise[0] < 2.3


def test_motion_within_the_exposure_is_rendered() -> None:
    shaft, line = _straight("reference")
    still = transmission(_camera(), [shaft], [np.repeat(line, 3, axis=0)], LAT)
    moved = line + np.array([[[-0.25, 0.0, 0.0]], [[0.0, 0.0, 0.0]], [[0.25, 0.0, 0.0]]])
    blurred = transmission(_camera(), [shaft], [moved], LAT)
    assert blurred.min() > still.min()
    assert (1 - blurred).sum() == pytest.approx((1 - still).sum(), rel=0.02)
    assert (blurred < 0.95).sum() > (still < 0.95).sum()
