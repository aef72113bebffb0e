"""Pairings that cannot be ruled out are reported; sites that contradict the geometry are rejected."""

from dataclasses import replace

import numpy as np
import pytest

from fluoromap.catheters import DEFAULT_CATALOGUE, Catalogue
from fluoromap.contracts import Chain, FrameChains, MatchedSite, Segmentation, Silent
from fluoromap.geometry import Gantry, camera_from_gantry
from fluoromap.matching import match_study
from fluoromap.matching.doubts import mirror, mirrored_sites
from fluoromap.matching.two_view import triangulate_linear
from fluoromap.reasons import Reason

LOOK_ALIKES = {"reference", "pacing"}


def level(study) -> None:  # type: ignore[no-untyped-def]
    """Place the look-alikes side by side at one height, moving alike.

    Two views cannot distinguish them.
    """
    study.pacing_roams_mm = 0.0
    study.places = {"reference": np.array([20.0, -8.0, 0.0]), "pacing": np.array([6.0, -30.0, 0.0])}
    study.directions = dict.fromkeys(LOOK_ALIKES, np.array([0.1, 0.1, 1.0]))
    study.swing |= {"reference": 3.0, "pacing": 3.0}


def apart_mm(site: MatchedSite, truth: np.ndarray, catheter: str = "reference") -> float:
    a, b = (
        next(one for one in seen.chains if one.catheter == catheter)
        for seen in (site.runs.diastole.a, site.runs.diastole.b)
    )
    points = triangulate_linear(site.runs.camera_a, site.runs.camera_b, a.pixels_uv, b.pixels_uv)
    return float(np.linalg.norm(points.mean(axis=0) - truth.mean(axis=0)))


@pytest.mark.parametrize("seed", range(3))
def test_a_pairing_that_cannot_be_ruled_out_is_kept(heart, seed: int) -> None:  # type: ignore[no-untyped-def]
    study = heart(seed=seed, breathing_mm=0.0)
    level(study)
    (site,) = match_study((study.site("S0"),), DEFAULT_CATALOGUE, Silent()).sites
    assert site.runs.alternative is not None
    assert 0.02 < site.runs.alternative.probability <= 0.5
    told = {catheter for catheter, reason in site.notes if reason is Reason.IDENTITY_UNCERTAIN}
    assert told == LOOK_ALIKES
    for name in LOOK_ALIKES:
        chosen, other = (
            [next(one.pixels_uv for one in seen.chains if one.catheter == name) for seen in (pair.a, pair.b)]
            for pair in (site.runs.diastole, site.runs.alternative.diastole)
        )
        # One view's chain is another catheter's in the alternative.
        assert [np.allclose(*views) for views in zip(chosen, other, strict=True)].count(False) == 1
    mapping = [
        next(one.pixels_uv for one in pair.a.chains if one.catheter == "mapping")
        for pair in (site.runs.diastole, site.runs.alternative.diastole)
    ]
    assert np.array_equal(*mapping)


def test_the_other_sites_decide_what_one_cannot(heart) -> None:  # type: ignore[no-untyped-def]
    study = heart(seed=4, breathing_mm=0.0)
    level(study)
    doubtful = study.site("S0")
    # Elsewhere the pacing catheter lies higher: there no doubt is possible, and the reference is the same.
    study.places["pacing"] = np.array([6.0, -30.0, 9.0])
    sites = (doubtful, *(study.site(f"S{i}") for i in range(1, 5)))
    alone = match_study(sites[:1], DEFAULT_CATALOGUE, Silent()).sites[0]
    together = match_study(sites, DEFAULT_CATALOGUE, Silent()).sites
    assert alone.runs.alternative is not None
    assert (
        together[0].runs.alternative is None
        or together[0].runs.alternative.probability < alone.runs.alternative.probability / 4
    )
    places = [min(apart_mm(site, study.truth[site.site][name]) for name in LOOK_ALIKES) for site in together]
    assert max(places) < 3


def test_right_pairs_leave_no_alternative(heart) -> None:  # type: ignore[no-untyped-def]
    study = heart(seed=5)
    matching = match_study(tuple(study.site(f"S{i}") for i in range(4)), DEFAULT_CATALOGUE, Silent())
    assert [site.runs.alternative for site in matching.sites] == [None] * 4


def changed(segmentation: Segmentation, change) -> Segmentation:  # type: ignore[no-untyped-def]
    frames = tuple(FrameChains(one.frame, tuple(map(change, one.chains))) for one in segmentation.frames)
    mean = segmentation.diastole
    return replace(
        segmentation, frames=frames, diastole=FrameChains(mean.frame, tuple(map(change, mean.chains)))
    )  # fmt: skip


def flipped(chain: Chain) -> Chain:
    return replace(chain, pixels_uv=np.array([511, 0]) + chain.pixels_uv * [-1, 1])


@pytest.mark.parametrize("view", ["segmentation_a", "segmentation_b"])
def test_a_mirrored_view_is_refused(heart, view: str) -> None:  # type: ignore[no-untyped-def]
    study = heart(seed=6, breathing_mm=1.0)
    sites = [study.site(f"S{i}") for i in range(5)]
    turned = tuple(replace(one, **{view: changed(getattr(one, view), flipped)}) for one in sites)
    matching = match_study(turned, DEFAULT_CATALOGUE, Silent())
    assert not matching.sites
    assert {one.reasons for one in matching.rejected} == {(Reason.VIEW_MIRRORED,)}
    assert len(match_study(tuple(sites), DEFAULT_CATALOGUE, Silent()).sites) == 5


def test_a_mirrored_camera_sees_the_mirrored_image() -> None:
    camera = camera_from_gantry(Gantry(30, 10, 1000, 500, (178 / 512, 178 / 512), 512, 400))
    points = np.random.default_rng(0).uniform(-40, 40, (20, 3))
    assert mirror(camera).project(points)[:, 0] == pytest.approx(399 - camera.project(points)[:, 0])
    assert mirror(camera).project(points)[:, 1] == pytest.approx(camera.project(points)[:, 1])


def test_many_sites_say_together_what_one_does_not() -> None:
    assert mirrored_sites([6.0]) == ([False], [True])
    assert mirrored_sites([6.0, 5.0, 7.0, -8.0])[0] == [False] * 4
    assert mirrored_sites([6.0, 5.0, 7.0, 1.0, -8.0, 6.0])[0] == [True, True, True, True, False, True]
    assert mirrored_sites([-19.0, -8.0, 20.0]) == ([False, False, True], [False, False, True])
    # Near the central rays everything looks the same in the mirror.
    assert mirrored_sites([-1.0, 1.0, -2.0]) == ([False] * 3, [True] * 3)
    assert mirrored_sites([]) == ([], [])


def test_a_catheter_too_many_is_reported_and_not_swapped_in(heart) -> None:  # type: ignore[no-untyped-def]
    study = heart(seed=7)
    two = Catalogue(
        (DEFAULT_CATALOGUE["reference"], DEFAULT_CATALOGUE["mapping"]), reference="reference", mapping="mapping"
    )
    matching = match_study(tuple(study.site(f"S{i}") for i in range(5)), two, Silent())
    assert len(matching.sites) == 5
    nearest = set()
    for site in matching.sites:
        assert ("reference", Reason.EXTRA_CATHETER) in site.notes
        assert ("mapping", Reason.EXTRA_CATHETER) not in site.notes
        nearest.add(min(LOOK_ALIKES, key=lambda name: apart_mm(site, study.truth[site.site][name])))
    assert len(nearest) == 1


def test_catheters_that_all_look_alike_are_matched_all_the_same(heart) -> None:  # type: ignore[no-untyped-def]
    study = heart(seed=14, wrong_kinds=0.5)
    alike = Catalogue(
        tuple(replace(DEFAULT_CATALOGUE["mapping"], name=name) for name in DEFAULT_CATALOGUE.names),
        "reference",
        "mapping",
    )
    (site,) = match_study((study.site("S0"),), alike, Silent()).sites
    assert {chain.catheter for chain in site.runs.diastole.a.chains} == set(alike.names)
    for chain in site.runs.diastole.a.chains:
        other = next(one for one in site.runs.diastole.b.chains if one.catheter == chain.catheter)
        nearest = {
            min(
                study.truth["S0"],
                key=lambda name: np.abs(camera.project(study.truth["S0"][name]) - seen.pixels_uv).mean(),
            )
            for camera, seen in ((site.runs.camera_a, chain), (site.runs.camera_b, other))
        }
        assert len(nearest) == 1
    assert {reason for _, reason in site.notes} == {Reason.IDENTITY_UNCERTAIN}


def test_views_that_disagree_beyond_the_tolerance_are_reported(heart) -> None:  # type: ignore[no-untyped-def]
    study = heart(seed=8, breathing_mm=2.0)
    sites = [study.site(f"S{i}") for i in range(6)]
    noted = {}
    for degrees in (0, 1, 7):
        camera = camera_from_gantry(Gantry(0, degrees, 1000, 500, (178 / 512, 178 / 512), 512, 512))
        matching = match_study(tuple(replace(one, camera_b=camera) for one in sites), DEFAULT_CATALOGUE, Silent())
        noted[degrees] = [("mapping", Reason.GEOMETRY_DOUBTFUL) in site.notes for site in matching.sites]
    assert noted[0] == noted[1] == [False] * 6
    assert sum(noted[7]) >= len(noted[7]) / 2 > 0


def test_a_wrong_angle_is_not_taken_for_a_mirror(heart) -> None:  # type: ignore[no-untyped-def]
    study = heart(seed=8, breathing_mm=2.0)
    off = camera_from_gantry(Gantry(0, 10, 1000, 500, (178 / 512, 178 / 512), 512, 512))
    matching = match_study(
        tuple(replace(study.site(f"S{i}"), camera_b=off) for i in range(4)), DEFAULT_CATALOGUE, Silent()
    )
    assert (Reason.VIEW_MIRRORED,) not in {one.reasons for one in matching.rejected}
    assert all(Reason.GEOMETRY_DOUBTFUL in {reason for _, reason in site.notes} for site in matching.sites)


def test_chains_without_their_tip_are_paired_by_the_electrodes_they_have(heart) -> None:  # type: ignore[no-untyped-def]
    study = heart(seed=9)
    sites = [study.site(f"S{i}") for i in range(4)]

    def without_tip(chain: Chain) -> Chain:
        return replace(
            chain, electrodes=chain.electrodes[1:], pixels_uv=chain.pixels_uv[1:],
            covariance_px2=chain.covariance_px2[1:], scores=chain.scores[1:],
        )  # fmt: skip

    sites[2] = replace(sites[2], segmentation_b=changed(sites[2].segmentation_b, without_tip))
    matching = match_study(tuple(sites), DEFAULT_CATALOGUE, Silent())
    assert len(matching.sites) == 4
    site = next(one for one in matching.sites if one.site == "S2")
    truth = study.truth["S2"]
    for chain in site.runs.diastole.b.chains:
        assert chain.electrodes == (2, 3, 4)
        apart = np.linalg.norm(chain.pixels_uv - site.runs.camera_b.project(truth[chain.catheter][1:]), axis=1)
        others = [
            np.linalg.norm(chain.pixels_uv - site.runs.camera_b.project(one[1:]), axis=1).mean()
            for one in truth.values()
        ]
        assert apart.mean() == min(others)


def test_an_irregular_rhythm_is_reported(heart) -> None:  # type: ignore[no-untyped-def]
    study = heart(seed=10)
    runs = study.site("S0")
    uneven = replace(runs.segmentation_a, r_wave_frames=(3, 30, 70))
    (site,) = match_study((replace(runs, segmentation_a=uneven),), DEFAULT_CATALOGUE, Silent()).sites
    assert {catheter for catheter, reason in site.notes if reason is Reason.IRREGULAR_RHYTHM} == set(
        DEFAULT_CATALOGUE.names
    )
    (even,) = match_study((runs,), DEFAULT_CATALOGUE, Silent()).sites
    assert Reason.IRREGULAR_RHYTHM not in {reason for _, reason in even.notes}
