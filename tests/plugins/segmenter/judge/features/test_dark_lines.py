"""Rows of parts on a dark line, and catheters with their shafts."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from fluoromap.segmenter.judge.features.dark_lines import (
    IN_FRAME,
    depths_along,
    depths_beyond,
    ends_on_coil,
    gap_share,
    goes_on,
    is_dark_line,
)
from fluoromap.segmenter.picture.shaft_image import ShaftImage

PX_PER_MM = 3.2
DOUBT = np.zeros(6)
"""Log-odds of electrodes."""
CHAIN = np.stack([40.0 + 3.0 * PX_PER_MM * np.arange(6), np.full(6, 60.0)], axis=1)


def picture(part, line, radius_mm, reduction=1):
    """Draw a dark line along the chain, and darker parts at its places."""
    v, u = np.mgrid[:120, :160].astype(float)
    x = np.zeros((120, 160))
    x[np.abs(v - 60.0) <= radius_mm * PX_PER_MM] -= line
    for column, row in CHAIN:
        x[(np.abs(u - column) <= 0.6 * PX_PER_MM) & (np.abs(v - row) <= max(radius_mm, 1.0) * PX_PER_MM)] -= part - line
    cells = gaussian_filter(x, 1.0).reshape(120 // reduction, reduction, 160 // reduction, reduction)
    return ShaftImage(cells.mean(axis=(1, 3)).astype(np.float32), reduction, 0.1, PX_PER_MM)


@pytest.mark.parametrize(
    ("line", "radius_mm", "is_dark"),
    [(0.7, 2.0, True), (0.3, 2.0, False), (0.9, 0.6, True), (0.4, 0.6, False), (0.3, 1.0, False), (0.0, 1.0, False)],
)
def test_a_cable_is_dark_between_its_parts_too(line, radius_mm, is_dark):
    assert is_dark_line([depths_along(CHAIN, picture(1.0, line, radius_mm))], DOUBT, IN_FRAME) == is_dark


def test_depths_are_those_of_the_line_below_its_surroundings():
    depths = depths_along(CHAIN, picture(1.0, 0.7, 2.0))
    assert depths.shape == (11, 2)
    np.testing.assert_allclose(depths[::2, 0], 1.0, atol=0.1)
    np.testing.assert_allclose(depths[1::2, 0], 0.7, atol=0.1)
    np.testing.assert_allclose(depths[1::2, 1], 0.7, atol=0.1)


def test_a_reduced_picture_shows_the_same_line():
    whole, reduced = (depths_along(CHAIN, picture(1.0, 0.7, 2.0, reduction)) for reduction in (1, 2))
    np.testing.assert_allclose(reduced, whole, atol=0.12)


def test_an_edge_of_anatomy_beside_a_catheter_is_no_line():
    shafts = picture(1.0, 0.2, 0.8)
    shafts.smooth[66:] -= 2.0
    assert not is_dark_line([depths_along(CHAIN, shafts)], DOUBT, IN_FRAME)


def test_one_clear_gap_shows_that_the_line_is_a_shaft():
    thick, thin = (depths_along(CHAIN, picture(1.0, line, 2.0)) for line in (0.7, 0.2))
    assert is_dark_line([thick, thick], DOUBT, IN_FRAME)
    assert not is_dark_line([thick, thin], DOUBT, IN_FRAME)


def test_the_faintest_gap_of_a_dark_line_reaches_its_limit():
    depths = [depths_along(CHAIN, picture(1.0, 0.35, 2.0))]
    assert is_dark_line(depths, DOUBT, replace(IN_FRAME, thinnest=0.6))
    assert not is_dark_line(depths, DOUBT, IN_FRAME)


def test_nothing_is_no_line():
    assert not is_dark_line([depths_along(CHAIN, picture(0.0, 0.0, 2.0))], DOUBT, IN_FRAME)


def test_the_coil_of_a_lead_may_be_as_dark_as_its_rings():
    assert not is_dark_line([depths_along(CHAIN[:2], picture(1.0, 0.9, 0.6))], DOUBT, IN_FRAME)
    assert is_dark_line([depths_along(CHAIN[:3], picture(1.0, 0.9, 0.6))], DOUBT, IN_FRAME)


@pytest.mark.parametrize(
    ("electrodes", "odds", "is_dark"), [(4, 0.9, True), (4, 1.1, False), (6, 1.6, True), (6, 1.8, False)]
)
def test_what_clearly_looks_like_electrodes_has_a_dark_shaft(electrodes, odds, is_dark):
    depths = [depths_along(CHAIN[:electrodes], picture(1.0, 0.9, 0.6))]
    assert is_dark_line(depths, np.full(electrodes, odds), IN_FRAME) == is_dark


def test_separate_spots_have_clear_gaps_and_parts_of_a_line_have_dark_ones():
    for line in (0.0, 0.3, 0.6):
        thin = [depths_along(CHAIN, picture(1.0, line, 0.8))]
        assert gap_share(thin) == pytest.approx(line, abs=0.12)
    assert gap_share([depths_along(CHAIN, picture(1.0, 0.7, 2.0))]) == pytest.approx(1.4, abs=0.1)
    assert gap_share([depths_along(CHAIN, picture(0.0, 0.0, 2.0))]) == np.inf


def test_the_gaps_of_all_sections_count():
    clear, dark = (depths_along(CHAIN, picture(1.0, line, 0.8)) for line in (0.0, 0.9))
    assert gap_share([clear, clear, dark]) == pytest.approx(gap_share([clear]), abs=0.05)


@pytest.mark.parametrize(
    ("gaps", "odds", "is_coil"),
    [
        ((0.5, 0.75, 1.6), (3.0, 2.0, 0.5, 0.0), True),
        ((1.6, 0.75, 0.5), (0.0, 0.5, 2.0, 3.0), True),
        ((0.5, 0.4, 1.6), (3.0, 2.0, 0.5, 0.0), False),  # a wide gap parts a merged pair from the other
        ((0.5, 0.75, 1.2), (3.0, 2.0, 0.5, 0.0), False),
        ((1.6, 0.75, 0.5), (3.0, 2.0, 0.5, 0.0), False),  # the pair that is in doubt has a gap
        ((0.5, 0.75, 1.6), (3.0, 2.0, 1.4, 0.0), False),
        ((0.5, 0.75, 1.6), (2.0, 1.6, 0.5, 0.0), False),
    ],
)
def test_the_coil_of_a_lead_has_no_gap_and_is_in_doubt(gaps, odds, is_coil):
    depths = np.zeros((7, 2))
    depths[::2, 0], depths[1::2, 0] = 1.0, gaps
    assert ends_on_coil([depths], np.array(odds)) == is_coil


def test_only_chains_of_four_may_be_the_ends_of_a_lead():
    depths = np.ones((2 * 5 - 1, 2))
    assert not ends_on_coil([depths], np.array([0.0, 0.0, 3.0, 3.0, 3.0]))
    assert not ends_on_coil([np.zeros((7, 2))], np.array([0.0, 0.0, 3.0, 3.0]))


@pytest.mark.parametrize(
    ("line", "first_mm", "last_mm", "part_of_line"),
    [(0.6, -12.0, 27.0, True), (0.6, -0.9, 27.0, False), (0.6, -12.0, 16.0, False), (0.3, -12.0, 27.0, False)],
)
def test_a_cable_goes_on_beyond_both_ends_and_a_catheter_ends_at_its_tip(line, first_mm, last_mm, part_of_line):
    shafts = picture(1.0, line, 0.8)
    first, last = (int(CHAIN[0, 0] + mm * PX_PER_MM) for mm in (first_mm, last_mm))
    shafts.smooth[:, :first] = shafts.smooth[:, last:] = 0.0
    beyond = depths_beyond(CHAIN, shafts)
    assert goes_on([depths_along(CHAIN, shafts)], beyond) == part_of_line
    np.testing.assert_array_equal(depths_beyond(CHAIN[::-1], shafts), beyond[::-1])


def test_a_line_beyond_an_end_may_bend():
    v, u = np.mgrid[:120, :160].astype(float)
    bent = 60.0 + np.tan(np.deg2rad(18.0)) * np.maximum(u - CHAIN[-1, 0], 0.0)
    x = -0.6 * (np.abs(v - bent) <= 0.8 * PX_PER_MM)
    shafts = ShaftImage(gaussian_filter(x, 1.0).astype(np.float32), 1, 0.1, PX_PER_MM)
    assert depths_beyond(CHAIN, shafts).min() > 0.45
    shafts.smooth[:70] = 0.0
    assert depths_beyond(CHAIN, shafts).min() < 0.1


def test_a_clear_gap_is_no_part_of_the_line_beyond_both_ends():
    shafts = picture(1.0, 0.6, 0.8)
    depths, beyond = depths_along(CHAIN, shafts), depths_beyond(CHAIN, shafts)
    assert goes_on([depths], beyond)
    depths[5] = -0.2
    assert not goes_on([depths], beyond)


def test_what_is_not_dark_goes_on_nowhere():
    assert not goes_on([np.zeros((11, 2))], np.zeros(2))
