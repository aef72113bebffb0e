"""Negative deflections of one electrogram: where they are steepest, and how well the noise lets one know.

The slope at each sample is that of a cubic fitted to the samples within 5 ms on each side (Savitzky and Golay, Anal. Chem. 36
(1964) 1627), which follows a deflection of a few ms.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np
from scipy.signal import find_peaks, savgol_coeffs, savgol_filter

from fluoromap.contracts import Array, BoolArray
from fluoromap.electrogram.quiet_part import quiet_sd

_WINDOW_MS = 5.0
_WIDTHS = 1.25
_WIDER = 1.5
_WIDEST_MS = 12.0
_LEAST_HALF = 3
_LEAST_SLOPE_TO_NOISE = 5.0
_PLACEMENT = 0.05
_APART_MS = 10.0
"""Steep places that are closer belong to one deflection."""
_CONVERTER_SD = 1.0 / math.sqrt(12.0)
"""Standard deviation of a converter's rounding, in its steps (Widrow, IRE Trans. Circuit Theory 3 (1956) 266)."""


@dataclass(frozen=True, slots=True)
class Deflection:
    """One negative deflection.

    time_ms : of its steepest place. noise_sd_ms : by the noise of the recording. drawn_sd_ms : by other signals under it.
    slope : at the steepest place, positive, per ms. width_ms : half of its extent. rise : the steepest rise within 10 ms over the
    slope.
    """

    time_ms: float
    noise_sd_ms: float
    drawn_sd_ms: float
    slope: float
    width_ms: float
    rise: float


@dataclass(slots=True, eq=False)
class Channel:
    """One electrogram on evenly spaced samples.

    step : of the converter. blanked : samples without a measurement, in which no deflection is looked for.
    """

    signal: Array
    start_ms: float
    spacing_ms: float
    step: float
    blanked: BoolArray
    slopes: Array = field(init=False)
    steep: Array = field(init=False)
    """Samples at which a deflection is steepest and clearly steeper than noise, ascending."""
    _noise: dict[tuple[int, int], float] = field(init=False, default_factory=dict)

    def __post_init__(self) -> None:
        half = self._half(_WINDOW_MS)
        self.slopes = self._derivative(self.signal, half, 1)
        # The fits over the rounding of a converter that shows a constant still have slopes.
        rounding = _CONVERTER_SD * self.step * math.sqrt(float((self._kernel(half, 1) ** 2).sum()))
        threshold = _LEAST_SLOPE_TO_NOISE * max(quiet_sd(self.slopes), rounding, 1e-9 * float(np.ptp(self.signal)))
        distance = max(1, round(_APART_MS / self.spacing_ms))
        steep, _ = find_peaks(-self.slopes, height=threshold, distance=distance)
        usable = ~np.convolve(self.blanked, np.ones(2 * half + 1), "same").astype(bool)
        usable[:half] = usable[len(usable) - half :] = False
        self.steep = steep[usable[steep]]

    def time_ms(self, sample: float) -> float:
        """Return the time of a sample."""
        return self.start_ms + self.spacing_ms * sample

    def deflection(self, steepest: int) -> Deflection:
        """Return the deflection that is steepest near a sample.

        The steepest place lies between samples where the curvature of the fitted cubic vanishes. The standard deviation follows
        from the sharpness of that minimum, and from the curvatures that the same fits have in the quieter parts of the
        recording. So hum, far field and filtered noise count with their real size, and not as independent errors of samples.
        """
        slope = -float(self.slopes[steepest])
        width = self._width_ms(steepest, _WINDOW_MS)
        fitted = min(max(_WIDTHS * width, _WINDOW_MS), _WIDEST_MS)
        if fitted == _WIDEST_MS:
            width = self._width_ms(steepest, _WIDEST_MS)
        rise = self._rise(steepest) / slope
        found = self._place(steepest, self._half(fitted))
        others = [self._place(steepest, self._half(by * fitted)) for by in (_WIDER, 1.0 / _WIDER)]
        if found is None or others[0] is None:
            return Deflection(self.time_ms(steepest), 2.0 * self.spacing_ms, 0.0, slope, width, rise)
        place, noise_sd = found
        # Signals under the deflection, above all far field, shift its steepest place, and shift it more for a wider fit. A
        # deflection that is no cubic is steepest elsewhere for a narrower fit.
        drawn = max(abs(other[0] - place) for other in others if other is not None)
        drawn_sd = self.spacing_ms * math.hypot(drawn, _PLACEMENT)
        return Deflection(self.time_ms(place), noise_sd, drawn_sd, slope, width, rise)

    def _place(self, steepest: int, half: int) -> tuple[float, float] | None:
        """Return the steepest place in samples and its standard deviation in ms.

        None where the minimum of the slope is no sharper than noise.
        """
        near = max(round(_WINDOW_MS / self.spacing_ms), 1)
        first, last = max(0, steepest - near), min(len(self.signal), steepest + near + 1)
        slope, curvature, third = (self._around(first, last, half, order) for order in (1, 2, 3))
        best = int(np.argmin(slope))
        # The steepest of many noisy places looks sharper than it is: assume one standard deviation less.
        sure = third[best] - 3.0 * self._noise_of(half, 3)
        if sure <= 0:
            return None
        shift = float(np.clip(-curvature[best] / third[best] / self.spacing_ms, -1.0, 1.0))
        return first + best + shift, self._noise_of(half, 2) / float(sure)

    def _width_ms(self, steepest: int, window_ms: float) -> float:
        """Return the standard deviation of the Gaussian whose derivative has such a slope and sharpness."""
        half = self._half(window_ms)
        slope, third = (float(self._around(steepest, steepest + 1, half, order)[0]) for order in (1, 3))
        return math.sqrt(-3.0 * slope / third) if slope < 0 < third else math.inf

    def _rise(self, steepest: int) -> float:
        reach = round(_APART_MS / self.spacing_ms)
        return float(self.slopes[max(0, steepest - reach) : steepest + reach + 1].max())

    def _around(self, first: int, last: int, half: int, order: int) -> Array:
        """Return a derivative at the samples from ``first`` to before ``last``."""
        begin, end = max(0, first - half), min(len(self.signal), last + half)
        if end - begin < 2 * half + 1:
            begin, end = (0, 2 * half + 1) if begin == 0 else (len(self.signal) - 2 * half - 1, len(self.signal))
        return self._derivative(self.signal[begin:end], half, order)[first - begin : last - begin]

    def _noise_of(self, half: int, order: int) -> float:
        if (half, order) not in self._noise:
            self._noise[half, order] = quiet_sd(self._derivative(self.signal, half, order))
        return self._noise[half, order]

    def _half(self, window_ms: float) -> int:
        most = (len(self.signal) - 1) // 2
        return min(max(_LEAST_HALF, int(window_ms / self.spacing_ms + 1e-9)), most)

    def _derivative(self, values: Array, half: int, order: int) -> Array:
        found: Array = savgol_filter(values, 2 * half + 1, 3, deriv=order, delta=self.spacing_ms)
        return found

    def _kernel(self, half: int, order: int) -> Array:
        kernel: Array = savgol_coeffs(2 * half + 1, 3, deriv=order, delta=self.spacing_ms)
        return kernel
