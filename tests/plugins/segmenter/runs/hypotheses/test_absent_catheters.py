"""Long catheters that a run does not show are left out of the search for the others."""

import numpy as np
import pytest

from fluoromap.catheters import Catalogue, catheter_type
from fluoromap.contracts import Chain, FrameChains, Segmentation
from fluoromap.segmenter.runs.hypotheses.absent_catheters import absent_catheters, without_absent

TYPES = {"cs": "decapolar-2-5-2", "loop": "circular-10", "his": "quadripolar-2-5-2", "ablation": "ablation-4"}
CATALOGUE = Catalogue(tuple(catheter_type(type_, name) for name, type_ in TYPES.items()), "cs", "ablation")
ALIKE = {"cs": "loop", "loop": "cs", "his": "ablation", "ablation": "his"}


def segmented(*names: str) -> Segmentation:
    """Return a run of one frame whose tracks have these names."""
    chains = []
    for track, name in enumerate(names):
        count = CATALOGUE[name].electrodes
        points = np.stack([20.0 * np.arange(count), np.full(count, 50.0 * track)], axis=1)
        covariance = np.tile(np.eye(2), (count, 1, 1))
        kinds = ((name, 0.9), (ALIKE[name], 0.1))
        chains.append(Chain(tuple(range(1, count + 1)), points, covariance, np.ones(count), kinds, track))
    entry = FrameChains(0, tuple(chains))
    return Segmentation((entry,), entry, (0,), np.zeros(1), np.zeros(1))


@pytest.mark.parametrize(
    ("found", "sought", "reference"),
    [
        (("cs",), ("cs", "his", "ablation"), "cs"),
        (("loop", "ablation"), ("loop", "his", "ablation"), "loop"),
        (("his",), ("his", "ablation"), "his"),
    ],
)
def test_the_others_are_sought_without_long_catheters_that_do_not_show(found, sought, reference):
    less = without_absent(CATALOGUE, absent_catheters(segmented(*found), CATALOGUE).names)
    assert (less.names, less.reference, less.mapping) == (sought, reference, "ablation")


@pytest.mark.parametrize("found", [(), ("cs", "loop", "his"), ("cs", "his", "ablation")])
def test_nothing_is_left_out_where_that_cannot_help(found):
    """Nothing shows, or all long catheters do, or all others."""
    assert absent_catheters(segmented(*found), CATALOGUE).names == ()


def test_a_lacking_mapping_catheter_keeps_the_study_possible():
    catalogue = Catalogue(CATALOGUE.catheters[:3], "his", "cs")
    less = without_absent(catalogue, absent_catheters(segmented("loop"), catalogue).names)
    assert (less.names, less.reference, less.mapping) == (("loop", "his"), "loop", "his")
