"""The map fused on a fluoroscopy frame."""

from __future__ import annotations

import io

import numpy as np
from numpy.typing import ArrayLike, NDArray
from PIL import Image, ImageDraw

from fluoromap.contracts import Array, BoolArray, ChamberMap, SurfaceSite
from fluoromap.fuser.colours import NO_DATA_HATCH_RGB, Scale, milliseconds, scale_of
from fluoromap.fuser.isochrones import isochrones
from fluoromap.fuser.lettering import BLACK, WHITE, Labels, bar_box, draw_colour_bar, halo_text
from fluoromap.fuser.raster import Raster, rasterise
from fluoromap.fuser.surface import face_normals
from fluoromap.geometry import Camera
from fluoromap.reasons import Reason

Picture = NDArray[np.uint8]

TINT = 0.32
"""Share of the map's colour in a pixel: electrodes keep two thirds of their contrast."""

HATCH_TINT = 0.22
OUTLINE_RGB = (140, 225, 255)
OUTLIER_RGB = (255, 176, 64)
LEAST_DEPTH_MM = 10.0


def draw_overlay(
    frame: NDArray[np.uint8],
    camera: Camera,
    chamber: ChamberMap,
    shift_world_mm: ArrayLike,
    highlight_site: str,
    tip_uv: ArrayLike | None,
    scale: int = 1,
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
    scale : int
        Pixels of the picture per pixel of the frame, along each side.

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
    if scale < 1:
        raise ValueError("scale must be 1 or more")
    canvas = _Canvas(camera.translated(shift_world_mm), scale)
    times = scale_of(chamber)
    size = (camera.columns * scale, camera.rows * scale)
    grey = Image.fromarray(frame)
    picture = np.array(grey if scale == 1 else grey.resize(size, Image.Resampling.BICUBIC))
    rgb = np.repeat(picture[..., None], 3, axis=2)

    facing = canvas.facing(chamber)
    raster = rasterise(*canvas.project(chamber.vertices_mm), chamber.faces, facing, picture.shape)
    _tint(rgb, raster, chamber, times, canvas.unit)
    image = Image.fromarray(rgb)
    image = _with_lines(image, canvas, chamber, facing, times)
    _draw_sites(image, canvas, chamber, raster, highlight_site, tip_uv, times)
    return np.asarray(image)


def encode_png(picture: Picture) -> bytes:
    """PNG of an RGB or grey picture; the same picture gives the same bytes."""
    stream = io.BytesIO()
    Image.fromarray(picture).save(stream, format="PNG", compress_level=6)
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
        in_front = np.where(depth > LEAST_DEPTH_MM, depth, np.nan)
        uv = self._camera.project(points_mm)
        # What lies behind the source is far outside the picture, never mirrored into it.
        return self.to_picture(np.where(np.isnan(in_front)[:, None], -1e6, uv)), depth

    def facing(self, chamber: ChamberMap) -> BoolArray:
        """Faces whose outer side looks at the detector: the ray from the source leaves the chamber through them."""
        normals = face_normals(chamber.vertices_mm, chamber.faces)
        rays = chamber.vertices_mm[chamber.faces].mean(axis=1) - self._camera.source_world_mm
        outward: BoolArray = (normals * rays).sum(axis=1) > 0
        return outward


def _tint(rgb: Picture, raster: Raster, chamber: ChamberMap, times: Scale, unit: float) -> None:
    shown = raster.shown()
    covered = raster.sample(chamber.covered.astype(np.float64)) > 0.5
    colours = times.band_colours()[times.band(raster.sample(_times_beyond_cover(chamber)))].astype(np.float32)
    v, u = np.nonzero(shown)
    period = max(4, round(7 * unit))
    hatch = ~covered & ((u + v) % period < max(1, round(unit)))
    colours[hatch] = NO_DATA_HATCH_RGB
    share = np.where(covered, TINT, np.where(hatch, HATCH_TINT, 0.0)).astype(np.float32)[:, None]
    under = rgb[shown].astype(np.float32)
    rgb[shown] = (under + share * (colours - under)).round().astype(np.uint8)


def _times_beyond_cover(chamber: ChamberMap) -> Array:
    """Times at the vertices, those just beyond the covered part taking their neighbours', so that a face at its rim
    does not run through all bands down to 0."""
    lat, faces = chamber.lat_ms.copy(), chamber.faces
    weight = chamber.covered[faces].astype(np.float64)
    total = np.bincount(faces.ravel(), np.repeat((weight * lat[faces]).sum(axis=1), 3), minlength=len(lat))
    count = np.bincount(faces.ravel(), np.repeat(weight.sum(axis=1), 3), minlength=len(lat))
    rim = ~chamber.covered & (count > 0)
    lat[rim] = total[rim] / count[rim]
    return lat


def _with_lines(
    image: Image.Image, canvas: _Canvas, chamber: ChamberMap, facing: BoolArray, times: Scale
) -> Image.Image:
    """Isochrones and outline, drawn at twice the size and averaged: smooth lines."""
    layer = Image.new("RGBA", (image.width * 2, image.height * 2), (255, 255, 255, 0))
    draw = ImageDraw.Draw(layer)
    width = max(2, round(2 * canvas.unit))
    for line in isochrones(chamber, times.edges_ms):
        uv = canvas.project(line.points_mm)[0] * 2 + 0.5
        for run in _runs(facing[line.faces]):
            draw.line(uv[run].ravel().tolist(), fill=(255, 255, 255, 130), width=width, joint="curve")
    uv = canvas.project(chamber.vertices_mm)[0] * 2 + 0.5
    for edge in _silhouette(chamber, facing):
        draw.line(uv[edge].ravel().tolist(), fill=(*OUTLINE_RGB, 230), width=round(1.5 * width))
    image = image.convert("RGBA")
    image.alpha_composite(layer.reduce(2))
    return image.convert("RGB")


def _runs(flags: BoolArray) -> list[slice]:
    """Slices of a line's points for each run of segments whose flag is set."""
    edges = np.flatnonzero(np.diff(np.concatenate([[0], flags.astype(np.int8), [0]])))
    return [slice(int(start), int(stop) + 1) for start, stop in edges.reshape(-1, 2)]


def _silhouette(chamber: ChamberMap, facing: BoolArray) -> NDArray[np.int64]:
    """Edges (e, 2) between a face that faces the viewer and one that does not."""
    edges = np.sort(chamber.faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1)
    unique, of_edge = np.unique(edges, axis=0, return_inverse=True)
    count = np.bincount(of_edge.ravel(), np.repeat(facing, 3), minlength=len(unique))
    rim: NDArray[np.int64] = unique[count == 1]
    return rim


def _draw_sites(
    image: Image.Image, canvas: _Canvas, chamber: ChamberMap, raster: Raster, highlight_site: str,
    tip_uv: ArrayLike | None, times: Scale,
) -> None:  # fmt: skip
    draw = ImageDraw.Draw(image)
    size, unit = canvas.letters, canvas.unit
    places, near = _places(canvas, chamber)
    on_near_wall = raster.visible(*canvas.project(np.array([site.surface_mm for site in chamber.sites])))
    highlighted = next((site for site in chamber.sites if site.site == highlight_site), None)
    star = None if highlighted is None else tuple(places[highlighted.site])
    if tip_uv is not None:
        star = tuple(canvas.to_picture(np.asarray(tip_uv, dtype=np.float64)))

    radius = 3.2 * unit
    points = [place for name, place in places.items() if name != highlight_site]
    if star is not None:
        points.append(star)
    boxes = [(u - radius, v - radius, u + radius, v + radius) for u, v in points]
    labels = Labels(image.width, image.height, [*boxes, bar_box(times, image.size, size)])
    if star is not None:
        text = "" if highlighted is None else f"{_time(highlighted)} ms"
        middle = labels.place(star, text, round(1.25 * size), 9 * unit)
        _draw_star(draw, star, 8 * unit)
        halo_text(draw, middle, text, round(1.25 * size), WHITE, BLACK)
    for site, visible in zip(chamber.sites, on_near_wall, strict=True):
        if site.site == highlight_site:
            continue
        outlier = Reason.LAT_OUTLIER in site.reasons
        colour = OUTLIER_RGB if outlier else tuple(times.band_colours()[times.band(np.array(site.lat_ms))].tolist())
        u, v = places[site.site]
        _draw_dot(draw, (u, v), radius, colour, filled=bool(visible))
        ink = OUTLIER_RGB if outlier else WHITE if visible else (205, 205, 205)
        middle = labels.place((u, v), _time(site), size, 4 * unit)
        halo_text(draw, middle, _time(site), size, ink, BLACK)
    draw_colour_bar(image, times, size, dark=True, mark_ms=None if highlighted is None else highlighted.lat_ms)


def _places(canvas: _Canvas, chamber: ChamberMap) -> tuple[dict[str, tuple[float, float]], Array]:
    uv, near = canvas.project(np.array([site.position_mm for site in chamber.sites]))
    return {site.site: (float(u), float(v)) for site, (u, v) in zip(chamber.sites, uv, strict=True)}, near


def _time(site: SurfaceSite) -> str:
    return milliseconds(site.lat_ms) + ("?" if Reason.LAT_OUTLIER in site.reasons else "")


def _draw_dot(
    draw: ImageDraw.ImageDraw, middle: tuple[float, float], radius: float, colour: tuple[int, ...], *, filled: bool
) -> None:
    u, v = middle
    box = (u - radius, v - radius, u + radius, v + radius)
    width = max(1, round(radius / 3))
    if filled:
        draw.ellipse(box, fill=colour, outline=BLACK, width=width)
    else:
        draw.ellipse(box, outline=BLACK, width=3 * width)
        draw.ellipse((u - radius + width / 2, v - radius + width / 2, u + radius - width / 2, v + radius - width / 2),
                     outline=colour, width=width)  # fmt: skip


def _draw_star(draw: ImageDraw.ImageDraw, middle: tuple[float, float], radius: float) -> None:
    angles = np.radians(-90 + 36 * np.arange(10))
    for grow, colour in ((1.25, BLACK), (1.0, WHITE)):
        reach = grow * radius * np.where(np.arange(10) % 2 == 0, 1.0, 0.42 + 0.1 * (grow - 1))
        corners = np.stack([middle[0] + reach * np.cos(angles), middle[1] + reach * np.sin(angles)], axis=1)
        draw.polygon(corners.ravel().tolist(), fill=colour)
