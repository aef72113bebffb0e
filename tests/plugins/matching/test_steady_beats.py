"""R waves to the nearest frame, of hearts that beat steadily and of others."""

import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import given
from hypothesis import strategies as st

from fluoromap.contracts import Array
from fluoromap.matching.steady_beats import steady_beats_ms

FRAME_MS = 1000 / 7.5


def to_frames(beats_ms: npt.ArrayLike) -> Array:
    told: Array = np.rint(np.divide(beats_ms, FRAME_MS)) * FRAME_MS
    return told


def places(times_ms: Array, cycle_ms: float, rng: np.random.Generator) -> Array:
    phase = times_ms[:, None] / cycle_ms + np.array([0.0, 0.1, 0.3, 0.8])
    pulse = np.exp(-0.5 * ((phase % 1.0 - 0.5) / 0.11) ** 2)
    seen = 20 * pulse + rng.normal(0, 0.3, pulse.shape)
    centred: Array = seen - seen.mean(axis=0)
    return centred


@given(st.floats(620, 1000), st.floats(0, 1))
def test_a_steady_rhythm_is_never_farther_than_a_frame_from_the_truth(cycle_ms: float, start: float) -> None:
    beats = cycle_ms * (start + np.arange(4))
    found = steady_beats_ms(to_frames(beats), FRAME_MS / 2, np.zeros(0), None)
    assert np.abs(found - to_frames(beats)).max() <= FRAME_MS / 2 + 1e-6
    assert np.ptp(np.diff(found)) == pytest.approx(0, abs=1e-6)


@pytest.mark.parametrize("with_places", [False, True])
def test_steady_beats_and_the_catheters_time_r_waves_more_finely_than_frames_do(with_places: bool) -> None:
    rng = np.random.default_rng(5)
    times = np.linspace(0, 14 * FRAME_MS, 15)
    told: list[float] = []
    finer: list[float] = []
    lengths: list[float] = []
    for _ in range(60):
        cycle_ms = rng.uniform(620, 900)
        beats = cycle_ms * (rng.uniform() + np.arange(3 if cycle_ms < 650 else 2))
        seen = places(times, cycle_ms, rng) if with_places else None
        found = steady_beats_ms(to_frames(beats), FRAME_MS / 2, times, seen)
        told.extend(to_frames(beats) - beats)
        finer.extend(found - beats)
        lengths.append(float(np.diff(found).mean()) - cycle_ms)
    assert np.std(finer) < np.std(told)
    # The ends of two frames give a length to 0.41 frames; returning catheters give it far better.
    assert np.std(lengths) < (0.08 if with_places else 0.5) * FRAME_MS


def test_beats_that_differ_by_more_than_frames_explain_stay_as_given() -> None:
    told = to_frames(np.array([100.0, 900.0, 1400.0, 2300.0]))
    assert (steady_beats_ms(told, FRAME_MS / 2, np.zeros(0), None) == told).all()
