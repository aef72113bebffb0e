"""Symbols of sites: a dot with its time, and the star of the highlighted site."""

from __future__ import annotations

import numpy as np
from PIL import Image, ImageDraw

from fluoromap.contracts import Array, SurfaceSite
from fluoromap.drawing.colours import Scale, milliseconds
from fluoromap.drawing.lettering import BLACK, RGB, WHITE, Labels, Point, halo_text
from fluoromap.reasons import AT_BEST_C, Reason

OUTLIER_RGB: RGB = (255, 176, 64)
FAR_RGB: RGB = (205, 205, 205)
DOT_RADIUS = 2.7
RING_RADIUS = 3.2
FINER = 4
DARK_RGB: RGB = (30, 30, 35)
DARK_OUTLIER_RGB: RGB = (168, 84, 0)


def is_outlier(site: SurfaceSite) -> bool:
    """Return True where the neighbours of a site contradict its time."""
    return Reason.LAT_OUTLIER in site.reasons


def is_doubtful(site: SurfaceSite) -> bool:
    """Return True where a site's time, position or catheter is in doubt."""
    return is_outlier(site) or not AT_BEST_C.isdisjoint(site.reasons)


def time_text(site: SurfaceSite) -> str:
    """Return the site's time in ms.

    A question mark follows where the site is in doubt.
    """
    return milliseconds(site.lat_ms) + ("?" if is_doubtful(site) else "")


def draw_dot(image: Image.Image, place: Point, site: SurfaceSite, times: Scale, unit: float, *, near: bool) -> None:
    """Draw a site as a dot in the colour of its time.

    It is filled on the near wall and a ring on the far wall; a time that the neighbours contradict is amber.
    """
    band = tuple(times.band_colours()[times.band(np.array(site.lat_ms))].tolist())
    colour = OUTLIER_RGB if is_outlier(site) else band
    radius = (DOT_RADIUS if near else RING_RADIUS) * unit
    rings = [(radius + unit, BLACK), (radius, colour)]
    if not near:
        rings.append((0.5 * radius, BLACK))
    angles = np.linspace(0, 2 * np.pi, 33)[:-1]
    circle = np.stack([np.cos(angles), np.sin(angles)], axis=1)
    _stamp(image, place, [(reach * circle, ring) for reach, ring in rings])


def draw_time(
    draw: ImageDraw.ImageDraw, labels: Labels, place: Point, site: SurfaceSite, unit: float, size: int, *,
    near: bool, on_light: bool = False,
) -> None:  # fmt: skip
    """Draw the site's time beside its dot.

    The letters are amber where the site is in doubt. Else they are dark where the picture's background is light.
    """
    text = time_text(site)
    if on_light:
        ink, halo = DARK_OUTLIER_RGB if is_doubtful(site) else DARK_RGB, WHITE
    else:
        ink, halo = OUTLIER_RGB if is_doubtful(site) else WHITE if near else FAR_RGB, BLACK
    halo_text(draw, labels.place(place, text, size, 4.5 * unit), text, size, ink, halo)


def draw_star(image: Image.Image, place: Point, radius: float) -> None:
    """Draw a white star with a dark rim, its centre at ``place``."""
    angles = np.radians(-90 + 36 * np.arange(10))
    star = np.stack([np.cos(angles), np.sin(angles)], axis=1)
    points = (np.arange(10) % 2 == 0)[:, None]
    rim, inside = np.where(points, 1.35, 0.65) * star, np.where(points, 1.0, 0.42) * star
    _stamp(image, place, [(radius * rim, BLACK), (radius * inside, WHITE)])


def _stamp(image: Image.Image, place: Point, shapes: list[tuple[Array, RGB]]) -> None:
    """Draw polygons around ``place`` larger and average them.

    Their centre is then correct to a tenth of a pixel.
    """
    reach = int(np.ceil(max(float(np.abs(shape).max()) for shape, _ in shapes))) + 2
    corner = (round(place[0]) - reach, round(place[1]) - reach)
    patch = Image.new("RGBA", ((2 * reach + 1) * FINER, (2 * reach + 1) * FINER), (0, 0, 0, 0))
    draw = ImageDraw.Draw(patch)
    for shape, colour in shapes:
        # Pillow truncates coordinates; adding half a pixel rounds them.
        fine = (shape + np.subtract(place, corner) + 0.5) * FINER
        draw.polygon(fine.ravel().tolist(), fill=(*colour, 255))
    small = patch.reduce(FINER)
    image.paste(small, corner, small)
