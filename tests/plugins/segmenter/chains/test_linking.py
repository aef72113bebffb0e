import numpy as np
import pytest

from fluoromap.catheters import DEFAULT_CATALOGUE, Catalogue, Catheter, catheter_type
from fluoromap.segmenter.chains.families import catheter_families
from fluoromap.segmenter.chains.linking import PossibleChains, best_chains, evidence, link_candidates
from fluoromap.segmenter.chains.path_search import find_paths
from fluoromap.segmenter.chains.row_tracing import trace_rows
from fluoromap.segmenter.electrodes.proposals import probability_of_contrast
from fluoromap.segmenter.four_step.contrast import Contrast
from fluoromap.segmenter.judge.names import kind_probabilities
from fluoromap.segmenter.picture.shaft_image import ShaftImage

PX = 5.75


def drawn(curves, noise=0.02, size=320):
    """Draw a log image with dark spots at the electrodes.

    A fainter shaft follows behind. curves: list of (points, shaft end).
    """
    v, u = np.mgrid[0:size, 0:size].astype(float)
    x = np.random.default_rng(3).normal(6, noise, (size, size))
    for points, end in curves:
        line = np.linspace(points[0], points[-1], 60).tolist() + np.linspace(points[-1], end, 60).tolist()
        depth = np.zeros_like(x)
        for pu, pv in line:
            depth = np.maximum(depth, 0.12 * (np.hypot(u - pu, v - pv) < 5))
        for pu, pv in points:
            depth = np.maximum(depth, 0.9 * (np.hypot(u - pu, v - pv) < 4))
        x -= depth
    return x.astype(np.float32)


def straight(catheter, tip, angle, foreshortening=0.9):
    direction = np.array([np.cos(angle), np.sin(angle)])
    points = np.asarray(tip) + np.outer(catheter.arc_lengths_mm * PX * foreshortening, direction)
    return points, points[-1] + 50 * direction


def linked(points, image, catalogue=DEFAULT_CATALOGUE):
    contrast = Contrast.of_frame(image, np.ones(image.shape, bool), PX).of(points)
    weights = evidence(probability_of_contrast(contrast))
    return link_candidates(
        points, weights, np.zeros(len(points)), ShaftImage(image, 1, 0.05, PX), catheter_families(catalogue)
    )


@pytest.mark.parametrize("electrodes", [2, 3, 4, 6, 8, 10])
def test_chains_of_any_number_of_electrodes_run_from_the_tip(electrodes):
    rng = np.random.default_rng(electrodes)
    spacing = tuple(rng.choice([2.5, 3.0, 4.5], electrodes - 1)) if electrodes > 2 else (3.5,)
    probe = Catheter("probe", electrodes, spacing, 2.0, 1.0)
    catalogue = Catalogue((probe, Catheter("reference", 4, (9.0, 9.0, 9.0), 2.0, 1.0)), "reference", "probe")
    points, end = straight(probe, (60, 70), 0.4)
    shuffled = rng.permutation(electrodes)
    chains = linked(points[shuffled], drawn([(points, end)]), catalogue)
    assert len(chains) == 1
    order = [int(shuffled[candidate]) for candidate in chains[0].candidates]
    assert order in (list(range(electrodes)), list(range(electrodes))[::-1])


def test_two_catheters_and_stray_candidates():
    one, end_one = straight(DEFAULT_CATALOGUE["reference"], (60, 80), 0.3)
    two, end_two = straight(DEFAULT_CATALOGUE["mapping"], (250, 250), -2.6)
    image = drawn([(one, end_one), (two, end_two)])
    stray = np.array([[40.0, 250.0], [280.0, 40.0], [150.0, 160.0]])
    chains = linked(np.concatenate([one, two, stray]), image)
    assert sorted(tuple(sorted(chain.candidates)) for chain in chains) == [(0, 1, 2, 3), (4, 5, 6, 7)]


def test_candidates_on_a_plain_background_make_no_chain():
    points, _ = straight(DEFAULT_CATALOGUE["reference"], (60, 80), 0.3)
    image = np.random.default_rng(0).normal(6, 0.05, (320, 320)).astype(np.float32)
    assert linked(points, image) == ()


def test_look_alikes_are_one_family_and_share_their_probability():
    families = catheter_families(DEFAULT_CATALOGUE)
    assert [family.names for family in families] == [("reference", "pacing"), ("mapping",)]
    given = kind_probabilities(np.log(np.array([[0.6, 0.4]])), families)
    assert dict(given[0])["reference"] == pytest.approx(dict(given[0])["pacing"])
    assert sum(dict(given[0]).values()) == pytest.approx(1.0)


def test_kinds_respect_how_many_of_each_the_catalogue_has():
    """Three chains, all looking like the diagnostic kind: one of them must be the mapping catheter."""
    families = catheter_families(DEFAULT_CATALOGUE)
    given = kind_probabilities(np.array([[0.0, -1.0], [0.0, -1.0], [0.0, -0.2]]), families)
    mapping = [dict(row).get("mapping", 0.0) for row in given]
    assert sum(mapping) == pytest.approx(1.0)
    assert mapping[2] > mapping[0]


def test_the_many_chains_of_a_long_catheter_do_not_crowd_out_a_short_one():
    catalogue = Catalogue(
        (catheter_type("decapolar-2-5-2", "cs"), catheter_type("quadripolar-2-5-2", "rv")), "cs", "rv"
    )
    families = catheter_families(catalogue)
    rng = np.random.default_rng(0)
    row, _ = straight(catalogue["cs"], (20, 60), 0.1, 0.5)
    doubled = np.concatenate([row, row + rng.normal(0, 1.0, row.shape)])
    short, _ = straight(catalogue["rv"], (60, 250), 0.1)
    points = np.concatenate([doubled, short])
    # Two candidates for each of ten electrodes: hundreds of chains that all score more than the short catheter.
    long_rows = np.arange(10) + 10 * rng.integers(0, 2, (300, 10))
    possible = PossibleChains((long_rows, np.arange(20, 24)[None]), (rng.uniform(5.0, 6.0, 300), np.array([4.0])))
    chosen = best_chains(possible, points, families, PX)
    assert sorted(families[chain.family].names for chain in chosen) == [("cs",), ("rv",)]


def test_parts_of_a_long_catheter_do_not_crowd_out_a_short_one_elsewhere():
    catalogue = Catalogue(
        (catheter_type("decapolar-2-5-2", "cs"), catheter_type("quadripolar-2-5-2", "rv")), "cs", "rv"
    )
    families = catheter_families(catalogue)
    rng = np.random.default_rng(0)
    row, _ = straight(catalogue["cs"], (20, 60), 0.1, 0.5)
    short, _ = straight(catalogue["rv"], (60, 250), 0.1)
    # Two candidates for each electrode: hundreds of chains of four in the long catheter score more than the short one.
    points = np.concatenate([row, row + rng.normal(0, 1.0, row.shape), short])
    parts = np.sort(rng.permuted(np.tile(np.arange(10), (300, 1)), axis=1)[:, :4], axis=1)
    parts += 10 * rng.integers(0, 2, parts.shape)
    possible = PossibleChains(
        (np.arange(10)[None], np.concatenate([parts, np.arange(20, 24)[None]])),
        (np.array([12.0]), np.append(rng.uniform(5.0, 6.0, 300), 4.0)),
    )
    chosen = best_chains(possible, points, families, PX)
    assert sorted(chain.candidates for chain in chosen) == [tuple(range(10)), (20, 21, 22, 23)]


def test_parts_of_the_longest_catheter_do_not_crowd_out_a_long_one_over_which_a_short_chain_lies():
    names = "duodecapolar-2-2-2", "decapolar-2-5-2", "ablation-4"
    families = catheter_families(Catalogue(tuple(catheter_type(name, name) for name in names), names[0], names[-1]))
    rng = np.random.default_rng(0)
    longest, _ = straight(families[0].catheter, (20, 60), 0.1, 0.5)
    long, _ = straight(families[1].catheter, (20, 250), 0.1, 0.5)
    points = np.concatenate([longest, longest + rng.normal(0, 1.0, longest.shape), long])
    # Hundreds of chains of ten in the longest catheter score more than the long catheter.
    parts = np.sort(rng.permuted(np.tile(np.arange(20), (300, 1)), axis=1)[:, :10], axis=1)
    parts += 20 * rng.integers(0, 2, parts.shape)
    own = np.arange(40, 50)
    possible = PossibleChains(
        (np.arange(20)[None], np.concatenate([parts, own[None]]), own[None, :4]),
        (np.array([16.0]), np.append(rng.uniform(8.0, 9.0, 300), 5.0), np.array([4.5])),
    )
    chosen = best_chains(possible, points, families, PX)
    assert sorted(chain.candidates for chain in chosen) == [tuple(range(20)), tuple(own.tolist())]


def bent(catheter, tip, turn_deg, at):
    """Return the electrodes of a catheter that bends once, at the electrode ``at``."""
    angles = np.where(np.arange(catheter.electrodes - 1) < at, 0.0, np.deg2rad(turn_deg))
    steps = np.array(catheter.spacing_mm)[:, None] * PX * np.stack([np.cos(angles), np.sin(angles)], axis=1)
    return np.concatenate([[tip], tip + np.cumsum(steps, axis=0)])


def test_pairs_of_rings_that_are_longer_than_the_catalogue_says_are_found():
    # Edge gaps of 2 and 8 mm between rings of 2 mm, not of 1 mm, seen from the side at the last pair only.
    listed = catheter_type("decapolar-2-8-2", "cs")
    gaps = np.array([4.0 if index % 2 == 0 else 10.0 for index in range(9)])
    seen = PX * np.linspace(0.7, 1.0, 9) * gaps
    points = np.stack([20.0 + np.concatenate([[0.0], np.cumsum(seen)]), np.full(10, 50.0)], axis=1)
    paths = find_paths(points, np.ones(len(points)), np.array(listed.spacing_mm) * PX, PX)
    assert list(range(10)) in paths.tolist()


@pytest.mark.parametrize(
    ("name", "is_found"), [("decapolar-2-5-2", True), ("quadripolar-2-5-2", False), ("quadripolar-5-5-5", True)]
)
def test_only_a_long_catheter_or_one_with_wide_gaps_may_bend_sharply(name, is_found):
    catheter = catheter_type(name, "bent")
    points = bent(catheter, np.array([30.0, 30.0]), 64.0, 2 if name.startswith("quad") else 4)
    spacing_px = np.array(catheter.spacing_mm) * PX
    paths = find_paths(points, np.ones(len(points)), spacing_px, PX)
    assert any((path == np.arange(len(points))).all() for path in paths) == is_found


@pytest.mark.parametrize(("name", "is_found"), [("duodecapolar-2-2-2", True), ("quadripolar-2-5-2", False)])
def test_a_long_catheter_may_turn_out_of_the_image_plane(name, is_found):
    catheter = catheter_type(name, "deep")
    spacing_px = np.array(catheter.spacing_mm) * PX
    ratios = np.linspace(0.32, 1.05, len(spacing_px))
    u = 30.0 + np.cumsum(np.concatenate([[0.0], ratios * spacing_px]))
    points = np.stack([u, np.full(len(u), 100.0)], axis=1)
    paths = find_paths(points, np.ones(len(points)), spacing_px, PX)
    assert any((path == np.arange(len(points))).all() for path in paths) == is_found


def test_a_hooked_catheter_with_wide_gaps_is_linked_and_one_with_narrow_gaps_is_not():
    for name, expected in (("quadripolar-5-5-5", 1), ("quadripolar-2-5-2", 0)):
        probe = catheter_type(name, "probe")
        catalogue = Catalogue((probe, Catheter("reference", 4, (9.0, 9.0, 9.0), 2.0, 1.0)), "reference", "probe")
        points = bent(probe, np.array([60.0, 60.0]), 80.0, 2)
        shaft_end = points[-1] + 8.0 * (points[-1] - points[-2]) / probe.spacing_mm[-1]
        assert len(linked(points, drawn([(points, shaft_end)]), catalogue)) == expected


def test_the_trace_of_a_long_catheter_follows_its_bend_over_a_missing_electrode():
    catheter = catheter_type("decapolar-2-5-2", "hook")
    arc = catheter.arc_lengths_mm * PX
    radius = 14.0 * PX
    angles = arc / radius
    points = 250.0 + radius * np.stack([np.cos(angles), np.sin(angles)], axis=1)
    seen = np.delete(points, 5, axis=0)
    rows, places, _ = trace_rows(seen, np.ones(9), catheter, PX, 10, np.ones((512, 512), np.bool_))
    expected = [0, 1, 2, 3, 4, -1, 5, 6, 7, 8]
    (row,) = np.flatnonzero((rows == expected).all(axis=1))
    assert np.linalg.norm(places[row, 5] - points[5]) < 1.5 * PX


def test_a_whole_catheter_is_worth_more_than_a_displaced_chain_with_a_part_of_another():
    catalogue = Catalogue((catheter_type("decapolar-2-5-2", "cs"), catheter_type("ablation-4", "map")), "cs", "map")
    row, _ = straight(catalogue["cs"], (20, 60), 0.1, 0.5)
    beyond = row[-1] + np.outer([1.0, 2.0], row[-1] - row[-2])
    points = np.concatenate([row, beyond, row[2:4] + 3.0])
    long_rows = np.array([np.arange(10), np.arange(2, 12)])
    possible = PossibleChains((long_rows, np.array([[0, 1, 12, 13]])), (np.array([13.7, 7.2]), np.array([4.0])))
    families = catheter_families(catalogue)
    assert [chain.candidates for chain in best_chains(possible, points, families, PX)] == [
        tuple(range(2, 12)), (0, 1, 12, 13)
    ]  # fmt: skip
    (whole,) = best_chains(possible, points, families, PX, sure=10)
    assert whole.candidates == tuple(range(10))


def test_chains_do_not_take_turns_along_one_line():
    catalogue = Catalogue(
        (catheter_type("hexapolar-2-5-2", "hexa"), catheter_type("quadripolar-5-5-5", "quad")), "hexa", "quad"
    )
    points = np.array([20.0, 60.0]) + np.outer(np.arange(8) * 4.0 * PX, [np.cos(0.1), np.sin(0.1)])
    possible = PossibleChains(
        (np.array([[0, 1, 3, 4, 6, 7]]), np.array([[2, 3, 5, 6]])), (np.array([6.0]), np.array([5.0]))
    )
    (only,) = best_chains(possible, points, catheter_families(catalogue), PX)
    assert only.candidates == (0, 1, 3, 4, 6, 7)


def test_two_rims_of_a_ring_do_not_let_chains_take_turns():
    catalogue = Catalogue(
        (catheter_type("octapolar-2-5-2", "octa"), catheter_type("quadripolar-5-5-5", "quad")), "octa", "quad"
    )
    along = np.array([np.cos(0.1), np.sin(0.1)])
    points = np.array([20.0, 60.0]) + np.outer(np.arange(11) * 3.0 * PX, along)
    rims = points[[6, 8]] + 0.8 * PX * along
    aside = points[10] + 4.0 * PX * along[::-1]
    points = np.concatenate([points, rims, aside[None]])
    # The short chain shares no candidate with the long one, but two of its places, and one lies in a gap.
    possible = PossibleChains(
        (np.array([[0, 1, 3, 4, 6, 8, 9, 10]]), np.array([[11, 7, 12, 13]])), (np.array([6.0]), np.array([5.0]))
    )
    (only,) = best_chains(possible, points, catheter_families(catalogue), PX)
    assert only.candidates == (0, 1, 3, 4, 6, 8, 9, 10)


def test_chains_that_meet_in_one_electrode_do_not_take_turns_there():
    catalogue = Catalogue(
        (catheter_type("octapolar-2-5-2", "octa"), catheter_type("quadripolar-2-5-2", "quad")), "octa", "quad"
    )
    points = np.array([20.0, 60.0]) + np.outer(np.arange(15) * 3.0 * PX, [np.cos(0.1), np.sin(0.1)])
    # Of equal spacings every third electrode is left out; the two chains share one and lie in one gap of each other.
    possible = PossibleChains(
        (np.array([[0, 1, 3, 4, 6, 7, 9, 10]]), np.array([[14, 13, 11, 10]])), (np.array([6.0]), np.array([5.0]))
    )
    beside = best_chains(possible, points, catheter_families(catalogue), PX)
    assert len(beside) == 2
    possible = PossibleChains(
        (np.array([[0, 1, 3, 4, 6, 7, 9, 10]]), np.array([[12, 11, 9, 8]])), (np.array([6.0]), np.array([5.0]))
    )
    (only,) = best_chains(possible, points, catheter_families(catalogue), PX)
    assert only.candidates == (0, 1, 3, 4, 6, 7, 9, 10)
