"""The catheter catalogue of a study, and the motion of a catheter's shaft."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

_LEAST_ON_LOOP, _PAIRS_ON_LOOP = 8, 20
_LOOP_TURNS = 0.85
"""Part of a full circle that the electrodes of a circular catheter fill."""
_USUAL_LONG_TIP_MM = 4.0


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

    @property
    def is_circular(self) -> bool:
        """Whether the electrodes lie on a loop: all are alike, and eight or more equally far apart or 20 in pairs.

        A straight catheter has a tip electrode that is longer than its rings.
        """
        if self.electrodes < _LEAST_ON_LOOP or not _alike((self.tip_mm, self.ring_mm)):
            return False
        in_pairs = self.electrodes >= _PAIRS_ON_LOOP and _alike(self.spacing_mm[::2]) and _alike(self.spacing_mm[1::2])
        return in_pairs or _alike(self.spacing_mm)

    @property
    def curvature_per_mm(self) -> float:
        """Turn along the shaft, radians a millimetre: that of a circular catheter's loop, 0 for a straight one."""
        if not self.is_circular:
            return 0.0
        return 2 * math.pi * _LOOP_TURNS / (float(self.arc_lengths_mm[-1]) + 0.5 * self.tip_mm + self.ring_mm)

    @property
    def angles_on_loop_rad(self) -> NDArray[np.float64] | None:
        """Angles of the electrodes on a circular catheter's loop from electrode 1's, (electrodes,); None for a straight one."""
        return self.curvature_per_mm * self.arc_lengths_mm if self.is_circular else None

    def tip_centre_sd_mm(self, usual_sd_mm: float) -> float:
        """Return how far the tip's middle may be from its image's centre.

        A standard deviation, mm along the shaft. ``usual_sd_mm`` is that of tips of 4 mm and less. Makers round longer tips in
        proportion.
        """
        return usual_sd_mm * max(1.0, self.tip_mm / _USUAL_LONG_TIP_MM)

    def looks_like(self, other: Catheter) -> bool:
        """Return whether the two look alike in fluoroscopy (all lengths within 1 mm, both loops or neither).

        Descriptions are wrong by up to 0.5 mm each.
        """
        if self.electrodes != other.electrodes or self.is_circular != other.is_circular:
            return False
        mine = (*self.spacing_mm, self.tip_mm, self.ring_mm)
        theirs = (*other.spacing_mm, other.tip_mm, other.ring_mm)
        return all(abs(a - b) <= 1.0 for a, b in zip(mine, theirs, strict=True))


@dataclass(frozen=True, slots=True)
class Catalogue:
    """The catheters of one study, and the roles of reference and mapping catheter.

    The reference catheter is the origin of coordinates. Only a study with a single catheter, which maps, has none (None);
    its coordinates count from the isocentre.

    Raises
    ------
    ValueError
        When names repeat, a role names no catheter, or several catheters have no reference.
    """

    catheters: tuple[Catheter, ...]
    reference: str | None
    mapping: str

    def __post_init__(self) -> None:
        names = [catheter.name for catheter in self.catheters]
        if len(set(names)) != len(names):
            raise ValueError("catheter names must differ")
        if self.reference is None and len(names) > 1:
            raise ValueError("one of several catheters must be the reference")
        for role in (self.reference, self.mapping):
            if role is not None and role not in names:
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


def _alike(lengths_mm: Sequence[float]) -> bool:
    return max(lengths_mm) - min(lengths_mm) < 1e-6


def _alternating(pairs: int, pair_mm: float, apart_mm: float) -> tuple[float, ...]:
    """Return the edge gaps of ``pairs`` pairs of electrodes.

    ``pair_mm`` lies within a pair and ``apart_mm`` between pairs; a name like 2-5-2 lists such gaps.
    """
    return tuple(pair_mm if index % 2 == 0 else apart_mm for index in range(2 * pairs - 1))


CATHETER_TYPES: dict[str, tuple[tuple[float, ...], float, float]] = {
    "quadripolar-2-5-2": (_alternating(2, 2.0, 5.0), 2.0, 1.0),
    "quadripolar-5-5-5": ((5.0,) * 3, 2.0, 1.0),
    "quadripolar-2-2-2": ((2.0,) * 3, 2.0, 1.0),
    "hexapolar-2-5-2": (_alternating(3, 2.0, 5.0), 2.0, 1.0),
    "octapolar-2-5-2": (_alternating(4, 2.0, 5.0), 2.0, 1.0),
    "decapolar-2-5-2": (_alternating(5, 2.0, 5.0), 2.0, 1.0),
    "decapolar-2-8-2": (_alternating(5, 2.0, 8.0), 2.0, 1.0),
    "decapolar-2-2-2": ((2.0,) * 9, 2.0, 1.0),
    "decapolar-5-5-5": ((5.0,) * 9, 2.0, 1.0),
    "duodecapolar-2-2-2": ((2.0,) * 19, 2.0, 1.0),
    "duodecapolar-2-8-2": (_alternating(10, 2.0, 8.0), 2.0, 1.0),
    "ablation-3.5": (_alternating(2, 2.0, 5.0), 3.5, 1.3),
    "ablation-4": (_alternating(2, 2.0, 5.0), 4.0, 1.3),
    "ablation-8": (_alternating(2, 2.0, 5.0), 8.0, 1.3),
    "circular-10": ((5.0,) * 9, 1.0, 1.0),
    "circular-20": ((2.0,) * 19, 1.0, 1.0),
    "circular-20-2-6-2": (_alternating(10, 2.0, 6.0), 1.0, 1.0),
    "pacing-lead": ((8.0,), 1.5, 2.5),
    "defibrillator-lead": ((10.0,), 1.5, 2.5),
}
"""Gaps between electrode edges from the tip on, length of the tip and of each ring, all mm, of catheters as their makers name
them. Makers differ by some tenths of a millimetre; lengths given with a study count before these."""


def catheter_type(type_name: str, name: str) -> Catheter:
    """Return the catheter of a named type under its own name.

    A type is for example ``decapolar-2-5-2``.

    Raises
    ------
    ValueError
        When no type has that name.
    """
    if type_name not in CATHETER_TYPES:
        raise ValueError(f"no catheter type is named {type_name!r}: use one of {', '.join(CATHETER_TYPES)}")
    gaps, tip_mm, ring_mm = CATHETER_TYPES[type_name]
    return Catheter.from_edge_spacing(name, len(gaps) + 1, gaps, tip_mm, ring_mm)


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

    The shaft is not stretched: along it all electrodes move with the tip. The vessel holds the shaft, which bends:
    across it, electrodes farther back move less.
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
