"""The tip of a catheter: two views, and the sites of a study, contradict a wrong end."""

from dataclasses import replace

import numpy as np
import pytest

from fluoromap.catheters import DEFAULT_CATALOGUE
from fluoromap.contracts import Array, Chain, FrameChains, MatchedSite, Segmentation, Silent
from fluoromap.matching import SiteRuns, match_study
from fluoromap.matching.ends import common_ends
from fluoromap.reasons import Reason

NAME = "reference"
SURE, UNSURE = 4.0, 0.3


def with_tip(  # type: ignore[no-untyped-def]
    runs: SiteRuns, heart, view: int, odds: float | None, *, wrong: bool = False
) -> SiteRuns:
    """Return the runs with the segmenter's tip odds of the reference catheter.

    With ``wrong`` it numbered the catheter from the other end.
    """
    camera = (runs.camera_a, runs.camera_b)[view]
    field = ("segmentation_a", "segmentation_b")[view]
    segmentation = getattr(runs, field)
    middle = camera.project(heart.truth[runs.site][NAME]).mean(axis=0)
    track = min(
        segmentation.diastole.chains, key=lambda one: float(np.linalg.norm(one.pixels_uv.mean(axis=0) - middle))
    ).track

    def told(chain: Chain) -> Chain:
        if chain.track != track or chain.manual:
            return chain
        if not wrong:
            return replace(chain, tip_odds=odds)
        return replace(chain, tip_odds=None if odds is None else -odds).from_other_end(4)

    def entry(before: FrameChains) -> FrameChains:
        return replace(before, chains=tuple(told(chain) for chain in before.chains))

    after: Segmentation = replace(
        segmentation, frames=tuple(map(entry, segmentation.frames)), diastole=entry(segmentation.diastole)
    )
    return replace(runs, **{field: after})


def pixels(site: MatchedSite, view: int) -> Array:
    """Return the diastolic places of the reference catheter's electrodes, (4, 2)."""
    (chain,) = (one for one in (site.runs.diastole.a, site.runs.diastole.b)[view].chains if one.catheter == NAME)
    assert chain.electrodes == (1, 2, 3, 4)
    return chain.pixels_uv


def agrees(site: MatchedSite, before: SiteRuns, view: int) -> bool:
    """Return whether the reference catheter's electrodes have the numbers that the segmenter's right chain had."""
    segmentation = (before.segmentation_a, before.segmentation_b)[view]
    assert segmentation is not None
    assert segmentation.diastole is not None
    return any(np.array_equal(chain.pixels_uv, pixels(site, view)) for chain in segmentation.diastole.chains)


def match(*sites: SiteRuns) -> tuple[MatchedSite, ...]:
    return match_study(sites, DEFAULT_CATALOGUE, Silent()).sites


@pytest.mark.parametrize("view", [0, 1])
def test_the_other_view_corrects_a_wrong_end_everywhere(heart, view: int) -> None:  # type: ignore[no-untyped-def]
    study = heart(seed=1)
    right = study.site("S1")
    runs = with_tip(with_tip(right, study, 1 - view, SURE), study, view, UNSURE, wrong=True)
    (site,) = match(runs)
    assert agrees(site, right, 0)
    assert agrees(site, right, 1)
    track = (site.runs.track_a, site.runs.track_b)[view]
    told = (right.segmentation_a, right.segmentation_b)[view]
    assert told is not None
    for seen, entry in zip(track, told.frames, strict=True):
        (chain,) = (one for one in seen.chains if one.catheter == NAME)
        assert any(np.array_equal(chain.pixels_uv, one.pixels_uv) for one in entry.chains)


def test_a_segmenter_that_does_not_doubt_the_end_is_believed(heart) -> None:  # type: ignore[no-untyped-def]
    study = heart(seed=1)
    right = study.site("S1")
    wrong = with_tip(with_tip(right, study, 0, None, wrong=True), study, 1, None, wrong=True)
    (site,) = match(wrong)
    assert agrees(site, wrong, 0)
    assert agrees(site, wrong, 1)


def test_the_other_sites_correct_what_both_views_of_a_site_have_wrong(heart) -> None:  # type: ignore[no-untyped-def]
    study = heart(seed=2)
    right = [study.site(f"S{k}") for k in range(4)]
    sites = [with_tip(with_tip(runs, study, 0, SURE), study, 1, SURE) for runs in right]
    sites[2] = with_tip(with_tip(right[2], study, 0, UNSURE, wrong=True), study, 1, UNSURE, wrong=True)
    matched = match(*sites)
    assert all(agrees(site, runs, view) for site, runs in zip(matched, right, strict=True) for view in (0, 1))
    assert (NAME, Reason.IDENTITY_UNCERTAIN) not in matched[2].notes


def test_an_end_that_nothing_shows_is_uncertain(heart) -> None:  # type: ignore[no-untyped-def]
    study = heart(seed=3, names=("reference", "mapping"))
    right = study.site("S1")
    unsure = with_tip(with_tip(right, study, 0, UNSURE), study, 1, UNSURE)
    marked = [(NAME, Reason.IDENTITY_UNCERTAIN) in match(runs)[0].notes for runs in (unsure,)]
    assert marked == [True]


def test_a_catheter_numbered_by_hand_keeps_its_numbers(heart, mark) -> None:  # type: ignore[no-untyped-def]
    study = heart(seed=1)
    right = study.site("S1")
    told = with_tip(with_tip(right, study, 0, UNSURE), study, 1, SURE)
    wrong = with_tip(right, study, 0, -SURE)
    place = right.camera_a.project(study.truth["S1"][NAME])
    by_hand = replace(told, segmentation_a=mark(wrong.segmentation_a, place, NAME, 0))
    (site,) = match(by_hand)
    assert agrees(site, right, 0)
    assert agrees(site, right, 1)


def test_sites_agree_on_the_end_of_a_resting_catheter() -> None:
    lying = np.array([[0.0, 0.0, 30.0], [1.0, 2.0, 29.0], [0.0, 1.0, -30.0], [30.0, 0.0, 0.0]])
    wrong, sure = common_ends(lying, np.array([1.0, 2.0, 0.5, 0.2]))
    assert wrong.tolist() == [False, False, True, False]
    assert sure == pytest.approx([2.5, 2.5, 2.5, 0.2])
    wrong, sure = common_ends(lying, np.array([1.0, 2.0, np.inf, 0.2]))
    assert wrong.tolist() == [True, True, False, False]
    assert np.isfinite(sure).all()


def test_numbers_from_the_other_end_and_back_are_the_same() -> None:
    points = np.arange(6.0).reshape(3, 2)
    chain = Chain((1, 2, 4), points, np.array([np.eye(2) * k for k in (1, 2, 3)]), np.arange(3.0), (), tip_odds=1.5)
    other = chain.from_other_end(5)
    assert other.electrodes == (2, 4, 5)
    assert other.tip_odds == -1.5
    again = other.from_other_end(5)
    assert (again.electrodes, again.pixels_uv.tolist(), again.tip_odds) == (chain.electrodes, points.tolist(), 1.5)
