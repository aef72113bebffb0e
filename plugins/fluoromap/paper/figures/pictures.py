"""The figures as pictures: one map above the other with the same colours, and a caption."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw

from fluoromap.contracts import ChamberMap
from fluoromap.drawing.colours import Scale, scale_of
from fluoromap.drawing.lettering import font, text_size
from fluoromap.drawing.map_picture import BACKGROUND, INK, VIEWS, draw_map_views
from fluoromap.drawing.overlay import Look, Picture, draw_overlay
from fluoromap.paper.figures.moment import MomentInView

_DIRECTIONS = ("AP", "left lateral (LAO 90)", "PA")
_OVERLAY_SCALE = 2
_BORDER_PX = 16
_TITLE_PX, _HEADING_PX, _CAPTION_PX = 26, 21, 19
_LINE = 1.45
"""Height of a line as a multiple of the height of its letters."""


def shared_scale(first: ChamberMap, second: ChamberMap) -> Scale:
    """Return iso-time steps that cover both maps."""
    step = max(scale_of(first).step_ms, scale_of(second).step_ms)
    scales = [scale_of(chamber, step) for chamber in (first, second)]
    start, stop = min(scale.start_ms for scale in scales), max(scale.stop_ms for scale in scales)
    return Scale(start, step, round((stop - start) / step))


def in_space(moment: MomentInView) -> tuple[Picture, Picture]:
    """Draw both maps in 3D at one scale: exact depth, single-view depth."""
    times = shared_scale(moment.exact, moment.single_view)
    views = [view for view in VIEWS if view[0] in _DIRECTIONS]
    exact = draw_map_views(moment.exact, views, times=times, simulated=True)
    return exact, draw_map_views(moment.single_view, views, like=moment.exact, times=times, simulated=True)


def on_frame(moment: MomentInView, site: str, stored: NDArray[np.uint16]) -> tuple[Picture, Picture]:
    """Draw both maps on the frame of one site: exact depth, single-view depth.

    ``stored`` are the frame's pixels.
    """
    shown = moment.site(site)
    low, high = np.percentile(stored, [0.5, 99.5])
    frame = np.clip((stored - low) / (high - low) * 255, 0, 255).round().astype(np.uint8)
    look = Look(_OVERLAY_SCALE, times=shared_scale(moment.exact, moment.single_view), simulated=True)
    exact = draw_overlay(frame, shown.camera, moment.exact, shown.exact_origin_mm, site, shown.tip_uv, look)
    single_view = draw_overlay(
        frame, shown.camera, moment.single_view, shown.single_view_origin_mm, site, shown.tip_uv, look
    )
    return exact, single_view


def figure(title: str, parts: Sequence[tuple[str, Picture]], caption: Sequence[str]) -> Picture:
    """Draw pictures one above the other with title, headings and caption.

    Returns
    -------
    (rows, columns, 3) uint8
        RGB.
    """
    width = max(picture.shape[1] for _, picture in parts)
    lines = [line for sentence in caption for line in _wrap(sentence, width)]
    heights = [_line_px(_HEADING_PX) + picture.shape[0] for _, picture in parts]
    height = _line_px(_TITLE_PX) + sum(heights) + len(lines) * _line_px(_CAPTION_PX)
    page = Image.new("RGB", (width + 2 * _BORDER_PX, height + (len(parts) + 2) * _BORDER_PX), BACKGROUND)
    draw = ImageDraw.Draw(page)
    top = _BORDER_PX
    draw.text((_BORDER_PX, top), title, fill=INK, font=font(_TITLE_PX))
    top += _line_px(_TITLE_PX)
    for heading, picture in parts:
        draw.text((_BORDER_PX, top), heading, fill=INK, font=font(_HEADING_PX))
        top += _line_px(_HEADING_PX)
        page.paste(Image.fromarray(picture), (_BORDER_PX, top))
        top += picture.shape[0] + _BORDER_PX
    for line in lines:
        draw.text((_BORDER_PX, top), line, fill=INK, font=font(_CAPTION_PX))
        top += _line_px(_CAPTION_PX)
    return np.asarray(page)


def _line_px(size: int) -> int:
    return round(_LINE * size)


def _wrap(sentence: str, width_px: int) -> Iterator[str]:
    line = ""
    for word in sentence.split():
        longer = f"{line} {word}".strip()
        if line and text_size(longer, _CAPTION_PX)[0] > width_px:
            yield line
            longer = word
        line = longer
    yield line
