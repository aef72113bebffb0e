"""A simulated mapping study: the input of the pipeline and its truth."""

from __future__ import annotations

import functools
import math
from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import Literal, get_args

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from fluoromap.catheters import DEFAULT_CATALOGUE, Catalogue
from fluoromap.geometry import Camera, Gantry, camera_from_gantry
from fluoromap.phantom.anatomy import Anatomy, Resident, draw_anatomy, electrodes_over_cycle_mm
from fluoromap.phantom.appearance import APPEARANCES, Appearance, Contrast
from fluoromap.phantom.chamber import Chamber
from fluoromap.phantom.fluoroscopy import RenderedFrames, detect, expected_photons, transmission
from fluoromap.phantom.motion import DIASTOLIC_PHASE, HEART_RATE_HZ, Beats, Breathing, HeartKind
from fluoromap.phantom.torso import Torso, torso

Array = NDArray[np.float64]
View = Literal["a", "b"]

EXPOSURE_MS = 6.0
ACTIVATION_NOISE_MS = 1.0
_INSTANTS = 3
_MARGIN_PX = 20.0
_ATTEMPTS = 12
_MOST_CATHETERS = 6
# Each purpose has an independent stream of random numbers.
_ANATOMY, _GANTRY, _TIMES, _RUN, _BONES, _TISSUE, _PHOTONS = range(7)


def _standard(primary_deg: float) -> Gantry:
    return Gantry(primary_deg, 0.0, 1000.0, 500.0, (178 / 512, 178 / 512), 512, 512)


LATERAL = _standard(90.0)
"""Left lateral: 512x512 over 178 mm, source to detector 1000 mm, isocentre half way."""
FRONTAL = _standard(0.0)
"""Postero-anterior, otherwise like :data:`LATERAL`."""


@dataclass(frozen=True, slots=True)
class StudySpec:
    """Specification of a simulated study.

    The same specification gives the same study, to the last pixel.

    Parameters
    ----------
    seed : int
        0 or more.
    sites : int
        Number of mapping sites, 1 to 200.
    frames : int
        Frames in each run.
    frame_rate_hz : float
    heart : {"human", "dog"}
        1.0-1.6 or 1.6-2.2 beats a second.
    contrast : pair of {"LAT", "PA"}
        Appearance of view a and b (:data:`~fluoromap.phantom.appearance.APPEARANCES`), independent of their angles.
    gantries : pair of Gantry
        View a and b as stated in the files.
    gantry_error_deg, isocentre_error_mm : float
        Standard deviation, an axis, of a view's true rotation about the isocentre and true offset against the files. There
        is one draw for each view of the study.
    breathing_mm : float
        Largest shift of the heart to head or feet between runs; 0 means that the breath is held all the time.
    dose : float
        Photons a pixel, as a multiple of the appearance's.
    catalogue : Catalogue
        1 to 6 catheters. A single catheter maps, and its study has no reference.

    Raises
    ------
    ValueError
        Where a number is out of range.
    """

    seed: int
    sites: int = 8
    frames: int = 30
    frame_rate_hz: float = 15.0
    heart: HeartKind = "human"
    contrast: tuple[Contrast, Contrast] = ("LAT", "LAT")
    gantries: tuple[Gantry, Gantry] = (LATERAL, FRONTAL)
    gantry_error_deg: float = 0.0
    isocentre_error_mm: float = 0.0
    breathing_mm: float = 4.0
    dose: float = 1.0
    catalogue: Catalogue = DEFAULT_CATALOGUE

    def __post_init__(self) -> None:
        if self.seed < 0:
            raise ValueError("seed must be 0 or more")
        if not 1 <= self.sites <= 200:
            raise ValueError("sites must be between 1 and 200")
        if self.frames < 1:
            raise ValueError("frames must be 1 or more")
        if not 1 <= self.frame_rate_hz <= 120:
            raise ValueError("frame_rate_hz must be between 1 and 120")
        if self.heart not in HEART_RATE_HZ:
            raise ValueError(f"heart must be one of {', '.join(HEART_RATE_HZ)}")
        if len(self.contrast) != 2 or any(contrast not in APPEARANCES for contrast in self.contrast):
            raise ValueError(f"contrast must be two of {', '.join(APPEARANCES)}")
        if len(self.gantries) != 2:
            raise ValueError("gantries must be two")
        for name in ("gantry_error_deg", "isocentre_error_mm", "breathing_mm"):
            value = getattr(self, name)
            if not (math.isfinite(value) and 0 <= value <= 20):
                raise ValueError(f"{name} must be between 0 and 20")
        if len(self.catalogue.catheters) > _MOST_CATHETERS:
            raise ValueError(f"the catalogue must have at most {_MOST_CATHETERS} catheters")
        if not (math.isfinite(self.dose) and 0.01 <= self.dose <= 100):
            raise ValueError("dose must be between 0.01 and 100")


@dataclass(frozen=True, eq=False)
class RunTruth:
    """Truth of one run, at the middle of each of its n exposures.

    camera : the view with its gantry error. phases : (n,) of the cardiac cycle, 0 at an R wave. points_mm : catheter ->
    (n, electrodes, 3), LPS from the isocentre. pixels_uv : catheter -> (n, electrodes, 2), (u, v) of electrode centres.
    """

    camera: Camera
    phases: Array
    points_mm: Mapping[str, Array]
    pixels_uv: Mapping[str, Array]


@dataclass(frozen=True, eq=False)
class SimulatedRun:
    """One cine as in a file, and its truth.

    view : "a" or "b". gantry : as stated in the file. frame_times_ms : (n,) from the first frame on. start_seconds :
    acquisition of the first frame after the study's start. r_wave_frames : frames nearest to the R waves.
    """

    view: View
    gantry: Gantry
    frames: RenderedFrames
    frame_times_ms: Array
    start_seconds: float
    r_wave_frames: tuple[int, ...]
    truth: RunTruth


@dataclass(frozen=True, eq=False)
class SiteTruth:
    """Truth of one site at diastole, averaged over the beats of its two runs.

    diastole_mm : catheter -> (electrodes, 3), LPS from the isocentre, breathing averaged over both runs.
    relative_mm : free of breathing, minus the mean of the reference catheter, if any. contact_mm : (3,) point where the
    mapping tip's end touches the wall, without breathing. lat_ms : activation time there without annotation noise.
    """

    diastole_mm: Mapping[str, Array]
    relative_mm: Mapping[str, Array]
    contact_mm: Array
    lat_ms: float


@dataclass(frozen=True, eq=False)
class SimulatedSite:
    """One place of the mapping tip: annotated activation time ``lat_ms``, runs in view a and b, and truth."""

    name: str
    lat_ms: float
    runs: tuple[SimulatedRun, SimulatedRun]
    truth: SiteTruth


@dataclass(frozen=True, eq=False)
class SimulatedStudy:
    """All sites of one heart.

    chamber : the wall without breathing, with its focus. reference_mm : (3,) mean of the reference catheter at diastole
    without breathing; the chamber minus it is in the map's coordinates. It is 0 where the study has no reference.
    """

    spec: StudySpec
    catalogue: Catalogue
    chamber: Chamber
    reference_mm: Array
    heart_rate_hz: float
    sites: tuple[SimulatedSite, ...]


def simulate_study(spec: StudySpec) -> SimulatedStudy:
    """Simulate a mapping study in a fraction of a second; frames are rendered on access.

    Raises
    ------
    ValueError
        Where the heart does not fit into the views' fields.
    """
    cameras = (_true_camera(spec, 0), _true_camera(spec, 1))
    anatomy = _anatomy_in_field(spec, cameras)
    times_rng = np.random.default_rng([spec.seed, _TIMES])
    start = 0.0
    activation = anatomy.chamber.activation_ms(anatomy.contacts_mm)
    sites = []
    for index in range(spec.sites):
        starts = (start, start + float(times_rng.uniform(20, 60)))
        start = starts[1] + float(times_rng.uniform(90, 240))
        annotated = float(activation[index] + times_rng.normal(0, ACTIVATION_NOISE_MS))
        sites.append(_site(spec, anatomy, cameras, index, starts, (float(activation[index]), annotated)))
    reference = origin_mm(_diastole_mm(anatomy.residents(0)), spec.catalogue)
    return SimulatedStudy(spec, spec.catalogue, anatomy.chamber, reference, anatomy.rate_hz, tuple(sites))


def _true_camera(spec: StudySpec, view: int) -> Camera:
    rng = np.random.default_rng([spec.seed, _GANTRY, view])
    camera = camera_from_gantry(spec.gantries[view])
    error = np.eye(4)
    error[:3, :3] = Rotation.from_rotvec(rng.normal(0, spec.gantry_error_deg, 3), degrees=True).as_matrix()
    error[:3, 3] = rng.normal(0, spec.isocentre_error_mm, 3)
    return Camera(camera.matrix @ error, camera.rows, camera.columns)


def _anatomy_in_field(spec: StudySpec, cameras: tuple[Camera, Camera]) -> Anatomy:
    """Draw hearts until one fits into both fields.

    Its electrodes must stay inside over the cycle and all breathing positions.
    """
    rng = np.random.default_rng([spec.seed, _ANATOMY])
    breaths = np.array([[0.0, 0.0, -1.2], [0.0, 0.0, 1.2]]) * spec.breathing_mm
    for _ in range(_ATTEMPTS):
        anatomy = draw_anatomy(spec.heart, spec.sites, rng, spec.catalogue)
        points = np.concatenate([electrodes_over_cycle_mm(anatomy.residents(i), 8) for i in range(spec.sites)])
        points = points[..., None, :] + breaths
        inside = True
        for camera in cameras:
            pixels = camera.project(points)
            limit = np.array([camera.columns, camera.rows]) - 1 - _MARGIN_PX
            inside &= bool((pixels >= _MARGIN_PX).all() and (pixels <= limit).all())
        if inside:
            return anatomy
    raise ValueError(
        "the heart does not fit into the views' fields; choose gantries with a field of at least 75 mm at the isocentre"
    )


def _site(
    spec: StudySpec,
    anatomy: Anatomy,
    cameras: tuple[Camera, Camera],
    index: int,
    starts: tuple[float, float],
    lat_ms: tuple[float, float],
) -> SimulatedSite:
    residents = anatomy.residents(index)
    exposures = tuple(_exposures(spec, anatomy, index, view) for view in (0, 1))
    times = np.arange(spec.frames) / spec.frame_rate_hz
    runs = tuple(_run(spec, cameras[view], exposures[view], times, index, view, starts[view]) for view in (0, 1))
    breathing = np.mean([e.breathing.at(times).mean(axis=0) for e in exposures], axis=0)
    diastole = _diastole_mm(residents)
    origin = origin_mm(diastole, spec.catalogue)
    truth = SiteTruth(
        MappingProxyType({name: _read_only(points + breathing) for name, points in diastole.items()}),
        MappingProxyType({name: _read_only(points - origin) for name, points in diastole.items()}),
        _read_only(anatomy.contacts_mm[index]),
        lat_ms[0],
    )
    return SimulatedSite(f"S{index + 1:02d}", lat_ms[1], (runs[0], runs[1]), truth)


def _diastole_mm(residents: tuple[Resident, ...]) -> dict[str, Array]:
    """Return the electrodes at diastole of the average beat without breathing, catheter -> (electrodes, 3)."""
    pulses = Beats.even(1.0, 1.0).pulses(np.array([DIASTOLIC_PHASE]))
    return {r.shaft.catheter.name: r.shaft.electrodes_mm(r.shaft.lines_mm(pulses @ r.vectors_mm))[0] for r in residents}


def origin_mm(electrodes_mm: Mapping[str, Array], catalogue: Catalogue) -> Array:
    """Return the mean of the reference catheter's electrodes.

    It is the isocentre where the study has no reference.

    Parameters
    ----------
    electrodes_mm : mapping of catheter to (..., electrodes, 3)
    catalogue : Catalogue

    Returns
    -------
    ndarray (..., 3)
    """
    if catalogue.reference is None:
        return np.zeros(3)
    mean: Array = electrodes_mm[catalogue.reference].mean(axis=-2)
    return mean


@dataclass(frozen=True, eq=False)
class _Exposures:
    """The catheters of one run at any time."""

    residents: tuple[Resident, ...]
    beats: Beats
    breathing: Breathing

    def lines_mm(self, times_s: Array) -> list[Array]:
        """Return the centre line of each catheter at times ``(t,)``, each (t, k, 3)."""
        pulses = self.beats.pulses(times_s)
        rest = self.beats.rest_mm(times_s)
        breath = self.breathing.at(times_s)[:, None, :]
        return [
            resident.shaft.lines_mm(pulses @ resident.vectors_mm + rest[:, number]) + breath
            for number, resident in enumerate(self.residents)
        ]


def _exposures(spec: StudySpec, anatomy: Anatomy, site: int, view: int) -> _Exposures:
    rng = np.random.default_rng([spec.seed, _RUN, site, view])
    residents = anatomy.residents(site)
    beats = Beats.draw(anatomy.rate_hz, spec.frames / spec.frame_rate_hz, len(residents), rng)
    return _Exposures(residents, beats, Breathing.draw(spec.breathing_mm, rng))


def _run(
    spec: StudySpec, camera: Camera, exposures: _Exposures, times_s: Array, site: int, view: int, start_s: float
) -> SimulatedRun:
    gantry = spec.gantries[view]
    names = [resident.shaft.catheter.name for resident in exposures.residents]
    points = {
        name: _read_only(resident.shaft.electrodes_mm(line))
        for name, resident, line in zip(names, exposures.residents, exposures.lines_mm(times_s), strict=True)
    }
    pixels = {name: _read_only(camera.project(points[name])) for name in names}
    truth = RunTruth(
        camera, _read_only(exposures.beats.phases(times_s)), MappingProxyType(points), MappingProxyType(pixels)
    )
    r_waves = np.rint(exposures.beats.r_waves_s * spec.frame_rate_hz).astype(int)
    r_wave_frames = tuple(int(frame) for frame in r_waves if 0 <= frame < spec.frames)
    appearance = APPEARANCES[spec.contrast[view]]
    breath_mm = float(exposures.breathing.shift_mm[2])

    def render(frame: int) -> NDArray[np.uint16]:
        behind = _torso(gantry, appearance, spec.seed, site, view, breath_mm)
        instants = times_s[frame] + (np.arange(_INSTANTS) - (_INSTANTS - 1) / 2) / _INSTANTS * EXPOSURE_MS / 1000
        shafts = [resident.shaft for resident in exposures.residents]
        passed = transmission(camera, shafts, exposures.lines_mm(instants), appearance)
        expected = expected_photons(behind, passed, appearance, spec.dose)
        key = np.random.SeedSequence([spec.seed, _PHOTONS, site, view, frame]).generate_state(1, np.uint64)[0]
        return detect(expected, appearance.photons * spec.dose, int(key))

    frames = RenderedFrames((gantry.rows, gantry.columns), spec.frames, render)
    name: View = get_args(View)[view]
    return SimulatedRun(name, gantry, frames, _read_only(times_s * 1000), start_s, r_wave_frames, truth)


@functools.lru_cache(maxsize=4)
def _torso(gantry: Gantry, appearance: Appearance, seed: int, site: int, view: int, breathing_mm: float) -> Torso:
    bones = np.random.default_rng([seed, _BONES, view])
    tissue = np.random.default_rng([seed, _TISSUE, site, view])
    return torso(gantry, appearance, bones, tissue, breathing_mm)


def _read_only(array: Array) -> Array:
    array = np.array(array, dtype=np.float64)
    array.setflags(write=False)
    return array
