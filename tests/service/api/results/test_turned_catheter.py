"""A catheter that matching numbers from the other end has these numbers in the detected electrodes too."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from fastapi.testclient import TestClient
from finished_study import FRAMES, FinishedStudy, matching

from fluoromap.contracts import Array, Chain, FrameChains, Matching, NamedChain, Segmentation

PIXELS = np.array([[10.0, 20.0], [14.0, 23.0]])
COVARIANCE = np.tile(np.eye(2), (2, 1, 1))


def _segmentation() -> Segmentation:
    chain = Chain((1, 2), PIXELS, COVARIANCE, np.ones(2), (("reference", 1.0),), track=0, tip_odds=0.5)
    frames = tuple(FrameChains(frame, (chain,)) for frame in range(FRAMES))
    return Segmentation(frames, None, (), np.zeros(FRAMES), np.arange(FRAMES, dtype=np.float64))


def _matching(pixels_uv: Array) -> Matching:
    before = matching()
    (site,) = before.sites
    named = NamedChain("reference", (1, 2), pixels_uv, COVARIANCE, track=0)
    track = tuple(replace(seen, chains=(named,)) for seen in site.runs.track_a)
    return replace(before, sites=(replace(site, runs=replace(site.runs, track_a=track)),))


def test_detected_electrodes_have_the_numbers_of_matching(client: TestClient, study: FinishedStudy) -> None:
    for uid in study.uids.values():
        study.end("segment", uid, _segmentation())
    study.end("match", None, _matching(PIXELS[::-1]))
    run = f"/v1/studies/{study.study_id}/instances/{study.uids['S01', 'a']}"
    for found in (
        client.get(f"{run}/frames/2/electrodes").json(),
        client.get(f"{run}/electrodes").json()[1]["electrodes"],
    ):
        assert [(one["electrode"], one["u_px"]) for one in found] == [(1, 14.0), (2, 10.0)]
