"""Chains of one image: which of them compete, and which are accepted."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.ndimage import maximum_filter

from fluoromap.catheters import Catalogue, catheter_type
from fluoromap.contracts import Chain, FrameChains
from fluoromap.segmenter.chains.families import catheter_families
from fluoromap.segmenter.chains.linking import PossibleChains, best_chains
from fluoromap.segmenter.electrodes.proposals import Likeness, Proposals, log_odds
from fluoromap.segmenter.frames.chain_detector import ChainDetector, with_whole_places
from fluoromap.segmenter.frames.electrode_detector import IN_A_RUN
from fluoromap.segmenter.judge.acceptance import UNSEEN, ScoreLimits
from fluoromap.segmenter.judge.features.unexplained_rows import continues
from fluoromap.segmenter.picture.field_mask import FieldMask, are_in

PX = 4.0
SIZE = 360
CATALOGUE = Catalogue(
    (catheter_type("decapolar-2-5-2", "cs"), catheter_type("ablation-4", "ablation")), "cs", "ablation"
)


class Evidence:
    """Image evidence with a probability and a score for each of some points, and nothing elsewhere."""

    reduction = 1
    pixel_noise = position_noise = 0.02

    def __init__(self, image, points, probability, scores, halves=None, tips=(), contrast=0.0):
        self.contrast = contrast
        self.smooth, self.points = image, points
        self.probability, self.scores = np.asarray(probability), np.asarray(scores)
        self.halves = np.zeros((0, 2)) if halves is None else halves
        self.tips = np.reshape(tips, (-1, 2))

    @property
    def likeness(self):
        """As much for the points as ``contrast``, and nothing elsewhere."""
        values = np.zeros_like(self.smooth)
        u, v = np.rint(self.points).astype(np.int64).T
        values[v, u] = self.contrast
        return Likeness(values, 1.0, 0.0)

    def proposals(self, allowed, expected):
        order = np.argsort(-self.probability, kind="stable")
        covariance = np.tile(0.5 * np.eye(2), (len(order), 1, 1))
        return Proposals(self.points[order], self.probability[order], covariance)

    def _nearest(self, values, points_uv, otherwise):
        away = np.linalg.norm(points_uv[:, None] - self.points[None], axis=2)
        return np.where(away.min(axis=1) < 4.0, values[away.argmin(axis=1)], otherwise)

    def halves_of_pairs(self, allowed):
        count = len(self.halves)
        return Proposals(self.halves, np.full(count, 0.9), np.tile(np.eye(2), (count, 1, 1)))

    def tip_logits_at(self, points_uv):
        away = np.linalg.norm(points_uv[:, None] - self.tips[None], axis=2).min(axis=1, initial=np.inf)
        return np.where(away < 4.0, 2.0, -2.0)

    def probability_at(self, points_uv):
        return self._nearest(self.probability, points_uv, 0.01)

    def kind_odds_at(self, points_uv):
        return log_odds(self.probability_at(points_uv))

    def unseen_probability_at(self, points_uv):
        return np.zeros(len(points_uv))

    def variance_at(self, points_uv):
        return np.full(len(points_uv), 0.5)

    def scores_at(self, points_uv):
        return self._nearest(self.scores, points_uv, 0.01)


def row_of(name, tip, angle, shortened=0.9):
    return np.asarray(tip) + np.outer(CATALOGUE[name].arc_lengths_mm * PX * shortened, [np.cos(angle), np.sin(angle)])


def drawn(rows):
    """Draw a log image of catheters.

    Each electrode is a dark spot; a faint shaft follows the row and goes on behind it.
    """
    v, u = np.mgrid[:SIZE, :SIZE].astype(np.float64)
    image = np.random.default_rng(3).normal(6.0, 0.02, (SIZE, SIZE))
    for row in rows:
        along = (row[-1] - row[0]) / np.linalg.norm(row[-1] - row[0])
        t = (u - row[0][0]) * along[0] + (v - row[0][1]) * along[1]
        across = (v - row[0][1]) * along[0] - (u - row[0][0]) * along[1]
        length = np.linalg.norm(row[-1] - row[0])
        image -= 0.12 * ((np.abs(across) < 3.0) & (t > 0) & (t < length + 40.0))
        for point in row:
            image -= 0.8 * (np.hypot(u - point[0], v - point[1]) < 3.0)
    return image.astype(np.float32)


def drawn_without_shaft(row):
    v, u = np.mgrid[:SIZE, :SIZE].astype(np.float64)
    image = np.random.default_rng(3).normal(6.0, 0.02, (SIZE, SIZE))
    for point in row:
        image -= 0.8 * (np.hypot(u - point[0], v - point[1]) < 3.0)
    return image.astype(np.float32)


def detector_of(evidence, catalogue=CATALOGUE, acceptance=IN_A_RUN):
    everywhere = np.ones(evidence.smooth.shape, np.bool_)
    field = FieldMask(everywhere, everywhere, everywhere, np.zeros(0, np.int64), np.zeros(0, np.int64), 1.0)
    return ChainDetector(catalogue, field, PX, lambda x: evidence, acceptance)


def chains_found(image, points, probability, scores, **more):
    detector = detector_of(Evidence(image, points, probability, scores, **more))
    return detector.split_pairs(detector.search(image)).entry(0).chains


class EvidenceInField(Evidence):
    """Proposes electrodes where they are allowed only."""

    def proposals(self, allowed, expected):
        proposed = super().proposals(allowed, expected)
        return proposed.where(are_in(allowed, proposed.points_uv))


def lies_on(chain, row):
    return len(chain.pixels_uv) == len(row) and np.linalg.norm(chain.pixels_uv - row, axis=1).max() < 5.0


def test_a_chain_that_would_be_rejected_does_not_take_a_catheter_s_place():
    catheter, vessel = row_of("ablation", (60, 60), 0.3), row_of("ablation", (60, 250), -0.2)
    points = np.concatenate([catheter, vessel])
    probability, scores = [0.8] * 4 + [0.99] * 4, [0.9] * 4 + [0.05] * 4
    found = chains_found(drawn([catheter, vessel]), points, probability, scores)
    assert len(found) == 1
    assert lies_on(found[0], catheter)


@pytest.mark.parametrize(("likely", "is_there"), [(0.97, True), (0.45, False)])
def test_nothing_takes_the_place_of_a_catheter_at_the_edge_of_the_field(likely, is_there):
    """A catheter's electrodes near the edge compete with others at once where two are sure; noise there does not."""
    at_edge, other = row_of("ablation", (12, 100), np.pi / 2), row_of("ablation", (120, 250), -0.2)
    image, points = drawn([at_edge, other]), np.concatenate([at_edge, other])
    probability = [likely] * 4 + [0.9] * 4
    evidence = EvidenceInField(image, points, probability, [0.9] * 8)
    (ablation,) = (catheter for catheter in CATALOGUE.catheters if catheter.name == "ablation")
    detector = detector_of(evidence, Catalogue((ablation,), None, "ablation"))
    away = np.zeros(image.shape, np.bool_)
    away[20:-20, 20:-20] = True
    detector.field = replace(detector.field, candidates=away)
    (chain,) = detector.search(image).entry(0).chains
    assert lies_on(chain, at_edge if is_there else other)


def test_a_part_of_a_longer_catheter_gives_its_electrodes_back_to_it():
    catheter, vessel = row_of("cs", (60, 60), 0.3), row_of("cs", (60, 250), -0.2)
    points = np.concatenate([catheter, vessel])
    # The vessel takes the place of the decapolar catheter, whose electrodes then look like one of the ablation catheter.
    probability, scores = [0.8] * 10 + [0.99] * 10, [0.9] * 10 + [0.05] * 10
    found = chains_found(drawn([catheter, vessel]), points, probability, scores)
    assert len(found) == 1
    assert lies_on(found[0], catheter)


def test_a_doubted_catheter_is_accepted_beside_a_sure_one_only():
    ablation, cs = row_of("ablation", (60, 250), -0.2), row_of("cs", (60, 60), 0.3)
    acceptance = replace(IN_A_RUN, scores_beside=ScoreLimits(0.3, seen=0.1, least_seen=0.7))
    for scores_of_cs, count in ((0.9, 2), (0.1, 0)):
        scores = [0.35] * 4 + [scores_of_cs] * 10
        image, points = drawn([ablation, cs]), np.concatenate([ablation, cs])
        detector = detector_of(Evidence(image, points, [0.95] * 14, scores), acceptance=acceptance)
        assert len(detector.search(image).entry(0).chains) == count


def test_what_takes_the_place_of_a_doubted_catheter_beside_a_sure_one_gives_it_back():
    ablation, vessel, cs = (
        row_of("ablation", (60, 250), -0.2),
        row_of("ablation", (200, 300), 0.1),
        row_of("cs", (60, 60), 0.3),
    )
    acceptance = replace(IN_A_RUN, scores_beside=ScoreLimits(0.3, seen=0.1, least_seen=0.7))
    image, points = drawn([ablation, vessel, cs]), np.concatenate([ablation, vessel, cs])
    probability, scores = [0.9] * 4 + [0.99] * 14, [0.35] * 4 + [0.05] * 4 + [0.9] * 10
    found = detector_of(Evidence(image, points, probability, scores), acceptance=acceptance).search(image)
    assert any(lies_on(chain, ablation) for chain in found.entry(0).chains)


@pytest.mark.parametrize("astray", [(1,), (1, 3), (2, 3)])
def test_an_electrode_that_its_fit_leads_astray_is_judged_where_it_was_proposed(astray):
    catheter = row_of("ablation", (60, 60), 0.3)
    dark = catheter.copy()
    dark[list(astray)] += 4.5 * np.array([np.cos(0.3), np.sin(0.3)])
    found = chains_found(drawn([dark]), catheter, [0.99] * 4, [0.9] * 4)
    assert len(found) == 1
    assert np.linalg.norm(found[0].pixels_uv - dark, axis=1).max() < 2.5


@pytest.mark.parametrize(("between", "listed"), [([0.8, 0.8], True), ([0.995], True), ([0.995, 0.995], False)])
def test_a_long_chain_is_unlisted_where_more_than_one_thing_between_is_like_its_electrodes(between, listed):
    catheter = row_of("cs", (60, 60), 0.4)
    gaps = 0.5 * (catheter[[3, 5]] + catheter[[4, 6]])[: len(between)]
    points = np.concatenate([catheter, gaps])
    found = chains_found(drawn([catheter]), points, [0.99] * 10 + between, [0.9] * 10 + [0.9] * len(between))
    assert any(lies_on(chain, catheter) for chain in found) == listed


def test_electrodes_of_a_long_catheter_in_its_line_do_not_make_a_short_chain_unlisted():
    ablation, cs = row_of("ablation", (200, 100), 0.0), row_of("cs", (170, 100), np.pi)
    points = np.concatenate([ablation, cs])
    found = chains_found(drawn([ablation, cs]), points, [0.99] * 14, [0.9] * 14)
    assert sorted(len(chain.electrodes) for chain in found) == [4, 10]


def test_a_row_that_the_catalogue_does_not_list_is_not_two_catheters_end_to_end():
    catalogue = Catalogue(
        (catheter_type("hexapolar-2-5-2", "cs"), catheter_type("quadripolar-2-5-2", "his")), "cs", "his"
    )
    row = row_of("cs", (60, 60), 0.4)
    evidence = Evidence(drawn([row]), row, [0.99] * 10, [0.9] * 10)
    assert detector_of(evidence, catalogue).search(evidence.smooth).entry(0).chains == ()


@pytest.mark.parametrize(("second", "listed"), [(0.9, False), (0.6, True)])
def test_a_short_chain_is_a_part_of_a_catheter_with_one_more_pair_as_sure_as_its_own_electrodes(second, listed):
    arc_mm = catheter_type("hexapolar-2-5-2", "his").arc_lengths_mm
    row = np.array([60.0, 60.0]) + np.outer(arc_mm * PX * 0.9, [np.cos(0.3), np.sin(0.3)])
    catalogue = Catalogue((catheter_type("quadripolar-2-5-2", "his"),), None, "his")
    evidence = Evidence(drawn([row]), row, [0.9] * 5 + [second], [0.9] * 6)
    chains = detector_of(evidence, catalogue).search(evidence.smooth).entry(0).chains
    assert bool(chains) == listed


@pytest.mark.parametrize(("more", "listed"), [(0.75, False), (0.7, True)])
def test_a_long_chain_in_a_longer_row_is_unlisted_where_the_others_are_sure_too(more, listed):
    row = row_of("cs", (60, 60), 0.4)
    catalogue = Catalogue((catheter_type("hexapolar-2-5-2", "cs"),), None, "cs")
    evidence = Evidence(drawn([row]), row, [0.97] * 6 + [more] * 4, [0.9] * 10)
    chains = detector_of(evidence, catalogue).search(evidence.smooth).entry(0).chains
    assert any(lies_on(chain, row[:6]) for chain in chains) == listed


def test_a_part_of_a_loop_is_a_part_of_a_longer_row():
    angles = np.deg2rad([0.0, 12.0, 42.0, 54.0, 84.0, 96.0, 126.0, 138.0])
    loop = 180.0 + 12.0 * PX * np.stack([np.cos(angles), np.sin(angles)], axis=1)
    numbers, covariance = (1, 2, 3, 4), np.tile(np.eye(2), (4, 1, 1))
    chain = Chain(numbers, loop[:4], covariance, np.ones(4), (("his", 1.0),))
    his = catheter_type("quadripolar-2-5-2", "his")
    assert continues(chain, loop, his, PX)
    aside = loop[3] + np.outer(np.arange(1, 5) * 4.0 * PX, [np.cos(0.9), np.sin(0.9)])
    assert not continues(chain, aside, his, PX)


@pytest.mark.parametrize(("hidden", "found"), [(slice(8, 10), True), (slice(4, 6), True), (slice(7, 10), False)])
def test_something_may_hide_a_pair_of_a_long_catheter(hidden, found):
    catheter = row_of("cs", (60, 60), 0.4)
    probability, scores = np.full(10, 0.95), np.full(10, 0.9)
    probability[hidden], scores[hidden] = 0.02, 0.02
    evidence = Evidence(drawn([catheter]), catheter, probability, scores)
    assert (
        any(lies_on(chain, catheter) for chain in detector_of(evidence).search(evidence.smooth).entry(0).chains)
        == found
    )


def test_a_long_chain_a_pair_too_far_along_its_catheter_hides_no_pair():
    catheter = row_of("cs", (60, 60), 0.4)
    on = (catheter[-1] - catheter[0]) / np.linalg.norm(catheter[-1] - catheter[0])
    shaft = catheter[-1] + np.outer(np.array([5.0, 7.0]) * PX * 0.9, on)
    # The tip is not proposed, and two places on the shaft are: the displaced chain has more proposals.
    points = np.concatenate([catheter[1:], shaft])
    evidence = Evidence(drawn([catheter]), points, [0.95] * 9 + [0.9] * 2, [0.9] * 9 + [0.02] * 2)
    chains = detector_of(evidence).search(evidence.smooth).entry(0).chains
    assert any(lies_on(chain, catheter) for chain in chains)


@pytest.mark.parametrize(("weakest", "listed"), [(0.3, True), (0.2, False)])
def test_a_long_chain_with_a_place_of_nothing_has_no_excuse_for_what_lies_between(weakest, listed):
    catheter = row_of("cs", (60, 60), 0.4)
    points = np.concatenate([catheter, 0.5 * (catheter[3:4] + catheter[4:5])])
    probability = [0.99] * 6 + [weakest] + [0.99] * 3 + [0.995]
    found = chains_found(drawn([catheter]), points, probability, [0.9] * 11)
    assert any(lies_on(chain, catheter) for chain in found) == listed


def test_pairs_that_were_found_as_one_are_split_where_a_catheter_is_missing():
    catheter = row_of("cs", (60, 60), 0.4, shortened=0.5)
    merged = 0.5 * (catheter[0::2] + catheter[1::2])[:4]
    points = np.concatenate([merged, catheter[8:]])
    image, sure = drawn([catheter]), [0.95] * 6
    assert not any(lies_on(chain, catheter) for chain in chains_found(image, points, sure, sure))
    found = chains_found(image, points, sure, sure, halves=catheter[:8])
    assert any(lies_on(chain, catheter) for chain in found)


def test_a_split_keeps_the_chains_that_were_found_without_it():
    catheter, whole = row_of("cs", (60, 60), 0.4, shortened=0.5), row_of("cs", (60, 200), 0.2)
    merged = 0.5 * (catheter[0::2] + catheter[1::2])[:4]
    points = np.concatenate([merged, catheter[8:], whole])
    sure = [0.95] * 16
    two = Catalogue((catheter_type("decapolar-2-5-2", "cs"), catheter_type("decapolar-2-5-2", "rv")), "cs", "rv")
    image = drawn([catheter, whole])
    detector = detector_of(Evidence(image, points, sure, sure, halves=catheter[:8]), two)
    searched = detector.search(image)
    (known,) = searched.found.chains
    moved = replace(known, pixels_uv=known.pixels_uv + 1.0)
    split = detector.split_pairs(replace(searched, found=replace(searched.found, chains=(moved,))))
    assert len(split.found.chains) == 2
    assert moved in split.found.chains


def test_a_long_chain_with_places_that_are_no_electrodes_gives_way_to_one_with_a_split_pair():
    catheter = row_of("cs", (120, 120), 0.4, shortened=0.5)
    on = (catheter[-1] - catheter[0]) / np.linalg.norm(catheter[-1] - catheter[0])
    shaft = catheter[-1] + np.outer(np.array([6.0, 9.0]) * PX * 0.5, on)
    merged = 0.5 * (catheter[:1] + catheter[1:2])
    points = np.concatenate([merged, catheter[2:], shaft])
    probability, scores = [0.95] * 9 + [0.25, 0.25], [0.95] * 11
    image = drawn([catheter])
    (displaced,) = chains_found(image, points, probability, scores)
    assert not lies_on(displaced, catheter)
    found = chains_found(image, points, probability, scores, halves=catheter[:2])
    assert any(lies_on(chain, catheter) for chain in found)


def test_of_chains_that_differ_in_one_electrode_the_clearer_one_wins():
    one = Catalogue((catheter_type("decapolar-5-5-5", "cs"),), None, "cs")
    along = np.concatenate([[0.0], np.cumsum(np.asarray(one["cs"].spacing_mm))]) * PX * 0.85
    # The last gap is shorter, and beyond the other end something lies just where one more electrode would.
    along[-1] -= 0.2 * (along[-1] - along[-2])
    places = np.append(along, -(along[1] - along[0]))
    points = np.stack([70.0 + places, np.full(11, 180.0)], axis=1)
    image = drawn_without_shaft(points[:10])
    evidence = Evidence(image, points, [0.98] * 10 + [0.3], [0.95] * 11)
    detector = detector_of(evidence, one)
    (found,) = detector.search(image).entry(0).chains
    ends = np.sort(found.pixels_uv[:, 0])[[0, -1]]
    np.testing.assert_allclose(ends, points[[0, 9], 0], atol=4.0)


def test_three_blobs_are_no_quadripolar_catheter_with_a_split_pair():
    catheter = row_of("ablation", (60, 60), 0.4, shortened=0.5)
    points = np.concatenate([catheter[:2], 0.5 * (catheter[2:3] + catheter[3:])])
    found = chains_found(drawn([catheter]), points, [0.95] * 3, [0.95] * 3, halves=catheter[2:])
    assert not any(lies_on(chain, catheter) for chain in found)


def test_an_end_that_looks_like_a_tip_is_the_tip():
    catheter = row_of("cs", (60, 60), 0.4)
    for end in (catheter[0], catheter[-1]):
        (found,) = chains_found(drawn_without_shaft(catheter), catheter, [0.95] * 10, [0.9] * 10, tips=end)
        np.testing.assert_allclose(found.pixels_uv[0], end, atol=2.0)


def test_a_chain_of_another_shape_is_refused_before_its_electrodes_are_judged(monkeypatch):
    catheter = row_of("ablation", (60, 60), 0.3)
    image = drawn([catheter])
    evidence = Evidence(image, catheter, [0.9] * 4, [0.9] * 4)
    (known,) = chains_found(image, catheter, [0.9] * 4, [0.9] * 4)
    bent = known.pixels_uv.copy()
    bent[2] += 4.6 * np.array([-np.sin(0.3), np.cos(0.3)])
    other = replace(known, pixels_uv=bent, covariance_px2=np.tile(25.0 * np.eye(2), (4, 1, 1)))
    detector = detector_of(evidence)
    same = detector.find_again(image, known, np.zeros(2), 3.0, (), same_shape=True)
    assert same is not None
    assert lies_on(same, catheter)
    found = detector.find_again(image, other, np.zeros(2), 3.0, ())
    assert found is not None
    assert np.linalg.norm(found.pixels_uv[2] - bent[2]) > 4.0
    monkeypatch.setattr(Evidence, "scores_at", None)
    assert detector.find_again(image, other, np.zeros(2), 3.0, (), same_shape=True) is None


class WideEvidence(Evidence):
    """Evidence whose contrast covers electrodes, not single pixels."""

    @property
    def likeness(self):
        return Likeness(maximum_filter(super().likeness.values, 5), 1.0, 0.0)


def test_a_chain_that_was_found_again_is_less_sure_than_one_that_was_found():
    catheter = row_of("cs", (60, 60), 0.3)
    image = drawn([catheter])
    (known,) = chains_found(image, catheter, [0.9] * 10, [0.9] * 10)
    elsewhere = replace(known, covariance_px2=known.covariance_px2 + 9.0 * np.eye(2))
    again = detector_of(WideEvidence(image, catheter, [0.9] * 10, [0.9] * 10)).find_again(
        image, elsewhere, np.zeros(2), 3.0, ()
    )
    np.testing.assert_allclose(again.pixels_uv, known.pixels_uv, atol=0.2)
    sizes = [np.trace(chain.covariance_px2, axis1=1, axis2=2) for chain in (again, known)]
    assert np.median(sizes[0] / sizes[1]) > 1.3


def test_contrast_shows_a_confirmed_chain_that_its_frame_s_proposer_doubts():
    catheter = row_of("cs", (60, 60), 0.3)
    image = drawn([catheter])
    (known,) = chains_found(image, catheter, [0.9] * 10, [0.9] * 10)
    for contrast, is_shown in ((5.0, True), (1.0, False)):
        detector = detector_of(WideEvidence(image, catheter, [1e-6] * 10, [1e-6] * 10, contrast=contrast))
        assert detector.find_again(image, known, np.zeros(2), 3.0, ()) is None
        again = detector.find_again(image, known, np.zeros(2), 3.0, (), confirmed=True)
        assert (again is not None and lies_on(again, catheter)) == is_shown


def test_less_likely_points_between_half_of_the_electrodes_make_a_long_chain_unlisted():
    catheter = row_of("cs", (60, 60), 0.4)
    gaps = 0.5 * (catheter[:-1] + catheter[1:])[[1, 3, 5, 7]]
    wide = np.concatenate([gaps - 0.6 * PX, gaps + 0.6 * PX])
    points = np.concatenate([catheter, wide])
    found = chains_found(drawn([catheter]), points, [0.99] * 10 + [0.8] * 8, [0.9] * 10 + [0.9] * 8)
    assert not any(lies_on(chain, catheter) for chain in found)


def test_a_short_chain_with_a_sure_point_between_its_electrodes_is_unlisted():
    catheter = row_of("ablation", (60, 60), 0.3)
    points = np.concatenate([catheter, 0.5 * (catheter[1:2] + catheter[2:3])])
    assert chains_found(drawn([catheter]), points, [0.99] * 4 + [0.8], [0.9] * 5) == ()


def test_a_cable_that_crosses_between_electrodes_does_not_make_a_chain_unlisted():
    for name in ("ablation", "cs"):
        catheter = row_of(name, (60, 60), 0.3)
        crossing = 0.5 * (catheter[1] + catheter[2])
        cable = np.array([crossing - 40 * np.array([0.2, 1.0]), crossing + 40 * np.array([0.2, 1.0])])
        image = drawn([catheter])
        v, u = np.mgrid[:SIZE, :SIZE].astype(np.float64)
        way = cable[1] - cable[0]
        image -= 0.3 * (np.abs((u - cable[0, 0]) * way[1] - (v - cable[0, 1]) * way[0]) < 3.0 * np.linalg.norm(way))
        count = len(catheter)
        found = chains_found(
            image.astype(np.float32),
            np.concatenate([catheter, crossing[None]]),
            [0.99] * (count + 1),
            [0.9] * (count + 1),
        )
        assert any(lies_on(chain, catheter) for chain in found)


def test_a_chain_on_parallel_bars_is_no_catheter():
    row = row_of("ablation", (60, 200), 0.0)
    v, u = np.mgrid[:SIZE, :SIZE].astype(np.float64)
    image = drawn_without_shaft(row)
    on_bar = (np.abs(u[..., None] - row[:, 0]).min(axis=-1) < 3.0) & (v > 200.0) & (v < 200.0 + 8.0 * PX)
    for picture, count in ((image, 1), (np.where(on_bar, image - 0.4, image).astype(np.float32), 0)):
        assert len(chains_found(picture, row, [0.99] * 4, [0.9] * 4)) == count


def test_a_short_chain_may_have_a_part_of_its_shaft_between_its_electrodes():
    catheter = row_of("ablation", (60, 60), 0.3)
    shaft = 0.5 * (catheter[1:2] + catheter[2:3])
    found = chains_found(drawn([catheter]), np.concatenate([catheter, shaft]), [0.99] * 4 + [0.6], [0.9] * 5)
    assert any(lies_on(chain, catheter) for chain in found)
    # As probable as its weakest electrode, it is an electrode that the catalogue does not list.
    weak = chains_found(drawn([catheter]), np.concatenate([catheter, shaft]), [0.99, 0.7, 0.99, 0.99, 0.7], [0.9] * 5)
    assert not any(lies_on(chain, catheter) for chain in weak)


@pytest.mark.parametrize(("contrast", "long"), [(20.0, False), (4.0, True)])
def test_a_short_catheter_with_its_shaft_is_no_long_one_where_noise_would_not_hide_the_rest(contrast, long):
    catalogue = Catalogue(
        (catheter_type("decapolar-2-5-2", "cs"), catheter_type("hexapolar-2-5-2", "his")), "cs", "his"
    )
    row = row_of("cs", (60, 60), 0.4)
    probability = np.array([0.99] * 6 + [0.3] * 4)
    evidence = Evidence(
        drawn([row[:6]]), row, probability, [0.9] * 6 + [0.6] * 4, contrast=np.where(probability > 0.5, contrast, 1.0)
    )
    (chain,) = detector_of(evidence, catalogue).search(evidence.smooth).entry(0).chains
    assert lies_on(chain, row if long else row[:6])


def in_picture(row):
    return ((row >= 0) & (row <= SIZE - 1)).all(axis=1)


@pytest.mark.parametrize(
    ("name", "tip", "angle", "outside"),
    [
        ("ablation", (352, 150), np.pi, 0),
        ("ablation", (45, 120), np.pi, 1),
        ("ablation", (365, 150), np.pi, 1),
        ("cs", (95, 200), np.pi, 4),
        ("cs", (395, 60), np.pi, 3),
    ],
)
def test_a_catheter_that_is_partly_outside_the_picture_is_found(name, tip, angle, outside):
    row = row_of(name, tip, angle)
    shown = in_picture(row)
    assert np.count_nonzero(~shown) == outside
    found = chains_found(drawn([row]), row[shown], [0.99] * shown.sum(), [0.9] * shown.sum())
    (chain,) = found
    is_seen = chain.scores > UNSEEN
    # The spacings that are left do not always show which end is the tip.
    assert np.count_nonzero(is_seen) == np.count_nonzero(shown)
    away = np.linalg.norm(chain.pixels_uv[is_seen][:, None] - row[shown], axis=2)
    assert away.min(axis=1).max() < 5.0
    assert not in_picture(chain.pixels_uv[~is_seen]).any()


def test_electrodes_that_a_picture_should_show_are_not_taken_for_outside():
    row = row_of("ablation", (120, 120), 0.4)
    for kept in (row[1:], row[:3]):
        assert chains_found(drawn([kept]), kept, [0.99] * 3, [0.9] * 3) == ()


def test_a_catheter_with_too_few_electrodes_in_the_picture_is_not_found():
    ablation = row_of("ablation", (22, 120), np.pi)
    shown = in_picture(ablation)
    assert np.count_nonzero(shown) == 2
    assert chains_found(drawn([ablation]), ablation[shown], [0.99] * 2, [0.9] * 2) == ()


def test_a_catheter_that_leaves_the_picture_is_found_again():
    row = row_of("ablation", (62, 120), np.pi)
    (chain,) = chains_found(drawn([row]), row, [0.99] * 4, [0.9] * 4)
    moved = row - np.array([22.0, 0.0])
    shown = in_picture(moved)
    assert np.count_nonzero(shown) == 3
    image = drawn([moved])
    detector = detector_of(Evidence(image, moved[shown], [0.99] * 3, [0.9] * 3, contrast=12.0))
    again = detector.find_again(image, chain, np.array([-20.0, 0.0]), 6.0, ())
    assert np.linalg.norm(again.pixels_uv - moved, axis=1)[shown].max() < 5.0
    assert (again.scores[~shown] == UNSEEN).all()


@pytest.mark.parametrize(("contrast", "probability", "sizes"), [(8.0, 0.6, [10]), (8.0, 0.4, [4]), (20.0, 0.6, [4])])
def test_a_row_of_faint_electrodes_in_a_moved_mean_comes_before_a_clearer_part_of_it(
    monkeypatch, contrast, probability, sizes
):
    row = row_of("cs", (60, 100), 0.2)
    image = np.zeros((SIZE, SIZE), np.float32)
    # The first velocity is the row's, all others show a part of it more clearly.
    of_row = Evidence(image, row, np.full(10, probability), np.ones(10), contrast=contrast)
    of_part = Evidence(image, row[:4], np.full(4, 0.95), np.ones(4), contrast=contrast)
    seen = iter([of_row, *[of_part] * 18])

    def find_chains(self, x, frame, beside=()):
        self._latest = x, next(seen)
        points = self._latest[1].points
        numbers, covariance = tuple(range(1, len(points) + 1)), np.tile(np.eye(2), (len(points), 1, 1))
        return FrameChains(frame, (Chain(numbers, points, covariance, np.ones(len(points)), (("cs", 1.0),)),))

    monkeypatch.setattr(ChainDetector, "find_chains", find_chains)
    found = detector_of(of_row).find_moving([image] * 5, np.arange(5) * 16.7, 2, 2)
    assert [len(chain.electrodes) for chain in found] == sizes
    assert next(seen, None) is None


@pytest.mark.parametrize("missing", [0, 1])
def test_predicted_electrodes_are_no_places_beside_those_of_split_pairs(missing):
    hexapolar = Catalogue((catheter_type("hexapolar-2-5-2", "his"), catheter_type("ablation-4", "map")), "his", "map")
    row = np.array([60.0, 60.0]) + np.outer(hexapolar["his"].arc_lengths_mm * PX * 0.5, [np.cos(0.4), np.sin(0.4)])
    merged = 0.5 * (row[0:4:2] + row[1:4:2])
    # Two pairs are split, and of the third one or two rings are seen: three places or four.
    points = np.concatenate([merged, row[4 : 6 - missing]])
    sure = [0.95] * len(points)
    detector = detector_of(Evidence(drawn([row]), points, sure, sure, halves=row[:4]), hexapolar)
    image = drawn([row])
    found = detector.split_pairs(detector.search(image)).entry(0).chains
    assert any(lies_on(chain, row) for chain in found) == (missing == 0)


def test_a_pair_s_halves_are_preferred_to_one_of_them_and_the_whole():
    families = catheter_families(Catalogue((catheter_type("decapolar-2-5-2", "cs"),), None, "cs"))
    catheter = row_of("cs", (60, 60), 0.4, shortened=0.5)
    # Nine candidates, the first of them split in two.
    points = np.concatenate([catheter[:1], catheter[2:], catheter[:2] + 0.5])
    both, whole_and_half = [9, 10, *range(1, 9)], [0, 10, *range(1, 9)]
    possible = PossibleChains((np.array([both, whole_and_half]),), (np.array([2.0, 2.5]),))
    priced = with_whole_places(possible, points, families, 9, 2)
    (chosen,) = best_chains(priced, points, families, PX)
    assert chosen.candidates == tuple(both)
    weak = replace(possible, scores=(np.array([2.0, -3.0]),))
    assert len(with_whole_places(weak, points, families, 9, 2).rows[0]) == 1
