"""Stated ellipsoids of a mixture of gantries hold the share of gantries that they claim."""

from __future__ import annotations

import numpy as np
import pytest

from fluoromap.contracts import CHI2_95_3D, Array
from fluoromap.triangulator.gantry_kinds import GANTRY_KINDS, credible_covariance
from fluoromap.triangulator.self_calibration import any_study_belief, header_belief
from fluoromap.triangulator.uncertainty import UncertaintyParams

OFFSET_OF_A = slice(3, 6)


def drawn_offsets(count: int) -> Array:
    """Return offsets (count, 3) of view a of gantries of all kinds, mm."""
    rng = np.random.default_rng(14)
    kinds = rng.choice(len(GANTRY_KINDS), count, p=[kind.share for kind in GANTRY_KINDS])
    multiples = np.array([kind.offset for kind in GANTRY_KINDS])[kinds]
    sizes = UncertaintyParams().isocentre_sd_mm * multiples
    return np.asarray(sizes[:, None] * rng.normal(size=(count, 3)))


def share_inside(offsets: Array, covariance: Array) -> float:
    distance = np.einsum("ki,ij,kj->k", offsets, np.linalg.inv(covariance), offsets)
    return float((distance <= CHI2_95_3D).mean())


def test_the_kinds_are_all_gantries() -> None:
    assert sum(kind.share for kind in GANTRY_KINDS) == pytest.approx(1.0)


def test_the_header_s_ellipsoid_holds_95_percent_of_gantries_and_the_second_moment_does_not() -> None:
    offsets = drawn_offsets(200_000)
    params = UncertaintyParams()
    credible = header_belief(params).gantry.covariance[OFFSET_OF_A, OFFSET_OF_A]
    moment = any_study_belief(params).gantry.covariance[OFFSET_OF_A, OFFSET_OF_A]
    assert np.cov(offsets.T) == pytest.approx(moment, abs=0.03)
    assert share_inside(offsets, credible) == pytest.approx(0.95, abs=0.003)
    assert share_inside(offsets, moment) < 0.92


def test_a_single_kind_keeps_its_covariance() -> None:
    usual = UncertaintyParams().gantry_covariance()
    found = credible_covariance(np.array([0.5, 0.5]), np.array([usual, usual]))
    np.testing.assert_allclose(found, usual, rtol=1e-9, atol=0)


def test_a_rare_kind_never_makes_the_ellipsoid_smaller_than_its_variance() -> None:
    usual = UncertaintyParams().gantry_covariance()
    shares, moments = np.array([0.99, 0.01]), np.array([usual, 16 * usual])
    found = credible_covariance(shares, moments)
    whole = np.einsum("k,kij->ij", shares, moments)
    assert (np.diag(found) >= np.diag(whole) * (1 - 1e-12)).all()


def test_a_gantry_without_offsets_has_none() -> None:
    params = UncertaintyParams(isocentre_sd_mm=0.0)
    covariance = header_belief(params).gantry.covariance
    assert (covariance[OFFSET_OF_A, OFFSET_OF_A] == 0).all()
    assert (np.diag(covariance)[:3] > 0).all()
