"""Long catheters of a study that a run does not show: the others are sought again without them.

What lies on several catheters may look like a long one in single frames, and takes their places there: a loop needs little to pass
through the electrodes of an ablation catheter. The mean along its track shows that it is none, but then most frames lack the
others.
"""

from __future__ import annotations

from fluoromap.catheters import Catalogue
from fluoromap.contracts import Segmentation
from fluoromap.segmenter.chain_search import MANY_ELECTRODES
from fluoromap.segmenter.learned_chain.added_catheters import tracks_of


def without_absent(found: Segmentation, catalogue: Catalogue) -> Catalogue | None:
    """Return a catalogue without its long catheters that do not show.

    No track of the run is likely to be one of them. The result is None where nothing was found, where all long catheters were, or
    where all others were.
    """
    tracks = tracks_of(found).values()
    shown = {max(track.chain.kinds, key=lambda kind: kind[1])[0] for track in tracks}
    kept = tuple(one for one in catalogue.catheters if one.electrodes < MANY_ELECTRODES or one.name in shown)
    if not shown or len(kept) == len(catalogue.catheters) or len(tracks) >= len(kept):
        return None
    names = [one.name for one in kept]
    mapping = catalogue.mapping if catalogue.mapping in names else names[-1]
    others = [name for name in names if name != mapping]
    reference = catalogue.reference if catalogue.reference in others else next(iter(others), None)
    return Catalogue(kept, reference, mapping)
