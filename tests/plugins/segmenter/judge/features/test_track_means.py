"""The evidence for electrodes in the means along a track."""

from pathlib import Path

import numpy as np

from fluoromap.contracts import PixelFacts
from fluoromap.phantom import StudySpec, simulate_study
from fluoromap.segmenter.electrodes.network.network_response import NetworkResponse
from fluoromap.segmenter.electrodes.network.weights import SHIPPED, read_weights
from fluoromap.segmenter.electrodes.proposals import log_odds
from fluoromap.segmenter.judge.features.track_means import TrackMeans
from fluoromap.segmenter.picture.field_mask import find_field
from fluoromap.segmenter.picture.log_image import LogTransform

PX_PER_MM = 512 / 178 * 2
FACTS = PixelFacts(False, 12, False)


def test_the_network_is_asked_at_two_scales(monkeypatch):
    trained = read_weights(Path(SHIPPED))
    spec = StudySpec(313, sites=1, frames=1, heart="dog", contrast=("LAT", "PA"))
    run = simulate_study(spec).sites[0].runs[1]
    path_uv = run.truth.pixels_uv["reference"]
    field = find_field(run.frames, FACTS)
    image = field.fill(LogTransform.of_run(FACTS, field.mean_level)(run.frames[0]))
    ask, said = NetworkResponse.of_reduced, {}

    def record(small, trained, scale, orientations):
        seen = ask(small, trained, scale, orientations)
        said[scale] = seen
        return seen

    monkeypatch.setattr(NetworkResponse, "of_reduced", record)
    odds = TrackMeans(trained, PX_PER_MM).evidence_along([0], path_uv, lambda frame: image).log_odds
    assert len(said) == 2
    largest, smaller = sorted(said, reverse=True)
    assert smaller < 0.9 * largest
    corner = np.floor(path_uv[0].min(axis=0) - 40.0 / largest)
    each = [log_odds(seen.shares_at(path_uv[0] - corner)) for seen in said.values()]
    np.testing.assert_allclose(odds, np.mean(each, axis=0))
