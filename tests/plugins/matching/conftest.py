"""A small beating heart seen by two runs a site: chains only, no pictures."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
import pytest

from fluoromap.catheters import DEFAULT_CATALOGUE
from fluoromap.contracts import Array, Chain, FrameChains, Segmentation
from fluoromap.geometry import Camera, Gantry, camera_from_gantry
from fluoromap.matching import SiteRuns

FRAMES = 80
FRAME_MS = 1000 / 60


def camera(primary: float, secondary: float = 0.0) -> Camera:
    return camera_from_gantry(Gantry(primary, secondary, 1000, 500, (178 / 512, 178 / 512), 512, 512))


def beat(phase: Array) -> Array:
    """Return how far the heart is contracted.

    It is 0 through diastole, and a sharp pulse from phase 0 to 0.45.
    """
    phase = np.asarray(phase) % 1.0
    return np.where(phase < 0.45, np.sin(np.pi * phase / 0.45) ** 2, 0.0)


@dataclass
class Heart:
    """Everything a test may want to change about a study; ``site`` makes the next site's runs."""

    seed: int = 0
    angles: tuple[float, float] = (90.0, 0.0)
    rate_hz: float = 1.8
    noise_px: float = 0.7
    pacing_roams_mm: float = 5.0
    breathing_mm: float = 3.0
    tracked: bool = True
    r_waves: bool = False
    wrong_kinds: float = 0.1
    names: tuple[str, ...] = DEFAULT_CATALOGUE.names
    truth: dict[str, dict[str, Array]] = field(default_factory=dict)
    starts: dict[str, tuple[float, float]] = field(default_factory=dict)

    def __post_init__(self) -> None:
        self.rng = np.random.default_rng(self.seed)
        self.places = {"reference": np.array([22.0, -22.0, -8.0]), "pacing": np.array([8.0, -34.0, 14.0])}
        self.directions = {"reference": np.array([0.3, 0.5, 1.0]), "pacing": np.array([-0.6, 0.4, 0.8])}
        self.swing = {"mapping": 5.0, "reference": 2.5, "pacing": 3.5}

    def site(self, name: str) -> SiteRuns:
        rng = self.rng
        tips = {"mapping": np.array([-10.0, 15.0, 0.0]) + rng.uniform(-18, 18, 3)}
        tips |= self.places
        if self.pacing_roams_mm:
            tips["pacing"] = tips["pacing"] + rng.normal(0, self.pacing_roams_mm, 3)
        points = {}
        for catheter in self.names:
            direction = self.directions.get(catheter, rng.normal(size=3))
            along = DEFAULT_CATALOGUE[catheter].arc_lengths_mm[:, None]
            points[catheter] = tips[catheter] + along * direction / np.linalg.norm(direction)
        self.truth[name] = points
        self.starts[name] = (float(rng.uniform()), float(rng.uniform()))
        runs = [
            self.run(one, points, start) for one, start in zip(map(camera, self.angles), self.starts[name], strict=True)
        ]
        return SiteRuns(name, camera(self.angles[0]), camera(self.angles[1]), runs[0], runs[1])

    def positions(self, points: dict[str, Array], phase: float) -> dict[str, Array]:
        """Return the electrodes lifted and turned by the contraction.

        The proximal ones move half as much as the tip.
        """
        moved = {}
        for catheter, at in points.items():
            share = np.linspace(1.0, 0.5, len(at))[:, None]
            motion = np.array([-0.6, 0.5, 0.65]) * self.swing[catheter]
            moved[catheter] = at + share * motion * float(beat(np.array(phase)))
        return moved

    def run(self, seen_by: Camera, points: dict[str, Array], start: float) -> Segmentation:
        rng = self.rng
        breathing = rng.normal(0, [0.25, 0.25, 1.0]) * self.breathing_mm
        times = np.arange(FRAMES) * FRAME_MS
        phases = (start + times / 1000 * self.rate_hz) % 1.0
        order = rng.permutation(list(points))
        entries = []
        for frame, phase in enumerate(phases):
            moved = self.positions(points, float(phase))
            chains = tuple(
                self.chain(catheter, seen_by.project(moved[catheter] + breathing), track)
                for track, catheter in enumerate(order)
            )
            entries.append(FrameChains(frame, chains))
        quiet = [f for f in range(3, FRAMES - 3) if np.ptp(np.unwrap(phases[f - 3 : f + 4], period=1)) < 0.4
                 and (phases[f - 3 : f + 4] > 0.5).all()]  # fmt: skip
        middle = min(quiet, key=lambda f: abs(phases[f] - 0.75))
        moved = self.positions(points, 0.75)
        diastole = FrameChains(
            middle,
            tuple(
                self.chain(catheter, seen_by.project(moved[catheter] + breathing), track, noise_px=0.4 * self.noise_px)
                for track, catheter in enumerate(order)
            ),
        )
        motion = np.abs(np.gradient(beat(phases))) + 0.01
        r_waves = tuple(np.flatnonzero(np.diff(phases, prepend=phases[0]) < 0).tolist()) if self.r_waves else ()
        return Segmentation(tuple(entries), diastole, tuple(range(middle - 3, middle + 4)), motion, times, r_waves)

    def chain(self, catheter: str, pixels: Array, track: int, noise_px: float | None = None) -> Chain:
        noise = self.noise_px if noise_px is None else noise_px
        is_mapping = catheter == "mapping"
        if self.rng.random() < self.wrong_kinds:
            is_mapping = not is_mapping
        p = 0.8 if is_mapping else 0.1
        kinds = (("reference", (1 - p) / 2), ("pacing", (1 - p) / 2), ("mapping", p))
        return Chain(
            electrodes=(1, 2, 3, 4),
            pixels_uv=pixels + self.rng.normal(0, noise, pixels.shape),
            covariance_px2=np.broadcast_to(max(noise, 0.1) ** 2 * np.eye(2), (4, 2, 2)),
            scores=np.full(4, 10.0),
            kinds=kinds,
            track=track if self.tracked else -1,
        )


def named_by_hand(segmentation: Segmentation, pixels: Array, name: str, frame: int) -> Segmentation:
    """Return the segmentation after a user has marked a catheter.

    The user marks the catheter nearest to ``pixels`` (4, 2) in one frame as ``name``.
    """
    entry = segmentation.frames[frame]
    nearest = min(entry.chains, key=lambda chain: float(np.linalg.norm(chain.pixels_uv - pixels)))
    marked = replace(nearest, kinds=((name, 1.0),), manual=True)
    chains = tuple(marked if chain is nearest else chain for chain in entry.chains)
    frames = tuple(FrameChains(frame, chains) if one.frame == frame else one for one in segmentation.frames)
    return replace(segmentation, frames=frames)


@pytest.fixture
def heart() -> type[Heart]:
    return Heart


@pytest.fixture
def mark():  # type: ignore[no-untyped-def]
    return named_by_hand
