"""Electrodes of one frame for showing, found in the file itself: no job and no geometry is needed."""

from __future__ import annotations

import io
import math
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path

import numpy as np
from PIL import Image, ImageDraw

from fluoromap.catheters import Catalogue
from fluoromap.contracts import Run
from fluoromap.matching.likely_names import likely_names
from fluoromap.registry import build_previewer
from fluoromap_service.dicom import InstanceFacts, frame_to_8bit, open_frames
from fluoromap_service.dicom.facts import Pair

_RING_PX = 4
_COLOURS = (255, 80, 80), (80, 230, 80), (110, 170, 255), (255, 110, 255), (255, 190, 60), (90, 255, 255)


class ScaleSource(StrEnum):
    """The source of the pixels per millimetre."""

    MEASURED = "measured"
    """The geometry of the run: header and study."""
    FOUND = "found"
    """The scale at which the study's catheters explain the pictures best, right to about 20 %."""
    UNKNOWN = "unknown"
    """No scale explains the pictures."""


@dataclass(frozen=True, slots=True)
class PreviewElectrode:
    """One electrode in stored pixels; ``catheter`` is the most probable one that no other chain has."""

    catheter: str | None
    electrode: int
    u_px: float
    v_px: float
    sd_px: float


@dataclass(frozen=True, slots=True)
class FramePreview:
    """The electrodes of one frame.

    px_per_mm : at the isocentre, None where ``scale`` is unknown. inverted : whether high values are dark although the header does
    not say so.
    """

    px_per_mm: float | None
    scale: ScaleSource
    inverted: bool
    electrodes: tuple[PreviewElectrode, ...]


def preview_electrodes(
    path: Path, facts: InstanceFacts, catalogue: Catalogue, frame: int, px_per_mm: float | None
) -> FramePreview:
    """Find the electrodes of one frame (from 0) of a file.

    Parameters
    ----------
    path : Path
    facts : InstanceFacts
    catalogue : Catalogue
        Of the study.
    frame : int
    px_per_mm : float or None
        At the isocentre; None while the geometry is incomplete.
    """
    frames = open_frames(path, facts)
    run = Run(frames, np.array(facts.frame_times_ms), px_per_mm or 1.0, facts.pixels, facts.r_wave_frames)
    seen = build_previewer().preview(run, catalogue, frame, px_per_mm is not None)
    scale = ScaleSource.UNKNOWN if seen.px_per_mm is None else ScaleSource.MEASURED
    if seen.scale_found:
        scale = ScaleSource.FOUND
    electrodes = tuple(
        PreviewElectrode(name, number, float(u), float(v), math.sqrt(max(float(covariance.trace()) / 2, 0.0)))
        for chain, name in zip(seen.chains, likely_names(seen.chains), strict=True)
        for number, (u, v), covariance in zip(chain.electrodes, chain.pixels_uv, chain.covariance_px2, strict=True)
    )
    return FramePreview(seen.px_per_mm, scale, seen.inverted, electrodes)


def preview_png(
    path: Path, facts: InstanceFacts, catalogue: Catalogue, frame: int, px_per_mm: float | None, window: Pair | None
) -> bytes:
    """Return the frame as a PNG with a ring round each electrode that :func:`preview_electrodes` finds."""
    found = preview_electrodes(path, facts, catalogue, frame, px_per_mm)
    grey = frame_to_8bit(open_frames(path, facts)[frame], facts, window)
    picture = Image.fromarray(255 - grey if found.inverted else grey).convert("RGB")
    pen = ImageDraw.Draw(picture)
    for one in found.electrodes:
        number = catalogue.names.index(one.catheter) if one.catheter in catalogue.names else len(catalogue.names)
        colour = _COLOURS[number % len(_COLOURS)]
        u, v = one.u_px, one.v_px
        pen.ellipse([u - _RING_PX, v - _RING_PX, u + _RING_PX, v + _RING_PX], outline=colour)
        if one.electrode == 1:
            pen.text((u + 2 * _RING_PX, v), one.catheter or "", fill=colour)
    stored = io.BytesIO()
    picture.save(stored, "PNG")
    return stored.getvalue()
