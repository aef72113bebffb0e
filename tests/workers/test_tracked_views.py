"""The views that the stage ``monoplane`` tracks: their parts of its key, and their frames."""

from __future__ import annotations

from dataclasses import fields, replace
from typing import Any

import numpy as np
import pytest
from finished_study import make_study, matching, triangulation
from sql_statements import sql_statements

from fluoromap.catheters import Catalogue, Catheter
from fluoromap.contracts import APriori, MatchedSite, Matching, MonoplaneView, Observation, SiteCycle
from fluoromap.reasons import Reason
from fluoromap_service.jobs.job_life import Claim
from fluoromap_service.store.codec import decode, encode, plain_form
from fluoromap_service.store.engine import reading
from fluoromap_service.store.models import Job
from fluoromap_service.study.snapshot import Snapshot
from fluoromap_workers import tracked_views
from fluoromap_workers.stage_inputs import StoredJob, prepare
from fluoromap_workers.tracked_views import TrackedView

CATALOGUE = Catalogue(
    (Catheter("reference", 2, (4.0,), 2.0, 1.0), Catheter("mapping", 2, (4.0,), 2.0, 1.0)), "reference", "mapping"
)
CYCLE = SiteCycle(np.array([0.0, 0.5]), (("mapping", 1),), np.zeros((2, 1, 3)), np.tile(np.eye(3), (2, 1, 1, 1)))


def _view(matched: MatchedSite | None = None, **changes: Any) -> TrackedView:
    located = triangulation().sites[0]
    view = TrackedView(
        matched=matched or matching().sites[0], view="a", camera=located.camera("a"), catalogue=CATALOGUE,
        a_priori=APriori(located.points), a_priori_frame=located.diastolic_frame("a"), cycle=None, others=(),
    )  # fmt: skip
    return replace(view, **changes)


def _with_runs(site: MatchedSite, **changes: Any) -> MatchedSite:
    return replace(site, runs=replace(site.runs, **changes))


def _stored() -> MatchedSite:
    return decode(Matching, encode(matching())).sites[0]


def test_every_field_of_a_view_is_part_of_its_key() -> None:
    site, located = matching().sites[0], triangulation().sites[0]
    without = tuple(Observation(frame, None, ()) for frame in range(len(site.runs.track_a)))
    changed = {
        "site": _view(replace(site, site="S02")),
        "view": _view(view="b"),
        "camera": _view(camera=located.camera("b")),
        "catalogue": _view(catalogue=replace(CATALOGUE, mapping="reference", reference="mapping")),
        "frame_times_ms": _view(_with_runs(site, frame_times_a_ms=site.runs.frame_times_a_ms + 1.0)),
        "observations": _view(_with_runs(site, track_a=without)),
        "a_priori": _view(a_priori=APriori(located.points[:-1])),
        "a_priori_frame": _view(a_priori_frame=0),
        "cycle": _view(cycle=CYCLE),
        "others": _view(others=(CYCLE,)),
    }
    assert set(changed) == {field.name for field in fields(MonoplaneView)}
    contents = [_view().content(), *(view.content() for view in changed.values())]
    assert len(set(contents)) == len(contents)
    assert _view().content() == contents[0]


def test_other_parts_of_a_matched_site_do_not_change_the_key() -> None:
    site = matching().sites[0]
    noted = replace(site, notes=(("mapping", Reason.IDENTITY_UNCERTAIN),))
    for other in (noted, _with_runs(site, track_b=site.runs.track_b[::-1])):
        assert _view(other).content() == _view(site).content()


def test_the_frames_of_an_unchanged_site_are_decoded_once(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(tracked_views, "_hashes", tracked_views._Hashes())
    content = _view(_stored()).content()
    assert content == _view().content()

    def never(*_: object) -> object:
        raise AssertionError("decoded again")

    monkeypatch.setattr(tracked_views, "_frames", never)
    assert _view(_stored()).content() == content


def test_a_solver_gets_the_frames_and_the_remembered_site_keeps_none() -> None:
    site = _stored()
    shown = _view(site).decoded()
    expected = matching().sites[0].runs
    assert plain_form(shown) == plain_form(
        MonoplaneView(
            "S01", "a", _view().camera, CATALOGUE, expected.frame_times_a_ms, expected.track_a, _view().a_priori.points, 1,
            None, (),
        )
    )  # fmt: skip
    assert "track_a" not in vars(site.runs)


def test_the_stages_of_all_sites_read_the_same_rows_once(data_dir: Any) -> None:
    study = make_study()
    study.mapped()
    with reading() as session:
        snapshot = Snapshot.model_validate(session.get_one(Job, study.job_id).snapshot)
    counts = []
    for subjects in (["S01"], ["S01", "S02"]):
        with reading() as session, sql_statements() as statements:
            job = StoredJob(session, study.job_id, snapshot)
            for subject in subjects:
                prepare(job, Claim(1, study.job_id, 1, "monoplane", subject))
        counts.append(len(statements))
    assert counts[0] == counts[1] > 0
