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
