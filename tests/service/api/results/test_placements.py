"""The place of the map in every frame, as the overlays draw it."""

from __future__ import annotations

import numpy as np
import pytest
from fastapi.testclient import TestClient
from finished_study import FRAMES, FinishedStudy

from fluoromap_service.results.fusion import fusion_of
from fluoromap_service.store.engine import reading
from fluoromap_service.store.models import Job


@pytest.mark.parametrize("followed", [False, True])
def test_every_frame_is_where_its_overlay_is(client: TestClient, study: FinishedStudy, followed: bool) -> None:
    study.mapped()
    if followed:
        study.followed()
    for view in ("a", "b"):
        uid = study.uids["S01", view]
        placement = client.get(f"/v1/jobs/{study.job_id}/overlays/{uid}/placement").json()
        assert (placement["site"], placement["view"]) == ("S01", view)
        assert [each["frame"] for each in placement["frames"]] == list(range(1, FRAMES + 1))
        with reading() as session:
            job = session.get_one(Job, study.job_id)
            fusions = [fusion_of(session, job, uid, frame) for frame in range(1, FRAMES + 1)]
            assert fusion_of(session, job, uid, None).frame + 1 == placement["frame"]
        for each, fusion in zip(placement["frames"], fusions, strict=True):
            assert fusion.tip_uv is not None
            np.testing.assert_allclose(each["shift_mm"], fusion.shift_mm)
            np.testing.assert_allclose(each["tip_px"], fusion.tip_uv)
            for name, places in fusion.electrodes_uv.items():
                own = [[one["u_px"], one["v_px"]] for one in each["electrodes"] if one["catheter"] == name]
                np.testing.assert_allclose(np.array(own).reshape(-1, 2), places)
            point = fusion.chamber.vertices_mm[0]
            *pixel, depth = np.array(placement["projection"]) @ [*(point + each["shift_mm"]), 1.0]
            np.testing.assert_allclose(np.array(pixel) / depth, fusion.camera.project(point + fusion.shift_mm))


def test_runs_and_jobs_without_placement(client: TestClient, study: FinishedStudy) -> None:
    path = f"/v1/jobs/{study.job_id}/overlays"
    assert client.get(f"{path}/{study.uids['S01', 'a']}/placement").status_code == 409
    study.mapped()
    for uid in (study.uids["S02", "a"], "1.2.3"):
        assert client.get(f"{path}/{uid}/placement").status_code == 404
