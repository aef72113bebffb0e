"""Local activation time: the steepest negative deflection of the mapping electrogram minus the reference's, in the same beat.

The paper samples 1000 times a second; here the samples may have any times, as long as these ascend.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from fluoromap.contracts import Array
from fluoromap.electrogram.artefacts import is_saturated, without_spikes
from fluoromap.electrogram.beats import find_beats
from fluoromap.electrogram.deflections import Channel, Deflection
from fluoromap.electrogram.recording import UnusableElectrogram, read_recording

_LONGEST_CONDUCTION_MS = 250.0
"""No two places of a chamber are activated further apart in one beat; flutter around a whole atrium takes about as long."""
_SURE_ALONE_MS = 125.0
"""Half of the shortest lasting cycle: within it a single beat cannot be taken for its neighbour."""
_SAME_TIME_MS = 1.0
"""Electric signals reach all channels at once; a sample's rounding is left."""
_NEAR_HALF_CYCLE = 0.4
_RIVAL = 0.5
_SLOW_MS = 7.0
"""A wider deflection is far field: that of tissue at a distance h is h / (1.7 v) wide, which is 12 mm at a speed v of 1 m/s."""
_UPWARD = 1.5
_NORMAL_MAD = 1.4826
_LARGEST_DEVIATION = 3.5
"""Deviation over the normal one beyond which a beat does not count (Iglewicz and Hoaglin 1993)."""
_TOLERANCE_MS = 5.0, 10.0
"""Least and most difference to the median at which a beat counts: experts differ by 6.8 ms (Alcaine 2014)."""
_LEAST_SHARE = 2.0 / 3.0


@dataclass(frozen=True, slots=True)
class ElectrogramResult:
    """The activation time of one site.

    lat_ms : mapping minus reference, the mean of the beats. sd_ms : its standard deviation. reference_ms, mapping_ms : the times of
    a typical beat. beats : number of beats that count. warnings : sentences about points to check.
    """

    lat_ms: float
    sd_ms: float
    reference_ms: float
    mapping_ms: float
    beats: int
    warnings: tuple[str, ...]


@dataclass(frozen=True, slots=True)
class _Beat:
    reference: Deflection
    mapping: Deflection
    rivals: int

    @property
    def lat_ms(self) -> float:
        return self.mapping.time_ms - self.reference.time_ms


def activation_time(time_ms: ArrayLike, reference: ArrayLike, mapping: ArrayLike) -> ElectrogramResult:
    """Return the local activation time of one site from its two electrograms.

    1. Spikes of a stimulator are replaced by straight lines.
    2. The deflections of the reference that have one shape are the beats.
    3. In each beat the steepest negative deflection of the mapping electrogram counts that is less than half a cycle away.
    4. Beats that differ from the median do not count. The time is the mean of the others.

    The standard deviation follows from the scatter of the beats, and from the sharpness of their deflections in the noise.

    Parameters
    ----------
    time_ms, reference, mapping : (n,)
        Times, strictly ascending, and the two signals in any unit.

    Raises
    ------
    UnusableElectrogram
        When a signal is too short, not finite, flat, saturated or without a deflection above the noise; when times do not ascend
        or are not in ms; when the beats disagree. The message names the signal.
    """
    recording = read_recording(time_ms, reference, mapping)
    signals = *_, blanked, spikes = without_spikes(recording)
    warnings: list[str] = []
    if spikes:
        warnings.append(
            f"{_count(spikes, 'stimulation artefact')} left out; check that tissue and not a stimulus was timed."
        )
    channels = []
    for name, signal, step in zip(
        ("reference", "mapping"), signals[:2], (recording.reference_step, recording.mapping_step), strict=True
    ):
        channel = Channel(signal, recording.start_ms, recording.spacing_ms, step, blanked)
        if not len(channel.steep):
            raise UnusableElectrogram(f"The {name} electrogram has no steep negative deflection above the noise.")
        if is_saturated(signal, recording.spacing_ms):
            raise UnusableElectrogram(f"The {name} electrogram is saturated; lower the amplifier's gain.")
        channels.append(channel)
    beats = _beats(channels[0], channels[1], warnings)
    used = _agreeing(beats, warnings)
    return _result(used, warnings)


def _beats(reference: Channel, mapping: Channel, warnings: list[str]) -> list[_Beat]:
    """Return the beats in which both electrograms have a deflection."""
    found = find_beats(reference)
    if found.others:
        warnings.append(
            f"The reference electrogram has {found.others} more steep deflections of other shapes, which do not count; check that "
            "the right beats were taken."
        )
    places = [reference.deflection(int(sample)) for sample in found.samples]
    cycle = float(np.median(np.diff([place.time_ms for place in places]))) if len(places) > 1 else math.inf
    reach = min(_LONGEST_CONDUCTION_MS, cycle / 2.0)
    beats = [beat for place in places if (beat := _beat(place, mapping, reach)) is not None]
    if not beats:
        raise UnusableElectrogram(
            f"The mapping electrogram has no steep negative deflection within {reach:.0f} ms of the reference's; send a recording "
            "that shows both in the same beat."
        )
    # At its edges a recording may lack one of the two.
    inner = [
        place
        for place in places
        if place.time_ms - reach >= mapping.start_ms
        and place.time_ms + reach <= mapping.time_ms(len(mapping.signal) - 1)
    ]
    missing = len(inner) - sum(beat.reference in inner for beat in beats)
    if missing > (1.0 - _LEAST_SHARE) * len(inner):
        raise UnusableElectrogram(
            f"The mapping electrogram has no steep negative deflection in {missing} of {len(inner)} beats; check the reference."
        )
    if missing:
        warnings.append(f"The mapping electrogram has no steep negative deflection in {_count(missing, 'beat')}.")
    _warn_of_doubts(beats, cycle, mapping.spacing_ms, warnings)
    return beats


def _beat(reference: Deflection, mapping: Channel, reach_ms: float) -> _Beat | None:
    times = mapping.start_ms + mapping.spacing_ms * mapping.steep
    within = mapping.steep[np.abs(times - reference.time_ms) <= reach_ms]
    if not len(within):
        return None
    slopes = mapping.slopes[within]
    steepest = int(np.argmin(slopes))
    rivals = int((slopes <= _RIVAL * slopes[steepest]).sum()) - 1
    return _Beat(reference, mapping.deflection(int(within[steepest])), rivals)


def _warn_of_doubts(beats: list[_Beat], cycle_ms: float, spacing_ms: float, warnings: list[str]) -> None:
    lat_ms = float(np.median([beat.lat_ms for beat in beats]))
    if len(beats) == 1 and abs(lat_ms) > _SURE_ALONE_MS:
        warnings.append(
            "Only one beat was recorded, so the two deflections may belong to different beats; record several."
        )
    if abs(lat_ms) <= max(_SAME_TIME_MS, spacing_ms):
        warnings.append(
            "Both deflections fall at the same time, as a stimulus and crosstalk do; check that tissue was timed in both."
        )
    if abs(lat_ms) > _NEAR_HALF_CYCLE * cycle_ms:
        warnings.append(
            f"The deflections are nearly half a cycle of {cycle_ms:.0f} ms apart, so they may belong to different beats."
        )
    if 2 * sum(beat.rivals > 0 for beat in beats) >= len(beats):
        warnings.append(
            "The mapping electrogram has several negative deflections of almost equal steepness; check the annotation."
        )
    for name in ("reference", "mapping"):
        deflections: list[Deflection] = [getattr(beat, name) for beat in beats]
        if np.median([deflection.width_ms for deflection in deflections]) > _SLOW_MS:
            warnings.append(f"The deflection of the {name} electrogram is slow; it may be far field of other tissue.")
        if np.median([deflection.rise for deflection in deflections]) > _UPWARD:
            warnings.append(f"The {name} electrogram rises faster than it falls; check its polarity.")


def _agreeing(beats: list[_Beat], warnings: list[str]) -> list[_Beat]:
    """Return the beats that differ little from the median.

    Raises
    ------
    UnusableElectrogram
        When fewer than two of three beats, or than two of two, agree.
    """
    lats = np.array([beat.lat_ms for beat in beats])
    away = np.abs(lats - np.median(lats))
    tolerance = float(np.clip(_LARGEST_DEVIATION * _NORMAL_MAD * np.median(away), *_TOLERANCE_MS))
    used = [beat for beat, deviation in zip(beats, away, strict=True) if deviation <= tolerance]
    if len(used) < min(len(beats), max(2, math.ceil(_LEAST_SHARE * len(beats)))):
        shown = ", ".join(f"{lat:.0f}" for lat in lats[:8])
        raise UnusableElectrogram(
            f"The beats disagree about the activation time ({shown} ms); send a recording of one regular rhythm."
        )
    if len(used) < len(beats):
        warnings.append(
            f"{_count(len(beats) - len(used), 'beat')} left out: the activation time differs from the others."
        )
    return used


def _result(used: list[_Beat], warnings: list[str]) -> ElectrogramResult:
    lats: Array = np.array([beat.lat_ms for beat in used])
    lat_ms, n = float(lats.mean()), len(lats)
    noise = float(np.mean([beat.reference.noise_sd_ms**2 + beat.mapping.noise_sd_ms**2 for beat in used]))
    drawn = float(np.median([beat.reference.drawn_sd_ms**2 + beat.mapping.drawn_sd_ms**2 for beat in used]))
    # The scatter of few beats is itself uncertain: the variance of Student's distribution.
    scatter = float(lats.var(ddof=1)) * ((n - 1) / (n - 3) if n > 3 else 1.0) if n > 1 else 0.0
    typical = used[int(np.argmin(np.abs(lats - lat_ms)))]
    reference_ms = typical.reference.time_ms
    sd_ms = math.sqrt(max(scatter, noise) / n + drawn)
    if sd_ms > _TOLERANCE_MS[1]:
        raise UnusableElectrogram(
            f"The activation time has a standard deviation of {sd_ms:.0f} ms; send a recording with clearer deflections."
        )
    if sd_ms > _TOLERANCE_MS[0]:
        warnings.append("The activation time is uncertain; see its standard deviation.")
    return ElectrogramResult(lat_ms, sd_ms, reference_ms, reference_ms + lat_ms, n, tuple(warnings))


def _count(number: int, thing: str) -> str:
    return f"{number} {thing} was" if number == 1 else f"{number} {thing}s were"
