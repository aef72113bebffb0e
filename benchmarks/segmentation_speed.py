"""Speed of segmentation: ``python benchmarks/segmentation_speed.py [sites] [frames] [seed]``.

All times are processor time of one thread, so that a busy machine gives nearly the figures of an idle machine. Measured are:

1. each filter of the four steps on one simulated 512x512 frame a view, beside its plain NumPy/SciPy/scikit-image twin (the
   oracle of the tests) and beside SimpleITK, OpenCV and medpy where installed (the same sweeps or radii on the same input);
2. the segmenters on runs of several lengths, everything included, in ms a frame;
3. decoding of real compressed frames, where FLUOROMAP_SAMPLE_DATA names a folder of them;
4. the start of a worker process before it takes work, with an empty and with a full folder of compiled kernels;
5. a study of ``sites`` x 2 views x ``frames`` uncompressed frames (20 x 2 x 120) from the files to chains and tracks, without
   the time in which the phantom renders it.
"""

from __future__ import annotations

import os

# One core, as in a worker: threads of the matrix products would only wait for each other.
os.environ.update(OMP_NUM_THREADS="1", OPENBLAS_NUM_THREADS="1", NUMBA_NUM_THREADS="1")

import importlib
import importlib.util
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from datetime import UTC, datetime
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from memory_frames import MemoryFrames
from numpy.typing import NDArray
from skimage.filters import threshold_otsu
from skimage.measure import label, regionprops
from skimage.morphology import disk

from fluoromap.catheters import DEFAULT_CATALOGUE
from fluoromap.contracts import PixelFacts, Run, Segmenter, Silent
from fluoromap.geometry import camera_from_gantry
from fluoromap.phantom import Contrast, SimulatedRun, StudySpec, simulate_study
from fluoromap.segmenter.catheter_chain.plugin import CatheterChain, blob_chains
from fluoromap.segmenter.four_step.blobs import find_blobs
from fluoromap.segmenter.four_step.complex_shock import complex_shock, to_grey_range
from fluoromap.segmenter.four_step.frame_chains import FourStepDetector, FourStepParams
from fluoromap.segmenter.four_step.homomorphic import homomorphic
from fluoromap.segmenter.four_step.morphology import disk_morphology
from fluoromap.segmenter.four_step.perona_malik import edge_scale, perona_malik
from fluoromap.segmenter.four_step.plugin import FourStep
from fluoromap.segmenter.learned_chain.plugin import LearnedChain
from fluoromap.segmenter.picture.field_mask import find_field
from fluoromap.segmenter.picture.log_image import Image, LogTransform
from fluoromap_service.dicom import deterministic_uid, open_frames, read_instance, write_cine

Work = Callable[[], object]

VIEWS: tuple[Contrast, Contrast] = ("LAT", "PA")
LENGTHS = 30, 60, 120, 240
FACTS = PixelFacts(logarithmic=False, bits_stored=12, monochrome1=False)
GOAL_MS = 12.5
REAL = {
    "JPEG baseline 512": "xa_512x512x96_jpeg_baseline.dcm",
    "JPEG lossless 1024": "xa_1024_jpeg_lossless.dcm",
    "JPEG 2000 lossless 1024": "xa_1024_jpeg2000_lossless.dcm",
}
START = """
import time
begun = time.process_time()
from fluoromap_workers.pool_child import warm_up
from fluoromap.registry import plugins
plugins()
imported = time.process_time()
warm_up()
print(imported - begun, time.process_time() - imported)
"""


def main(sites: int, frames: int, seed: int) -> None:
    longest = max(LENGTHS)
    spec = StudySpec(seed, sites=1, frames=longest, frame_rate_hz=60.0, heart="dog", contrast=VIEWS)
    runs = simulate_study(spec).sites[0].runs
    # Filters come before hundreds of frames fill the memory: then every new array costs page faults, which no worker has.
    for view, run in zip(VIEWS, runs, strict=True):
        filters(view, run.frames[0], camera_from_gantry(run.gantry).px_per_mm)
    pictures = [list(run.frames) for run in runs]
    lengths(runs, pictures)
    decoding()
    starting()
    study(sites, frames, seed + 1)


def milliseconds(work: Work, repeats: int = 9) -> float:
    """Return the median milliseconds over ``repeats`` after one warm-up."""
    work()
    times = []
    for _ in range(repeats):
        start = time.process_time()
        work()
        times.append(time.process_time() - start)
    return 1000 * float(np.median(times))


def filters(view: str, frame: NDArray[np.uint16], px_per_mm: float) -> None:
    plain = _twins()
    run = Run(MemoryFrames([frame]), np.zeros(1), px_per_mm, FACTS)
    mask = find_field(run.frames, run.pixels)
    x: Image = mask.fill(LogTransform.of_run(run.pixels, mask.mean_level)(frame))
    steps = FourStepDetector(DEFAULT_CATALOGUE, mask, px_per_mm, FourStepParams())
    blobs = blob_chains(DEFAULT_CATALOGUE, mask, px_per_mm)
    filtered = homomorphic(x)
    k = edge_scale(filtered, mask.inside)
    assert k is not None
    diffused = perona_malik(filtered, k)
    grey = to_grey_range(diffused, mask.inside)
    sharp = complex_shock(grey)
    bright = disk_morphology(sharp)

    def components() -> object:
        return regionprops(label(bright >= threshold_otsu(bright, nbins=1024), connectivity=2))  # type: ignore[no-untyped-call]

    rows: dict[str, tuple[Work, Work, dict[str, Work]]] = {
        "homomorphic (4)": (lambda: homomorphic(x), lambda: plain.plain_homomorphic(x), {}),
        "Perona-Malik (5)(6)": (
            lambda: perona_malik(filtered, k),
            lambda: plain.plain_perona_malik(filtered, k),
            _diffusion_peers(filtered, k),
        ),
        "complex shock (7)": (lambda: complex_shock(grey), lambda: plain.plain_complex_shock(grey), {}),
        "disks of 14 and 2 px": (
            lambda: disk_morphology(sharp),
            lambda: plain.plain_disk_morphology(sharp.astype(float), 14, 2),
            _disk_peers(sharp),
        ),
        "Otsu, components": (
            lambda: find_blobs(bright, mask.inside, mask.candidates, 20, 800),
            components,
            _component_peers(bright),
        ),
    }
    print(f"512x512 {view}, ms a frame          ours      twin  ratio   peers")
    twins = 0.0
    for name, (ours, twin, peers) in rows.items():
        mine, theirs = milliseconds(ours), milliseconds(twin, 1)
        twins += theirs
        beside = ", ".join(f"{peer} {milliseconds(work, 3):.1f}" for peer, work in peers.items())
        print(f"  {name:30}{mine:8.2f}{theirs:10.1f}{theirs / mine:6.0f}x   {beside}")
    chain = milliseconds(lambda: steps.blobs(x))
    print(f"  {'four steps and labels':30}{chain:8.2f}{twins:10.1f}{twins / chain:6.0f}x   goal 14 ms, 30x")
    print(f"  {'four-step, chains':30}{milliseconds(lambda: steps.find_chains(x, 0)):8.2f}")
    print(f"  {'catheter-chain, chains':30}{milliseconds(lambda: blobs.find_chains(x, 0)):8.2f}")
    print(f"  {'field mask, once a run':30}{milliseconds(lambda: find_field(run.frames, run.pixels)):8.2f}")


def lengths(runs: tuple[SimulatedRun, SimulatedRun], frames: list[list[NDArray[np.uint16]]]) -> None:
    plans: list[tuple[str, Callable[[], Segmenter], tuple[int, ...]]] = [
        ("catheter-chain", CatheterChain, LENGTHS),
        ("learned-chain", LearnedChain, LENGTHS),
        ("four-step", FourStep, LENGTHS[:1]),
    ]
    print("runs with tracking and diastole, ms a frame" + "".join(f"{count:8} frames" for count in LENGTHS))
    for name, segmenter, counts in plans:
        for view, run, pictures in zip(VIEWS, runs, frames, strict=True):
            cells = []
            for count in counts:
                part = Run(
                    MemoryFrames(pictures[:count]),
                    run.frame_times_ms[:count],
                    camera_from_gantry(run.gantry).px_per_mm,
                    FACTS,
                )
                cells.append(milliseconds(partial(_segment, segmenter(), part), 1) / count)
            print(f"  {name + ', ' + view:42}" + "".join(f"{cell:15.2f}" for cell in cells))


def decoding() -> None:
    folder = os.environ.get("FLUOROMAP_SAMPLE_DATA")
    if not folder:
        print("decoding: FLUOROMAP_SAMPLE_DATA names no folder of real files")
        return
    print("decoding, ms a frame                  ours   pydicom")
    pixel_array = importlib.import_module("pydicom.pixels.utils").pixel_array
    for name, file in REAL.items():
        path = Path(folder) / file
        frames = open_frames(path, read_instance(path))
        ours = milliseconds(partial(frames.__getitem__, 0))
        theirs = milliseconds(partial(pixel_array, path, index=0))
        print(f"  {name:30}{ours:10.2f}{theirs:10.2f}")


def starting() -> None:
    """Print the start time of a worker process.

    The modules' byte code exists, as after any first start.
    """
    with tempfile.TemporaryDirectory() as folder:
        environment = {key: value for key, value in os.environ.items() if key != "PYTHONDONTWRITEBYTECODE"}
        environment["PYTHONPYCACHEPREFIX"] = str(Path(folder) / "code")
        print("a worker process starts, s           imports   warm-up")
        for label, kernels in (("", "first"), ("no compiled kernels", "second"), ("compiled kernels", "second")):
            environment["NUMBA_CACHE_DIR"] = str(Path(folder) / kernels)
            command = [sys.executable, "-c", START]
            done = subprocess.run(command, env=environment, stdout=subprocess.PIPE, text=True, check=True)
            imports, warm_up = (float(word) for word in done.stdout.split()[-2:])
            if label:
                print(f"  {label:30}{imports:12.2f}{warm_up:10.2f}")
    print("  goal: 8 s without compiled kernels, 1 s with them")


def study(sites: int, frames: int, seed: int) -> None:
    spec = StudySpec(seed, sites=sites, frames=frames, frame_rate_hz=60.0, heart="dog", contrast=VIEWS)
    spent, count = 0.0, 0
    with tempfile.TemporaryDirectory() as folder:
        for site in simulate_study(spec).sites:
            for run in site.runs:
                path = Path(folder) / "run.dcm"
                _write(path, run, f"{seed}.{site.name}.{run.view}")
                start = time.process_time()
                facts = read_instance(path)
                px_per_mm = camera_from_gantry(run.gantry).px_per_mm
                part = Run(open_frames(path, facts), np.array(facts.frame_times_ms), px_per_mm, facts.pixels)
                _segment(CatheterChain(), part)
                spent += time.process_time() - start
                count += facts.frames
                path.unlink()
    each = 1000 * spent / count
    whole = 20 * 2 * 120 * each / 1000
    print(
        f"study of {sites} sites x 2 views x {frames} frames, from the files: {spent:.1f} s, {each:.2f} ms a frame "
        f"(goal {GOAL_MS}); 20 x 2 x 120 frames: {whole:.0f} s (goal 60)"
    )


def _segment(segmenter: Segmenter, run: Run) -> object:
    return segmenter.segment(run, DEFAULT_CATALOGUE, {}, Silent())


def _write(path: Path, run: SimulatedRun, name: str) -> None:
    write_cine(
        path,
        run.frames,
        frame_count=len(run.frames),
        gantry=run.gantry,
        frame_time_ms=1000 / 60,
        acquired=datetime(2026, 1, 5, tzinfo=UTC),
        study_instance_uid=deterministic_uid("speed"),
        series_number=1,
        sop_instance_uid=deterministic_uid(name),
    )


def _twins() -> Any:
    """Return the module of the tests' plain filters."""
    path = Path(__file__).parents[1] / "tests" / "plugins" / "segmenter" / "test_filters.py"
    spec = importlib.util.spec_from_file_location("plain_filters", path)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def _peer(name: str) -> Any:
    """Return a peer's module with one thread; None if not installed."""
    try:
        module: Any = importlib.import_module(name)
    except ImportError:
        return None
    if name == "SimpleITK":
        module.ProcessObject.SetGlobalDefaultNumberOfThreads(1)
    if name == "cv2":
        module.setNumThreads(1)
    return module


def _diffusion_peers(x: Image, k: float) -> dict[str, Work]:
    peers: dict[str, Work] = {}
    sitk, medpy = _peer("SimpleITK"), _peer("medpy.filter.smoothing")
    if sitk is not None:
        image = sitk.GetImageFromArray(x)
        peers["SimpleITK gradient"] = lambda: sitk.GradientAnisotropicDiffusion(image, 0.125, 1.0, 1, 15)
        peers["curvature"] = lambda: sitk.CurvatureAnisotropicDiffusion(image, 0.0625, 1.0, 1, 15)
    if medpy is not None:
        peers["medpy"] = lambda: medpy.anisotropic_diffusion(x, niter=15, kappa=k, gamma=0.2, option=1)
    return peers


def _disk_peers(x: Image) -> dict[str, Work]:
    peers: dict[str, Work] = {}
    sitk, cv2 = _peer("SimpleITK"), _peer("cv2")
    if sitk is not None:
        image = sitk.GetImageFromArray(x)

        def by_sitk() -> object:
            hat = sitk.BlackTopHat(image, [14, 14], sitk.sitkBall)
            return sitk.GrayscaleMorphologicalOpening(hat, [2, 2], sitk.sitkBall)

        peers["SimpleITK"] = by_sitk
    if cv2 is not None:
        large, small = disk(14).astype(np.uint8), disk(2).astype(np.uint8)

        def by_cv2() -> object:
            return cv2.morphologyEx(cv2.morphologyEx(x, cv2.MORPH_BLACKHAT, large), cv2.MORPH_OPEN, small)

        peers["OpenCV"] = by_cv2
    return peers


def _component_peers(x: Image) -> dict[str, Work]:
    peers: dict[str, Work] = {}
    sitk, cv2 = _peer("SimpleITK"), _peer("cv2")
    if sitk is not None:
        image = sitk.GetImageFromArray(x)

        def by_sitk() -> object:
            shapes = sitk.LabelShapeStatisticsImageFilter()
            shapes.Execute(sitk.ConnectedComponent(sitk.OtsuThreshold(image, 0, 1, 1024), True))
            return shapes.GetNumberOfLabels()

        peers["SimpleITK"] = by_sitk
    if cv2 is not None:

        def by_cv2() -> object:
            # OpenCV's Otsu takes 8 bits.
            levels = cv2.convertScaleAbs(x, alpha=255.0 / max(float(x.max()), 1e-6))
            return cv2.connectedComponentsWithStats(cv2.threshold(levels, 0, 255, cv2.THRESH_OTSU)[1], connectivity=8)

        peers["OpenCV, 8 bits"] = by_cv2
    return peers


if __name__ == "__main__":
    given = [int(argument) for argument in sys.argv[1:]]
    main(*(given + [20, 120, 8000][len(given) :]))
