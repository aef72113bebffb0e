"""Ways to number the electrodes of two chains that may show one catheter.

The segmenter may begin at the wrong end of a catheter. On a loop, whose ends nearly meet, it may begin at any electrode.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from fluoromap.contracts import Chain
from fluoromap.matching.run_catheters import RunCatheter


@dataclass(frozen=True, slots=True)
class Numbering:
    """New numbers of a catheter's electrodes.

    turned : whether they begin at the other end. rotated : on a loop, how many electrodes further they then begin.
    """

    turned: bool = False
    rotated: int = 0

    def number(self, electrode: int, electrodes: int) -> int:
        """Return the new number of an electrode of a catheter with so many of them."""
        if self.turned:
            electrode = electrodes + 1 - electrode
        return (electrode - 1 - self.rotated) % electrodes + 1 if self.rotated else electrode

    def from_other_end(self) -> Numbering:
        """Return the reverse of these numbers."""
        return Numbering(not self.turned, -self.rotated)

    def of(self, catheter: RunCatheter) -> RunCatheter:
        """Return the catheter with the new numbers."""
        if self == AS_FOUND:
            return catheter
        chains = {frame: self._of_chain(chain, catheter.electrodes) for frame, chain in catheter.chains.items()}
        return replace(catheter, chains=chains, diastole=self._of_chain(catheter.diastole, catheter.electrodes))

    def _of_chain(self, chain: Chain, electrodes: int) -> Chain:
        numbers = [self.number(electrode, electrodes) for electrode in chain.electrodes]
        order = np.argsort(numbers)
        return replace(
            chain,
            electrodes=tuple(sorted(numbers)),
            pixels_uv=chain.pixels_uv[order],
            covariance_px2=chain.covariance_px2[order],
            scores=chain.scores[order],
            tip_odds=-chain.tip_odds if self.turned and chain.tip_odds is not None else chain.tip_odds,
        )


AS_FOUND = Numbering()
Way = tuple[Numbering, Numbering]
"""The numbers of the two chains."""


@dataclass(frozen=True, slots=True)
class Reading:
    """Two chains, electrode by electrode.

    numbers : of the common electrodes in view a, as found. rows_a, rows_b : these electrodes in each chain. ways : the numbers with
    which these electrodes belong together.
    """

    pair: tuple[int, int]
    numbers: list[int]
    rows_a: list[int]
    rows_b: list[int]
    ways: tuple[Way, ...]

    @property
    def is_rotated(self) -> bool:
        """Whether the electrodes belong together on a loop only."""
        return all(a.rotated or b.rotated for a, b in self.ways)


def readings(pair: tuple[int, int], first: RunCatheter, second: RunCatheter, on_loop: bool) -> list[Reading]:
    """Return the ways in which two chains may show the same electrodes.

    Parameters
    ----------
    pair : (int, int)
        The chain of view a and that of view b.
    first, second : RunCatheter
    on_loop : bool
        Whether both may show a loop. Of one of them at least, the numbers begin at the right electrode.
    """
    alike = first.electrodes == second.electrodes
    may_turn = [alike and one.tip_odds is not None for one in (first, second)]
    ways = [
        (Numbering(a), Numbering(b))
        for a in (False, True)
        for b in (False, True)
        if (may_turn[0] or not a) and (may_turn[1] or not b)
    ]
    if on_loop and alike:
        further = range(1, first.electrodes)
        by_hand_a, by_hand_b = (one.diastole.manual for one in (first, second))
        ways += [(replace(a, rotated=k), b) for a, b in ways[:] for k in further if not by_hand_a] + [
            (a, replace(b, rotated=k)) for a, b in ways[:] for k in further if not by_hand_b
        ]
    in_a, in_b = first.diastole.electrodes, second.diastole.electrodes
    same: dict[tuple[int, ...], list[Way]] = {}
    for way in ways:
        found_as = {way[1].number(electrode, second.electrodes): electrode for electrode in in_b}
        partners = tuple(found_as.get(way[0].number(electrode, first.electrodes), 0) for electrode in in_a)
        same.setdefault(partners, []).append(way)
    found = []
    for partners, own in same.items():
        rows = [(row, in_b.index(partner)) for row, partner in enumerate(partners) if partner]
        if rows:
            rows_a, rows_b = ([row[side] for row in rows] for side in (0, 1))
            found.append(Reading(pair, [in_a[row] for row in rows_a], rows_a, rows_b, tuple(own)))
    return found
