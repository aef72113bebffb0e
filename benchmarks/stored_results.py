"""Compare the stored form of stage results with JSON: ``python benchmarks/stored_results.py [sites]``.

Simulates a study of 20 sites, 2 runs each, 120 frames a run, as electrodes without pictures. It runs the stages after the
segmenter once, encodes and decodes the results of all stages in the service's form and as JSON, and prints the processor seconds
and the megabytes of both for each stage.
"""

from __future__ import annotations

import dataclasses
import functools
import sys
import time
import types
import typing
from collections.abc import Callable, Sequence
from enum import Enum
from typing import Any

import numpy as np
from matching import Design, true_chains
from pydantic_core import from_json, to_json

from fluoromap.catheters import DEFAULT_CATALOGUE
from fluoromap.contracts import Matching, MonoplaneView, Silent, Triangulation
from fluoromap.matching import match_study
from fluoromap.registry import DEFAULTS, build_monoplane, build_triangulator
from fluoromap_service.jobs.stage_results import SiteTracks, ViewTrack
from fluoromap_service.store import codec

SEED = 6  # its runs have 60 frames a second: 120 frames
REPEATS = 3


def main(sites: int) -> None:
    print(f"{'stage':<12} {'results':>7}   {'JSON s':>7} {'ours s':>7}   {'JSON MB':>8} {'ours MB':>8}")
    totals = np.zeros(4)
    for stage, results in _results(sites).items():
        row = np.array([*_seconds_and_megabytes(results, _to_json, _from_json)])
        own = np.array([*_seconds_and_megabytes(results, codec.encode, codec.decode)])
        figures = np.array([row[0], own[0], row[1], own[1]])
        totals += figures
        _show(stage, len(results), figures)
    _show("all", 0, totals)
    print(f"size: 1/{totals[2] / totals[3]:.1f} of JSON; time: 1/{totals[0] / totals[1]:.0f}")


def _show(stage: str, count: int, figures: Sequence[float]) -> None:
    json_s, own_s, json_mb, own_mb = figures
    print(f"{stage:<12} {count or '':>7}   {json_s:7.3f} {own_s:7.3f}   {json_mb:8.2f} {own_mb:8.2f}")


def _results(sites: int) -> dict[str, list[Any]]:
    study = true_chains(SEED, Design(sites=sites))
    segmentations = [runs for site in study.sites for runs in (site.segmentation_a, site.segmentation_b)]
    matching = match_study(study.sites, DEFAULT_CATALOGUE, Silent())
    triangulator = build_triangulator(DEFAULTS["triangulator"], {})
    triangulation = triangulator.triangulate(matching.sites, DEFAULT_CATALOGUE, Silent())
    return {
        "segment": segmentations,
        "match": [matching],
        "triangulate": [triangulation],
        "monoplane": _tracks(matching, triangulation),
    }


def _tracks(matching: Matching, triangulation: Triangulation) -> list[SiteTracks]:
    solver = build_monoplane(DEFAULTS["monoplane"], {})
    located = {site.site: site for site in triangulation.sites}
    tracks = []
    for matched in matching.sites:
        site = located[matched.site]
        views = []
        for view in ("a", "b"):
            shown = MonoplaneView(
                site=matched.site,
                view=view,  # type: ignore[arg-type]
                camera=getattr(site, f"camera_{view}"),
                catalogue=DEFAULT_CATALOGUE,
                frame_times_ms=getattr(matched.runs, f"frame_times_{view}_ms"),
                observations=getattr(matched.runs, f"track_{view}"),
                a_priori=site.a_priori_points,
                a_priori_frame=getattr(site, f"frame_{view}"),
                cycle=site.cycle,
                others=(),
            )
            views.append(ViewTrack(view, solver.track(shown, Silent()), None, ""))  # type: ignore[arg-type]
        tracks.append(SiteTracks(matched.site, tuple(views)))
    return tracks


def _seconds_and_megabytes(
    results: Sequence[Any], encode: Callable[[Any], bytes], decode: Callable[[Any, bytes], Any]
) -> tuple[float, float]:
    """Return the least seconds of encoding and decoding, and the megabytes."""
    best = np.inf
    for _ in range(REPEATS):
        start = time.process_time()
        contents = [encode(result) for result in results]
        for result, content in zip(results, contents, strict=True):
            decode(type(result), content)
        best = min(best, time.process_time() - start)
    return best, sum(map(len, contents)) / 1e6


# --- the yardstick: dataclasses as JSON objects, arrays as lists, by pydantic's compiled encoder -------------------------


def _to_json(value: Any) -> bytes:
    return to_json(_plain(value))


def _from_json(kind: Any, content: bytes) -> Any:
    return _built(kind)(from_json(content))


def _plain(value: Any) -> Any:
    if dataclasses.is_dataclass(value):
        return {field.name: _plain(getattr(value, field.name)) for field in dataclasses.fields(value)}
    if isinstance(value, np.ndarray):
        return {"shape": value.shape, "values": value.ravel().tolist()}
    if isinstance(value, Enum):
        return value.value
    return [_plain(item) for item in value] if isinstance(value, tuple) else value


@functools.cache
def _built(kind: Any) -> Callable[[Any], Any]:
    origin, arguments = typing.get_origin(kind), typing.get_args(kind)
    if origin in (types.UnionType, typing.Union):
        present = _built(next(option for option in arguments if option is not type(None)))
        return lambda value: None if value is None else present(value)
    if origin is np.ndarray:
        return lambda value: np.array(value["values"]).reshape(value["shape"])
    if origin is tuple:
        if arguments[-1] is Ellipsis:
            each = _built(arguments[0])
            return lambda value: tuple(each(item) for item in value)
        members = [_built(argument) for argument in arguments]
        return lambda value: tuple(member(item) for member, item in zip(members, value, strict=True))
    if dataclasses.is_dataclass(kind):
        hints = typing.get_type_hints(kind)
        return lambda value: kind(**{name: _built(hints[name])(item) for name, item in value.items()})  # type: ignore[operator]
    return kind if isinstance(kind, type) and issubclass(kind, Enum) else lambda value: value


if __name__ == "__main__":
    main(int(sys.argv[1]) if len(sys.argv) > 1 else 20)
