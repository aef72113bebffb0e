"""A whole study matched: names, pairs, phases, and the reasons where they fail."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from fluoromap.catheters import DEFAULT_CATALOGUE
from fluoromap.contracts import FrameChains, MatchedSite, Segmentation, Silent
from fluoromap.geometry import Camera, Gantry, camera_from_gantry
from fluoromap.matching import SiteRuns, match_study, study_matching
from fluoromap.matching.two_view import triangulate_linear
from fluoromap.reasons import Reason


def named_right(site: MatchedSite, truth: dict[str, np.ndarray], names: tuple[str, ...]) -> bool:
    """Return whether each of these catheters is within 15 mm of truth.

    Breathing moves a catheter by less, an exchange of names by more.
    """
    a = {chain.catheter: chain for chain in site.runs.diastole.a.chains}
    b = {chain.catheter: chain for chain in site.runs.diastole.b.chains}
    for name in names:
        points = triangulate_linear(site.runs.camera_a, site.runs.camera_b, a[name].pixels_uv, b[name].pixels_uv)
        if np.linalg.norm(points.mean(axis=0) - truth[name].mean(axis=0)) > 15:
            return False
    return True


@pytest.mark.parametrize("angles", [(90.0, 0.0), (60.0, -30.0), (45.0, 0.0)])
def test_all_sites_are_all_named_and_paired_right(heart, angles: tuple[float, float]) -> None:  # type: ignore[no-untyped-def]
    study = heart(seed=1, angles=angles)
    sites = tuple(study.site(f"S{i:02d}") for i in range(5))
    matching = match_study(sites, DEFAULT_CATALOGUE, Silent())
    assert not matching.rejected
    for site in matching.sites:
        assert named_right(site, study.truth[site.site], ("reference", "pacing", "mapping"))
        assert ("reference", Reason.IDENTITY_BY_MOTION) in site.notes
        assert len(site.runs.track_a) == len(site.runs.frame_times_a_ms) == 80
        assert all(len(seen.chains) == 3 for seen in site.runs.track_b)


def test_sites_that_were_matched_before_get_the_same_answer_beside_others(heart) -> None:  # type: ignore[no-untyped-def]
    study, again = heart(seed=4), heart(seed=4)

    def answer(sites: list[SiteRuns]) -> list[object]:
        matched = match_study(tuple(sites), DEFAULT_CATALOGUE, Silent()).sites
        return [
            (site.notes, [(c.catheter, c.pixels_uv.tolist()) for seen in site.runs.track_a for c in seen.chains])
            for site in matched
        ]

    known = [study.site(f"S{i}") for i in range(3)]
    answer(known)
    fresh = [again.site(f"S{i}") for i in range(4)]
    assert answer([*known, study.site("S3")]) == answer(fresh)


@pytest.mark.parametrize("seed", range(4))
def test_the_mapping_catheter_is_recognised_by_its_tip_in_every_site(heart, seed: int) -> None:  # type: ignore[no-untyped-def]
    study = heart(seed=seed, wrong_kinds=0.2, noise_px=1.0, breathing_mm=5.0)
    matching = match_study(tuple(study.site(f"S{i}") for i in range(3)), DEFAULT_CATALOGUE, Silent())
    assert len(matching.sites) == 3
    assert all(named_right(site, study.truth[site.site], ("mapping",)) for site in matching.sites)


def test_one_site_alone_leaves_look_alikes_uncertain_and_takes_the_stiller_one(heart) -> None:  # type: ignore[no-untyped-def]
    study = heart(seed=2)
    (site,) = match_study((study.site("S01"),), DEFAULT_CATALOGUE, Silent()).sites
    assert set(site.notes) == {
        ("reference", Reason.IDENTITY_UNCERTAIN), ("pacing", Reason.IDENTITY_UNCERTAIN),
    }  # fmt: skip
    assert named_right(site, study.truth["S01"], ("reference", "pacing", "mapping"))


def test_a_name_by_hand_at_one_site_holds_for_the_study(heart, mark) -> None:  # type: ignore[no-untyped-def]
    # The look-alikes are exchanged on purpose: the catheter that moves more is called the reference.
    study = heart(seed=3)
    sites = [study.site(f"S{i}") for i in range(4)]
    runs = sites[2]
    frame = runs.segmentation_a.diastole.frame
    pixels = runs.camera_a.project(study.truth["S2"]["pacing"])
    sites[2] = replace(runs, segmentation_a=mark(runs.segmentation_a, pixels, "reference", frame))
    matching = match_study(tuple(sites), DEFAULT_CATALOGUE, Silent())
    for site in matching.sites:
        truth = study.truth[site.site]
        exchanged = {"reference": truth["pacing"], "pacing": truth["reference"], "mapping": truth["mapping"]}
        assert named_right(site, exchanged, ("reference", "pacing", "mapping"))
        assert site.notes == ()


def test_chains_without_track_numbers_are_followed_by_nearness(heart) -> None:  # type: ignore[no-untyped-def]
    study = heart(seed=4, tracked=False)
    (site,) = match_study((study.site("S01"),), DEFAULT_CATALOGUE, Silent()).sites
    truth = study.truth["S01"]
    assert named_right(site, truth, ("mapping",))
    for track, camera in ((site.runs.track_a, site.runs.camera_a), (site.runs.track_b, site.runs.camera_b)):
        for seen in track:
            chain = next(chain for chain in seen.chains if chain.catheter == "mapping")
            # Motion 5 mm, breathing some mm more; a neighbour would be farther.
            assert np.linalg.norm(chain.pixels_uv - camera.project(truth["mapping"]), axis=1).mean() < 75


@pytest.mark.parametrize("r_waves", [True, False])
def test_both_views_count_the_cardiac_cycle_from_the_same_moment(heart, r_waves: bool) -> None:  # type: ignore[no-untyped-def]
    study = heart(seed=5, r_waves=r_waves)
    matching = match_study(tuple(study.site(f"S{i}") for i in range(3)), DEFAULT_CATALOGUE, Silent())
    for site in matching.sites:
        start_a, start_b = study.starts[site.site]
        apart = []
        for pair in site.runs.cycle:
            a = start_a + pair.a.frame / 60 * study.rate_hz
            b = start_b + pair.b.frame / 60 * study.rate_hz
            apart.append(abs((a - b + 0.5) % 1.0 - 0.5))
        assert len(apart) > 50
        # Half a frame is 0.015 of this cycle.
        assert np.mean(apart) < 0.03
        phases = [pair.phase for pair in site.runs.cycle]
        assert phases == sorted(phases)
        assert phases[0] >= 0
        assert phases[-1] < 1


def test_diastole_comes_with_its_frames_and_phase(heart) -> None:  # type: ignore[no-untyped-def]
    study = heart(seed=6)
    runs = study.site("S01")
    (site,) = match_study((runs,), DEFAULT_CATALOGUE, Silent()).sites
    assert site.runs.diastole.a.frame == runs.segmentation_a.diastole.frame
    assert site.runs.diastole.b.frame == runs.segmentation_b.diastole.frame
    # Systole begins at phase 0 and lasts 0.45 of this cycle; the marked moment is 0.75.
    assert site.runs.diastole.phase == pytest.approx(0.75, abs=0.1)


def without_diastole(segmentation: Segmentation) -> Segmentation:
    return replace(segmentation, diastole=None, diastole_frames=())


def test_without_a_diastolic_mean_the_quietest_frame_replaces_it(heart) -> None:  # type: ignore[no-untyped-def]
    study = heart(seed=7)
    runs = study.site("S01")
    runs = replace(runs, segmentation_a=without_diastole(runs.segmentation_a))
    (site,) = match_study((runs,), DEFAULT_CATALOGUE, Silent()).sites
    assert runs.segmentation_a.motion[site.runs.diastole.a.frame] == runs.segmentation_a.motion.min()
    assert len(site.runs.diastole.a.chains) == 3
    assert named_right(site, study.truth["S01"], ("reference", "pacing", "mapping"))


def test_a_catheter_missing_in_the_diastolic_mean_is_taken_from_a_quiet_frame(heart) -> None:  # type: ignore[no-untyped-def]
    study = heart(seed=8)
    runs = study.site("S01")
    mean = runs.segmentation_b.diastole
    (site,) = match_study((runs,), DEFAULT_CATALOGUE, Silent()).sites
    mapping = next(chain for chain in site.runs.diastole.b.chains if chain.catheter == "mapping")
    left = tuple(chain for chain in mean.chains if not np.allclose(chain.pixels_uv, mapping.pixels_uv))
    segmentation = replace(runs.segmentation_b, diastole=FrameChains(mean.frame, left))
    (again,) = match_study((replace(runs, segmentation_b=segmentation),), DEFAULT_CATALOGUE, Silent()).sites
    found = next(chain for chain in again.runs.diastole.b.chains if chain.catheter == "mapping")
    assert found.pixels_uv == pytest.approx(mapping.pixels_uv, abs=5)
    assert again.runs.diastole.b.frame in runs.segmentation_b.diastole_frames


def keep(segmentation: Segmentation, wanted) -> Segmentation:  # type: ignore[no-untyped-def]
    """Keep only the chains for which ``wanted(chain)``."""
    frames = tuple(
        FrameChains(one.frame, tuple(chain for chain in one.chains if wanted(chain))) for one in segmentation.frames
    )
    mean = segmentation.diastole
    diastole = FrameChains(mean.frame, tuple(chain for chain in mean.chains if wanted(chain)))
    return replace(segmentation, frames=frames, diastole=diastole)


def track_of(segmentation: Segmentation, pixels: np.ndarray) -> int:
    return min(segmentation.diastole.chains, key=lambda one: float(np.linalg.norm(one.pixels_uv - pixels))).track


def test_a_missing_reference_is_reported_and_the_site_kept(heart) -> None:  # type: ignore[no-untyped-def]
    study = heart(seed=9)
    sites = [study.site(f"S{i}") for i in range(5)]
    gone = track_of(sites[1].segmentation_b, sites[1].camera_b.project(study.truth["S1"]["reference"]))
    sites[1] = replace(sites[1], segmentation_b=keep(sites[1].segmentation_b, lambda chain: chain.track != gone))
    matching = match_study(tuple(sites), DEFAULT_CATALOGUE, Silent())
    assert [site.site for site in matching.sites] == ["S0", "S1", "S2", "S3", "S4"]
    site = matching.sites[1]
    assert ("reference", Reason.CATHETER_NOT_FOUND) in site.notes
    assert named_right(site, study.truth["S1"], ("pacing", "mapping"))


def test_a_missing_mapping_catheter_rejects_the_site(heart) -> None:  # type: ignore[no-untyped-def]
    study = heart(seed=10)
    runs = study.site("S01")
    gone = track_of(runs.segmentation_a, runs.camera_a.project(study.truth["S01"]["mapping"]))
    runs = replace(runs, segmentation_a=keep(runs.segmentation_a, lambda chain: chain.track != gone))
    matching = match_study((runs,), DEFAULT_CATALOGUE, Silent())
    assert not matching.sites
    assert matching.rejected[0].reasons == (Reason.CATHETER_NOT_FOUND,)


def test_marks_that_hold_only_some_electrodes_pair_by_their_numbers(heart) -> None:  # type: ignore[no-untyped-def]
    study = heart(seed=11)
    runs = study.site("S01")

    def only(segmentation: Segmentation, rows: list[int]) -> Segmentation:
        def cut(entry: FrameChains) -> FrameChains:
            return FrameChains(
                entry.frame,
                tuple(
                    replace(
                        chain, electrodes=tuple(row + 1 for row in rows), pixels_uv=chain.pixels_uv[rows],
                        covariance_px2=chain.covariance_px2[rows], scores=chain.scores[rows],
                    )
                    for chain in entry.chains
                ),
            )  # fmt: skip

        return replace(segmentation, frames=tuple(map(cut, segmentation.frames)), diastole=cut(segmentation.diastole))

    runs = replace(
        runs, segmentation_a=only(runs.segmentation_a, [0, 1, 3]), segmentation_b=only(runs.segmentation_b, [0, 2, 3])
    )
    (site,) = match_study((runs,), DEFAULT_CATALOGUE, Silent()).sites
    assert site.runs.diastole.a.chains[0].electrodes == (1, 2, 4)
    assert site.runs.diastole.b.chains[0].electrodes == (1, 3, 4)


def empty(segmentation: Segmentation, why: Reason | None) -> Segmentation:
    return replace(
        segmentation, diastole=None, frames=tuple(FrameChains(one.frame, (), why) for one in segmentation.frames)
    )


def lateral(degrees: float) -> Camera:
    return camera_from_gantry(Gantry(degrees, 0, 1000, 500, (178 / 512, 178 / 512), 512, 512))


def test_sites_that_cannot_be_located_are_rejected_with_their_reason(heart) -> None:  # type: ignore[no-untyped-def]
    study = heart(seed=12)
    good = study.site("good")
    other = study.site("other")
    a, b = good.segmentation_a, good.segmentation_b
    assert a is not None
    assert b is not None
    sites = (
        good,
        SiteRuns("failed", good.camera_a, good.camera_b, None, b),
        SiteRuns("parallel", lateral(15), lateral(0), a, b),
        SiteRuns("empty", good.camera_a, good.camera_b, a, empty(b, None)),
        SiteRuns("contrast", good.camera_a, good.camera_b, empty(a, Reason.MANUAL_NEEDED), b),
    )
    matching = match_study(sites, DEFAULT_CATALOGUE, Silent())
    assert [site.site for site in matching.sites] == ["good"]
    assert {site.site: site.reasons for site in matching.rejected} == {
        "failed": (Reason.PLUGIN_FAILED,), "parallel": (Reason.VIEWS_PARALLEL,),
        "empty": (Reason.NO_ELECTRODES,), "contrast": (Reason.MANUAL_NEEDED,),
    }  # fmt: skip
    assert other.site == "other"


def test_views_that_do_not_belong_together_are_refused(heart) -> None:  # type: ignore[no-untyped-def]
    study = heart(seed=13, names=("mapping",))
    first = study.site("S0")
    turned = SiteRuns("S0", lateral(90), camera_from_gantry(
        Gantry(0, 60, 1000, 500, (178 / 512, 178 / 512), 512, 512)), first.segmentation_a, first.segmentation_b)  # fmt: skip
    matching = match_study((turned,), DEFAULT_CATALOGUE, Silent())
    assert not matching.sites
    assert matching.rejected[0].reasons == (Reason.PAIRING_FAILED,)


def test_an_empty_study_is_empty() -> None:
    assert match_study((), DEFAULT_CATALOGUE, Silent()).sites == ()


def test_a_mark_that_contradicts_everything_else_is_reported_not_dropped_silently(heart) -> None:  # type: ignore[no-untyped-def]
    study = heart(seed=3)
    sites = [study.site(f"S{i:02d}") for i in range(4)]
    segmentation = sites[1].segmentation_a
    entry = segmentation.frames[5]
    mapping = max(entry.chains, key=lambda chain: chain.probability("mapping"))
    astray = replace(
        mapping, pixels_uv=mapping.pixels_uv + np.array([60.0, -45.0]), kinds=(("mapping", 1.0),), manual=True, track=99
    )
    others = tuple(chain for chain in entry.chains if chain is not mapping)
    frames = tuple(FrameChains(5, (*others, astray)) if one.frame == 5 else one for one in segmentation.frames)
    sites[1] = replace(sites[1], segmentation_a=replace(segmentation, frames=frames))
    matching = match_study(tuple(sites), DEFAULT_CATALOGUE, Silent())
    told = {site.site for site in matching.sites if ("mapping", Reason.MARK_NOT_USED) in site.notes}
    assert told == {"S01"}


def test_named_chains_carry_the_track_of_the_segmenter(heart) -> None:  # type: ignore[no-untyped-def]
    runs = heart(seed=2).site("S01")
    (site,) = match_study((runs,), DEFAULT_CATALOGUE, Silent()).sites
    for segmentation, track in ((runs.segmentation_a, site.runs.track_a), (runs.segmentation_b, site.runs.track_b)):
        assert segmentation is not None
        for entry, observation in zip(segmentation.frames, track, strict=True):
            by_track = {chain.track: chain for chain in entry.chains}
            assert observation.chains
            for chain in observation.chains:
                np.testing.assert_array_equal(chain.pixels_uv, by_track[chain.track].pixels_uv)


class _Remembering(Silent):
    """A context with a memory: ``computed`` are the kinds of the partial results that it had to compute."""

    def __init__(self) -> None:
        self.computed: list[str] = []
        self._known: dict[str, Any] = {}

    def recall(self, kind, inputs, compute):  # type: ignore[no-untyped-def]
        key = repr((kind, inputs))
        if key not in self._known:
            self.computed.append(kind.__name__)
            self._known[key] = compute()
        return self._known[key]


def test_a_corrected_site_alone_is_compared_and_matched_again(heart, monkeypatch) -> None:  # type: ignore[no-untyped-def]
    study = heart(seed=4)
    sites = [study.site(f"S{i:02d}") for i in range(3)]
    gathered, views_of = [], study_matching.views_of
    monkeypatch.setattr(study_matching, "views_of", lambda runs: gathered.append(runs.site) or views_of(runs))
    context = _Remembering()
    match_study(sites, DEFAULT_CATALOGUE, context)
    assert gathered == ["S00", "S01", "S02"]
    assert context.computed == ["SiteComparison"] * 3 + ["MatchedRuns"] * 3

    gathered.clear()
    context.computed.clear()
    segmentation = sites[1].segmentation_a
    assert segmentation is not None
    frame = segmentation.frames[5]
    moved = replace(frame.chains[0], pixels_uv=frame.chains[0].pixels_uv + 0.1)
    frames = [FrameChains(5, (moved, *frame.chains[1:])) if one.frame == 5 else one for one in segmentation.frames]
    sites[1] = replace(sites[1], segmentation_a=replace(segmentation, frames=tuple(frames)))
    again = match_study(sites, DEFAULT_CATALOGUE, context)
    assert gathered == ["S01"]
    assert context.computed == ["SiteComparison", "MatchedRuns"]
    assert repr(again) == repr(match_study(sites, DEFAULT_CATALOGUE, Silent()))


def test_a_name_that_a_person_confirms_matches_no_other_site_again(heart, mark) -> None:  # type: ignore[no-untyped-def]
    study = heart(seed=1)
    sites = [study.site(f"S{i:02d}") for i in range(5)]
    context = _Remembering()
    before = match_study(sites, DEFAULT_CATALOGUE, context)
    doubt = ("reference", Reason.IDENTITY_BY_MOTION)
    assert all(doubt in site.notes for site in before.sites)

    context.computed.clear()
    segmentation = sites[1].segmentation_a
    assert segmentation is not None
    pixels = sites[1].camera_a.project(study.truth["S01"]["reference"])
    sites[1] = replace(sites[1], segmentation_a=mark(segmentation, pixels, "reference", 5))
    again = match_study(sites, DEFAULT_CATALOGUE, context)
    assert context.computed == ["SiteComparison", "MatchedRuns"]
    assert not any(doubt in site.notes for site in again.sites)
    assert repr(again) == repr(match_study(sites, DEFAULT_CATALOGUE, Silent()))
