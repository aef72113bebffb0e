"""From pictures as a laboratory stores them to the mapping tip: decapolar reference, hexapolar and ablation catheter."""

import numpy as np
import pytest
from frame_sources import Frames, displayed

from fluoromap.catheters import Catalogue, catheter_type
from fluoromap.contracts import CHI2_95_3D, PixelFacts, Run, Silent
from fluoromap.geometry import Gantry, camera_from_gantry
from fluoromap.matching import SiteRuns, match_study
from fluoromap.phantom import StudySpec, simulate_study
from fluoromap.segmenter.learned_chain.plugin import LearnedChain
from fluoromap.triangulator.maximum_likelihood import MaximumLikelihood
from fluoromap.triangulator.uncertainty import UncertaintyParams

CATALOGUE = Catalogue(
    (
        catheter_type("decapolar-2-5-2", "sinus"),
        catheter_type("hexapolar-2-5-2", "his"),
        catheter_type("ablation-4", "ablation"),
    ),
    reference="sinus",
    mapping="ablation",
)
FRAMES = 16
SPACING = 292.0 / 512


def segmented(run):
    frames = Frames([displayed(run.frames[k], quality=85) for k in range(FRAMES)])
    shown = Run(frames, run.frame_times_ms, camera_from_gantry(run.gantry).px_per_mm, PixelFacts(True, 8, False))
    return LearnedChain().segment(shown, CATALOGUE, {}, Silent())


@pytest.mark.parametrize("seed", [9300])
def test_the_mapping_tip_lies_within_a_millimetre_of_its_place_from_the_reference(seed):
    lateral, frontal = (Gantry(angle, 0.0, 1000.0, 500.0, (SPACING, SPACING), 512, 512) for angle in (90.0, 0.0))
    study = simulate_study(
        StudySpec(
            seed, sites=2, frames=FRAMES, gantries=(lateral, frontal), gantry_error_deg=0.3, isocentre_error_mm=0.6,
            catalogue=CATALOGUE,
        )
    )  # fmt: skip
    assert study.catalogue == CATALOGUE
    assert set(study.sites[0].truth.diastole_mm) == set(CATALOGUE.names)
    cameras = camera_from_gantry(lateral), camera_from_gantry(frontal)
    runs = [SiteRuns(site.name, *cameras, *(segmented(run) for run in site.runs)) for site in study.sites]
    matching = match_study(runs, CATALOGUE, Silent())
    found = MaximumLikelihood(UncertaintyParams()).triangulate(matching.sites, CATALOGUE, Silent())
    assert len(found.sites) == 2
    inside = []
    for at_site, site in zip(found.sites, study.sites, strict=True):
        assert {point.catheter for point in at_site.points} == set(CATALOGUE.names)
        tip = at_site.point("ablation", 1)
        assert np.linalg.norm(tip.relative_mm - site.truth.relative_mm["ablation"][0]) < 1.0
        for point in at_site.points:
            error = point.relative_mm - site.truth.relative_mm[point.catheter][point.electrode - 1]
            inside.append(error @ np.linalg.solve(point.relative_covariance_mm2, error) <= CHI2_95_3D)
    assert np.mean(inside) >= 0.8


def test_a_phantom_takes_two_to_six_catheters():
    seven = tuple(catheter_type("quadripolar-2-5-2", f"{number}") for number in range(7))
    with pytest.raises(ValueError, match="at most 6 catheters"):
        StudySpec(1, catalogue=Catalogue(seven, "0", "6"))
