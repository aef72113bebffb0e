"""Limits of what catheters look like: how long their gaps are in the image, and from when on a row is long."""

from __future__ import annotations

SHORTEST, LONGEST = 0.35, 1.12
"""Limits of the ratio between the spacing in the image and the same spacing across the rays at the isocentre.

A foreshortened catheter has a smaller ratio, a catheter nearer to the source a larger one.
"""
MANY_ELECTRODES = 6
"""From here on a catheter is long. Of a shorter one, more than one electrode is rarely missing."""
TURNING_ELECTRODES = 8
"""From here on a row is known even where it turns through the viewing direction and a part of its electrodes merge."""
LONG_TIP_MM = 3.0
"""From here on a tip is longer than rings for certain."""
