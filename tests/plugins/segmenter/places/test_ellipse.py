"""The ellipse has one writer: other modules of the segmenter pass covariances on, and add or multiply none."""

from __future__ import annotations

import ast
from pathlib import Path

import numpy as np
import pytest

from fluoromap.contracts import Chain
from fluoromap.segmenter.places import ellipse

ROOMS = Path(ellipse.__file__).parent.parent
MODULES = [path for path in sorted(ROOMS.rglob("*.py")) if path != Path(ellipse.__file__)]


@pytest.mark.parametrize("path", MODULES, ids=lambda path: str(path.relative_to(ROOMS)))
def test_no_other_module_computes_a_covariance_of_a_chain(path):
    calls = [node for node in ast.walk(ast.parse(path.read_text())) if isinstance(node, ast.Call)]
    for given in (keyword for call in calls for keyword in call.keywords if keyword.arg == "covariance_px2"):
        computed = [part for part in ast.walk(given.value) if isinstance(part, ast.BinOp | ast.AugAssign)]
        assert not computed, f"{path}:{given.value.lineno}"


def test_a_band_far_from_the_shape_of_the_other_frame_hardly_counts():
    expected = np.zeros((2, 2))
    found = np.array([[1.0, 0.0], [40.0, 0.0]])
    one = np.tile(np.eye(2), (2, 1, 1))
    places, covariance = ellipse.weighed_with_shape(expected, found, one, one, 10.0)
    assert 0.3 < places[0, 0] < 1.0
    assert places[1, 0] < 4.0
    assert np.linalg.det(covariance[1]) > np.linalg.det(covariance[0])
    np.testing.assert_allclose(covariance, covariance.transpose(0, 2, 1))


def test_the_way_of_an_oblique_electrode_widens_its_ellipse_most_along_the_way():
    chain = Chain((1, 2), np.zeros((2, 2)), np.tile(np.eye(2), (2, 1, 1)), np.ones(2), (("cs", 1.0),))
    moved = ellipse.moved_obliquely(chain, np.array([[3.0, 0.0], [0.0, 0.0]]))
    assert moved.covariance_px2[0, 0, 0] > moved.covariance_px2[0, 1, 1] > 1.0
    np.testing.assert_array_equal(moved.covariance_px2[1], np.eye(2))


def test_an_electrode_that_returned_to_its_candidate_has_the_way_in_its_ellipse():
    back = np.array([[True, False]])
    covariance = ellipse.returned(np.tile(np.eye(2), (1, 2, 1, 1)), np.array([[2.0, 2.0]]), back)
    np.testing.assert_array_equal(covariance[0, 0], 5.0 * np.eye(2))
    np.testing.assert_array_equal(covariance[0, 1], np.eye(2))
