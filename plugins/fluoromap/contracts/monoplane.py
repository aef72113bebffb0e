"""Input and result of a monoplane solver."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from fluoromap.catheters import Catalogue
from fluoromap.contracts.arrays import Array, BoolArray, frozen
from fluoromap.contracts.matching import Observation
from fluoromap.contracts.segmentation import View
from fluoromap.contracts.triangulation import ElectrodePoint, SiteCycle
from fluoromap.geometry import Camera
from fluoromap.reasons import Reason


@dataclass(frozen=True, eq=False)
class MonoplaneView:
    """One view of one site, to be tracked in 3D.

    frame_times_ms : (n,). observations : one per frame, in order. a_priori : points known from two views, valid in
    ``a_priori_frame``. cycle : the site's own biplane cycle or None. others : cycles of other sites, empty when ``cycle``
    is valid.
    """

    site: str
    view: View
    camera: Camera
    catalogue: Catalogue
    frame_times_ms: Array
    observations: tuple[Observation, ...]
    a_priori: tuple[ElectrodePoint, ...]
    a_priori_frame: int
    cycle: SiteCycle | None
    others: tuple[SiteCycle, ...]

    def __post_init__(self) -> None:
        n = len(self.observations)
        object.__setattr__(self, "frame_times_ms", frozen(self.frame_times_ms, (n,), "frame_times_ms"))
        if not 0 <= self.a_priori_frame < n:
            raise ValueError(f"a_priori_frame is {self.a_priori_frame}, but the run has {n} frames")


@dataclass(frozen=True, eq=False)
class StudyShares:
    """Shares of a track's covariances that grow and shrink with the variation of its study.

    depth_mm2, relative_depth_mm2 : (4, n, m) variance along the ray from breathing, beats, gantry angle and gantry offset, in
    the order of :class:`StudyVariation`. The second is that of positions less the reference's mean. angle_sd_rad, offset_sd_mm :
    error of this view's gantry, which displaces the electrodes across its rays. All have the default variation.
    """

    depth_mm2: Array
    relative_depth_mm2: Array
    angle_sd_rad: float
    offset_sd_mm: float

    def __post_init__(self) -> None:
        object.__setattr__(self, "depth_mm2", frozen(self.depth_mm2, (4, None, None), "depth_mm2"))
        relative = frozen(self.relative_depth_mm2, self.depth_mm2.shape, "relative_depth_mm2")
        object.__setattr__(self, "relative_depth_mm2", relative)


def _symmetric(value: ArrayLike, shape: tuple[int, ...], name: str) -> NDArray[Any]:
    """Return a read-only copy of covariances, each the mean of itself and its transpose."""
    checked = frozen(value, shape, name)
    transposed = np.swapaxes(checked, -1, -2)
    return checked if (checked == transposed).all() else frozen(0.5 * (checked + transposed), shape, name)


@dataclass(frozen=True, eq=False)
class Track:
    """Electrodes in 3D in every frame of one view.

    labels : (catheter, electrode) of each of the m electrodes. located : (n, m), False where there is no position; the
    arrays contain 0 there. positions_mm, baseline_mm : (n, m, 3), the baseline being the plain back-projection at the
    prior's depth. covariance_mm2 : (n, m, 3, 3), from the isocentre. relative_covariance_mm2 : (n, m, 3, 3) of the position
    less the mean of the reference catheter's electrodes in the same frame; None where the solver does not compute it.
    pixels_uv : (n, m, 2) observed. reasons : one tuple for each electrode. shares : None where the solver does not state them.
    The covariances have the default variation; :func:`fluoromap.monoplane.track_samples.in_study` brings them to the study's.
    They are made symmetric bit for bit, which rounding in a solver may prevent; the store keeps their upper halves only.
    """

    labels: tuple[tuple[str, int], ...]
    located: BoolArray
    positions_mm: Array
    baseline_mm: Array
    covariance_mm2: Array
    pixels_uv: Array
    reasons: tuple[tuple[Reason, ...], ...]
    relative_covariance_mm2: Array | None = None
    shares: StudyShares | None = None

    def __post_init__(self) -> None:
        m = len(self.labels)
        object.__setattr__(self, "located", frozen(self.located, (None, m), "located", dtype=np.bool_))
        n = self.located.shape[0]
        object.__setattr__(self, "positions_mm", frozen(self.positions_mm, (n, m, 3), "positions_mm"))
        object.__setattr__(self, "baseline_mm", frozen(self.baseline_mm, (n, m, 3), "baseline_mm"))
        covariance = _symmetric(self.covariance_mm2, (n, m, 3, 3), "covariance_mm2")
        object.__setattr__(self, "covariance_mm2", covariance)
        object.__setattr__(self, "pixels_uv", frozen(self.pixels_uv, (n, m, 2), "pixels_uv"))
        if self.relative_covariance_mm2 is not None:
            relative = _symmetric(self.relative_covariance_mm2, (n, m, 3, 3), "relative_covariance_mm2")
            object.__setattr__(self, "relative_covariance_mm2", relative)
        if len(self.reasons) != m:
            raise ValueError(
                f"there are {len(self.reasons)} tuples of reasons for {m} electrodes; one is needed for each"
            )
