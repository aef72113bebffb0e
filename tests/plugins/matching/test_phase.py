"""Cardiac phase from R waves and from motion."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from fluoromap.contracts import FrameChains, Segmentation
from fluoromap.matching.phase import cardiac_phases, cycle_length_ms, phase_distance, start_of_systole


def run(motion: np.ndarray, r_waves: tuple[int, ...] = (), frame_ms: float = 1000 / 60) -> Segmentation:
    n = len(motion)
    return Segmentation(
        tuple(FrameChains(frame, ()) for frame in range(n)), None, (), motion, np.arange(n) * frame_ms, r_waves
    )


def pulses(n: int, cycle_frames: float, start: float = 0.0) -> np.ndarray:
    """Return the motion of a heart.

    It is fast at contraction, less fast at relaxation, still for the rest of the cycle.
    """
    phase = (np.arange(n) / cycle_frames + start) % 1.0
    return np.exp(-(((phase - 0.1) / 0.05) ** 2)) + 0.5 * np.exp(-(((phase - 0.35) / 0.06) ** 2))


def test_r_waves_have_phase_zero_and_the_middle_between_them_one_half() -> None:
    rhythm = cardiac_phases(run(np.zeros(100), (20, 60, 90)), ())
    assert rhythm is not None
    phases = rhythm.phases
    assert phases[[20, 60, 90]] == pytest.approx(0)
    assert phases[[40, 75]] == pytest.approx(0.5)
    # Beyond the first and last beat the neighbouring cycle goes on.
    assert phases[10] == pytest.approx(0.75)
    assert phases[96] == pytest.approx(0.2)


def test_two_r_waves_are_enough_for_any_run() -> None:
    rhythm = cardiac_phases(run(np.zeros(200), (90, 110)), ())
    assert rhythm is not None
    phases = rhythm.phases
    assert phase_distance(phases[[10, 30, 190]], np.zeros(3)) == pytest.approx(0, abs=1e-9)
    assert ((phases >= 0) & (phases < 1)).all()


@pytest.mark.parametrize("cycle_frames", [27.3, 33.3, 50.0])
def test_without_r_waves_the_motion_gives_cycle_and_start_of_systole(cycle_frames: float) -> None:
    rhythm = cardiac_phases(run(pulses(120, cycle_frames, 0.4)), ())
    assert rhythm is not None
    phases = rhythm.phases
    truth = (np.arange(120) / cycle_frames + 0.4) % 1.0
    assert phase_distance(phases, truth).max() < 0.12
    # The same moment of every beat has the same phase; the position of zero does not matter.
    drift = np.unwrap(phases - truth, period=1.0)
    assert np.ptp(drift) < 0.06


def test_one_r_wave_gives_the_origin_and_motion_the_length() -> None:
    rhythm = cardiac_phases(run(pulses(120, 33.3), (40,)), ())
    assert rhythm is not None
    phases = rhythm.phases
    assert phases[40] == 0
    assert phase_distance(phases[73:74], np.array([0.99]))[0] < 0.05


@pytest.mark.parametrize("motion", [np.zeros(100), np.linspace(0, 1, 100), np.ones(6)])
def test_where_nothing_repeats_there_is_no_phase(motion: np.ndarray) -> None:
    assert cardiac_phases(run(motion), ()) is None


def test_noise_has_no_cycle() -> None:
    signal = np.random.default_rng(1).normal(size=(120, 2))
    assert cycle_length_ms(signal, 1000 / 60) is None


@given(st.floats(22, 80), st.floats(0, 1))
def test_the_length_of_a_cycle_is_found_to_a_fraction_of_a_frame(cycle_frames: float, start: float) -> None:
    phase = 2 * np.pi * (np.arange(160) / cycle_frames + start)
    signal = np.stack([np.cos(phase) + 0.4 * np.cos(2 * phase), np.sin(phase)], axis=1)
    found = cycle_length_ms(signal, 1000 / 60)
    assert found == pytest.approx(cycle_frames * 1000 / 60, rel=0.02)


def test_systole_starts_where_the_longest_quiet_stretch_ends() -> None:
    phases = np.arange(0, 1, 0.01)
    speed = np.where((phases > 0.3) & (phases < 0.5), 1.0, 0.0) + np.where((phases > 0.6) & (phases < 0.7), 0.8, 0.0)
    assert start_of_systole(phases, speed) == pytest.approx(0.3, abs=0.03)


@given(st.floats(0, 1), st.floats(0, 1))
def test_phase_distance_goes_round_the_cycle(first: float, second: float) -> None:
    apart = float(phase_distance(np.array(first), np.array(second)))
    assert 0 <= apart <= 0.5
    assert apart == pytest.approx(float(phase_distance(np.array(second), np.array(first + 1))), abs=1e-9)
