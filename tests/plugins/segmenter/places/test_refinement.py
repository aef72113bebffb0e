"""Sub-pixel positions: a catheter whose foreshortening changes along it is not pulled straight."""

import numpy as np
import pytest

from fluoromap.catheters import catheter_type
from fluoromap.segmenter.places.refinement import refine

PX_PER_MM = 3.5
CHI2_95_2D = 5.991464547107979


def test_a_long_catheter_s_ends_stay_where_its_foreshortening_changes():
    catheter = catheter_type("decapolar-2-5-2", "cs")
    ratios = np.linspace(0.5, 0.9, catheter.electrodes - 1)
    along = np.concatenate([[0.0], np.cumsum(np.asarray(catheter.spacing_mm) * ratios)]) * PX_PER_MM
    points = np.stack([40.0 + along, np.full(len(along), 40.0)], axis=1)
    v, u = np.mgrid[:80, : int(points[-1, 0]) + 60].astype(np.float64)
    image = np.zeros(v.shape)
    for k, (at, _) in enumerate(points):
        ratio = ratios[min(k, len(ratios) - 1)]
        half = 0.5 * (catheter.tip_mm if k == 0 else catheter.ring_mm) * PX_PER_MM * ratio
        band = np.clip(0.5 + (half - np.abs(u - at)) / 2.0, 0.0, 1.0)
        image -= 0.5 * band * (np.abs(v - 40.0) < 3.5)
    image += np.random.default_rng(3).normal(0.0, 0.1, image.shape)
    nothing = np.zeros((1, catheter.electrodes), np.bool_)
    fit = refine(image.astype(np.float32), points[None], catheter, PX_PER_MM, 0.1, nothing, nothing)
    error = fit.points_uv[0] - points
    assert np.abs(error[[0, 1, -2, -1], 0]).max() < 1.0
    assert np.sqrt((error[:, 0] ** 2).mean()) < 0.6


@pytest.mark.parametrize("first_guess_mm", [-2.5, 0.0, 1.5])
def test_the_middle_of_a_long_tip_is_found_from_its_ends(first_guess_mm):
    catheter = catheter_type("ablation-8", "ablation")
    px_per_mm = 5.0
    along = np.concatenate([[0.0], np.cumsum(np.asarray(catheter.spacing_mm))]) * px_per_mm
    points = np.stack([50.0 + along, np.full(4, 40.0)], axis=1)
    v, u = np.mgrid[:80, :220].astype(np.float64)
    image = np.random.default_rng(3).normal(0.0, 0.02, v.shape)
    for k, (at, _) in enumerate(points):
        half = 0.5 * (catheter.tip_mm if k == 0 else catheter.ring_mm) * px_per_mm
        band = np.clip(0.5 + (half - np.abs(u - at)) / 2.0, 0.0, 1.0)
        image -= 0.5 * band * (np.abs(v - 40.0) < 5.5)
    guess = points.copy()
    guess[0, 0] += first_guess_mm * px_per_mm
    nothing = np.zeros((1, 4), np.bool_)
    fit = refine(image.astype(np.float32), guess[None], catheter, px_per_mm, 0.02, nothing, nothing)
    error = fit.points_uv[0, 0, 0] - points[0, 0]
    # The template's end is round, that of the picture is not: triangulation adds this distance to the covariance.
    assert abs(error) < catheter.tip_centre_sd_mm(0.2) * px_per_mm


def test_bands_that_fit_perfectly_say_as_much_of_a_hidden_one(monkeypatch):
    def perfect(*arguments):
        unit_sd, misfits, rests = arguments[-3:]
        unit_sd[:], misfits[:], rests[:] = 1.0, 0.0, 0.0

    monkeypatch.setattr("fluoromap.segmenter.places.refinement._fit_bands", perfect)
    catheter = catheter_type("quadripolar-5-5-5", "rv")
    points = np.stack([40.0 + 6.0 * PX_PER_MM * np.arange(4), np.full(4, 60.0)], axis=1)
    hidden = np.array([[False, False, True, False]])
    with np.errstate(all="raise"):
        fit = refine(np.zeros((120, 200), np.float32), points[None], catheter, PX_PER_MM, 0.01, hidden, ~hidden)
    assert fit.misfits[0].max() < 0.05


def test_electrodes_that_something_lies_on_are_less_sure_and_stay_in_their_ellipses():
    catheter = catheter_type("decapolar-2-5-2", "cs")
    along = np.concatenate([[0.0], np.cumsum(catheter.spacing_mm)]) * PX_PER_MM
    points = np.stack([40.0 + along, np.full(len(along), 60.0)], axis=1)
    v, u = np.mgrid[:120, : int(points[-1, 0]) + 40].astype(np.float64)
    catheter_alone = np.zeros(v.shape)
    for k, (at, _) in enumerate(points):
        half = 0.5 * (catheter.tip_mm if k == 0 else catheter.ring_mm) * PX_PER_MM
        catheter_alone -= np.clip(0.5 + (half - np.abs(u - at)) / 2.0, 0.0, 1.0) * (np.abs(v - 60.0) < 3.5)
    nothing = np.zeros((1, catheter.electrodes), np.bool_)
    missed, wider = [], []
    for seed in range(12):
        draw = np.random.default_rng(seed)
        noise = draw.normal(0.0, 0.05, v.shape)
        crossed, slope = int(draw.integers(1, 9)), draw.uniform(0.5, 2.0)
        cable = np.abs((v - 60.0) - slope * (u - points[crossed, 0] - draw.uniform(2.0, 5.0))) < 3.0 * np.hypot(
            1.0, slope
        )
        alone, covered = (
            refine(image.astype(np.float32), points[None], catheter, PX_PER_MM, 0.05, nothing, nothing)
            for image in (catheter_alone + noise, catheter_alone - 0.25 * cable + noise)
        )
        error = covered.points_uv[0, crossed] - points[crossed]
        missed.append(error @ np.linalg.solve(covered.covariance_px2[0, crossed], error))
        wider.append(np.trace(covered.covariance_px2[0, crossed]) / np.trace(alone.covariance_px2[0, crossed]))
        far = np.abs(np.arange(catheter.electrodes) - crossed) >= 3
        np.testing.assert_allclose(covered.points_uv[0, far], alone.points_uv[0, far], atol=0.3)
    assert np.median(wider) > 1.5
    assert np.mean(np.array(missed) <= CHI2_95_2D) >= 0.8
