import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from fluoromap.electrogram import UnusableElectrogram, activation_time

TIMES = np.arange(0.0, 300.0)


def deflection(at_ms, times=TIMES, width_ms=4.0, height=1.0):
    """Return a biphasic unipolar electrogram that falls steepest at ``at_ms``."""
    x = (times - at_ms) / width_ms
    return -height * x * np.exp(-0.5 * x * x)


@given(st.floats(60, 240), st.floats(60, 240), st.floats(0.001, 1000))
def test_difference_of_the_steepest_falls(reference_at, mapping_at, gain):
    found = activation_time(TIMES, deflection(reference_at), gain * deflection(mapping_at))
    assert found.reference_ms == pytest.approx(reference_at, abs=0.3)
    assert found.mapping_ms == pytest.approx(mapping_at, abs=0.3)
    assert found.lat_ms == pytest.approx(mapping_at - reference_at, abs=0.4)
    assert found.lat_ms == pytest.approx(found.mapping_ms - found.reference_ms)


def test_negative_times_are_kept():
    assert activation_time(TIMES, deflection(150), deflection(120)).lat_ms == pytest.approx(-30, abs=0.4)


def test_uneven_samples():
    rng = np.random.default_rng(0)
    times = np.cumsum(rng.uniform(0.5, 1.5, 300))
    found = activation_time(times, deflection(100, times), deflection(147.3, times))
    assert found.lat_ms == pytest.approx(47.3, abs=0.6)


def filtered_noise(rng, sd):
    """Return noise as a 200 Hz amplifier leaves it.

    Neighbouring samples err alike.
    """
    noise = np.convolve(rng.normal(size=320), np.exp(-0.5 * (np.arange(-6, 7) / 1.5) ** 2), "same")[10:310]
    return sd * noise / np.std(noise)


SPOILT = {
    "white noise": lambda rng, at: rng.normal(0, 0.03, 300),
    "filtered noise": lambda rng, at: filtered_noise(rng, 0.03),
    "mains hum": lambda rng, at: 0.05 * np.sin(0.1 * np.pi * TIMES + rng.uniform(0, 6)),
    "wander": lambda rng, at: np.sin(TIMES / 60 + rng.uniform(0, 6)) + rng.normal(0, 0.02, 300),
    "far field": lambda rng, at: deflection(at + rng.uniform(-30, 30), width_ms=18, height=1.5),
    "late potential": lambda rng, at: (
        deflection(at + rng.uniform(30, 60), width_ms=2.5, height=0.3) + rng.normal(0, 0.02, 300)
    ),
}


@pytest.mark.parametrize("what", SPOILT)
def test_the_stated_deviation_covers_the_error(what):
    rng = np.random.default_rng(1)
    errors, stated = [], []
    for _ in range(60):
        reference_at, mapping_at = rng.uniform(90, 110), rng.uniform(120, 180)
        signals = [
            deflection(at, width_ms=rng.uniform(2.5, 6)) + SPOILT[what](rng, at) for at in (reference_at, mapping_at)
        ]
        result = activation_time(TIMES, *signals)
        errors.append(result.lat_ms - (mapping_at - reference_at))
        stated.append(result.sd_ms)
    assert np.abs(errors).max() < 1.5
    assert np.mean(np.abs(errors) < 2 * np.array(stated)) > 0.85
    assert np.mean(stated) < 2.5 * np.std(errors)


def test_a_sharp_near_field_wins_over_a_larger_far_field():
    far = deflection(190, width_ms=18, height=3)
    found = activation_time(TIMES, deflection(100), deflection(150, width_ms=3) + far)
    assert found.lat_ms == pytest.approx(50, abs=1)


def test_rivals_are_reported():
    double = deflection(100) + 0.95 * deflection(180)
    warnings = activation_time(TIMES, deflection(90), double).warnings
    assert len(warnings) == 1
    assert "mapping" in warnings[0]


@pytest.mark.parametrize(
    ("signal", "message"),
    [
        (np.zeros(300), "flat"),
        (np.clip(deflection(100), -0.2, 0.2), "saturated"),
        (np.random.default_rng(0).normal(size=300), "noise"),
        (filtered_noise(np.random.default_rng(0), 1.0), "noise"),
        (np.sin(0.1 * np.pi * TIMES), "noise"),
        (np.full(300, np.nan), "not numbers"),
        (np.zeros(299), "one value"),
        (np.linspace(0, 1, 300), "noise"),
    ],
)
def test_unusable_signals_are_refused_by_name(signal, message):
    with pytest.raises(UnusableElectrogram, match=f"mapping.*{message}"):
        activation_time(TIMES, deflection(100), signal)


def test_unusable_times_are_refused():
    with pytest.raises(UnusableElectrogram, match="at least"):
        activation_time(TIMES[:10], deflection(100)[:10], deflection(100)[:10])
    with pytest.raises(UnusableElectrogram, match="ascend"):
        activation_time(TIMES[::-1], deflection(100), deflection(100))
