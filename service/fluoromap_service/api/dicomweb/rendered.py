"""WADO-RS: rendered frames of runs and of secondary captures (PS3.18 sections 8.3.5 and 10.4.1.1.3)."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from typing import Any

from fastapi import Request, Response

from fluoromap_service.api.dicomweb.accept import media_ranges, not_acceptable
from fluoromap_service.api.dicomweb.descriptions import RENDERED_ANSWERS, rendered_parameters
from fluoromap_service.api.dicomweb.display import (
    JPEG_QUALITY,
    LARGEST_SIDE_PX,
    Display,
    MediaType,
    Viewport,
    Window,
    WindowFunction,
)
from fluoromap_service.api.dicomweb.stored import existing
from fluoromap_service.api.http.middleware.download_limit import PICTURE
from fluoromap_service.api.http.routers import new_router
from fluoromap_service.api.http.security import Reader
from fluoromap_service.problem import Problem, not_found

router = new_router("/dicom-web", tags=["dicomweb"], describe=rendered_parameters, responses=RENDERED_ANSWERS)

_MEDIA_TYPES: dict[str, MediaType] = {
    "image/jpeg": "image/jpeg", "image/png": "image/png", "image/*": "image/jpeg", "*/*": "image/jpeg",
}  # fmt: skip
_FUNCTIONS: dict[str, WindowFunction] = {
    "linear": "LINEAR", "linear-exact": "LINEAR_EXACT", "linear_exact": "LINEAR_EXACT", "sigmoid": "SIGMOID",
}  # fmt: skip


@router.get("/studies/{study_uid}/series/{series_uid}/instances/{uid}/rendered", dependencies=[PICTURE])
def render_instance(study_uid: str, series_uid: str, uid: str, request: Request, caller: Reader) -> Response:
    """Return the first frame of an instance as a picture."""
    return _rendered(request, study_uid, series_uid, uid, "1")


@router.get("/studies/{study_uid}/series/{series_uid}/instances/{uid}/frames/{number}/rendered", dependencies=[PICTURE])
def render_frame(study_uid: str, series_uid: str, uid: str, number: str, request: Request, caller: Reader) -> Response:
    """Return a frame as a picture; ``number`` counts from 1."""
    return _rendered(request, study_uid, series_uid, uid, number)


def _rendered(request: Request, study_uid: str, series_uid: str, uid: str, number: str) -> Response:
    display = _display(request)
    (instance,) = existing(study_uid, series_uid, uid)
    if instance.frames == 0:
        raise not_acceptable("This object has no pictures; ask for the object itself.")
    if not re.fullmatch(r"[0-9]{1,5}", number):
        raise Problem(400, "malformed", "The frame is not one number; write it as in frames/1/rendered.")
    if not 1 <= int(number) <= instance.frames:
        raise not_found("frame")
    _check_region(display.viewport, instance.header)
    return Response(instance.rendered(int(number) - 1, display), media_type=display.media_type)


def _check_region(viewport: Viewport | None, header: dict[str, Any]) -> None:
    """Refuse a region that is not inside the frame.

    Raises
    ------
    Problem
        422 ``invalid``.
    """
    if viewport is None or viewport.region is None:
        return
    left, top, width, height = viewport.region
    rows, columns = (int(header[tag]["Value"][0]) for tag in ("00280010", "00280011"))
    if min(left, top) < 0 or left + abs(width) > columns or top + abs(height) > rows:
        raise _invalid("viewport", f"a region inside the {columns} x {rows} pixels of the frame")


def _display(request: Request) -> Display:
    """Read the parameters of a rendered resource (PS3.18 table 8.3.5-1).

    Raises
    ------
    Problem
        406 ``not_acceptable``; 422 ``invalid``.
    """
    parameters = request.query_params
    quality = _numbers(parameters, "quality", (1,)) or (JPEG_QUALITY,)
    if not (1 <= quality[0] <= 100 and quality[0] == int(quality[0])):
        raise _invalid("quality", "a whole number from 1 to 100")
    return Display(_media_type(request), _window(parameters), _viewport(parameters), int(quality[0]))


def _media_type(request: Request) -> MediaType:
    # The query parameter is for clients that cannot set headers, so it counts first (PS3.18 section 8.3.3.1).
    sent = request.query_params.get("accept") or ",".join(request.headers.getlist("accept"))
    for item in media_ranges(sent):
        if item.quality > 0 and item.kind in _MEDIA_TYPES:
            return _MEDIA_TYPES[item.kind]
    raise not_acceptable("Rendered frames are image/jpeg or image/png; change the Accept header.")


def _window(parameters: Mapping[str, str]) -> Window | None:
    text = parameters.get("window")
    if text is None:
        return None
    numbers, _, function = text.rpartition(",")
    if function.lower() not in _FUNCTIONS:
        numbers, function = text, "linear"
    values = _numbers({"window": numbers}, "window", (2,))
    least = 1 if function.lower() == "linear" else 1e-6
    if len(values) != 2 or values[1] < least:
        raise _invalid("window", "centre, width and a function: linear, linear-exact or sigmoid")
    return Window(values[0], values[1], _FUNCTIONS[function.lower()])


def _viewport(parameters: Mapping[str, str]) -> Viewport | None:
    if parameters.get("viewport") is None:
        return None
    values = _numbers(parameters, "viewport", (2, 6))
    width, height, *region = values
    if not all(1 <= side <= LARGEST_SIDE_PX and side == int(side) for side in (width, height)):
        raise _invalid("viewport", f"a width and a height in whole pixels, at most {LARGEST_SIDE_PX}")
    if not region:
        return Viewport(int(width), int(height))
    left, top, region_width, region_height = region
    if min(abs(region_width), abs(region_height)) < 1:
        raise _invalid("viewport", "a region of one pixel or more")
    return Viewport(int(width), int(height), (left, top, region_width, region_height))


def _numbers(parameters: Mapping[str, str], name: str, counts: tuple[int, ...]) -> tuple[float, ...]:
    """Return the numbers of a parameter, with commas between; none when it is absent."""
    text = parameters.get(name)
    if text is None:
        return ()
    try:
        values = tuple(float(part) for part in text.split(","))
    except ValueError:
        raise _invalid(name, "numbers with commas between") from None
    if len(values) not in counts or not all(math.isfinite(value) for value in values):
        raise _invalid(name, f"{' or '.join(map(str, counts))} numbers with commas between")
    return values


def _invalid(name: str, wanted: str) -> Problem:
    return Problem(422, "invalid", f"{name} is wrong; send {wanted}.", [(f"query.{name}", "wrong")])
