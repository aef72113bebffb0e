"""Tracks: origins per frame, accuracy along and across the ray, refusals."""

from __future__ import annotations

import csv
import io
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from fastapi.testclient import TestClient
from finished_study import (
    COVARIANCE_A,
    REFERENCE_MM,
    RELATIVE_COVARIANCE_A,
    STEP_MM,
    TIP_MM,
    FinishedStudy,
    followed_site,
    triangulation,
)
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from fluoromap.monoplane.track_samples import reference_origins, split_along_ray


def _tip(client: TestClient, study: FinishedStudy, query: str = "") -> list[dict[str, Any]]:
    answer = client.get(f"/v1/jobs/{study.job_id}/tracks?site=S01&view=a{query}")
    assert answer.status_code == 200, answer.text
    found: list[dict[str, Any]] = next(
        track["samples"]
        for track in answer.json()["tracks"]
        if (track["catheter"], track["electrode"]) == ("mapping", 1)
    )
    return found


def _position(sample: dict[str, Any]) -> list[float]:
    return [sample[f"{axis}_mm"] for axis in "xyz"]


def test_reference_of_the_same_frame_is_subtracted_where_it_was_located(
    client: TestClient, study: FinishedStudy
) -> None:
    study.finish()
    first, second, third = _tip(client, study)
    assert [sample["frame"] for sample in (first, second, third)] == [1, 2, 3]
    np.testing.assert_allclose(_position(first), TIP_MM - (REFERENCE_MM + STEP_MM))
    np.testing.assert_allclose(_position(third), TIP_MM + STEP_MM - REFERENCE_MM)
    np.testing.assert_allclose(first["baseline_mm"], TIP_MM + 0.25 - (REFERENCE_MM + STEP_MM))
    assert second["grade"] == "rejected"
    assert second["reasons"] == ["depth_assumed", "track_interrupted"]
    assert second["x_mm"] is second["u_px"] is second["covariance_mm2"] is None


@pytest.mark.parametrize("hidden", [(), (0,), (1,)])
def test_the_reference_stays_in_place_when_some_of_it_is_hidden(hidden: tuple[int, ...]) -> None:
    track = followed_site().views[0].track
    assert track is not None
    located = track.located.copy()
    located[:, list(hidden)] = False
    origins = reference_origins(replace(track, located=located), triangulation().sites[0], "reference", None)
    np.testing.assert_allclose(origins.positions_mm[:2], [REFERENCE_MM + STEP_MM, REFERENCE_MM])
    # In the third frame nothing of it is seen.
    np.testing.assert_allclose(origins.positions_mm[2], REFERENCE_MM)
    assert origins.same_frame.tolist() == [True, True, False]


def test_tracks_from_the_isocentre(client: TestClient, study: FinishedStudy) -> None:
    study.finish()
    np.testing.assert_allclose(_position(_tip(client, study, "&origin=isocentre")[0]), TIP_MM)


def test_accuracy_is_stated_along_and_across_the_ray(client: TestClient, study: FinishedStudy) -> None:
    study.finish()
    sample = _tip(client, study)[0]
    # The tip lies within 2 degrees of the central ray, which is the x axis in a lateral view.
    assert sample["along_ray_sd_mm"] == pytest.approx(2.0, rel=2e-3)
    assert sample["lateral_sd_mm"] == pytest.approx(0.1, rel=0.2)
    assert sample["grade"] == "C"
    assert sample["covariance_mm2"] == COVARIANCE_A[np.triu_indices(3)].tolist()


def test_positions_from_the_reference_carry_their_own_uncertainty(client: TestClient, study: FinishedStudy) -> None:
    study.mapped()
    study.followed(relative=True)
    upper = np.triu_indices(3)
    first, _, third = _tip(client, study)
    assert first["covariance_mm2"] == RELATIVE_COVARIANCE_A[upper].tolist()
    assert first["along_ray_sd_mm"] == pytest.approx(0.7, rel=2e-3)
    assert first["grade"] == "A"
    # In frame 3 the diastolic reference is subtracted: nothing cancels.
    assert third["covariance_mm2"] == COVARIANCE_A[upper].tolist()
    assert _tip(client, study, "&origin=isocentre")[0]["covariance_mm2"] == COVARIANCE_A[upper].tolist()


@given(hnp.arrays(np.float64, (3, 3), elements=st.floats(-3, 3)), hnp.arrays(np.float64, 3, elements=st.floats(0.1, 3)))
def test_split_keeps_the_whole_variance(root: np.ndarray, ray: np.ndarray) -> None:
    covariance = root @ root.T
    along, lateral = split_along_ray(covariance, ray)
    assert along**2 + 2 * lateral**2 == pytest.approx(np.trace(covariance), abs=1e-9)


def test_views_that_could_not_be_followed_say_why(client: TestClient, study: FinishedStudy) -> None:
    study.finish()
    rejected = client.get(f"/v1/jobs/{study.job_id}/tracks").json()["rejected"]
    assert {entry["site"]: entry["reasons"] for entry in rejected} == {
        "S02": ["no_a_priori", "pairing_failed"],
        "S03": ["one_view_only", "no_activation_time"],
    }
    assert all(entry["message"] and entry["view"] == "a" for entry in rejected)


def test_a_failed_solver_is_reported_as_a_rejection(client: TestClient, study: FinishedStudy) -> None:
    study.mapped()
    study.fail("monoplane", "S01")
    answer = client.get(f"/v1/jobs/{study.job_id}/tracks?site=S01").json()
    assert answer["tracks"] == []
    assert answer["rejected"][0]["reasons"] == ["plugin_failed"]
    assert "it broke" in answer["rejected"][0]["message"]


def test_tracks_are_ready_site_by_site(client: TestClient, study: FinishedStudy) -> None:
    study.mapped()
    path = f"/v1/jobs/{study.job_id}/tracks"
    assert client.get(f"{path}?site=S01").json()["code"] == "not_ready"
    study.followed()
    assert client.get(f"{path}?site=S01").status_code == 200
    assert client.get(f"{path}?site=S99").status_code == 404
    assert client.get(f"{path}?site=S01&view=c").status_code == 422


def test_the_view_that_was_not_followed_has_no_tracks(client: TestClient, study: FinishedStudy) -> None:
    study.finish()
    answer = client.get(f"/v1/jobs/{study.job_id}/tracks?site=S01&view=b").json()
    assert answer["tracks"] == answer["rejected"] == []


@pytest.mark.parametrize(("path", "accept"), [("tracks.csv", "*/*"), ("tracks", "text/csv")])
def test_tracks_as_csv(client: TestClient, study: FinishedStudy, path: str, accept: str) -> None:
    study.finish()
    answer = client.get(f"/v1/jobs/{study.job_id}/{path}", headers={"Accept": accept})
    rows = list(csv.DictReader(io.StringIO(answer.text)))
    assert len(rows) == 3 * 3 + 2
    assert all(None not in row and None not in row.values() for row in rows)
    first = next(row for row in rows if row["catheter"] == "mapping")
    assert (first["frame"], first["solver"], first["reasons"]) == ("1", "by-hand", "depth_assumed")
    assert float(first["baseline_x_mm"]) == pytest.approx(TIP_MM[0] + 0.25 - REFERENCE_MM[0] - 1)
    assert (rows[-1]["site"], rows[-1]["frame"], rows[-1]["grade"]) == ("S03", "", "rejected")
