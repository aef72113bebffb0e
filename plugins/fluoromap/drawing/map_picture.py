"""A still picture of the map from six standard directions."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw

from fluoromap.contracts import Array, ChamberMap
from fluoromap.drawing.annotations import purpose_text
from fluoromap.drawing.colour_bar import draw_colour_bar
from fluoromap.drawing.colours import Scale, scale_of
from fluoromap.drawing.isochrones import Isochrone, isochrones
from fluoromap.drawing.lettering import Labels, Point, font, line_with_squares
from fluoromap.drawing.raster import rasterise
from fluoromap.drawing.symbols import draw_dot, draw_time, is_doubtful
from fluoromap.drawing.wall import colour_table, line_parts, outline_edges, pixel_bands
from fluoromap.fuser.surface import face_normals
from fluoromap.geometry import view_axes

Direction = tuple[str, float, float, tuple[str, str, str, str]]

VIEWS: tuple[Direction, ...] = (
    ("AP", 0, 0, ("R", "L", "H", "F")),
    ("LAO 45", 45, 0, ("R-A", "L-P", "H", "F")),
    ("left lateral (LAO 90)", 90, 0, ("A", "P", "H", "F")),
    ("PA", 180, 0, ("L", "R", "H", "F")),
    ("RAO 30", -30, 0, ("R-P", "L-A", "H", "F")),
    ("from the feet", 0, -90, ("R", "L", "A", "P")),
)
"""Name, primary and secondary C-arm angle in degrees, letters of the patient's directions left, right, top, bottom."""

PANELS_A_ROW = 3
PANEL_PX = 340
GAP_PX = 28
"""Space between panels, so that the letters of two neighbours do not look like one word."""
MARGIN_PX = 40
BAR_PX = 110
FOOTER_PX = 40
LETTERS_PX = 12
BACKGROUND = (250, 250, 248)
INK = (45, 45, 50)
SMOOTH = 2
"""Factor by which panels are drawn larger and then averaged, for smooth edges."""


def map_picture_size(views: Sequence[Direction] = VIEWS) -> tuple[int, int]:
    """Return rows and columns of a picture of the map, px."""
    pitch = PANEL_PX + GAP_PX
    rows = -(-len(views) // PANELS_A_ROW)
    return rows * pitch - GAP_PX + FOOTER_PX, PANELS_A_ROW * pitch - GAP_PX + BAR_PX


def draw_map_views(
    chamber: ChamberMap,
    views: Sequence[Direction] = VIEWS,
    like: ChamberMap | None = None,
    times: Scale | None = None,
    *,
    simulated: bool = False,
) -> NDArray[np.uint8]:
    """Draw the map from several directions.

    The picture has sites, isochrones, colour bar and figures of merit. All panels are orthographic and have one scale.
    The viewer is at the place of a C-arm's detector. Sites on the far wall are not drawn.

    Parameters
    ----------
    chamber : ChamberMap
    views : sequence of Direction
        As in :data:`VIEWS`; a row has three.
    like : ChamberMap or None
        Another map whose middle and size place this one in its panels, so that pictures of both can be compared.
    times : Scale or None
        Colour scale that several pictures share; None chooses the map's own.
    simulated : bool
        Write below the map that the data are simulated.

    Returns
    -------
    (rows, columns, 3) uint8
        RGB.
    """
    times = times or scale_of(chamber)
    lines = isochrones(chamber, times.edges_ms)
    extent = (like or chamber).vertices_mm
    middle = (extent.max(axis=0) + extent.min(axis=0)) / 2
    radius = float(np.linalg.norm(extent - middle, axis=1).max())
    px_per_mm = (PANEL_PX / 2 - MARGIN_PX) / radius
    pitch = PANEL_PX + GAP_PX
    rows, columns = map_picture_size(views)
    width, height = columns - BAR_PX, rows - FOOTER_PX
    picture = Image.new("RGB", (columns, rows), BACKGROUND)
    for index, (name, primary, secondary, letters) in enumerate(views):
        panel = _Panel(primary, secondary, middle, px_per_mm).draw(chamber, lines, times)
        _caption(panel, name, letters)
        picture.paste(panel, (pitch * (index % PANELS_A_ROW), pitch * (index // PANELS_A_ROW)))
    _scale_bar(ImageDraw.Draw(picture), px_per_mm, (width + 14.0, height + 0.55 * FOOTER_PX))
    draw_colour_bar(picture, times, 14, dark=False)
    place = (width / 2, height + 0.4 * FOOTER_PX)
    line_with_squares(ImageDraw.Draw(picture), place, _figures(chamber, simulated), 14, INK)
    return np.asarray(picture)


class _Panel:
    """One direction: an orthographic camera with the image axes of a C-arm at the same angles."""

    def __init__(self, primary_deg: float, secondary_deg: float, middle_mm: Array, px_per_mm: float) -> None:
        axes = view_axes(primary_deg, secondary_deg)
        self._axes, self._to_viewer = axes[:2], axes[2]
        self._middle = middle_mm
        self._px_per_mm = px_per_mm

    def project(self, points_mm: Array, factor: int) -> tuple[Array, Array]:
        """Return picture coordinates (k, 2) and nearness to the viewer (k,), mm.

        The panel is ``factor`` times as large.
        """
        offset = points_mm - self._middle
        uv = (offset @ self._axes.T * self._px_per_mm + PANEL_PX / 2) * factor - 0.5
        return uv, offset @ self._to_viewer

    def draw(self, chamber: ChamberMap, lines: tuple[Isochrone, ...], times: Scale) -> Image.Image:
        normals = face_normals(chamber.vertices_mm, chamber.faces)
        lengths = np.maximum(np.linalg.norm(normals, axis=1), 1e-12)
        towards = normals @ self._to_viewer / lengths
        facing = towards > 0
        uv, nearness = self.project(chamber.vertices_mm, SMOOTH)
        side = PANEL_PX * SMOOTH
        raster = rasterise(uv, nearness, chamber.faces, facing, (side, side))
        colours = colour_table(times, BACKGROUND)[pixel_bands(raster, chamber, times, SMOOTH)]
        # Light from the viewer, so weak that each colour can still be found on the bar. The background has none.
        light = np.append(0.78 + 0.22 * np.clip(towards, 0, 1), 1.0).astype(np.float32)
        pixels = (colours * light[raster.face][..., None]).round().astype(np.uint8)

        image = Image.fromarray(pixels)
        pen = ImageDraw.Draw(image)
        for line in lines:
            at, near = self.project(line.points_mm, SMOOTH)
            in_front = facing[line.faces] & raster.visible((at[1:] + at[:-1]) / 2, (near[1:] + near[:-1]) / 2)
            for part in line_parts(in_front):
                pen.line((at[part] + 0.5).ravel().tolist(), fill=(255, 255, 255), width=SMOOTH, joint="curve")
        for edge in outline_edges(chamber.faces, facing):
            pen.line((uv[edge] + 0.5).ravel().tolist(), fill=INK, width=SMOOTH)
        image = image.reduce(SMOOTH)

        visible = raster.visible(*self.project(np.array([site.surface_mm for site in chamber.sites]), SMOOTH))
        places = self.project(np.array([site.surface_mm for site in chamber.sites]), 1)[0].tolist()
        front = [index for index in range(len(places)) if visible[index]]
        taken = [(places[i][0] - 4, places[i][1] - 4, places[i][0] + 4, places[i][1] + 4) for i in front]
        labels = Labels(PANEL_PX, PANEL_PX, taken)
        for i in front:
            u, v = places[i]
            draw_time(
                ImageDraw.Draw(image), labels, (u, v), chamber.sites[i], 1.0, LETTERS_PX, near=True, on_light=True
            )
        for i in front:
            u, v = places[i]
            draw_dot(image, (u, v), chamber.sites[i], times, 1.0, near=True)
        return image


def _caption(panel: Image.Image, name: str, letters: tuple[str, str, str, str]) -> None:
    draw = ImageDraw.Draw(panel)
    draw.text((12, 10), name, fill=INK, font=font(15))
    middle, far = PANEL_PX / 2, PANEL_PX - 12
    left, right, top, bottom = letters
    for place, letter in (((12, middle), left), ((far, middle), right), ((middle, 16), top), ((middle, far), bottom)):
        draw.text(place, letter, fill=(140, 140, 145), font=font(12), anchor="mm")


def _scale_bar(draw: ImageDraw.ImageDraw, px_per_mm: float, start: Point) -> None:
    length_mm = next(length for length in (50, 20, 10, 5, 2, 1) if length * px_per_mm <= 90 or length == 1)
    left, level = start
    right = left + length_mm * px_per_mm
    draw.line((left, level, right, level), fill=INK, width=2)
    for end in (left, right):
        draw.line((end, level - 4, end, level + 4), fill=INK, width=2)
    draw.text(((left + right) / 2, level - 12), f"{length_mm} mm", fill=INK, font=font(12), anchor="mm")


def _figures(chamber: ChamberMap, simulated: bool) -> str:
    parts = [
        purpose_text(simulated=simulated),
        f"{len(chamber.sites)} sites",
        f"total activation time {chamber.total_activation_time_ms:.0f} ms",
        f"volume {chamber.volume_ml:.0f} ml",
        f"area {chamber.area_cm2:.0f} cm²",
        f"{100 * chamber.coverage:.0f} % covered",
    ]
    if chamber.leave_one_out_rms_ms is not None:
        parts.insert(3, f"leave-one-site-out error {chamber.leave_one_out_rms_ms:.1f} ms")
    doubtful = sum(is_doubtful(site) for site in chamber.sites)
    if doubtful:
        parts.append(f"{doubtful} doubtful (?)")
    return "   ·   ".join(parts)
