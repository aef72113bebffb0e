"""Overlay of the map on a fluoroscopy frame."""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import ArrayLike, NDArray
from PIL import Image, ImageDraw

from fluoromap.contracts import Array, BoolArray, ChamberMap
from fluoromap.drawing.annotations import annotation_boxes, direction_text, draw_annotations, purpose_text
from fluoromap.drawing.colour_bar import bar_box, draw_colour_bar
from fluoromap.drawing.colours import Palette, Scale, milliseconds, scale_of
from fluoromap.drawing.electrodes import draw_electrodes
from fluoromap.drawing.isochrones import isochrones
from fluoromap.drawing.lettering import BLACK, PHRASE_GAP, RGB, WHITE, Box, Labels, Point, halo_text
from fluoromap.drawing.raster import Raster, rasterise
from fluoromap.drawing.symbols import draw_dot, draw_star, draw_time, is_outlier, time_text
from fluoromap.drawing.wall import HATCH, NO_DATA, NOTHING, colour_table, line_parts, outline_edges, pixel_bands
from fluoromap.fuser.surface import face_normals
from fluoromap.geometry import Camera

Picture = NDArray[np.uint8]

TINT = 0.32
"""Share of the map's colour in a pixel; electrodes keep two thirds of their contrast."""

HATCH_TINT = 0.4
LINE_SHARE = 0.5
OUTLINE_SHARE = 0.9
OUTLINE_RGB = (140, 225, 255)
LEAST_DEPTH_MM = 10.0
OUT_OF_SIGHT_PX = -1e6
CHI2_95_2D = 5.991464547107979
ELLIPSE_RGB = (255, 255, 120)


@dataclass(frozen=True, eq=False)
class Look:
    """Options of an overlay.

    scale : pixels of the picture per pixel of the frame, along each side. palette, step_ms : of the isochrones; a step of
    None suits the map. covariances_mm2 : site -> (3, 3) of its position, drawn as the 95 % ellipse. until_ms : the wall is
    coloured only where it is activated by this time, and the front is a thick line; None colours all. times : colour scale
    that several pictures share, instead of palette and step. electrodes_uv : catheter -> (k, 2)
    pixels of its electrodes in the frame, drawn as rings; the order of the catheters gives the colours. simulated : the
    caption says that the data are simulated.
    """

    scale: int = 1
    palette: Palette = "safe"
    step_ms: float | None = None
    covariances_mm2: Mapping[str, Array] = field(default_factory=dict)
    until_ms: float | None = None
    times: Scale | None = None
    electrodes_uv: Mapping[str, Array] = field(default_factory=dict)
    simulated: bool = False

    def __post_init__(self) -> None:
        if self.scale < 1:
            raise ValueError(f"scale must be 1 or more, not {self.scale}")
        if self.step_ms is not None and not self.step_ms > 0:
            raise ValueError(f"step_ms must be positive, not {self.step_ms}")


def draw_overlay(
    frame: NDArray[np.uint8],
    camera: Camera,
    chamber: ChamberMap,
    shift_world_mm: ArrayLike,
    highlight_site: str,
    tip_uv: ArrayLike | None,
    look: Look | None = None,
) -> Picture:
    """Draw the map projected into a frame, as the paper fuses it.

    The viewer looks from the detector, as in the displayed image. The overlay shows:

    - the bands and lines of equal time on the wall that faces the viewer,
    - a hatch where no site is near,
    - the outline of the surface,
    - every site with its time in ms: a dot on the wall that faces the viewer, a ring on the far wall; the time is amber with a
      question mark where the site is in doubt,
    - a star at the highlighted site's tip,
    - the electrodes of the frame where ``look`` has them, with the names of their catheters,
    - a colour bar,
    - site, direction of the view and purpose, the orientation of the patient, and the meaning of the symbols.

    Parameters
    ----------
    frame : (rows, columns) uint8
        Stored pixels after windowing.
    camera : Camera
        Camera of this run, for stored pixels.
    chamber : ChamberMap
        Map relative to the reference catheter.
    shift_world_mm : (3,)
        Position of the reference catheter in this run: world = map + shift.
    highlight_site : str
        The site of this run; for a name that is not in the map no time is drawn.
    tip_uv : (2,) or None
        Pixel of the tip in this frame; None uses the site's position in the map.
    look : Look

    Returns
    -------
    (rows * scale, columns * scale, 3) uint8
        RGB; pixel (u, v) of the frame has its centre at ((u + 0.5) * scale - 0.5, (v + 0.5) * scale - 0.5).

    Raises
    ------
    ValueError
        Where the frame does not have the camera's size.
    """
    if frame.dtype != np.uint8 or frame.shape != (camera.rows, camera.columns):
        raise ValueError(
            f"the frame must be uint8 of the camera's shape {(camera.rows, camera.columns)}, "
            f"not {frame.dtype} of shape {frame.shape}"
        )
    look = look or Look()
    canvas = _Canvas(camera.translated(shift_world_mm), look.scale)
    times = look.times or scale_of(chamber, look.step_ms, look.palette)
    size = (camera.columns * look.scale, camera.rows * look.scale)
    # Another processor may enlarge the frame meanwhile.
    with ThreadPoolExecutor(1) as thread:
        enlarged = thread.submit(_enlarged, frame, size)
        facing = canvas.facing(chamber)
        raster = rasterise(*canvas.project(chamber.vertices_mm), chamber.faces, facing, size[::-1])
        bands = pixel_bands(raster, chamber, times, canvas.unit, look.until_ms)
        image = enlarged.result()
    _tint(image, bands, times, raster.box)
    _draw_lines(image, canvas, chamber, facing, times, look)
    caption = PHRASE_GAP.join([highlight_site, direction_text(camera), purpose_text(simulated=look.simulated)])
    words = annotation_boxes(image.size, canvas.letters, caption)
    draw_electrodes(image, {name: canvas.to_picture(uv) for name, uv in look.electrodes_uv.items()}, canvas.unit)
    _draw_sites(image, canvas, chamber, raster, highlight_site, tip_uv, times, look.until_ms, words)
    draw_annotations(image, camera, caption, canvas.letters)
    if look.until_ms is not None:
        text, size_px = f"{milliseconds(look.until_ms)} ms", round(1.6 * canvas.letters)
        halo_text(ImageDraw.Draw(image), (3.2 * size_px, 1.6 * size_px), text, size_px, WHITE, BLACK)
    return np.asarray(image)


def _enlarged(frame: NDArray[np.uint8], size: tuple[int, int]) -> Image.Image:
    """Return the frame as an RGB picture of ``size`` (columns, rows)."""
    grey = Image.fromarray(frame)
    if grey.size != size:
        grey = grey.resize(size, Image.Resampling.BICUBIC)
    return Image.merge("RGB", (grey, grey, grey))


class _Canvas:
    """Projection of the map into the picture, and the sizes of lines and letters."""

    def __init__(self, camera: Camera, scale: int) -> None:
        self._camera = camera
        self._scale = scale
        self.unit = scale * float(np.clip(min(camera.rows, camera.columns) / 512, 0.6, 3.0))
        self.letters = max(9, round(12 * self.unit))

    def to_picture(self, uv: Array) -> Array:
        """Return picture coordinates (..., 2) of frame pixels (..., 2)."""
        picture_uv: Array = (uv + 0.5) * self._scale - 0.5
        return picture_uv

    def project(self, points_mm: Array) -> tuple[Array, Array]:
        """Return picture coordinates (k, 2) and nearness to the detector (k,): the depth from the source, mm."""
        depth = self._camera.depth_mm(points_mm)
        # The projection of a point behind the source would be mirrored.
        behind = depth < LEAST_DEPTH_MM
        uv = self._camera.project(np.where(behind[:, None], self._camera.axis_world * 1e3, points_mm))
        return self.to_picture(np.where(behind[:, None], OUT_OF_SIGHT_PX, uv)), depth

    def ellipse(self, point_mm: Array, covariance_mm2: Array) -> Array:
        """Return the outline (k, 2) of a point's 95 % ellipse.

        It is the ellipse of the point's projection into the picture, to first order.
        """
        step = 1e-3
        ends = self.project(point_mm + step * np.concatenate([np.eye(3), -np.eye(3)]))[0]
        jacobian = (ends[:3] - ends[3:]).T / (2 * step)
        values, vectors = np.linalg.eigh(jacobian @ covariance_mm2 @ jacobian.T)
        angles = np.linspace(0, 2 * np.pi, 49)
        circle = np.stack([np.cos(angles), np.sin(angles)]) * np.sqrt(CHI2_95_2D * np.maximum(values, 0.0))[:, None]
        outline: Array = self.project(point_mm[None])[0] + (vectors @ circle).T
        return outline

    def facing(self, chamber: ChamberMap) -> BoolArray:
        """Return True for faces that face the detector.

        The ray from the source leaves the chamber through such a face.
        """
        normals = face_normals(chamber.vertices_mm, chamber.faces)
        rays = chamber.vertices_mm[chamber.faces].mean(axis=1) - self._camera.source_world_mm
        outward: BoolArray = (normals * rays).sum(axis=1) > 0
        return outward


def _tint(image: Image.Image, bands: NDArray[np.int32], times: Scale, box: tuple[slice, slice]) -> None:
    """Blend the colours of the bands into the picture.

    ``box`` contains all pixels with a colour.
    """
    rows, columns = box
    if rows.start >= rows.stop or columns.start >= columns.stop:
        return
    bands = bands[box]
    shares = np.full(times.bands + 3, TINT)
    shares[[NOTHING, HATCH, NO_DATA]] = 0.0, HATCH_TINT, 0.0
    table = np.column_stack([colour_table(times, BLACK), (255 * shares).round().astype(np.uint8)])
    # Indexing one number a pixel is several times faster than indexing four.
    layer = Image.fromarray(table.view(np.uint32)[:, 0][bands].view(np.uint8).reshape(*bands.shape, 4))
    image.paste(layer, (columns.start, rows.start), layer)


def _draw_lines(
    image: Image.Image, canvas: _Canvas, chamber: ChamberMap, facing: BoolArray, times: Scale, look: Look
) -> None:
    """Draw isochrones, outline and ellipses.

    They are drawn at twice the size and averaged, for smooth lines.
    """
    thickness = max(2, round(2 * canvas.unit))

    def draw(lines: Sequence[Array], colour: RGB, share: float, width: int) -> None:
        if not len(lines):
            return
        points = np.concatenate(lines)
        low = np.clip(np.floor(points.min(axis=0) - width), 0, image.size).astype(np.int64)
        high = np.clip(np.ceil(points.max(axis=0) + width), 0, image.size).astype(np.int64)
        if (high <= low).any():
            return
        mask = Image.new("L", tuple((2 * (high - low)).tolist()))
        pen = ImageDraw.Draw(mask)
        # Pillow truncates coordinates; adding half a pixel rounds them.
        coordinates = ((points - low + 0.5) * 2).ravel().tolist()
        ends = np.cumsum([line.size for line in lines]).tolist()
        for start, end in itertools.pairwise([0, *ends]):
            pen.line(coordinates[start:end], fill=round(255 * share), width=width, joint="curve")
        image.paste(colour, (*low.tolist(), *high.tolist()), mask.reduce(2))

    def near(levels_ms: Array) -> list[Array]:
        """Return the parts of the isochrones on the wall that faces the viewer."""
        lines = isochrones(chamber, levels_ms)
        if not lines:
            return []
        # All lines go through one call, with a gap after each.
        at = canvas.project(np.concatenate([line.points_mm for line in lines]))[0]
        in_front = np.concatenate([np.append(facing[line.faces], False) for line in lines])
        return [at[part] for part in line_parts(in_front[:-1])]

    levels = times.edges_ms
    draw(near(levels if look.until_ms is None else levels[levels < look.until_ms]), WHITE, LINE_SHARE, thickness)
    if look.until_ms is not None:
        draw(near(np.array([look.until_ms])), WHITE, 1.0, 3 * thickness)
    outline = canvas.project(chamber.vertices_mm)[0][outline_edges(chamber.faces, facing)]
    draw(list(outline), OUTLINE_RGB, OUTLINE_SHARE, round(1.5 * thickness))
    for site in chamber.sites:
        if site.site in look.covariances_mm2:
            ellipse = canvas.ellipse(site.position_mm, look.covariances_mm2[site.site])
            draw([ellipse], ELLIPSE_RGB, OUTLINE_SHARE, thickness)


def _draw_sites(
    image: Image.Image, canvas: _Canvas, chamber: ChamberMap, raster: Raster, highlight_site: str,
    tip_uv: ArrayLike | None, times: Scale, until_ms: float | None, words: Sequence[Box],
) -> None:  # fmt: skip
    size, unit = canvas.letters, canvas.unit
    uv, _ = canvas.project(np.array([site.position_mm for site in chamber.sites]))
    places: list[Point] = [(float(u), float(v)) for u, v in uv]
    on_near_wall = raster.visible(*canvas.project(np.array([site.surface_mm for site in chamber.sites])))
    index = next((i for i, site in enumerate(chamber.sites) if site.site == highlight_site), None)
    highlighted = None if index is None else chamber.sites[index]
    star = None if index is None else places[index]
    if tip_uv is not None:
        u, v = canvas.to_picture(np.asarray(tip_uv, dtype=np.float64)).tolist()
        star = (u, v)

    others = [i for i in range(len(places)) if i != index]
    marks = [places[i] for i in others] + ([] if star is None else [star])
    reach = 4 * unit
    taken = [(u - reach, v - reach, u + reach, v + reach) for u, v in marks]
    labels = Labels(image.width, image.height, [*taken, *words, bar_box(times, image.size, size)])
    draw = ImageDraw.Draw(image)
    if star is not None and highlighted is not None:
        text, larger = f"{time_text(highlighted)} ms", round(1.25 * size)
        halo_text(draw, labels.place(star, text, larger, 10 * unit), text, larger, WHITE, BLACK)
    for i in others:
        draw_time(draw, labels, places[i], chamber.sites[i], unit, size, near=bool(on_near_wall[i]))
    for i in others:
        draw_dot(image, places[i], chamber.sites[i], times, unit, near=bool(on_near_wall[i]))
    if star is not None:
        draw_star(image, star, 8 * unit)
    mark = until_ms
    if mark is None and highlighted is not None and not is_outlier(highlighted):
        mark = highlighted.lat_ms
    draw_colour_bar(image, times, size, dark=True, mark_ms=mark)
