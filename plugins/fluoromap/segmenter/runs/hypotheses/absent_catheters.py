"""Long catheters of a study that a run does not show: the others are sought again without them.

What lies on several catheters may look like a long one in single frames, and takes their places there: a loop needs little to pass
through the electrodes of an ablation catheter. The mean along its track shows that it is none, but then most frames lack the
others.
"""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass

from fluoromap.catheters import Catalogue
from fluoromap.contracts import Segmentation
from fluoromap.segmenter.runs.hypotheses.added_catheters import tracks_of
from fluoromap.segmenter.shape.limits import MANY_ELECTRODES


@dataclass(frozen=True, slots=True)
class AbsentCatheters:
    """Names of the long catheters without which a run is searched once more."""

    names: tuple[str, ...]


def absent_catheters(found: Segmentation, catalogue: Catalogue) -> AbsentCatheters:
    """Return the long catheters of a study that do not show.

    No track of the run is likely to be one of them. There are none where nothing was found, or all others were.
    """
    tracks = tracks_of(found).values()
    shown = {track.chain.likely_name for track in tracks}
    absent = tuple(
        one.name for one in catalogue.catheters if one.electrodes >= MANY_ELECTRODES and one.name not in shown
    )
    others_lack = len(tracks) < len(catalogue.catheters) - len(absent)
    return AbsentCatheters(absent if shown and others_lack else ())


def without_absent(catalogue: Catalogue, absent: Collection[str]) -> Catalogue:
    """Return a catalogue without some of its catheters.

    Another one gets a role that has none left.
    """
    kept = tuple(one for one in catalogue.catheters if one.name not in absent)
    names = [one.name for one in kept]
    mapping = catalogue.mapping if catalogue.mapping in names else names[-1]
    others = [name for name in names if name != mapping]
    reference = catalogue.reference if catalogue.reference in others else next(iter(others), None)
    return Catalogue(kept, reference, mapping)
