"""Colours of activation times: steps, bands, and two colour maps.

In the palette ``safe`` early is warm and light, late is cold and dark. Colour-blind readers can order it, and so can
readers of a grey print. The palette ``red-early`` is that of mapping systems: red is early, violet is late. Places without a
near site get a hatched neutral grey, which is not the colour of any band.
"""

from __future__ import annotations

import functools
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from fluoromap.contracts import Array, ChamberMap
from fluoromap.reasons import Reason

Colours = NDArray[np.uint8]
Palette = Literal["safe", "red-early"]

NO_DATA_RGB = (150, 150, 150)
NO_DATA_HATCH_RGB = (205, 205, 205)
STEPS_MS = (5.0, 10.0, 20.0, 50.0)
MOST_BANDS = 13

_ANCHORS_RGB: dict[Palette, Array] = {
    # The map "plasma" of matplotlib (S. van der Walt and N. Smith, public domain, CC0), reversed, without its darkest end:
    # perceptually uniform and ordered under all common colour-vision deficiencies.
    "safe": np.array(
        [
            (240, 249, 33), (253, 202, 38), (252, 162, 54), (242, 125, 76), (225, 93, 101), (203, 66, 127),
            (174, 36, 146), (138, 9, 165), (100, 0, 167), (62, 4, 156),
        ],
        dtype=np.float64,
    ),
    # Lightest in the middle and dark at both ends, without a saturated green: so that colour-blind readers never see an early
    # band as a late one.
    "red-early": np.array(
        [
            (150, 0, 10), (225, 60, 0), (255, 150, 0), (255, 240, 50), (200, 245, 210), (60, 210, 235), (20, 120, 235),
            (40, 20, 170), (50, 0, 90),
        ],
        dtype=np.float64,
    ),
}  # fmt: skip


@dataclass(frozen=True, slots=True)
class Scale:
    """Iso-time steps of one map: ``bands`` bands of ``step_ms`` from ``start_ms`` on, and their colours."""

    start_ms: float
    step_ms: float
    bands: int
    palette: Palette = "safe"

    @property
    def stop_ms(self) -> float:
        """End of the last band, ms."""
        return self.start_ms + self.bands * self.step_ms

    @property
    def edges_ms(self) -> Array:
        """Times between and around the bands, (bands + 1,)."""
        return self.start_ms + self.step_ms * np.arange(self.bands + 1, dtype=np.float64)

    def band(self, lat_ms: Array) -> NDArray[np.int64]:
        """Return the band of each time.

        Times outside the scale belong to the first or last band.
        """
        bands = (lat_ms - self.start_ms) / self.step_ms
        # Conversion to an integer rounds towards 0, which is downwards only after clipping.
        return np.clip(bands, 0, self.bands - 1).astype(np.int64)

    def band_colours(self) -> Colours:
        """Return the RGB of each band, (bands, 3)."""
        return _band_colours(self.bands, self.palette)

    def colours(self, lat_ms: Array) -> Colours:
        """Return continuous RGB (k, 3) of times (k,), without bands, as mesh files need it."""
        return colour_map((lat_ms - self.start_ms) / (self.stop_ms - self.start_ms), self.palette)


@functools.lru_cache(maxsize=64)
def _band_colours(bands: int, palette: Palette) -> Colours:
    colours = colour_map((np.arange(bands) + 0.5) / bands, palette)
    colours.setflags(write=False)
    return colours


def colour_map(fraction: Array, palette: Palette = "safe") -> Colours:
    """Return the RGB (k, 3) of fractions (k,) of the scale, 0 early, 1 late.

    Values outside are clipped.
    """
    anchors = _ANCHORS_RGB[palette]
    position = np.clip(fraction, 0, 1) * (len(anchors) - 1)
    channels = [np.interp(position, np.arange(len(anchors)), channel) for channel in anchors.T]
    return np.stack(channels, axis=-1).round().astype(np.uint8)


def scale_of(chamber: ChamberMap, step_ms: float | None = None, palette: Palette = "safe") -> Scale:
    """Return the iso-time steps of a map.

    They cover every coloured vertex and every site that agrees with its neighbours. Edges are multiples of the step.

    Parameters
    ----------
    chamber : ChamberMap
    step_ms : float or None
        None chooses 5 or 10 ms; 20 or 50 ms where there would be too many bands to distinguish.
    palette : {"safe", "red-early"}
    """
    at_sites = [site.lat_ms for site in chamber.sites if Reason.LAT_OUTLIER not in site.reasons]
    times = np.concatenate([chamber.lat_ms[chamber.covered], at_sites])
    low, high = (float(times.min()), float(times.max())) if times.size else (0.0, 0.0)
    steps = STEPS_MS if step_ms is None else (step_ms,)
    for step in steps:
        start, stop = np.floor(low / step) * step, np.ceil(high / step) * step
        bands = max(1, round((stop - start) / step))
        if bands <= MOST_BANDS or step == steps[-1]:
            break
    return Scale(float(start), step, bands, palette)


def vertex_colours(chamber: ChamberMap) -> Colours:
    """Return the RGB (n, 3) of the map's vertices, grey where no site is near enough."""
    colours = scale_of(chamber).colours(chamber.lat_ms)
    colours[~chamber.covered] = NO_DATA_RGB
    return colours


def milliseconds(lat_ms: float) -> str:
    """Return a time in whole milliseconds, as written beside a site.

    Pillow's typeface has no true minus sign.
    """
    return str(round(lat_ms))
