"""Catheters that a study does not list: sought as usual types, and none of them gets a listed name."""

from dataclasses import replace

import numpy as np
import pytest

from fluoromap.catheters import DEFAULT_CATALOGUE, Catalogue, catheter_type
from fluoromap.contracts import Chain, FrameChains, PixelFacts, Run, Segmentation, Silent
from fluoromap.phantom import StudySpec, simulate_study
from fluoromap.reasons import Reason
from fluoromap.segmenter.learned_chain.plugin import LearnedChain
from fluoromap.segmenter.runs.hypotheses.unlisted_catheters import (
    asked_frames,
    frame_shows_more,
    listed_alone,
    run_shows_more,
    with_usual_types,
)

FRAMES = 4
STUDY = Catalogue(
    (catheter_type("quadripolar-2-5-2", "rv"), catheter_type("ablation-4", "map")), reference="rv", mapping="map"
)
QUADRIPOLAR, DECAPOLAR = (one.name for one in with_usual_types(STUDY).catheters[2:])


def chain(kinds: dict[str, float], v: float, seen: float = 0.9, electrodes: int = 4, manual: bool = False) -> Chain:
    points = np.stack([10.0 * np.arange(electrodes), np.full(electrodes, v)], axis=1)
    covariance = np.tile(np.eye(2), (electrodes, 1, 1))
    numbers = tuple(range(1, electrodes + 1))
    return Chain(numbers, points, covariance, np.full(electrodes, seen), tuple(kinds.items()), int(v), manual)


def segmented(*chains: Chain, lacking: int | None = None) -> Segmentation:
    """Return a segmentation in which the last chain is not there in one frame."""
    frames = tuple(
        FrameChains(frame, chains[:-1], Reason.TRACK_INTERRUPTED) if frame == lacking else FrameChains(frame, chains)
        for frame in range(FRAMES)
    )
    return Segmentation(frames, FrameChains(1, chains), (0, 1), np.zeros(FRAMES), np.arange(float(FRAMES)))


def shown(found: Segmentation) -> list[tuple[int, dict[str, float]]]:
    """Return track and kinds of each chain of every frame."""
    (one,) = {tuple((chain.track, chain.kinds) for chain in entry.chains) for entry in (*found.frames, found.diastole)}
    return [(track, dict(kinds)) for track, kinds in one]


def test_the_usual_types_have_names_that_the_study_does_not_use():
    study = Catalogue((catheter_type("quadripolar-2-5-2", QUADRIPOLAR),), None, QUADRIPOLAR)
    more = with_usual_types(study)
    assert len({one.name for one in more.catheters}) == 3
    assert more.reference not in (None, QUADRIPOLAR)
    assert with_usual_types(STUDY).reference == "rv"


def test_an_unlisted_catheter_is_reported_and_has_no_chain():
    found = segmented(
        chain({"map": 0.9, QUADRIPOLAR: 0.1}, 1), chain({DECAPOLAR: 1.0}, 2, electrodes=10), chain({"rv": 1.0}, 3)
    )
    alone = listed_alone(found, STUDY)
    assert shown(alone) == [(1, {"map": pytest.approx(1.0)}), (3, {"rv": 1.0})]
    assert alone.diastole.manual_needed is Reason.EXTRA_CATHETER


def test_without_an_unlisted_catheter_nothing_is_reported():
    found = segmented(chain({"map": 0.9, QUADRIPOLAR: 0.1}, 1), chain({"rv": 0.5, QUADRIPOLAR: 0.5}, 2))
    alone = listed_alone(found, STUDY)
    # Both quadripolar names are those of one catheter: no track shows the unlisted one.
    assert [dict(kinds) for _, kinds in shown(alone)] == [{"map": pytest.approx(1.0)}, {"rv": pytest.approx(1.0)}]
    assert alone.diastole.manual_needed is None


def test_of_two_that_look_alike_the_clearer_one_is_listed_with_half_of_the_probability():
    alike = {"rv": 0.5, QUADRIPOLAR: 0.5}
    found = segmented(chain({"map": 1.0}, 1), chain(alike, 2, seen=0.7), chain(alike, 3, seen=0.9))
    alone = listed_alone(found, STUDY)
    assert shown(alone) == [(1, {"map": 1.0}), (3, {"rv": pytest.approx(0.5)})]
    assert alone.diastole.manual_needed is Reason.EXTRA_CATHETER


def test_what_was_set_by_hand_keeps_its_name_and_the_clearer_one_is_left_out():
    """One frame has a mark; in the others the catheter is as likely the unlisted one."""
    alike = {"rv": 0.5, QUADRIPOLAR: 0.5}
    automatic, marked = chain(alike, 2, seen=0.9), chain({"rv": 1.0}, 3, manual=True)
    found = segmented(automatic, chain(alike, 3, seen=0.5))
    frames = (*found.frames[:2], FrameChains(2, (automatic, marked)), found.frames[3])
    alone = listed_alone(replace(found, frames=frames), STUDY)
    assert [[one.track for one in entry.chains] for entry in alone.frames] == [[3]] * FRAMES
    (kept,) = alone.frames[2].chains
    assert kept.manual
    assert kept.kinds == (("rv", 1.0),)


def test_nothing_that_was_set_by_hand_is_left_out():
    marked = [chain({"rv": 1.0}, 2, manual=True), chain({"rv": 1.0}, 3, manual=True)]
    alone = listed_alone(segmented(*marked, chain({QUADRIPOLAR: 0.9, "map": 0.1}, 4)), STUDY)
    assert {2, 3} <= {track for track, _ in shown(alone)}


def test_the_names_are_most_probable_together():
    """The second track is more like the ablation catheter than like an unlisted one, but the first one is clearly it."""
    found = segmented(chain({"map": 1.0}, 1), chain({"map": 0.6, QUADRIPOLAR: 0.4}, 2), chain({"rv": 1.0}, 3))
    assert [track for track, _ in shown(listed_alone(found, STUDY))] == [1, 3]


def test_a_frame_that_lacks_the_unlisted_catheter_alone_is_not_interrupted():
    both = chain({"map": 1.0}, 1), chain({"rv": 1.0}, 2)
    unlisted = segmented(*both, chain({DECAPOLAR: 1.0}, 3, electrodes=10), lacking=2)
    assert listed_alone(unlisted, STUDY).frames[2].manual_needed is None
    listed = segmented(chain({DECAPOLAR: 1.0}, 3, electrodes=10), *both, lacking=2)
    assert listed_alone(listed, STUDY).frames[2].manual_needed is Reason.TRACK_INTERRUPTED


def test_where_only_an_unlisted_catheter_is_seen_nothing_is():
    alone = listed_alone(segmented(chain({DECAPOLAR: 1.0}, 1, electrodes=10)), STUDY)
    assert all(
        entry.chains == () and entry.manual_needed is Reason.MANUAL_NEEDED for entry in (*alone.frames, alone.diastole)
    )


@pytest.mark.parametrize(("count", "frames"), [(1, (0,)), (2, (1, 0)), (60, (30, 15))])
def test_two_frames_are_asked_where_there_are_as_many(count, frames):
    assert asked_frames(count) == frames


def test_one_more_catheter_is_more_in_the_frame_and_in_the_run():
    one, both = (
        segmented(*chains) for chains in ((chain({"rv": 1.0}, 1),), (chain({"rv": 1.0}, 1), chain({"map": 1.0}, 2)))
    )
    assert run_shows_more(both, one, STUDY)
    assert not run_shows_more(both, both, STUDY)
    assert frame_shows_more(7.2, one, 0)
    assert not frame_shows_more(7.2, both, 0)


def test_usual_types_may_not_cost_a_listed_catheter_its_place():
    """A longer unlisted row drove a listed catheter to the place of the mapping catheter, which was found no more."""
    found = segmented(chain({"rv": 1.0}, 50), chain({"map": 1.0}, 90))
    more = segmented(chain({DECAPOLAR: 1.0}, 50, electrodes=10), chain({"rv": 1.0}, 90))
    assert not run_shows_more(more, found, STUDY)


def test_a_listed_catheter_in_its_place_is_not_lost_if_another_name_is_more_likely():
    found = segmented(chain({"rv": 0.6, "map": 0.4}, 50))
    more = segmented(chain({"rv": 0.4, "map": 0.6}, 50), chain({DECAPOLAR: 1.0}, 200, electrodes=10))
    assert run_shows_more(more, found, STUDY)


def test_an_unlisted_catheter_may_take_the_place_that_had_a_listed_name():
    """The study lists a mapping catheter that is not there; four electrodes of a longer one had its name."""
    found = segmented(chain({"rv": 1.0}, 50), chain({"map": 1.0}, 90))
    more = segmented(chain({"rv": 1.0}, 50), chain({DECAPOLAR: 1.0}, 90, electrodes=10))
    assert run_shows_more(more, found, STUDY)


def test_an_unlisted_catheter_does_not_take_the_name_of_the_mapping_catheter():
    """The catalogue alone named the reference catheter as the mapping one in this run, and left that one out."""
    spec = StudySpec(315, sites=1, frames=6, frame_rate_hz=60.0, heart="dog", contrast=("LAT", "PA"))
    frontal = simulate_study(spec).sites[0].runs[1]
    listed = Catalogue(
        tuple(one for one in DEFAULT_CATALOGUE.catheters if one.name != "pacing"), "reference", "mapping"
    )
    run = Run(frontal.frames, frontal.frame_times_ms, 512 / 178 * 2, PixelFacts(False, 12, False))
    found = LearnedChain().segment(run, listed, {}, Silent())
    assert found.diastole is not None
    assert found.diastole.manual_needed is Reason.EXTRA_CATHETER
    for entry in found.frames:
        (mapping,) = (chain for chain in entry.chains if chain.probability("mapping") > 0.9)
        away = np.linalg.norm(mapping.pixels_uv - frontal.truth.pixels_uv["mapping"][entry.frame], axis=1)
        assert away.max() < 5.0
        assert all(chain.probability("reference") < 0.6 for chain in entry.chains if chain is not mapping)
