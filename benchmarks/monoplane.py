"""Accuracy and speed of rigid-body tracking in one view: ``python benchmarks/monoplane.py [seed]``.

The data are the paper's simulation: a helix of 30 points that rotates by 0.5 degrees about each axis and moves by 1 mm along
each from frame to frame, with 0.5 px noise. H77 is the helix that reproduces the paper's Table 1; H18 fits into the image.
The benchmark prints:

- the 3D RMS beside the Cramer-Rao bound,
- the result for a-priori positions that are 2 mm wrong,
- the compiled pose beside OpenCV's, where installed, on the same images,
- refusals: one catheter alone, and three catheters in a beating heart.

Times are processor time of one thread. OpenCV is called from Python image by image, the compiled pose once a batch.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from importlib import import_module
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fluoromap.catheters import DEFAULT_CATALOGUE, Catalogue, Catheter
from fluoromap.contracts import (
    CHI2_95_3D,
    ElectrodePoint,
    MonoplaneView,
    NamedChain,
    Observation,
    Refusal,
    Silent,
    SiteCycle,
)
from fluoromap.geometry import Camera
from fluoromap.monoplane.body_pose import pose_covariance_mm2, rotation_of, solve_poses, track_body
from fluoromap.monoplane.rigid_pose import RigidPose
from fluoromap.phantom import StudySpec, simulate_study

Array = NDArray[np.float64]

NOISE_PX = 0.5
FOCAL_PX = 1000 / (178 / 512)
FRAMES = (3, 6, 15, 30)
POSES = 12_000
BODIES = 40
HEARTS = 10
SPEED_POSES = 3000
ROTATIONS = {"LAT": np.array([[0.0, -1, 0], [0, 0, -1], [1, 0, 0]]), "AP": np.eye(3)}
HELIX = Catalogue((Catheter("helix", 30, (5.0,) * 29, 2, 1), *DEFAULT_CATALOGUE.catheters), "reference", "helix")


@dataclass(frozen=True, eq=False)
class Simulation:
    """Points (n, 30, 3) of a helix in the n frames of one view, and their exact pixels (n, 30, 2)."""

    camera: Camera
    points_mm: Array
    pixels_uv: Array


def helix(name: str) -> Array:
    """Return 30 points over two turns, both ends included: (30, 3) mm from the isocentre."""
    radius, length, axis, centre = {
        "H18": (18.0, 60.0, 1, (-12, -13, -16)),
        "H77": (77.0, 250.0, 2, (-12, -15, -19)),
    }[name]
    t = np.linspace(0, 1, 30)
    across = radius * np.cos(4 * np.pi * t), radius * np.sin(4 * np.pi * t)
    points: Array = np.roll(np.stack([*across, length * (t - 0.5)], axis=1), axis - 2, axis=1) + centre
    return points


def simulate(name: str, view: str, frames: int) -> Simulation:
    """Simulate the paper's motion, X' = Rz Ry Rx X + (1, 1, 1) mm.

    The camera is right-handed and 500 mm from the isocentre.
    """
    intrinsic = np.array([[FOCAL_PX, 0, 256], [0, FOCAL_PX, 256], [0, 0, 1]])
    camera = Camera(intrinsic @ np.column_stack([ROTATIONS[view], [0, 0, 500]]), 512, 512)
    about = rotation_of(np.radians(0.5) * np.eye(3))
    points = [helix(name)]
    for _ in range(frames - 1):
        points.append(points[-1] @ (about[2] @ about[1] @ about[0]).T + 1.0)
    return Simulation(camera, np.array(points), camera.project(np.array(points)))


def bound_mm(camera: Camera, points_mm: Array) -> float:
    """Return the Cramer-Rao bound of one frame's points (m, 3), RMS 3D."""
    m = len(points_mm)
    noise = np.broadcast_to(NOISE_PX**2 * np.eye(2), (m, 2, 2))
    covariance = pose_covariance_mm2(camera, points_mm, points_mm.mean(axis=0), noise, np.ones(m, dtype=bool))
    return float(np.sqrt(np.trace(covariance, axis1=1, axis2=2).mean()))


def rms(errors: Array) -> float:
    return float(np.sqrt((errors**2).sum(axis=-1).mean()))


def accuracy(rng: np.random.Generator) -> Iterator[str]:
    """Yield RMS 3D and depth errors for exact a-priori positions.

    The bound is beside each error. The last value is the last frame's RMS over its bound.
    """
    yield f"A body of known shape, {POSES} frames a row. RMS 3D over frames 2..n, mm; ratios to the bound"
    yield f"{'':10}{'frames':>7}{'RMS':>9}{'depth':>9}{'bound':>9}{'ratio':>8}{'last frame':>12}{'noise-free, dz 0..5':>22}"
    for name in ("H18", "H77"):
        for view in ("LAT", "AP"):
            for frames in FRAMES:
                s = simulate(name, view, frames)
                body = s.points_mm[0] - s.points_mm[0].mean(axis=0)
                batch = POSES // (frames - 1)
                rotations = np.broadcast_to(np.eye(3), (batch, 3, 3))
                centres = np.broadcast_to(s.points_mm[0].mean(axis=0), (batch, 3))
                errors = np.empty((frames - 1, batch, 30, 3))
                for frame in range(1, frames):
                    pixels = s.pixels_uv[frame] + rng.normal(0, NOISE_PX, (batch, 30, 2))
                    rotations, centres = solve_poses(s.camera, body, pixels, rotations, centres, 6)
                    errors[frame - 1] = body @ np.swapaxes(rotations, 1, 2) + centres[:, None] - s.points_mm[frame]
                bound = np.sqrt(np.mean([bound_mm(s.camera, at) ** 2 for at in s.points_mm[1:]]))
                depth = float(np.sqrt(np.mean((errors @ s.camera.axis_world) ** 2)))
                yield (
                    f"{name} {view:6}{frames:>7}{rms(errors):>9.4f}{depth:>9.4f}{bound:>9.4f}{rms(errors) / bound:>8.3f}"
                    f"{rms(errors[-1]) / bound_mm(s.camera, s.points_mm[-1]):>12.3f}{noise_free_mm(s):>22.1e}"
                )


def noise_free_mm(s: Simulation) -> float:
    """Return the largest error from exact pixels.

    The start values are 0 to 5 mm depth a frame.
    """
    visible = np.ones(s.pixels_uv.shape[:2], dtype=bool)
    body = s.points_mm[0] - s.points_mm[0].mean(axis=0)
    largest = 0.0
    for depth_step_mm in range(6):
        rotations, centres = track_body(s.camera, s.points_mm[0], s.pixels_uv, visible, 0, float(depth_step_mm), 6)
        errors = body @ np.swapaxes(rotations, 1, 2) + centres[:, None] - s.points_mm
        largest = max(largest, float(np.abs(errors).max()))
    return largest


def view_of(s: Simulation, pixels: Array, a_priori: Array, covariance_mm2: Array) -> MonoplaneView:
    """Return a simulation as solver input.

    The positions of frame 1 are known with this covariance.
    """
    electrodes = tuple(range(1, 31))
    noise = np.broadcast_to(NOISE_PX**2 * np.eye(2), (30, 2, 2))
    return MonoplaneView(
        "S01", "a", s.camera, HELIX, np.arange(len(pixels), dtype=np.float64) * 16.7,
        tuple(Observation(f, None, (NamedChain("helix", electrodes, at, noise),)) for f, at in enumerate(pixels)),
        tuple(
            ElectrodePoint("helix", k, a_priori[k - 1], covariance_mm2, None, None, (0.5, 0.5), 90.0) for k in electrodes
        ),
        0, None, (),
    )  # fmt: skip


def a_priori_errors(rng: np.random.Generator) -> Iterator[str]:
    """Yield the RMS with fixed and with adjusted a-priori positions.

    The a-priori positions are exact, then wrong.
    """
    yield f"\nA-priori positions with errors up to a limit per axis, LAT, {BODIES} bodies a row. RMS 3D over frames 2..n, mm"
    yield (
        f"{'limit':>9}{'frames':>10}{'fixed':>10}{'adjusted':>10}{'bound':>8}{'ratio':>7}{'in 95 %':>9}"
        f"{'smooth path':>13}{'bound':>8}{'in 95 %':>9}"
    )
    solvers = [
        RigidPose(
            RigidPose.Params(known_rigid=True, gantry_angle_sd_deg=0, isocentre_sd_mm=0, acceleration_sd_mm=smooth)
        )
        for smooth in (None, 0.05)
    ]
    for wrong_mm in (0.0, 2.0):
        for name in ("H18", "H77"):
            for frames in (6, 15):
                s = simulate(name, "LAT", frames)
                fixed_errors = []
                errors: list[list[Array]] = [[], []]
                stated: list[list[Array]] = [[], []]
                for _ in range(BODIES):
                    pixels = s.pixels_uv + rng.normal(0, NOISE_PX, s.pixels_uv.shape)
                    a_priori = s.points_mm[0] + rng.uniform(-wrong_mm, wrong_mm, (30, 3))
                    poses = track_body(s.camera, a_priori, pixels, np.ones(pixels.shape[:2], dtype=bool), 0, 0.0, 10)
                    body = a_priori - a_priori.mean(axis=0)
                    fixed_errors.append((body @ np.swapaxes(poses[0], 1, 2) + poses[1][:, None] - s.points_mm)[1:])
                    view = view_of(s, pixels, a_priori, wrong_mm**2 / 3 * np.eye(3))
                    for k, solver in enumerate(solvers):
                        track = solver.track(view, Silent())
                        errors[k].append((track.positions_mm - s.points_mm)[1:])
                        stated[k].append(track.covariance_mm2[1:])
                cells = ""
                for k in (0, 1):
                    error, covariances = np.array(errors[k]), np.array(stated[k])
                    bound = float(np.sqrt(np.trace(covariances, axis1=-2, axis2=-1).mean()))
                    squared = np.einsum("...i,...ij,...j->...", error, np.linalg.inv(covariances), error)
                    share = f"{100 * (squared <= CHI2_95_3D).mean():.1f} %"
                    ratio = f"{rms(error) / bound:>7.2f}" if k == 0 else ""
                    cells += f"{rms(error):>{10 if k == 0 else 13}.2f}{bound:>8.2f}{ratio}{share:>9}"
                yield f"{wrong_mm:>6.0f} mm {name}{frames:>6}{rms(np.array(fixed_errors)):>10.2f}{cells}"


def opencv_poses(cv2: Any, s: Simulation) -> dict[str, Callable[[Array], tuple[Array, Array]]]:
    """Return OpenCV's pose solvers.

    Each takes pixels (30, 2) and returns rotation vector and translation in the camera's axes.
    """
    body = np.ascontiguousarray(s.points_mm[0] - s.points_mm[0].mean(axis=0))
    intrinsic = np.array([[FOCAL_PX, 0, 256], [0, FOCAL_PX, 256], [0, 0, 1]])
    view = np.linalg.solve(intrinsic, s.camera.matrix)
    rotation = cv2.Rodrigues(view[:, :3])[0]
    translation = (view[:, :3] @ s.points_mm[0].mean(axis=0) + view[:, 3]).reshape(3, 1)

    def warm(pixels: Array) -> tuple[Array, Array]:
        found: tuple[Array, Array] = cv2.solvePnP(
            body, pixels, intrinsic, None, rotation.copy(), translation.copy(), True, cv2.SOLVEPNP_ITERATIVE
        )[1:3]
        return found

    def cold(method: int) -> Callable[[Array], tuple[Array, Array]]:
        def solve(pixels: Array) -> tuple[Array, Array]:
            found: tuple[Array, Array] = cv2.solvePnP(body, pixels, intrinsic, None, flags=method)[1:3]
            return found

        return solve

    return {
        "OpenCV ITERATIVE, warm": warm,
        "OpenCV SQPNP": cold(cv2.SOLVEPNP_SQPNP),
        "OpenCV EPNP": cold(cv2.SOLVEPNP_EPNP),
    }


def speed(rng: np.random.Generator) -> Iterator[str]:
    """Yield accuracy and poses per second on the same images.

    Each pose starts from the pose of the frame before.
    """
    yield f"\nThe same {SPEED_POSES} images of 30 points (LAT), each from the pose of the frame before; one thread"
    yield f"{'':32}{'RMS mm':>9}{'to best':>9}{'poses/s':>10}{'rigid-pose is':>16}"
    try:
        cv2 = import_module("cv2")
        cv2.setNumThreads(1)
    except ImportError:
        cv2 = None
        yield "(OpenCV is not installed: pip install opencv-python-headless)"
    for name in ("H18", "H77"):
        s = simulate(name, "LAT", 2)
        body = s.points_mm[0] - s.points_mm[0].mean(axis=0)
        pixels = s.pixels_uv[1] + rng.normal(0, NOISE_PX, (SPEED_POSES, 30, 2))
        start = (
            np.broadcast_to(np.eye(3), (SPEED_POSES, 3, 3)),
            np.broadcast_to(s.points_mm[0].mean(axis=0), (SPEED_POSES, 3)),
        )
        solve_poses(s.camera, body, pixels[:1], start[0][:1], start[1][:1], 6)
        rates = []
        for _ in range(7):
            since = time.process_time()
            rotations, centres = solve_poses(s.camera, body, pixels, *start, 6)
            rates.append(SPEED_POSES / (time.process_time() - since))
        errors = {"rigid-pose": rms(body @ np.swapaxes(rotations, 1, 2) + centres[:, None] - s.points_mm[1])}
        rate = {"rigid-pose": float(np.median(rates))}
        if cv2 is not None:
            view = s.camera.matrix
            axes = np.linalg.solve(np.array([[FOCAL_PX, 0, 256], [0, FOCAL_PX, 256], [0, 0, 1]]), view)
            truth = s.points_mm[1] @ axes[:, :3].T + axes[:, 3]
            for label, solve in opencv_poses(cv2, s).items():
                since = time.process_time()
                found = [solve(image) for image in pixels]
                rate[label] = SPEED_POSES / (time.process_time() - since)
                places = np.array([body @ cv2.Rodrigues(turn)[0].T + shift.ravel() for turn, shift in found])
                errors[label] = rms(places - truth)
        best = min((errors[label] for label in errors if label != "rigid-pose"), default=errors["rigid-pose"])
        for label in errors:
            times = "" if label == "rigid-pose" else f"{rate['rigid-pose'] / rate[label]:.1f} x as fast"
            yield f"{name + ' ' + label:32}{errors[label]:>9.4f}{errors[label] / best:>9.4f}{rate[label]:>10.0f}{times:>16}"


def one_catheter(_: np.random.Generator) -> Iterator[str]:
    """Yield the bound of the mapping catheter's electrodes as a rigid body.

    The body has four electrodes and a known shape.
    """
    yield "\nOne catheter of four electrodes, shape exactly known: bound of a frame, RMS 3D, mm"
    yield f"{'bend radius':>12}" + "".join(f"{f'tilt {tilt} deg':>14}" for tilt in (0, 30, 60))
    camera = simulate("H18", "AP", 1).camera
    arc = DEFAULT_CATALOGUE["mapping"].arc_lengths_mm
    for radius in (20.0, 30.0, 60.0):
        cells = ""
        for tilt in (0, 30, 60):
            points = np.stack([radius * np.sin(arc / radius), radius * (1 - np.cos(arc / radius)), 0 * arc], axis=1)
            turned = (points - points.mean(axis=0)) @ rotation_of(np.radians([[0.0, -tilt, 0.0]]))[0].T
            cells += f"{bound_mm(camera, turned + np.array([10.0, 5.0, 0.0])):>14.0f}"
        yield f"{radius:>9.0f} mm{cells}"


def beating_hearts(rng: np.random.Generator) -> Iterator[str]:
    """Yield refusals for three catheters in a beating heart.

    The solver is rigid-pose, once with known_rigid and once with a known cycle.
    """
    yield (
        f"\nThree catheters in {HEARTS} beating hearts, two views, 30 frames at 15/s; a-priori positions within 0.15 mm per axis.\n"
        "Runs that rigid-pose refuses, at full and at reduced motion, and RMS 3D of the other runs, mm.\n"
        "Without a cycle and without known_rigid it refuses all of them"
    )
    yield f"{'':8}{'known_rigid':^36}{'cycle known':^36}"
    yield f"{'motion':>8}" + 2 * f"{'refused':>14}{'RMS':>11}{'stated':>11}"
    first = int(rng.integers(1_000_000))
    studies = [
        simulate_study(StudySpec(seed, sites=1, frames=30, breathing_mm=0.0)) for seed in range(first, first + HEARTS)
    ]
    for share in (1.0, 0.5, 0.25):
        cells = ""
        for known in (False, True):
            refused = 0
            errors, stated = [], []
            for study in studies:
                for run in study.sites[0].runs:
                    names = tuple(run.truth.points_mm)
                    points = np.concatenate([run.truth.points_mm[name] for name in names], axis=1)
                    points = points[:1] + share * (points - points[:1])
                    view = heart_view(study.catalogue, run.truth.camera, names, points, known, rng)
                    try:
                        track = RigidPose(
                            RigidPose.Params(known_rigid=not known, gantry_angle_sd_deg=0, isocentre_sd_mm=0)
                        ).track(view, Silent())
                    except Refusal:
                        refused += 1
                    else:
                        errors.append(rms((track.positions_mm - points)[1:]))
                        stated.append(float(np.sqrt(np.trace(track.covariance_mm2[1:], axis1=-2, axis2=-1).mean())))
            rest = f"{np.mean(errors):>11.1f}{np.mean(stated):>11.1f}" if errors else f"{'':22}"
            cells += f"{refused:>8} of {2 * HEARTS}{rest}"
        yield f"{100 * share:>6.0f} %{cells}"


def heart_view(
    catalogue: Catalogue,
    camera: Camera,
    names: tuple[str, ...],
    points_mm: Array,
    cycle_known: bool,
    rng: np.random.Generator,
) -> MonoplaneView:
    """Return one view of catheters with four electrodes each, points (n, m, 3).

    Frame 1, or all of a cycle, is known from two views.
    """
    noise = np.broadcast_to(NOISE_PX**2 * np.eye(2), (4, 2, 2))
    pixels = camera.project(points_mm) + rng.normal(0, NOISE_PX, (*points_mm.shape[:2], 2))
    measured = points_mm + rng.normal(0, 0.15, points_mm.shape)
    cycle = SiteCycle(
        np.linspace(0, 0.95, 15),
        tuple((name, electrode) for name in names for electrode in (1, 2, 3, 4)),
        measured[:15],
        np.broadcast_to(0.15**2 * np.eye(3), (15, points_mm.shape[1], 3, 3)),
    )
    observations = tuple(
        Observation(
            f, None, tuple(NamedChain(name, (1, 2, 3, 4), at[4 * k : 4 * k + 4], noise) for k, name in enumerate(names))
        )
        for f, at in enumerate(pixels)
    )
    a_priori = tuple(
        ElectrodePoint(names[k // 4], k % 4 + 1, at, 0.15**2 * np.eye(3), None, None, (0.5, 0.5), 90.0)
        for k, at in enumerate(measured[0])
    )
    times_ms = np.arange(len(pixels), dtype=np.float64) * 66.7
    return MonoplaneView(
        "S01", "a", camera, catalogue, times_ms, observations, a_priori, 0, cycle if cycle_known else None, ()
    )


TABLES = (accuracy, a_priori_errors, speed, one_catheter, beating_hearts)


def main() -> None:
    seed = int(sys.argv[1]) if len(sys.argv) > 1 else 1
    for table in TABLES:
        for line in table(np.random.default_rng(seed)):
            print(line, flush=True)


if __name__ == "__main__":
    main()
