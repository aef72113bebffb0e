"""Lag of a recursive noise filter: measured from the noise, and part of the ellipses of what moves."""

import numpy as np
import pytest

from fluoromap.contracts import Chain, FrameChains
from fluoromap.segmenter.lag import measure_lag, widen_by_lag

EVERYWHERE = np.ones((128, 128), np.bool_)


class Frames(list):
    shape = 128, 128


def filtered(lag: float, count: int = 8, quantised: bool = False) -> Frames:
    """Return noise after a recursive filter, on a slope, beside a bright bar that moves."""
    random = np.random.default_rng(1)
    slope = np.linspace(400.0, 900.0, 128)[None]
    state, frames = None, Frames()
    for frame in range(count + 20):
        exposure = random.poisson(np.broadcast_to(slope, (128, 128))).astype(np.float64)
        exposure[:, 8 * (frame % 4) : 8 * (frame % 4) + 10] += 500.0
        state = exposure if state is None else lag * state + (1.0 - lag) * exposure
        frames.append((np.round(state / 16.0) if quantised else state).astype(np.float32))
    return Frames(frames[20:])


@pytest.mark.parametrize("lag", [0.0, 0.2, 0.5, 0.7])
def test_lag_is_measured_beside_what_moves(lag):
    assert measure_lag(filtered(lag), EVERYWHERE) == pytest.approx(lag, abs=0.03)


def test_quantisation_makes_it_a_lower_bound():
    assert 0.1 < measure_lag(filtered(0.5, quantised=True), EVERYWHERE) <= 0.5


@pytest.mark.parametrize("count", [1, 2])
def test_few_frames_and_frames_without_noise_have_none(count):
    assert measure_lag(filtered(0.5, count), EVERYWHERE) == 0.0
    assert measure_lag(Frames([np.full((128, 128), 7, np.uint8)] * 5), EVERYWHERE) == 0.0
    assert measure_lag(filtered(0.5), ~EVERYWHERE) == 0.0


def chain(u: float, track: int = 0, manual: bool = False) -> Chain:
    points = np.array([[u, 10.0], [u + 10.0, 10.0]])
    return Chain((1, 2), points, np.tile(0.01 * np.eye(2), (2, 1, 1)), np.ones(2), (("cs", 1.0),), track, manual)


def test_ellipses_are_wider_along_the_motion_only():
    run = [
        FrameChains(0, (chain(10.0),)),
        FrameChains(1, (chain(11.0),)),
        FrameChains(2, (chain(31.0), chain(50.0, 1))),
    ]
    first, second, third = widen_by_lag(run, 0.25, 4.0)
    # Half a pixel, at the first frame too; never more than 0.2 mm.
    for entry, sd in ((first, 0.5), (second, 0.5), (third, 0.8)):
        assert entry.chains[0].covariance_px2[1] == pytest.approx(np.diag([0.01 + sd**2, 0.01]))
    assert third.chains[1] is run[2].chains[1]
    assert widen_by_lag(run, 0.0, 4.0) == tuple(run)


def test_what_a_user_set_keeps_its_ellipses():
    run = [FrameChains(0, (chain(10.0),)), FrameChains(1, (chain(14.0, manual=True),))]
    assert widen_by_lag(run, 0.5, 4.0)[1] == run[1]
