import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from simulated_recordings import draw_recording

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


def beats(at_ms, times, heights=None, width_ms=3.0):
    heights = np.ones(len(at_ms)) if heights is None else heights
    noise = np.random.default_rng(3).normal(0, 0.005, len(times))
    return sum(deflection(at, times, width_ms, height) for at, height in zip(at_ms, heights, strict=True)) + noise


LONG = np.arange(0.0, 900.0)


def test_both_deflections_are_of_one_beat_although_the_steepest_are_not():
    reference = beats((200, 640), LONG, (1.0, 1.5))
    mapping = beats((241.3, 681.3), LONG, (1.5, 1.0))
    found = activation_time(LONG, reference, mapping)
    assert found.lat_ms == pytest.approx(41.3, abs=0.5)
    assert (found.beats, found.warnings) == (2, ())


def test_a_mapping_electrogram_may_come_first_in_every_beat():
    found = activation_time(LONG + 5e6, beats((200, 640), LONG), beats((140, 580), LONG))
    assert found.lat_ms == pytest.approx(-60, abs=0.5)
    assert found.mapping_ms == pytest.approx(found.reference_ms + found.lat_ms)


def stimulus(times, at_ms, height=8.0):
    pulse = height * ((times >= at_ms) & (times < at_ms + 2)) - height * ((times >= at_ms + 2) & (times < at_ms + 4))
    tail = np.where(times >= at_ms + 4, -0.5 * height * np.exp(-np.maximum(times - at_ms - 4, 0) / 30), 0.0)
    return pulse + tail


def test_a_pacing_artefact_in_both_electrograms_is_left_out_and_named():
    times = np.arange(0.0, 400.0)
    signals = [beats((at,), times) + stimulus(times, 80) for at in (120, 161.3)]
    found = activation_time(times, *signals)
    assert found.lat_ms == pytest.approx(41.3, abs=1)
    assert "stimulation artefact" in found.warnings[0]


@pytest.mark.parametrize("khz", [0.5, 1.0, 4.0])
def test_a_stimulus_is_never_an_activation(khz):
    times = np.arange(0, 400, 1 / khz)
    pulse = 8.0 * ((times >= 80) & (times < 81.5))
    noise = np.random.default_rng(0).normal(0, 0.01, (2, len(times)))
    with pytest.raises(UnusableElectrogram, match=r"reference.*noise"):
        activation_time(times, pulse + noise[0], pulse + noise[1])


@pytest.mark.parametrize("sparse", [True, False])
def test_a_dead_channel_is_refused_although_its_least_bit_flickers(sparse):
    rng = np.random.default_rng(5)
    times = np.arange(0.0, 400.0)
    dead = np.zeros(400)
    dead[rng.choice(400, 16 if sparse else 300, replace=False)] = 1.0
    dead *= rng.choice([-1, 1], 400)
    with pytest.raises(UnusableElectrogram, match=r"mapping.*noise"):
        activation_time(times, beats((120,), times), dead)


@pytest.mark.parametrize(("factor", "message"), [(1000.0, "milliseconds"), (0.001, "milliseconds"), (60.0, "apart")])
def test_times_in_another_unit_are_refused(factor, message):
    with pytest.raises(UnusableElectrogram, match=message):
        activation_time(factor * TIMES, deflection(100), deflection(150))


def test_missing_samples_are_refused_with_their_place():
    kept = (TIMES < 50) | (TIMES > 70)
    with pytest.raises(UnusableElectrogram, match="missing between 49 and 71 ms"):
        activation_time(TIMES[kept], deflection(100)[kept], deflection(150)[kept])


def test_a_recording_of_a_whole_procedure_is_refused():
    times = np.arange(0.0, 3_700_000.0, 5.0)
    with pytest.raises(UnusableElectrogram, match="3700 s"):
        activation_time(times, np.sin(times), np.sin(times))


def test_beats_that_disagree_are_refused():
    times = np.arange(0.0, 1000.0)
    with pytest.raises(UnusableElectrogram, match="disagree"):
        activation_time(times, beats((200, 640), times), beats((240, 720), times))


def test_a_beat_of_another_place_is_left_out_and_told():
    times = np.arange(0.0, 3000.0)
    at = np.array([200.0, 800, 1400, 2000, 2600])
    mapping = at + 30
    mapping[2] += 60
    found = activation_time(times, beats(at, times), beats(mapping, times))
    assert found.lat_ms == pytest.approx(30, abs=0.5)
    assert found.beats == 4
    assert any("1 beat was left out" in warning for warning in found.warnings)


def test_the_deflection_of_another_beat_is_not_taken():
    times = np.arange(0.0, 500.0)
    with pytest.raises(UnusableElectrogram, match="within 250 ms"):
        activation_time(times, beats((50,), times), beats((400,), times))


def test_deflections_at_the_same_time_are_told():
    found = activation_time(TIMES, deflection(120), 0.3 * deflection(120))
    assert any("same time" in warning for warning in found.warnings)


def test_a_reversed_polarity_is_told():
    found = activation_time(TIMES, deflection(100), -deflection(150, width_ms=5))
    assert any("polarity" in warning for warning in found.warnings)


def test_far_field_alone_is_told():
    found = activation_time(TIMES, deflection(100), deflection(150, width_ms=15))
    assert any("far field" in warning for warning in found.warnings)


@pytest.mark.parametrize("first", range(0, 200, 50))
def test_no_simulated_recording_gives_a_wrong_time_in_silence(first):
    errors, normalised, usable = [], [], 0
    for seed in range(first, first + 50):
        recording = draw_recording(np.random.default_rng(seed))
        usable += recording.lat_ms is not None
        try:
            found = activation_time(recording.time_ms, recording.reference, recording.mapping)
        except UnusableElectrogram:
            continue
        error = np.inf if recording.lat_ms is None else found.lat_ms - recording.lat_ms
        assert abs(error) <= 10 or found.warnings, (seed, recording.kinds, error, found)
        if abs(error) <= 10:
            errors.append(abs(error))
            normalised.append(abs(error) / found.sd_ms)
    assert len(errors) > 0.8 * usable
    assert np.percentile(errors, 95) < 2.5
    assert np.mean(np.array(normalised) < 1.96) >= 0.9
