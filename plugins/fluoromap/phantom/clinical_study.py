"""A simulated study under given conditions: pixels of the electrodes without rendered frames, and the truth."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation
from scipy.special import ndtr

from fluoromap.catheters import DEFAULT_CATALOGUE, Catalogue, Catheter
from fluoromap.contracts import Array, Chain, FrameChains, Segmentation
from fluoromap.diastole import diastolic_frames
from fluoromap.geometry import Camera, camera_from_gantry
from fluoromap.matching import SiteRuns
from fluoromap.phantom.anatomy import RADIUS_6F_MM, Anatomy, Resident, draw_anatomy
from fluoromap.phantom.conditions import Conditions, GantryError
from fluoromap.phantom.motion import (
    BEAT_AMPLITUDE,
    BEAT_POSITION_MM,
    BEAT_TIMING_CYCLE,
    DIASTOLIC_PHASE,
    Beats,
    Breathing,
    wall_vectors,
)
from fluoromap.phantom.shaft import Shaft, arc_lengths_mm
from fluoromap.phantom.simulated_study import FRONTAL, LATERAL

NOISE_PX = 0.5
GANTRIES = (LATERAL, FRONTAL)
_SHAFT_POINTS = 130
"""Points of a centre line that are simulated: 52 mm, which contain all electrodes."""
_BEND_WIDTH_MM = 2.0
_IRREGULAR_SD, _FIBRILLATION_SD = 0.08, 0.22
_SHORTEST_BEAT_S = 0.33
_FOLLOWS_INTERVAL = 0.6
"""Change of a beat's amplitude with the interval before it, both as shares."""
_DECAPOLAR = Catheter("decapolar", 10, (3.5, 6.0, 3.0, 6.0, 3.0, 6.0, 3.0, 6.0, 3.0), tip_mm=2.0, ring_mm=1.0)
_ANATOMY, _BENDS, _RUN, _BREATH, _CHAINS, _SLIP = range(6)


@dataclass(frozen=True, eq=False)
class ClinicalRun:
    """Truth of one run: phases (n,), points_mm catheter -> (n, electrodes, 3) world, pixels_uv catheter -> (n, m, 2).

    The pixels are those of the radiographic centres, without noise.
    """

    phases: Array
    points_mm: Mapping[str, Array]
    pixels_uv: Mapping[str, Array]


@dataclass(frozen=True, eq=False)
class ClinicalSite:
    """Truth of one site: its two runs, and its electrodes at diastole.

    diastole_mm : catheter -> (m, 3), averaged over beats, at the mean breathing position of both runs.
    """

    name: str
    runs: tuple[ClinicalRun, ClinicalRun]
    diastole_mm: Mapping[str, Array]


@dataclass(frozen=True, eq=False)
class ClinicalStudy:
    """A study as matching gets it, with its truth.

    catalogue : as the user described the catheters. runs : chains of every run. truth : one entry a site.
    """

    conditions: Conditions
    catalogue: Catalogue
    runs: tuple[SiteRuns, ...]
    truth: tuple[ClinicalSite, ...]


def simulate_conditions(conditions: Conditions) -> ClinicalStudy:
    """Simulate a study under these conditions."""
    seed = conditions.seed
    anatomy = draw_anatomy("human", conditions.sites, np.random.default_rng([seed, _ANATOMY]))
    runs, truth = [], []
    for index in range(conditions.sites):
        residents = _residents(conditions, anatomy, index)
        seen, site = _site(conditions, anatomy.rate_hz, residents, index)
        runs.append(seen)
        truth.append(site)
    return ClinicalStudy(conditions, described_catalogue(conditions), tuple(runs), tuple(truth))


def described_catalogue(conditions: Conditions) -> Catalogue:
    """Return the catalogue with the user's errors."""
    described = []
    for catheter, errors in zip(_catheters(conditions), conditions.catalogue_errors_mm, strict=True):
        spacing = tuple(gap + error for gap, error in zip(catheter.spacing_mm, errors, strict=True))
        described.append(replace(catheter, spacing_mm=spacing))
    return replace(DEFAULT_CATALOGUE, catheters=tuple(described))


def _catheters(conditions: Conditions) -> tuple[Catheter, ...]:
    reference, pacing, mapping = DEFAULT_CATALOGUE.catheters
    if conditions.mapping_looks_alike:
        mapping = replace(reference, name=mapping.name)
    return reference, pacing, mapping


def _residents(conditions: Conditions, anatomy: Anatomy, site: int) -> tuple[Resident, ...]:
    """Return the catheters at a site, bent as the conditions say; the unlisted one comes last."""
    found = []
    for number, (resident, catheter) in enumerate(zip(anatomy.residents(site), _catheters(conditions), strict=True)):
        rest = resident.shaft.rest_mm[:_SHAFT_POINTS]
        if catheter.name == "pacing":
            usual = anatomy.resting[0][number].shaft.rest_mm[:_SHAFT_POINTS]
            rest = usual + conditions.pacing_slip * (rest - usual)
        # Reference and pacing catheter stay bent alike at all sites; the mapping catheter is turned at each.
        key = [conditions.seed, _BENDS, number, site if catheter.name == "mapping" else 0]
        bent = _bent(rest, conditions.bends_deg[number], np.random.default_rng(key))
        shaft = replace(resident.shaft, catheter=catheter, rest_mm=bent)
        found.append(Resident(shaft, resident.vectors_mm))
    if conditions.decapolar:
        found.append(_decapolar(conditions, anatomy))
    return tuple(found)


def _bent(rest_mm: Array, angle_deg: float, rng: np.random.Generator) -> Array:
    """Return a centre line with a local bend.

    The bend is 3 to 12 mm behind the tip's end. Arc lengths stay.
    """
    steps = np.diff(rest_mm, axis=0)
    along = np.concatenate([[0.0], np.cumsum(np.linalg.norm(steps, axis=1))])
    place = rng.uniform(3.0, 12.0)
    turned = np.radians(angle_deg) * ndtr((along[:-1] - place) / _BEND_WIDTH_MM)
    tangent = steps[int(np.searchsorted(along, place))]
    axis = np.cross(tangent, rng.normal(size=3))
    axis /= np.linalg.norm(axis)
    bent: Array = rest_mm[0] + np.concatenate(
        [np.zeros((1, 3)), np.cumsum(Rotation.from_rotvec(turned[:, None] * axis).apply(steps), axis=0)]
    )
    return bent


def _decapolar(conditions: Conditions, anatomy: Anatomy) -> Resident:
    """Return a catheter in the coronary sinus, along the base of the left ventricle."""
    rng = np.random.default_rng([conditions.seed, _SLIP])
    chamber = anatomy.chamber
    across, apex = chamber.axes[1], chamber.axes[2]
    tip = chamber.centre_mm + 26 * across - 24 * apex + rng.normal(0, 3, 3)
    behind = tip + 18 * chamber.axes[0] + rng.normal(0, 3, 3)
    bow = chamber.centre_mm + 34 * chamber.axes[0] - 30 * apex + rng.normal(0, 3, 3)
    entry = np.array([-18.0, 8.0, 95.0])
    shaft = Shaft.through(_DECAPOLAR, RADIUS_6F_MM, False, tip, behind, bow, entry)
    shaft = replace(shaft, rest_mm=shaft.rest_mm[:_SHAFT_POINTS])
    vectors = 0.6 * wall_vectors(chamber, tip[None], np.zeros(3))[0]
    return Resident(shaft, vectors)


@dataclass(frozen=True, eq=False)
class _Times:
    """Heart beats, breathing and frame times of one run."""

    times_s: Array
    beats: Beats
    breathing: Breathing

    def lines_mm(self, residents: tuple[Resident, ...]) -> list[Array]:
        """Return each catheter's centre line in every frame, (n, k, 3)."""
        pulses, rest = self.beats.pulses(self.times_s), self.beats.rest_mm(self.times_s)
        breath = self.breathing.at(self.times_s)[:, None, :]
        return [
            resident.shaft.lines_mm(pulses @ resident.vectors_mm + rest[:, number]) + breath
            for number, resident in enumerate(residents)
        ]

    @property
    def phases(self) -> Array:
        marks = self.beats.r_waves_s
        phases: Array = np.interp(self.times_s, marks, np.arange(len(marks), dtype=np.float64)) % 1.0
        return phases


def _site(
    conditions: Conditions, rate_hz: float, residents: tuple[Resident, ...], index: int
) -> tuple[SiteRuns, ClinicalSite]:
    name = f"S{index + 1:02d}"
    times = [_times(conditions, rate_hz, len(residents), index, view) for view in (0, 1)]
    runs, seen, headers = [], [], []
    shift = _table_frame_mm(conditions, index)
    for view, of_run in enumerate(times):
        header = camera_from_gantry(GANTRIES[view])
        table = _table_mm(conditions, index, view)
        if conditions.table is not None and conditions.table.in_header:
            header = header.translated(table)
        headers.append(header)
        camera = _true_camera(conditions.gantry_errors[view], view).translated(table - shift)
        runs.append(_run(conditions, camera, residents, of_run, shift))
        seen.append(_segmentation(conditions, runs[-1], of_run, index, view))
    breath = np.mean([one.breathing.at(one.times_s).mean(axis=0) for one in times], axis=0)
    pulses = Beats.even(1.0, 1.0).pulses(np.array([DIASTOLIC_PHASE]))
    diastole = {
        r.shaft.catheter.name: _electrodes_mm(r.shaft, r.shaft.lines_mm(pulses @ r.vectors_mm), 0.0)[0] + breath + shift
        for r in residents
    }
    truth = ClinicalSite(name, (runs[0], runs[1]), diastole)
    return SiteRuns(name, headers[0], headers[1], seen[0], seen[1]), truth


def _table_mm(conditions: Conditions, site: int, view: int) -> Array:
    """Return the patient's displacement (3,) by the table in a run."""
    table = conditions.table
    if table is None or (site, view) < (table.site, 1):
        return np.zeros(3)
    return np.array(table.displacement_mm)


def _table_frame_mm(conditions: Conditions, site: int) -> Array:
    """Return the displacement (3,) of the truth's frame from the patient's.

    The truth is in the patient's frame where the files state the table's position. Otherwise it is in the room's frame, at
    the table position of view a: nothing shows more.
    """
    if conditions.table is None or conditions.table.in_header:
        return np.zeros(3)
    return _table_mm(conditions, site, 0)


def _times(conditions: Conditions, rate_hz: float, catheters: int, site: int, view: int) -> _Times:
    """Draw beats and breathing of a run.

    Both runs of a simultaneous pair share them.
    """
    view = 0 if conditions.simultaneous else view
    rng = np.random.default_rng([conditions.seed, _RUN, site, view])
    frames = max(round(conditions.seconds * conditions.frame_rate_hz), 5)
    times = np.arange(frames) / conditions.frame_rate_hz
    beats = _beats(conditions, rate_hz, float(times[-1]), catheters, rng)
    breathing = Breathing.draw(conditions.breathing_mm, np.random.default_rng([conditions.seed, _BREATH, site, view]))
    return _Times(times, beats, breathing)


def _beats(
    conditions: Conditions, rate_hz: float, duration_s: float, catheters: int, rng: np.random.Generator
) -> Beats:
    """Draw the beats of a run. Amplitude follows the interval before: a long diastole fills the heart."""
    period = 1 / rate_hz
    spread = {"regular": 0.0, "irregular": _IRREGULAR_SD, "fibrillation": _FIBRILLATION_SD}[conditions.rhythm]
    count = int(np.ceil(1.6 * duration_s / period)) + 8
    intervals = np.maximum(period * np.exp(spread * rng.normal(size=count)), _SHORTEST_BEAT_S)
    marks = np.concatenate([[0.0], np.cumsum(intervals)]) - intervals[:2].sum() - period * rng.uniform()
    before = np.concatenate([[period], intervals])
    scale = conditions.beat_scale
    amplitude = 1 + scale * BEAT_AMPLITUDE * np.clip(rng.normal(size=count + 1), -2, 2)
    amplitude *= np.clip(1 + _FOLLOWS_INTERVAL * (before / period - 1), 0.5, 1.4)
    return Beats(
        period, marks, amplitude, scale * BEAT_TIMING_CYCLE * rng.normal(size=count + 1),
        scale * BEAT_POSITION_MM * rng.normal(size=(count + 1, catheters, 3)),
    )  # fmt: skip


def _true_camera(error: GantryError, view: int) -> Camera:
    gantry = GANTRIES[view]
    camera = camera_from_gantry(replace(gantry, source_detector_mm=gantry.source_detector_mm * (1 + error.scale)))
    displaced = np.eye(4)
    displaced[:3, :3] = Rotation.from_rotvec(error.rotation_deg, degrees=True).as_matrix()
    displaced[:3, 3] = error.offset_mm
    return Camera(camera.matrix @ displaced, camera.rows, camera.columns)


def _run(
    conditions: Conditions, camera: Camera, residents: tuple[Resident, ...], times: _Times, shift_mm: Array
) -> ClinicalRun:
    points, pixels = {}, {}
    offsets = (*conditions.tip_offsets_mm, 0.0)
    for resident, lines, offset in zip(residents, times.lines_mm(residents), offsets, strict=False):
        name = resident.shaft.catheter.name
        points[name] = _electrodes_mm(resident.shaft, lines, 0.0) + shift_mm
        seen = _electrodes_mm(resident.shaft, lines, offset) + shift_mm if offset else points[name]
        pixels[name] = camera.project(seen)
    return ClinicalRun(times.phases, points, pixels)


def _electrodes_mm(shaft: Shaft, lines_mm: Array, tip_offset_mm: float) -> Array:
    """Return electrode centres (t, m, 3) on centre lines (t, k, 3), the tip's displaced along the shaft."""
    wanted = shaft.catheter.tip_mm / 2 + shaft.catheter.arc_lengths_mm
    wanted[0] += tip_offset_mm
    length = arc_lengths_mm(lines_mm)
    after = np.clip((length[:, :, None] < wanted).sum(axis=1), 1, length.shape[1] - 1)
    rows = np.arange(len(lines_mm))[:, None]
    low, high = length[rows, after - 1], length[rows, after]
    share = ((wanted - low) / (high - low))[..., None]
    centres: Array = (1 - share) * lines_mm[rows, after - 1] + share * lines_mm[rows, after]
    return centres


def _segmentation(conditions: Conditions, run: ClinicalRun, times: _Times, site: int, view: int) -> Segmentation:
    """Return the run's chains as an ideal segmenter finds them: all electrodes, with noise.

    A segmenter looks for the catalogue's catheters. In the unlisted one it finds four electrodes that fit.
    """
    rng = np.random.default_rng([conditions.seed, _CHAINS, site, view])
    pixels = dict(run.pixels_uv)
    if "decapolar" in pixels:
        first = int(rng.choice([0, 2, 4, 6], p=[0.7, 0.1, 0.1, 0.1]))
        pixels["decapolar"] = pixels["decapolar"][:, first : first + 4]
    places = np.concatenate(list(pixels.values()), axis=1)
    speed = np.sqrt((np.diff(places, axis=0) ** 2).sum(axis=2).mean(axis=1))
    motion = np.concatenate([speed[:1], speed]) + 0.05
    times_ms = 1000 * times.times_s
    quiet = diastolic_frames(motion, times_ms)
    order = list(rng.permutation(list(pixels)))

    def chains(frames: list[int]) -> tuple[Chain, ...]:
        return tuple(
            _chain(conditions, name, track, pixels[name][frames].mean(axis=0), rng) for track, name in enumerate(order)
        )

    frames = tuple(FrameChains(frame, chains([frame])) for frame in range(len(times_ms)))
    diastole = FrameChains(quiet[len(quiet) // 2], chains(list(quiet))) if len(quiet) else None
    waves = np.rint(times.beats.r_waves_s * conditions.frame_rate_hz).astype(int)
    shown = tuple(int(frame) for frame in waves if 0 <= frame < len(times_ms)) if conditions.r_waves else ()
    return Segmentation(frames, diastole, tuple(quiet), motion, times_ms, shown)


def _chain(conditions: Conditions, name: str, track: int, pixels: Array, rng: np.random.Generator) -> Chain:
    names = DEFAULT_CATALOGUE.names
    p = 1 / 3 if conditions.mapping_looks_alike else 0.8 if name == "mapping" else 0.1
    kinds = tuple((other, p if other == "mapping" else (1 - p) / 2) for other in names)
    m = len(pixels)
    return Chain(
        tuple(range(1, m + 1)), pixels + rng.normal(0, NOISE_PX, pixels.shape),
        np.broadcast_to(NOISE_PX**2 * np.eye(2), (m, 2, 2)), np.full(m, 10.0), kinds, track,
    )  # fmt: skip
