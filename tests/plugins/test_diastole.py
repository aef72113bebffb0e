import numpy as np
import pytest

from fluoromap.diastole import diastolic_frames, quiet_stretches


def cycle(rate_hz, beat_s, beats, noise=0.0):
    """Return the motion of a heart.

    It has a systolic pulse out and back in the first 45 % of the beat, a short rest between, then quiet.
    """
    times = np.arange(int(rate_hz * beat_s * beats)) / rate_hz

    def place(t):
        phase = (t / beat_s) % 1
        return 6 / (1 + np.exp(-(phase - 0.12) / 0.015)) - 6 / (1 + np.exp(-(phase - 0.36) / 0.02))

    motion = np.abs(place(times) - place(times - 1 / rate_hz))
    motion = np.hypot(motion, 0.3 + noise * np.random.default_rng(0).normal(size=len(times)))
    motion[0] = motion[1]
    return motion, times * 1000, (times / beat_s) % 1


@pytest.mark.parametrize(("rate", "beat"), [(60, 0.55), (60, 0.9), (30, 0.8), (15, 0.5), (15, 0.7), (15, 1.0)])
def test_diastole_is_the_longest_rest_of_the_cycle(rate, beat):
    motion, times, phase = cycle(rate, beat, 3.2, noise=0.005)
    frames = diastolic_frames(motion, times)
    assert 1 <= len(frames) <= 7
    assert list(frames) == list(range(frames[0], frames[-1] + 1))
    assert all(phase[frame] > 0.43 or phase[frame] < 0.07 for frame in frames)


def test_r_waves_win():
    motion, times, phase = cycle(60, 0.8, 3)
    motion[(phase > 0.15) & (phase < 0.34)] = motion.min()
    motion[(phase > 0.85)] = 4.0
    frames = diastolic_frames(motion, times, r_wave_frames=(0, 48, 96))
    assert all(0.55 <= phase[frame] < 1 for frame in frames)


def test_where_hardly_anything_rests_the_two_frames_of_the_least_difference_are_taken():
    motion = np.array([5, 5, 9, 4.9, 8, 1.0, 9, 7, 5, 9.0])
    assert diastolic_frames(motion, np.arange(10) * 66.0) == (4, 5)


def test_where_nothing_rests_late_in_the_cycle_the_quietest_late_frame_is_used_alone():
    motion = np.array([1, 1, 1, 9, 9, 9, 9, 6, 9, 9.0])
    assert diastolic_frames(motion, np.arange(10) * 66.0, r_wave_frames=(0, 9)) == (7,)


@pytest.mark.parametrize("count", [1, 2, 3])
def test_very_short_runs(count):
    frames = diastolic_frames(np.zeros(count), np.arange(count) * 33.0)
    assert frames
    assert all(0 <= frame < count for frame in frames)


def test_stretches_begin_at_the_frame_before_the_first_quiet_difference():
    motion = np.array([9, 9, 1, 1, 1, 9, 9, 9, 1, 9.0])
    assert quiet_stretches(motion) == ((1, 4), (7, 8))
