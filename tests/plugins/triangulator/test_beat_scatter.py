"""Beats of single runs show how restless a heart is, also where both views are recorded at the same time."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from fluoromap.contracts import MatchedSite, Silent
from fluoromap.matching import match_study
from fluoromap.phantom.clinical_study import simulate_conditions
from fluoromap.phantom.conditions import Conditions
from fluoromap.triangulator.beat_scatter import beat_scatter
from fluoromap.triangulator.maximum_likelihood import MaximumLikelihood
from fluoromap.triangulator.uncertainty import UncertaintyParams

PHANTOM_BEATS = 0.25


def matched(conditions: Conditions) -> tuple[MatchedSite, ...]:
    study = simulate_conditions(conditions)
    return match_study(study.runs, study.catalogue, Silent()).sites


@pytest.mark.parametrize("beat_scale", [0.4, 1.4])
def test_the_scatter_of_regular_runs_shows_the_variation_of_the_beats(beat_scale: float) -> None:
    scales = np.geomspace(0.1, 4.0, 60)
    found = []
    for seed in (1, 2):
        sites = matched(replace(Conditions.draw(seed, (), sites=5), beat_scale=beat_scale))
        runs = [run for site in sites for run in beat_scatter(site.runs)]
        assert sum(run.degrees for run in runs) > 30
        found.append(scales[int(np.argmax(sum(run.log_likelihood(PHANTOM_BEATS * scales) for run in runs)))])
    assert np.exp(np.mean(np.log(found))) == pytest.approx(beat_scale, rel=0.25)


def test_a_run_without_a_second_beat_shows_nothing() -> None:
    runs = matched(Conditions.draw(1, (), sites=4))[0].runs
    still = replace(runs, track_a=runs.track_a[:3], track_b=runs.track_b[:3])
    assert beat_scatter(still) == ()


def test_a_restless_heart_is_not_taken_for_calm_because_both_views_show_the_same_beat() -> None:
    for seed in (1, 2):
        conditions = replace(Conditions.draw(seed, ("biplane",), sites=5), beat_scale=1.4)
        assert conditions.simultaneous
        study = simulate_conditions(conditions)
        sites = match_study(study.runs, study.catalogue, Silent()).sites
        answer = MaximumLikelihood(UncertaintyParams()).triangulate(sites, study.catalogue, Silent())
        assert answer.sites[0].variation.beats > 0.9
        assert answer.sites[0].variation.breathing < 0.2
