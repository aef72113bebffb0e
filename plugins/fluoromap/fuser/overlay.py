"""The map fused on a fluoroscopy frame."""

from __future__ import annotations

import io
from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import ArrayLike, NDArray
from PIL import Image, ImageDraw

from fluoromap.contracts import Array, BoolArray, ChamberMap
from fluoromap.fuser.colours import Palette, Scale, milliseconds, scale_of
from fluoromap.fuser.isochrones import isochrones
from fluoromap.fuser.lettering import BLACK, WHITE, Labels, Point, bar_box, draw_colour_bar, halo_text
from fluoromap.fuser.raster import Raster, rasterise
from fluoromap.fuser.surface import face_normals
from fluoromap.fuser.symbols import draw_dot, draw_star, draw_time, is_outlier, time_text
from fluoromap.fuser.wall import outline_edges, pixel_colours, runs
from fluoromap.geometry import Camera

Picture = NDArray[np.uint8]

TINT = 0.32
"""Share of the map's colour in a pixel: electrodes keep two thirds of their contrast."""

HATCH_TINT = 0.4
OUTLINE_RGB = (140, 225, 255)
LEAST_DEPTH_MM = 10.0
OUT_OF_SIGHT_PX = -1e6
CHI2_95_2D = 5.991464547107979
ELLIPSE_RGB = (255, 255, 120)
PNG_LEVEL = 2
"""Noise does not compress: more effort takes up to twice as long and saves a tenth."""


@dataclass(frozen=True, eq=False)
class Look:
    """How an overlay is drawn.

    scale : pixels of the picture per pixel of the frame, along each side. palette, step_ms : of the isochrones, None being
    the step that suits the map. covariances_mm2 : site -> (3, 3) of its position, drawn as the 95 % ellipse. until_ms : the
    wall is coloured only where it is activated by then, its front a thick line; None colours all. times : colour scale that
    several pictures share, in place of palette and step.
    """

    scale: int = 1
    palette: Palette = "safe"
    step_ms: float | None = None
    covariances_mm2: Mapping[str, Array] = field(default_factory=dict)
    until_ms: float | None = None
    times: Scale | None = None

    def __post_init__(self) -> None:
        if self.scale < 1:
            raise ValueError("scale must be 1 or more")
        if self.step_ms is not None and not self.step_ms > 0:
            raise ValueError("step_ms must be positive")


def draw_overlay(
    frame: NDArray[np.uint8],
    camera: Camera,
    chamber: ChamberMap,
    shift_world_mm: ArrayLike,
    highlight_site: str,
    tip_uv: ArrayLike | None,
    look: Look | None = None,
) -> Picture:
    """The map projected into a frame, as the paper fuses it.

    Drawn are the bands and lines of equal time on the wall that faces the viewer, who looks from the detector as the
    displayed image does; a hatch where no site is near; the hull's outline; every site with its time in ms (filled: on
    the wall facing the viewer, ring: on the far wall; amber with a question mark: contradicted by its neighbours); a star
    at the highlighted site's tip; a colour bar.

    Parameters
    ----------
    frame : (rows, columns) uint8
        Stored pixels after windowing.
    camera : Camera
        Of this run, for stored pixels.
    chamber : ChamberMap
        Relative to the reference catheter.
    shift_world_mm : (3,)
        Position of the reference catheter in this run: world = map + shift.
    highlight_site : str
        The site this run belongs to; a name that is not in the map draws no time.
    tip_uv : (2,) or None
        Where the tip was seen in this frame; None takes the site's position from the map.
    look : Look

    Returns
    -------
    (rows * scale, columns * scale, 3) uint8
        RGB; pixel (u, v) of the frame has its centre at ((u + 0.5) * scale - 0.5, (v + 0.5) * scale - 0.5).

    Raises
    ------
    ValueError
        When the frame is not of the camera's size.
    """
    if frame.dtype != np.uint8 or frame.shape != (camera.rows, camera.columns):
        raise ValueError(f"the frame must be uint8 of shape {(camera.rows, camera.columns)}, not {frame.shape}")
    look = look or Look()
    canvas = _Canvas(camera.translated(shift_world_mm), look.scale)
    times = look.times or scale_of(chamber, look.step_ms, look.palette)
    size = (camera.columns * look.scale, camera.rows * look.scale)
    grey = Image.fromarray(frame)
    picture = np.array(grey if look.scale == 1 else grey.resize(size, Image.Resampling.BICUBIC))
    rgb = np.repeat(picture[..., None], 3, axis=2)

    facing = canvas.facing(chamber)
    raster = rasterise(*canvas.project(chamber.vertices_mm), chamber.faces, facing, picture.shape)
    _tint(rgb, raster, chamber, times, canvas.unit, look.until_ms)
    image = Image.fromarray(rgb)
    _draw_lines(image, canvas, chamber, facing, times, look)
    _draw_sites(image, canvas, chamber, raster, highlight_site, tip_uv, times, look.until_ms)
    if look.until_ms is not None:
        text, size_px = f"{milliseconds(look.until_ms)} ms", round(1.6 * canvas.letters)
        halo_text(ImageDraw.Draw(image), (3.2 * size_px, size_px), text, size_px, WHITE, BLACK)
    return np.asarray(image)


def encode_png(picture: Picture) -> bytes:
    """PNG of an RGB or grey picture; the same picture gives the same bytes."""
    stream = io.BytesIO()
    Image.fromarray(picture).save(stream, format="PNG", compress_level=PNG_LEVEL)
    return stream.getvalue()


class _Canvas:
    """Where map coordinates lie in the picture, and how thick a line or a letter is there."""

    def __init__(self, camera: Camera, scale: int) -> None:
        self._camera = camera
        self._scale = scale
        self.unit = scale * float(np.clip(min(camera.rows, camera.columns) / 512, 0.6, 3.0))
        self.letters = max(9, round(12 * self.unit))

    def to_picture(self, uv: Array) -> Array:
        placed: Array = (uv + 0.5) * self._scale - 0.5
        return placed

    def project(self, points_mm: Array) -> tuple[Array, Array]:
        """Picture coordinates (k, 2) and nearness to the detector (k,): the depth from the source."""
        depth = self._camera.depth_mm(points_mm)
        # What lies behind the source would come out mirrored.
        behind = depth < LEAST_DEPTH_MM
        uv = self._camera.project(np.where(behind[:, None], self._camera.axis_world * 1e3, points_mm))
        return self.to_picture(np.where(behind[:, None], OUT_OF_SIGHT_PX, uv)), depth

    def ellipse(self, point_mm: Array, covariance_mm2: Array) -> Array:
        """Outline (k, 2) in the picture of the 95 % ellipse of a point's projection, to first order."""
        step = 1e-3
        ends = self.project(point_mm + step * np.concatenate([np.eye(3), -np.eye(3)]))[0]
        jacobian = (ends[:3] - ends[3:]).T / (2 * step)
        values, vectors = np.linalg.eigh(jacobian @ covariance_mm2 @ jacobian.T)
        angles = np.linspace(0, 2 * np.pi, 49)
        circle = np.stack([np.cos(angles), np.sin(angles)]) * np.sqrt(CHI2_95_2D * np.maximum(values, 0.0))[:, None]
        outline: Array = self.project(point_mm[None])[0] + (vectors @ circle).T
        return outline

    def facing(self, chamber: ChamberMap) -> BoolArray:
        """Faces whose outer side looks at the detector: the ray from the source leaves the chamber through them."""
        normals = face_normals(chamber.vertices_mm, chamber.faces)
        rays = chamber.vertices_mm[chamber.faces].mean(axis=1) - self._camera.source_world_mm
        outward: BoolArray = (normals * rays).sum(axis=1) > 0
        return outward


def _tint(rgb: Picture, raster: Raster, chamber: ChamberMap, times: Scale, unit: float, until_ms: float | None) -> None:
    colours, covered, hatched = pixel_colours(raster, chamber, times, unit, until_ms)
    share = np.where(covered, np.float32(TINT), np.where(hatched, np.float32(HATCH_TINT), np.float32(0.0)))[:, None]
    v, u = raster.pixels
    under = rgb[v, u].astype(np.float32)
    colours -= under
    colours *= share
    colours += under
    rgb[v, u] = colours.round(out=colours).astype(np.uint8)


def _draw_lines(
    image: Image.Image, canvas: _Canvas, chamber: ChamberMap, facing: BoolArray, times: Scale, look: Look
) -> None:
    """Isochrones, outline and ellipses, drawn at twice the size and averaged: smooth lines."""
    uv = canvas.project(chamber.vertices_mm)[0]
    ellipses = [
        canvas.ellipse(site.position_mm, look.covariances_mm2[site.site])
        for site in chamber.sites
        if site.site in look.covariances_mm2
    ]
    margin = 4 * canvas.unit
    drawn = np.concatenate([uv, *ellipses])
    low = np.clip(np.floor(drawn.min(axis=0) - margin), 0, image.size).astype(np.int64)
    high = np.clip(np.ceil(drawn.max(axis=0) + margin), 0, image.size).astype(np.int64)
    if (high <= low).any():
        return

    def fine(points_uv: Array) -> list[float]:
        # Pillow cuts coordinates to whole numbers; half a pixel more rounds them.
        placed: list[float] = ((points_uv - low + 0.5) * 2).ravel().tolist()
        return placed

    width, height = (2 * (high - low)).tolist()
    layer = Image.new("RGBA", (width, height), (255, 255, 255, 0))
    draw = ImageDraw.Draw(layer)
    thickness = max(2, round(2 * canvas.unit))
    edges = times.edges_ms if look.until_ms is None else times.edges_ms[times.edges_ms < look.until_ms]
    for line in isochrones(chamber, edges):
        at = canvas.project(line.points_mm)[0]
        for run in runs(facing[line.faces]):
            draw.line(fine(at[run]), fill=(255, 255, 255, 130), width=thickness, joint="curve")
    for line in isochrones(chamber, np.array([] if look.until_ms is None else [look.until_ms])):
        at = canvas.project(line.points_mm)[0]
        for run in runs(facing[line.faces]):
            draw.line(fine(at[run]), fill=(255, 255, 255, 255), width=3 * thickness, joint="curve")
    for edge in outline_edges(chamber.faces, facing):
        draw.line(fine(uv[edge]), fill=(*OUTLINE_RGB, 230), width=round(1.5 * thickness))
    for ellipse in ellipses:
        draw.line(fine(ellipse), fill=(*ELLIPSE_RGB, 230), width=thickness, joint="curve")
    smooth = layer.reduce(2)
    image.paste(smooth, tuple(low.tolist()), smooth)


def _draw_sites(
    image: Image.Image, canvas: _Canvas, chamber: ChamberMap, raster: Raster, highlight_site: str,
    tip_uv: ArrayLike | None, times: Scale, until_ms: float | None,
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
    labels = Labels(image.width, image.height, [*taken, bar_box(times, image.size, size)])
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
