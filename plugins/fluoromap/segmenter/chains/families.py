"""Families: catheters of a study that look alike in fluoroscopy."""

from __future__ import annotations

import functools
from dataclasses import dataclass

from fluoromap.catheters import Catalogue, Catheter
from fluoromap.contracts import Chain

_WORTH = 6.0
_FLOOR_FALLS = 0.6


@dataclass(frozen=True, slots=True)
class CatheterFamily:
    """Catheters that look alike in fluoroscopy.

    At most ``len(names)`` chains of one frame belong to a family.
    """

    names: tuple[str, ...]
    catheter: Catheter

    @property
    def floor(self) -> float:
        """Score below which a chain may be anatomy.

        The floor is higher for two electrodes: there is no second spacing to check. It is lower for more than four: bends and
        spacings cost a long catheter more, and its row is rarer in anatomy.
        """
        if self.catheter.electrodes == 2:
            return 3.0
        return 1.0 - _FLOOR_FALLS * max(self.catheter.electrodes - 4, 0)

    @property
    def worth(self) -> float:
        """What a chain of this family adds to the value of a set, besides its score."""
        return _WORTH * max(1.0, self.catheter.electrodes / 4)


@functools.lru_cache(maxsize=32)
def catheter_families(catalogue: Catalogue) -> tuple[CatheterFamily, ...]:
    """Group the catalogue's catheters by :meth:`~fluoromap.catheters.Catheter.looks_like`."""
    groups: list[list[Catheter]] = []
    for catheter in catalogue.catheters:
        for group in groups:
            if group[0].looks_like(catheter):
                group.append(catheter)
                break
        else:
            groups.append([catheter])
    return tuple(CatheterFamily(tuple(member.name for member in group), group[0]) for group in groups)


def family_of(chain: Chain, catalogue: Catalogue) -> CatheterFamily | None:
    """Return the most probable family whose catheters have exactly this chain's electrodes."""
    whole = [
        family
        for family in catheter_families(catalogue)
        if chain.electrodes == tuple(range(1, family.catheter.electrodes + 1))
    ]
    return max(whole, key=lambda family: sum(chain.probability(name) for name in family.names), default=None)
