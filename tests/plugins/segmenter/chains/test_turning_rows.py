"""Rows of electrodes that turn through the viewing direction."""

import numpy as np
import pytest

from fluoromap.catheters import Catalogue, catheter_type
from fluoromap.contracts import Chain
from fluoromap.segmenter.chains.families import catheter_families
from fluoromap.segmenter.chains.linking import PossibleChains, best_chains, possible_chains
from fluoromap.segmenter.chains.missing_electrodes import complete_chains
from fluoromap.segmenter.chains.row_tracing import trace_rows
from fluoromap.segmenter.picture.field_mask import are_in
from fluoromap.segmenter.picture.shaft_image import ShaftImage
from fluoromap.segmenter.places.ellipse import beside_other_electrodes
from fluoromap.segmenter.shape.row_shape import next_place, place_covariance_mm2, row_fit, smooth_places

PX = 3.5
CATHETER = catheter_type("decapolar-2-5-2", "cs")
EVERYWHERE = np.ones((512, 512), np.bool_)


def turning_row(at_mm, radius_mm=16.0, tilt=0.25):
    """Return the pixels of a catheter on a circle seen nearly on edge.

    It comes straight at the viewer ``at_mm`` from its tip.
    """
    angles = (CATHETER.arc_lengths_mm - at_mm) / radius_mm
    return np.array([250.0, 200.0]) + radius_mm * PX * np.stack([np.cos(angles), tilt * np.sin(angles)], axis=1)


def straight_row(foreshortening=0.8):
    return np.array([60.0, 80.0]) + np.outer(CATHETER.arc_lengths_mm * PX * foreshortening, [np.cos(0.4), np.sin(0.4)])


def fit_of(row):
    return float(row_fit(row[None], CATHETER.spacing_mm, np.full((1, 10), 0.3), PX)[0])


def test_a_turn_through_the_viewing_direction_is_as_likely_as_none():
    turning = [fit_of(turning_row(at_mm)) for at_mm in (12.0, 20.0, 28.0)]
    assert min(turning) > fit_of(straight_row()) - 2.0


@pytest.mark.parametrize("wrong", ["displaced by a pair", "zigzag", "gaps exchanged"])
def test_other_rows_are_less_likely(wrong):
    row = straight_row()
    if wrong == "displaced by a pair":
        row = np.concatenate([row[:1], row[:1] + 3.0, row[:-2]])
    elif wrong == "zigzag":
        row[::2] += [-6.0, 9.0]
    else:
        gaps = np.diff(row, axis=0)
        row = row[0] + np.concatenate([np.zeros((1, 2)), np.cumsum(np.roll(gaps, 1, axis=0), axis=0)])
    assert fit_of(row) < fit_of(straight_row()) - 5.0


def test_the_likelihood_is_that_of_the_gaps_covariance():
    row = turning_row(20.0)
    covariance = place_covariance_mm2(CATHETER.spacing_mm, 0.0) * PX**2 + np.diag(np.linspace(0.1, 1.0, 10))
    differences = np.diff(np.eye(10), axis=0)
    gaps = differences @ row
    expected = -0.5 * np.sum(gaps * np.linalg.solve(differences @ covariance @ differences.T, gaps))
    fitted = row_fit(row[None], CATHETER.spacing_mm, np.linspace(0.1, 1.0, 10)[None], PX)
    np.testing.assert_allclose(fitted, [expected], rtol=1e-9)


def test_electrodes_that_were_not_seen_are_put_on_the_row():
    row = turning_row(20.0)
    variance = np.ones((1, 10))
    variance[0, [4, 5]] = np.inf
    seen_at = row.copy()
    seen_at[[4, 5]] = 0.0
    (placed,) = smooth_places(seen_at[None], CATHETER.spacing_mm, 0.0, variance, PX)
    assert np.linalg.norm(placed - row, axis=1).max() < 1.0 * PX


def test_a_row_goes_straight_on_beyond_what_is_seen():
    row = straight_row()
    variance = np.full((1, 10), 0.1)
    variance[0, 6:] = np.inf
    (placed,) = smooth_places(row[None], CATHETER.spacing_mm, 0.0, variance, PX)
    assert np.linalg.norm(placed[-1] - row[-1]) < 0.25 * np.linalg.norm(row[-1] - row[5])


def test_the_next_place_follows_a_bend():
    row = turning_row(12.0)
    for known in range(4, 10):
        weights, sd_mm = next_place(CATHETER.spacing_mm, 0.0, known)
        assert np.linalg.norm(weights @ row[:known] - row[known]) < 3.0 * sd_mm * PX


@pytest.mark.parametrize("at_mm", [12.0, 20.0, 28.0])
@pytest.mark.parametrize("backwards", [False, True])
def test_one_candidate_stands_for_merged_electrodes(at_mm, backwards):
    row = turning_row(at_mm)
    gaps = np.linalg.norm(np.diff(row, axis=0), axis=1)
    closest = int(np.argmin(gaps))
    assert gaps[closest] < 5.0
    merged = row[closest : closest + 2].mean(axis=0)
    candidates = np.concatenate([row[:closest], merged[None], row[closest + 2 :]])
    if backwards:
        candidates = candidates[::-1]
    traced, places, covered = trace_rows(candidates, np.ones(9), CATHETER, PX, 40, EVERYWHERE)
    best = [rows for rows in range(len(traced)) if np.linalg.norm(places[rows] - row, axis=1).max() < 4.0]
    assert best
    first = best[0]
    assert np.count_nonzero(traced[first] < 0) == 1
    assert covered[first].max() == (8 - closest if backwards else closest)


def test_a_row_of_six_needs_a_candidate_for_each_place():
    hexapolar = catheter_type("hexapolar-2-5-2", "his")
    candidates = turning_row(12.0)[[0, 1, 2, 3, 5]]
    _, _, covered = trace_rows(candidates, np.ones(5), hexapolar, PX, 40, EVERYWHERE)
    assert (covered < 0).all()


def test_the_turn_of_a_row_does_not_cost_its_score():
    catalogue = Catalogue((CATHETER, catheter_type("ablation-4", "ablation")), "cs", "ablation")
    families = catheter_families(catalogue)
    image = np.full((512, 512), 6.0, np.float32)

    def score(row):
        possible = possible_chains(
            row, np.ones(10), np.full(10, 0.3), ShaftImage(image, 1, 0.05, PX), families, slack=20.0
        )
        return float(possible.scores[0][(possible.rows[0] == np.arange(10)).all(axis=1)][0])

    assert score(turning_row(20.0)) > score(straight_row()) - 6.0


def test_a_merged_electrode_does_not_make_a_row_worth_more():
    catalogue = Catalogue((CATHETER, catheter_type("hexapolar-2-5-2", "his")), "cs", "his")
    families = catheter_families(catalogue)
    points = np.concatenate([straight_row()[:7], straight_row()[4:7] + 0.5])
    possible = PossibleChains((np.arange(10)[None], np.arange(6)[None]), (np.array([2.0]), np.array([5.0])))
    (as_long,) = best_chains(possible, points, families, PX, sure=7)
    assert len(as_long.candidates) == 10
    is_merged = np.arange(10) >= 7
    (as_short,) = best_chains(possible, points, families, PX, sure=7, is_merged=is_merged)
    assert len(as_short.candidates) == 6


@pytest.mark.parametrize("gap_px", [0.5, 20.0])
def test_electrodes_of_a_turning_row_that_lie_at_one_place_are_less_certain(gap_px):
    row = straight_row()
    row[5] = row[4] + [gap_px, 0.0]
    covariance = np.tile(0.1 * np.eye(2), (10, 1, 1))
    chain = Chain(tuple(range(1, 11)), row, covariance, np.ones(10), (("cs", 1.0),))
    sd = np.sqrt(beside_other_electrodes(chain, [], PX)[:, 0, 0])
    assert (sd[4] > 1.5) == (gap_px < 1.0)
    np.testing.assert_allclose(np.delete(sd, [4, 5]), np.sqrt(0.1))


def test_an_end_that_another_electrode_covers_is_no_end():
    row = turning_row(CATHETER.arc_lengths_mm[-1] - 1.0)
    _, _, covered = trace_rows(row[:9], np.ones(9), CATHETER, PX, 40, EVERYWHERE)
    assert (covered[:, [0, -1]] < 0).all()


def test_what_speaks_for_a_candidate_counts_once():
    row = turning_row(20.0)
    closest = int(np.argmin(np.linalg.norm(np.diff(row, axis=0), axis=1)))
    weights = np.full(10, 2.0)
    weights[closest + 1] = -1.0
    (best, *_), _, _ = trace_rows(row, weights, CATHETER, PX, 40, EVERYWHERE)
    assert set(best.tolist()) == set(range(10))


def test_electrodes_without_a_candidate_have_their_price_in_the_field_only():
    catalogue = Catalogue((CATHETER, catheter_type("ablation-4", "ablation")), "cs", "ablation")
    families = catheter_families(catalogue)

    def gained(candidates, inside=EVERYWHERE):
        count = len(candidates)
        completed = complete_chains(
            candidates, np.ones(count), np.full(count, 0.3), lambda at: np.zeros(len(at)), -0.9, families, PX, inside
        )
        rows = completed.rows[0]
        complete = rows[np.isin(np.arange(count), rows).all() & ((rows < count).sum(axis=1) == count)]
        predicted = complete[complete >= count]
        return completed.weights[predicted], completed.is_merged[predicted], completed.points_uv[predicted]

    row = straight_row()
    weights, is_merged, _ = gained(np.delete(row, 4, axis=0))
    assert (weights[~is_merged] == -1.0).all()
    assert len(weights[~is_merged])
    cut = EVERYWHERE.copy()
    cut[:, int(row[6, 0]) :] = False
    weights, is_merged, places = gained(row[:6], cut)
    expected = np.where(are_in(cut, places), -1.0, 0.0)
    assert np.array_equal(weights[~is_merged], expected[~is_merged])
    assert (expected == 0.0).any()
    turning = turning_row(20.0)
    closest = int(np.argmin(np.linalg.norm(np.diff(turning, axis=0), axis=1)))
    weights, is_merged, _ = gained(np.delete(turning, closest + 1, axis=0))
    assert (weights[is_merged] < -1.0).all()
    assert is_merged.any()
