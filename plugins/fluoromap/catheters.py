"""The catheter catalogue of a study, and the motion of a catheter's shaft."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True, slots=True)
class Catheter:
    """One catheter as its maker describes it.

    Parameters
    ----------
    name : str
        Unique in a study, for example ``mapping``.
    electrodes : int
        Number of electrodes, 2 or more; electrode 1 is the tip.
    spacing_mm : tuple of float
        ``electrodes - 1`` distances from electrode centre to electrode centre along the shaft, from the tip on.
    tip_mm, ring_mm : float
        Length of the tip electrode and of each ring along the shaft.

    Raises
    ------
    ValueError
        When the numbers do not describe a catheter.
    """

    name: str
    electrodes: int
    spacing_mm: tuple[float, ...]
    tip_mm: float
    ring_mm: float

    def __post_init__(self) -> None:
        if not self.name or len(self.name) > 64:
            raise ValueError("a catheter needs a name of at most 64 characters")
        if not 2 <= self.electrodes <= 64:
            raise ValueError(f"catheter {self.name!r}: electrodes must be between 2 and 64")
        if len(self.spacing_mm) != self.electrodes - 1:
            raise ValueError(
                f"catheter {self.name!r}: {self.electrodes} electrodes need {self.electrodes - 1} spacings"
            )
        for value in (*self.spacing_mm, self.tip_mm, self.ring_mm):
            if not (math.isfinite(value) and 0 < value <= 100):
                raise ValueError(f"catheter {self.name!r}: lengths must be between 0 and 100 mm")

    @classmethod
    def from_edge_spacing(
        cls, name: str, electrodes: int, edge_spacing_mm: tuple[float, ...], tip_mm: float, ring_mm: float
    ) -> Catheter:
        """Build a catheter from the gaps between electrode edges.

        Catheter labels (2-5-2) give these gaps.
        """
        centres = tuple(
            gap + (tip_mm + ring_mm) / 2 if index == 0 else gap + ring_mm for index, gap in enumerate(edge_spacing_mm)
        )
        return cls(name, electrodes, centres, tip_mm, ring_mm)

    @property
    def arc_lengths_mm(self) -> NDArray[np.float64]:
        """Distance of each electrode's centre from electrode 1's along the shaft, shape ``(electrodes,)``."""
        return np.concatenate([[0.0], np.cumsum(self.spacing_mm)])

    def looks_like(self, other: Catheter) -> bool:
        """Return whether the two look alike in fluoroscopy (all lengths within 1 mm).

        Descriptions are wrong by up to 0.5 mm each.
        """
        if self.electrodes != other.electrodes:
            return False
        mine = (*self.spacing_mm, self.tip_mm, self.ring_mm)
        theirs = (*other.spacing_mm, other.tip_mm, other.ring_mm)
        return all(abs(a - b) <= 1.0 for a, b in zip(mine, theirs, strict=True))


@dataclass(frozen=True, slots=True)
class Catalogue:
    """The catheters of one study, and the roles of reference and mapping catheter.

    The reference catheter is the origin of coordinates.

    Raises
    ------
    ValueError
        When names repeat or a role names no catheter.
    """

    catheters: tuple[Catheter, ...]
    reference: str
    mapping: str

    def __post_init__(self) -> None:
        names = [catheter.name for catheter in self.catheters]
        if len(set(names)) != len(names):
            raise ValueError("catheter names must differ")
        for role in (self.reference, self.mapping):
            if role not in names:
                raise ValueError(f"no catheter is named {role!r}")
        if self.reference == self.mapping:
            raise ValueError("the reference and the mapping catheter must differ")

    def __getitem__(self, name: str) -> Catheter:
        for catheter in self.catheters:
            if catheter.name == name:
                return catheter
        raise KeyError(name)

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the catheters, in the order of the catalogue."""
        return tuple(catheter.name for catheter in self.catheters)


DEFAULT_CATALOGUE = Catalogue(
    catheters=(
        Catheter("reference", 4, (3.5, 6.0, 3.0), tip_mm=2.0, ring_mm=1.0),
        Catheter("pacing", 4, (3.5, 6.0, 3.0), tip_mm=2.0, ring_mm=1.0),
        Catheter("mapping", 4, (4.65, 6.3, 3.3), tip_mm=4.0, ring_mm=1.3),
    ),
    reference="reference",
    mapping="mapping",
)
"""Two 6F diagnostic catheters and a 7F ablation catheter with a 4 mm tip, all 2-5-2 mm edge to edge."""

BENDS_OVER_MM = 25.0
"""Length of shaft over which a catheter's motion falls from its tip's towards half of it."""


def follows_tip(
    points_mm: NDArray[np.float64], labels: Sequence[tuple[str, int]], catalogue: Catalogue
) -> NDArray[np.float64]:
    """Return each electrode's displacement for a displaced tip, (..., N, 3, 3).

    The shaft is not stretched: along it all electrodes move with the tip. The vessel holds the shaft, which bends: across
    it,
    electrodes farther back move less.
    """
    follows = np.empty((*points_mm.shape, 3))
    for catheter in {name for name, _ in labels}:
        own = [k for k, (name, _) in enumerate(labels) if name == catheter]
        arc = catalogue[catheter].arc_lengths_mm
        behind = np.array([arc[min(labels[k][1], len(arc)) - 1] for k in own])
        share = (0.5 + 0.5 * np.exp(-behind / BENDS_OVER_MM))[:, None, None]
        chord = points_mm[..., own[-1], :] - points_mm[..., own[0], :]
        axis = chord / np.maximum(np.linalg.norm(chord, axis=-1, keepdims=True), 1e-9)
        along = (axis[..., :, None] * axis[..., None, :])[..., None, :, :]
        follows[..., own, :, :] = share * np.eye(3) + (1 - share) * along
    return follows
