"""Small runs of the benchmark of silent wrongs: studies in which earlier versions were wrong without a warning."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import silent_wrongs

from fluoromap.phantom.conditions import Conditions, Property, TableMove

SEEDS = range(100, 104)


def scores(name: Property) -> list[silent_wrongs.StudyScore]:
    return [silent_wrongs.score_study(Conditions.draw(seed, (name,), sites=5)) for seed in SEEDS]


@pytest.mark.parametrize("name", ["bend", "tip", "catalogue"])
def test_wrong_lengths_do_not_make_tracks_worse_than_their_baseline(name: Property) -> None:
    found = [score.tracks for score in scores(name)]
    rms, baseline = (np.sqrt(sum(getattr(one, of) for one in found)) for of in ("squared", "baseline"))
    assert rms <= 1.05 * baseline
    assert sum(one.silent for one in found) == 0


def test_a_moved_table_is_never_silent() -> None:
    for displacement in ((12.0, 2.0, -9.0), (-6.4, 4.0, -10.4), (4.6, -0.7, 4.2)):
        calm = Conditions.draw(100, (), sites=5)
        score = silent_wrongs.score_study(replace(calm, table=TableMove(1, displacement, False)))
        assert score.points.silent == score.tracks.silent == 0


def test_look_alikes_are_right_or_flagged_and_never_graded_above_c() -> None:
    for name in ("look-alikes", "table", "catalogue"):
        for score in scores(name):
            assert score.misnamed_unflagged == score.misnamed_above_c == 0


def test_the_table_has_two_lines_a_stratum() -> None:
    lines = silent_wrongs.rows("calm", [silent_wrongs.score_study(Conditions.draw(1, (), sites=4))])
    assert len(lines) == 2
    assert "points" in lines[0]
    assert "tracks" in lines[1]


def test_ellipsoids_of_calm_hearts_are_not_too_wide() -> None:
    """A calm heart on a C-arm as measured: ellipsoids from the reference neither doubt it nor boast."""
    found = [silent_wrongs.score_study(Conditions.draw(seed, (), sites=5)) for seed in range(200, 212)]
    for kind in ("points", "tracks"):
        sums = [getattr(score, kind) for score in found]
        chi2 = sum(one.chi2[1] for one in sums) / sum(one.counted[1] for one in sums)
        assert 0.7 < chi2 < 1.3


def test_ellipsoids_hold_the_points_of_a_restless_heart_seen_at_one_time() -> None:
    calm = [Conditions.draw(seed, ("biplane",), sites=5) for seed in SEEDS]
    sums = [silent_wrongs.score_study(replace(one, beat_scale=1.4)).points for one in calm]
    assert sum(one.inside[1] for one in sums) >= 0.9 * sum(one.counted[1] for one in sums)
