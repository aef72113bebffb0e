"""The version of each stage beside the fingerprint of its result on a fixed input.

A changed result with an unchanged version would leave old results in the stores of users. After a wanted change, raise the
version of the stage and write the new fingerprints by ``python tests/plugins/test_versions.py``.

A fingerprint has two parts. ``sha256`` covers types, fields, shapes, names, integers and reasons. ``sums`` has two numbers for
each field of floating-point numbers: their sum with fixed weights, and their norm. A hash of rounded numbers would differ
between processors, whose last digits differ.
"""

from __future__ import annotations

import dataclasses
import functools
import hashlib
import json
import math
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from chambers import wave

from fluoromap import matching
from fluoromap.catheters import DEFAULT_CATALOGUE
from fluoromap.contracts import (
    Array,
    Chain,
    FrameChains,
    MonoplaneView,
    NamedChain,
    Observation,
    PixelFacts,
    Run,
    Segmentation,
    Silent,
    Triangulation,
)
from fluoromap.geometry import camera_from_gantry
from fluoromap.matching import SiteRuns, match_study
from fluoromap.phantom import SimulatedRun, SimulatedStudy, StudySpec, simulate_study
from fluoromap.phantom.ideal_matching import matched_sites
from fluoromap.registry import Kind, build_fuser, build_monoplane, build_segmenter, build_triangulator, plugins
from fluoromap.segmenter.warm_up import SyntheticFrames

KNOWN = Path(__file__).with_name("result_fingerprints.json")
TOLERANCE = 1e-6
"""Largest change of a weighted sum between processors, as a share of the norm."""
TOLERANCES = {
    "Chain.covariance_px2": 1e-5,
    "Chain.scores": 3e-3,  # read at the nearest pixel, which may be another one
    "ChamberMap.lat_ms": 5e-4,  # an optimiser sets the prior of the field
    "ChamberMap.lat_sd_ms": 5e-4,
    "ChamberMap.leave_one_out_rms_ms": 5e-4,
    "SurfaceSite.leave_one_out_error_ms": 5e-4,
}
"""Exceptions, measured by compiling for a generic processor (NUMBA_CPU_NAME=generic, OPENBLAS_CORETYPE=Nehalem)."""

MATCHING = "matching"
BUILT_IN = {
    f"{row.kind} {row.name}": row
    for row in plugins()
    if row.stage is not None and row.stage.__module__.startswith("fluoromap.")
}
STAGES = (*BUILT_IN, MATCHING)


def numbers(value: object, name: str = "") -> Iterator[tuple[str, object]]:
    """Yield all contents of a result as (field, content).

    The order is depth first.
    """
    if dataclasses.is_dataclass(value):
        for field in dataclasses.fields(value):
            yield from numbers(getattr(value, field.name), f"{type(value).__name__}.{field.name}")
    elif isinstance(value, tuple):
        yield name, f"{len(value)} entries"
        for entry in value:
            yield from numbers(entry, name)
    else:
        yield name, value


def fingerprint(result: object) -> dict[str, Any]:
    """Return hash and weighted sums of a result."""
    digest = hashlib.sha256()
    floats: dict[str, list[Array]] = {}
    for name, content in numbers(result):
        if isinstance(content, float):
            content = np.array([content])
        if isinstance(content, np.ndarray) and content.dtype.kind == "f":
            floats.setdefault(name, []).append(content.ravel())
            digest.update(f"{name} {content.shape}\n".encode())
        else:
            text = content.tolist() if isinstance(content, np.ndarray) else content
            digest.update(f"{name} {text}\n".encode())
    sums = {}
    for name, parts in sorted(floats.items()):
        values = np.concatenate(parts)
        weights = np.cos(1.0 + np.arange(len(values)))
        sums[name] = [float(f"{number:.10g}") for number in (weights @ values, np.linalg.norm(values))]
    return {"sha256": digest.hexdigest(), "sums": sums}


@functools.cache
def study() -> SimulatedStudy:
    """Simulate five sites of a heart, two seconds a view."""
    return simulate_study(StudySpec(41, sites=5, frames=24, breathing_mm=1.0))


@functools.cache
def located() -> Triangulation:
    return build_triangulator("linear", {}).triangulate(matched_sites(study()), DEFAULT_CATALOGUE, Silent())


def segmented(name: str) -> object:
    frames = SyntheticFrames(DEFAULT_CATALOGUE)
    run = Run(frames, 66.7 * np.arange(len(frames), dtype=np.float64), 5.75, PixelFacts(False, 12, False))
    return build_segmenter(name, {}).segment(run, DEFAULT_CATALOGUE, {}, Silent())


def triangulated(name: str) -> object:
    return build_triangulator(name, {}).triangulate(matched_sites(study()), DEFAULT_CATALOGUE, Silent())


def tracked(name: str) -> object:
    if name == "rigid-pose":
        return build_monoplane(name, {"known_rigid": True}).track(rigid_view(), Silent())
    site, place = matched_sites(study())[0], located().sites[0]
    view = MonoplaneView(
        site=site.site, view="a", camera=place.camera_a, catalogue=DEFAULT_CATALOGUE,
        frame_times_ms=site.runs.frame_times_a_ms, observations=site.runs.track_a, a_priori=place.points,
        a_priori_frame=place.frame_a, cycle=None, others=tuple(other.cycle for other in located().sites[1:] if other.cycle),
    )  # fmt: skip
    return build_monoplane(name, {}).track(view, Silent())


def rigid_view() -> MonoplaneView:
    """Return a view of the first site's electrodes as a rigid body.

    They move as one, which a beating heart does not.
    """
    place = located().sites[0]
    points = np.array([point.position_mm for point in place.points])
    noise = np.random.default_rng(7)
    observations = []
    for frame in range(6):
        c, s = math.cos(0.02 * frame), math.sin(0.02 * frame)
        turn = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
        pixels = place.camera_a.project(points @ turn.T + 0.5 * frame) + 0.3 * noise.normal(size=(len(points), 2))
        chains = []
        for catheter in DEFAULT_CATALOGUE.names:
            own = [k for k, point in enumerate(place.points) if point.catheter == catheter]
            electrodes = tuple(place.points[k].electrode for k in own)
            chains.append(NamedChain(catheter, electrodes, pixels[own], np.tile(0.09 * np.eye(2), (len(own), 1, 1))))
        observations.append(Observation(frame, None, tuple(chains)))
    return MonoplaneView(
        site="S01", view="a", camera=place.camera_a, catalogue=DEFAULT_CATALOGUE,
        frame_times_ms=66.7 * np.arange(6, dtype=np.float64), observations=tuple(observations),
        a_priori=place.points, a_priori_frame=0, cycle=None, others=(),
    )  # fmt: skip


def fused(name: str) -> object:
    sites, _ = wave(16, seed=5)
    return build_fuser(name, {}).fuse(sites, Silent())


def matched() -> object:
    runs = [
        SiteRuns(
            site.name,
            camera_from_gantry(site.runs[0].gantry),
            camera_from_gantry(site.runs[1].gantry),
            chains_of(site.runs[0], 10 * number),
            chains_of(site.runs[1], 10 * number + 1),
        )
        for number, site in enumerate(study().sites)
    ]
    return match_study(runs, DEFAULT_CATALOGUE, Silent())


def chains_of(run: SimulatedRun, seed: int) -> Segmentation:
    """Return the true chains of a run with noise.

    The tip's length is the only sign of the catheter.
    """
    rng = np.random.default_rng(seed)
    n = len(run.frame_times_ms)

    def chain(name: str, track: int, pixels: Array) -> Chain:
        mapping_probability = 0.8 if name == "mapping" else 0.1
        rest = (1 - mapping_probability) / 2
        kinds = (("reference", rest), ("pacing", rest), ("mapping", mapping_probability))
        covariance = np.tile(0.25 * np.eye(2), (len(pixels), 1, 1))
        return Chain(tuple(range(1, len(pixels) + 1)), pixels, covariance, np.ones(len(pixels)), kinds, track)

    noisy = {name: uv + rng.normal(0, 0.5, uv.shape) for name, uv in run.truth.pixels_uv.items()}
    frames = tuple(
        FrameChains(frame, tuple(chain(name, k, uv[frame]) for k, (name, uv) in enumerate(noisy.items())))
        for frame in range(n)
    )
    return Segmentation(frames, None, (), np.ones(n), run.frame_times_ms, run.r_wave_frames)


RESULTS: dict[Kind, Callable[[str], object]] = {
    "segmenter": segmented,
    "triangulator": triangulated,
    "monoplane": tracked,
    "fuser": fused,
}


def current(stage: str) -> dict[str, Any]:
    """Return the present version and fingerprint of a stage."""
    if stage == MATCHING:
        return {"version": matching.VERSION, **fingerprint(matched())}
    row = BUILT_IN[stage]
    return {"version": row.version, **fingerprint(RESULTS[row.kind](row.name))}


def differences(old: dict[str, Any], new: dict[str, Any]) -> list[str]:
    """Return the fields in which two fingerprints differ."""
    fields = [] if old["sha256"] == new["sha256"] else ["sha256"]
    for name in {*old["sums"], *new["sums"]}:
        before, after = (one["sums"].get(name, [math.nan, math.nan]) for one in (old, new))
        allowed = TOLERANCES.get(name, TOLERANCE) * max(before[1], 1e-9)
        if not all(abs(a - b) <= allowed for a, b in zip(before, after, strict=True)):
            fields.append(name)
    return sorted(fields)


def test_fingerprints_are_known_for_exactly_the_built_in_stages() -> None:
    assert set(json.loads(KNOWN.read_text())) == set(STAGES)


@pytest.mark.parametrize("stage", STAGES)
def test_a_changed_result_has_a_new_version(stage: str) -> None:
    old, new = json.loads(KNOWN.read_text())[stage], current(stage)
    assert old["version"] == new["version"], f"{stage}: write the fingerprints of version {new['version']}, see above"
    assert differences(old, new) == [], f"{stage}: the result differs; raise the version and write the fingerprints"


def test_a_small_change_is_a_difference() -> None:
    sites, _ = wave(16, seed=5)
    moved = (dataclasses.replace(sites[0], lat_ms=sites[0].lat_ms * 1.001), *sites[1:])
    renamed = (dataclasses.replace(sites[0], site="S99"), *sites[1:])
    assert differences(fingerprint(sites), fingerprint(sites)) == []
    assert differences(fingerprint(sites), fingerprint(moved)) == ["MappedSite.lat_ms"]
    assert differences(fingerprint(sites), fingerprint(renamed)) == ["sha256"]


if __name__ == "__main__":
    KNOWN.write_text(json.dumps({stage: current(stage) for stage in STAGES}, indent=1) + "\n")
