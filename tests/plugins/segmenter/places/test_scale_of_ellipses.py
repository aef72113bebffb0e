"""Ellipses of electrodes at the scale of their picture."""

from dataclasses import replace

import numpy as np
import pytest

from fluoromap.contracts import Chain
from fluoromap.segmenter.places.ellipse import at_scale

CHAIN = Chain(
    (1, 2, 3),
    np.array([[20.0, 20.0], [30.0, 22.0], [45.0, 25.0]]),
    np.tile(np.array([[0.04, 0.01], [0.01, 0.09]]), (3, 1, 1)),
    np.ones(3),
    (("cs", 1.0),),
)


@pytest.mark.parametrize("px_per_mm", [3.1, 4.1, 5.75])
def test_ellipses_of_few_pixels_are_smaller_and_keep_their_shape(px_per_mm):
    (placed,) = at_scale([CHAIN], px_per_mm)
    share = placed.covariance_px2 / CHAIN.covariance_px2
    assert np.ptp(share) < 1e-12
    # In millimetres they are larger all the same.
    assert px_per_mm / 5.75 < np.sqrt(share[0, 0, 0]) * (1.0 + 1e-9)
    assert share[0, 0, 0] <= 1.0
    np.testing.assert_array_equal(placed.pixels_uv, CHAIN.pixels_uv)


def test_what_a_user_set_keeps_its_ellipses():
    manual = replace(CHAIN, manual=True)
    assert at_scale([manual], 3.1) == (manual,)
