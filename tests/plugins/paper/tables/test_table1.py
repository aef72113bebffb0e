"""Table 1: reproduced figures of the paper, and the laws that they obey."""

import numpy as np
import pytest

from fluoromap.paper.tables.depth_figures import DepthFigures, depth_figures
from fluoromap.paper.tables.published import DEPTH_STEPS_MM, IMAGES
from fluoromap.paper.tables.table1 import Table1Row, table1


@pytest.fixture(scope="module")
def rows() -> tuple[Table1Row, ...]:
    return table1()


def of(rows: tuple[Table1Row, ...], helix: str, view: str) -> list[Table1Row]:
    return [row for row in rows if (row.helix, row.view) == (helix, view)]


def test_every_row_of_both_helices_and_views_is_there(rows: tuple[Table1Row, ...]) -> None:
    keys = {(row.helix, row.view, row.dz_mm, row.images) for row in rows}
    assert len(rows) == len(keys) == 2 * 2 * 6 * 4
    assert {row.fitted is not None for row in of(rows, "H77", "LAT")} == {True}
    assert all(row.fitted is None for row in rows if (row.helix, row.view) != ("H77", "LAT"))


def test_the_ap_half_is_reproduced(rows: tuple[Table1Row, ...]) -> None:
    half = of(rows, "H77", "AP")
    assert len(half) == 24
    assert np.mean([abs(row.ours.rms_mm - row.paper.rms_mm) / row.paper.rms_mm for row in half]) <= 0.06
    assert np.mean([abs(row.ours.mean_mm - row.paper.mean_mm) / row.paper.mean_mm for row in half]) <= 0.06


def test_the_answer_follows_the_start_value(rows: tuple[Table1Row, ...]) -> None:
    for images in IMAGES:
        means = [row.ours.mean_mm for row in of(rows, "H77", "AP") if row.images == images]
        slope = np.diff(means[3:])
        assert slope.min() >= 0.965
        assert slope.max() <= 0.985


@pytest.mark.parametrize("source", ["ours", "paper"])
def test_a_constant_error_accumulates_as_the_root_of_the_mean_of_k_squared(
    rows: tuple[Table1Row, ...], source: str
) -> None:
    """Check that far from the true displacement the error is nearly the same in every image, as in the paper."""
    for row in of(rows, "H77", "AP"):
        if row.dz_mm >= 4:
            figures: DepthFigures = getattr(row, source)
            expected = np.sqrt(np.mean(np.arange(1, row.images) ** 2))
            assert figures.rms_mm / figures.mean_mm == pytest.approx(expected, rel=0.04)


def test_the_best_start_value_is_the_truth_not_an_estimate(rows: tuple[Table1Row, ...]) -> None:
    """Check that dz = 1 is right only because the true displacement in depth of H18 is about 1 mm."""
    for view in ("AP", "LAT"):
        for images in IMAGES:
            means = [row.ours.mean_mm for row in of(rows, "H18", view) if row.images == images]
            assert int(np.argmin(means)) == DEPTH_STEPS_MM.index(1)


def test_figures_of_a_known_error() -> None:
    error = np.zeros((3, 2, 3))
    error[1:, 0, 2] = 1.0, 3.0
    error[1:, 1, 0] = 2.0
    found = depth_figures([error], [np.array([0.0, 0.0, 1.0])])
    assert (found.mean_mm, found.min_mm, found.max_mm) == pytest.approx((0.75, 0.0, 2.0))
    assert found.rms_mm == pytest.approx(np.sqrt((1 + 9 + 4 + 4) / 4))
