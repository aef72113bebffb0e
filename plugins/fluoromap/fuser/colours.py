"""Colours of activation times: steps, bands, and a colour map that colour-blind readers can order.

Early is warm and light, late is cold and dark, so that the order survives in grey too. Where no site is near enough
there is a hatched neutral grey, which no band has.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from fluoromap.contracts import Array, ChamberMap
from fluoromap.reasons import Reason

Colours = NDArray[np.uint8]

NO_DATA_RGB = (150, 150, 150)
NO_DATA_HATCH_RGB = (205, 205, 205)
STEPS_MS = (5.0, 10.0, 20.0, 50.0)
MOST_BANDS = 13

# The map "plasma" of matplotlib (S. van der Walt and N. Smith, public domain, CC0), reversed, without its darkest end:
# perceptually uniform and ordered under all common colour-vision deficiencies.
_ANCHORS_RGB = np.array(
    [
        (240, 249, 33), (253, 202, 38), (252, 162, 54), (242, 125, 76), (225, 93, 101), (203, 66, 127),
        (174, 36, 146), (138, 9, 165), (100, 0, 167), (62, 4, 156),
    ],
    dtype=np.float64,
)  # fmt: skip


@dataclass(frozen=True, slots=True)
class Scale:
    """Iso-time steps of one map: ``bands`` bands of ``step_ms``, the first one from ``start_ms`` on."""

    start_ms: float
    step_ms: float
    bands: int

    @property
    def stop_ms(self) -> float:
        return self.start_ms + self.bands * self.step_ms

    @property
    def edges_ms(self) -> Array:
        """Times between and around the bands, (bands + 1,)."""
        return self.start_ms + self.step_ms * np.arange(self.bands + 1, dtype=np.float64)

    def band(self, lat_ms: Array) -> NDArray[np.int64]:
        """Band of each time; times outside the scale count to the first or last one."""
        return np.clip(np.floor((lat_ms - self.start_ms) / self.step_ms), 0, self.bands - 1).astype(np.int64)

    def band_colours(self) -> Colours:
        """RGB of each band, (bands, 3)."""
        return colour_map((np.arange(self.bands) + 0.5) / self.bands)

    def colours(self, lat_ms: Array) -> Colours:
        """Continuous RGB (k, 3) of times (k,), without bands: what mesh files carry."""
        return colour_map((lat_ms - self.start_ms) / (self.stop_ms - self.start_ms))


def colour_map(fraction: Array) -> Colours:
    """RGB (k, 3) of fractions (k,) of the scale, 0 early, 1 late; beyond is clipped."""
    position = np.clip(fraction, 0, 1) * (len(_ANCHORS_RGB) - 1)
    channels = [np.interp(position, np.arange(len(_ANCHORS_RGB)), channel) for channel in _ANCHORS_RGB.T]
    return np.stack(channels, axis=-1).round().astype(np.uint8)


def scale_of(chamber: ChamberMap) -> Scale:
    """Iso-time steps for a map: 5 or 10 ms, 20 or 50 only where those would be too many to tell apart.

    Covers every coloured vertex and every site that agrees with its neighbours; edges are multiples of the step.
    """
    at_sites = [site.lat_ms for site in chamber.sites if Reason.LAT_OUTLIER not in site.reasons]
    times = np.concatenate([chamber.lat_ms[chamber.covered], at_sites])
    low, high = (float(times.min()), float(times.max())) if times.size else (0.0, 0.0)
    for step in STEPS_MS:
        start, stop = np.floor(low / step) * step, np.ceil(high / step) * step
        bands = max(1, round((stop - start) / step))
        if bands <= MOST_BANDS or step == STEPS_MS[-1]:
            break
    return Scale(float(start), step, bands)


def vertex_colours(chamber: ChamberMap) -> Colours:
    """RGB (n, 3) of the map's vertices, grey where no site is near enough."""
    colours = scale_of(chamber).colours(chamber.lat_ms)
    colours[~chamber.covered] = NO_DATA_RGB
    return colours


def milliseconds(lat_ms: float) -> str:
    """A time as it is written beside a site: whole milliseconds. (Pillow's typeface has no true minus sign.)"""
    return str(round(lat_ms))
