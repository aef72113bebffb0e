"""The colour bar of the pictures: the bands of a scale with their times in ms."""

from __future__ import annotations

from PIL import Image, ImageDraw

from fluoromap.drawing.colours import NO_DATA_HATCH_RGB, NO_DATA_RGB, Scale, milliseconds
from fluoromap.drawing.lettering import BLACK, WHITE, Box, font, text_size

BAR_SHARE = 0.42
"""Height of the colour bar's bands, as a share of the picture's height."""


def bar_box(scale: Scale, picture: tuple[int, int], size: int) -> Box:
    """Return the panel of :func:`draw_colour_bar` at the right edge of a picture (width, height)."""
    width, height = picture
    widest = max(text_size(milliseconds(edge), size)[0] for edge in scale.edges_ms)
    panel_width = max(1.1 * size + 0.6 * size + widest + size, text_size("no data", size)[0] + size)
    panel_height = BAR_SHARE * height + 5.6 * size
    top = (height - panel_height) / 2
    return (width - panel_width - 0.5 * size, top, width - 0.5 * size, top + panel_height)


def draw_colour_bar(image: Image.Image, scale: Scale, size: int, *, dark: bool, mark_ms: float | None = None) -> None:
    """Draw the bands with their times in ms, and the hatch "no data".

    The earliest band is on top. ``mark_ms`` adds a mark at a time.
    """
    ink, ground = (WHITE, (0, 0, 0, 150)) if dark else ((40, 40, 40), (255, 255, 255, 255))
    left, top, right, bottom = bar_box(scale, image.size, size)
    panel = Image.new("RGBA", (round(right - left), round(bottom - top)), (0, 0, 0, 0))
    draw = ImageDraw.Draw(panel)
    draw.rounded_rectangle((0, 0, panel.width - 1, panel.height - 1), radius=size // 2, fill=ground)
    bar_left, bar_right = 0.5 * size, 1.6 * size
    bar_top = 1.9 * size
    bar_height = BAR_SHARE * image.height
    draw.text((panel.width / 2, 0.9 * size), "ms", fill=ink, font=font(size), anchor="mm")

    def level(lat_ms: float) -> float:
        share = (lat_ms - scale.start_ms) / (scale.stop_ms - scale.start_ms)
        return bar_top + min(max(share, 0.0), 1.0) * bar_height

    edges = scale.edges_ms.tolist()
    for colour, early, late in zip(scale.band_colours().tolist(), edges, edges[1:], strict=False):
        draw.rectangle((bar_left, level(early), bar_right, level(late)), fill=tuple(colour))
    every = max(1, -(-int(1.3 * size * scale.bands) // int(bar_height)), -(-scale.bands // 8))
    for index, edge in enumerate(edges):
        draw.line((bar_right, level(edge), bar_right + 0.3 * size, level(edge)), fill=ink)
        if index % every == 0:
            place = (bar_right + 0.6 * size, level(edge))
            draw.text(place, milliseconds(edge), fill=ink, font=font(size), anchor="lm")
    draw.rectangle((bar_left, bar_top, bar_right, bar_top + bar_height), outline=ink)
    if mark_ms is not None:
        y, reach = level(mark_ms), 0.45 * size
        draw.polygon(
            (bar_left - 1, y - reach, bar_left + 0.6 * size, y, bar_left - 1, y + reach), fill=WHITE, outline=BLACK
        )

    swatch_top = bar_top + bar_height + 0.9 * size
    swatch = (round(bar_left), round(swatch_top), round(panel.width - bar_left), round(swatch_top + size))
    draw.rectangle(swatch, fill=NO_DATA_RGB)
    for x in range(swatch[0] - size, swatch[2], max(3, size // 3)):
        clipped = [(x + step, swatch[3] - step) for step in range(size) if swatch[0] <= x + step <= swatch[2]]
        draw.line(clipped, fill=NO_DATA_HATCH_RGB)
    draw.rectangle(swatch, outline=ink)
    draw.text(
        (panel.width / 2, swatch_top + 1.7 * size), "no data", fill=ink, font=font(round(0.85 * size)), anchor="mm"
    )
    image.paste(panel, (round(left), round(top)), panel)
