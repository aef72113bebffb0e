"""Scale and polarity found without the header: the phantom at two scales, inverted, and pictures without catheters."""

from dataclasses import replace

import numpy as np
import pytest
from frame_sources import Frames

from fluoromap.catheters import DEFAULT_CATALOGUE
from fluoromap.contracts import PixelFacts, Run, Silent
from fluoromap.phantom import StudySpec, simulate_study
from fluoromap.segmenter.electrodes.network.weights import SHIPPED, read_weights
from fluoromap.segmenter.learned_chain.plugin import LearnedChain, LearnedChainParams
from fluoromap.segmenter.runs.hypotheses import scale_and_polarity as explanation
from fluoromap.segmenter.runs.hypotheses.scale_and_polarity import (
    Explanation,
    find_scale,
    is_inverted,
    promising_scales,
)

PX_PER_MM = 512 / 178 * 2
HIGHEST = 4095


def run_of(frames):
    source = Frames(frames)
    return Run(source, np.arange(len(source)) * 1000 / 60, 1.0, PixelFacts(False, 12, False))


@pytest.fixture(scope="module")
def frames():
    spec = StudySpec(313, sites=1, frames=4, frame_rate_hz=60.0, heart="dog", contrast=("LAT", "PA"))
    return list(simulate_study(spec).sites[0].runs[0].frames)


def test_the_scale_is_found_from_the_catalogue(frames):
    found = find_scale(run_of(frames), DEFAULT_CATALOGUE)
    assert found is not None
    assert 0.78 * PX_PER_MM <= found.px_per_mm <= 1.2 * PX_PER_MM
    assert not found.monochrome1
    assert found.electrodes >= 6.0


def test_half_the_picture_has_half_the_scale(frames):
    halved = [(frame[::2, ::2] // 2 + frame[1::2, 1::2] // 2).astype(np.uint16) for frame in frames]
    found = find_scale(run_of(halved), DEFAULT_CATALOGUE)
    assert found is not None
    assert 0.78 * PX_PER_MM <= 2.0 * found.px_per_mm <= 1.35 * PX_PER_MM


def test_bright_electrodes_are_recognised(frames):
    inverted = [np.uint16(HIGHEST) - frame for frame in frames]
    found = find_scale(run_of(inverted), DEFAULT_CATALOGUE)
    assert found is not None
    assert found.monochrome1
    run = replace(run_of(inverted), px_per_mm=PX_PER_MM)
    assert is_inverted(run, DEFAULT_CATALOGUE)
    assert not is_inverted(replace(run_of(frames), px_per_mm=PX_PER_MM), DEFAULT_CATALOGUE)


@pytest.mark.parametrize(("of_inverted", "is_inverted_chosen"), [(8.0, False), (10.0, True)])
def test_the_header_is_right_unless_the_inverted_picture_explains_clearly_more(
    monkeypatch, frames, of_inverted, is_inverted_chosen
):
    def explained(run, pixels, *_):
        return [explanation.Explanation(3.1, pixels.monochrome1, of_inverted if pixels.monochrome1 else 6.0, True)]

    monkeypatch.setattr(explanation, "_explanations", explained)
    found = find_scale(run_of(frames), DEFAULT_CATALOGUE)
    assert found is not None
    assert found.monochrome1 == is_inverted_chosen
    assert is_inverted(run_of(frames), DEFAULT_CATALOGUE) == is_inverted_chosen


def test_a_large_picture_has_a_large_scale(frames):
    doubled = [frame.repeat(2, axis=0).repeat(2, axis=1) for frame in frames]
    found = find_scale(run_of(doubled), DEFAULT_CATALOGUE)
    assert found is not None
    assert 0.78 * PX_PER_MM <= 0.5 * found.px_per_mm <= 1.2 * PX_PER_MM


def test_an_inverted_run_is_segmented_all_the_same(frames, caplog):
    inverted = replace(run_of([np.uint16(HIGHEST) - frame for frame in frames]), px_per_mm=PX_PER_MM)
    found = LearnedChain().segment(inverted, DEFAULT_CATALOGUE, {}, Silent())
    assert sum(len(chain.electrodes) for chain in found.frames[2].chains) >= 8
    assert "inverted" in caplog.text


@pytest.fixture
def blind_weights(tmp_path):
    """A weights file whose network sees no electrode anywhere."""
    with np.load(SHIPPED, allow_pickle=False) as shipped:
        arrays = {name: shipped[name] for name in shipped.files}
    arrays["calibration"] = np.array([1.0, -40.0, 1.0], np.float32)
    path = tmp_path / "blind.npz"
    np.savez(path, **arrays)
    return path


def test_scale_and_polarity_are_those_of_the_jobs_own_weights(frames, blind_weights, caplog):
    inverted = replace(run_of([np.uint16(HIGHEST) - frame for frame in frames]), px_per_mm=PX_PER_MM)
    segmenter = LearnedChain(LearnedChainParams(weights=str(blind_weights)))
    found = segmenter.segment(inverted, DEFAULT_CATALOGUE, {}, Silent())
    assert all(entry.chains == () for entry in found.frames)
    assert "inverted" not in caplog.text
    trained = read_weights(blind_weights)
    assert not is_inverted(inverted, DEFAULT_CATALOGUE, trained)
    assert find_scale(inverted, DEFAULT_CATALOGUE, trained=trained) is None


@pytest.mark.parametrize("level", [20, 600])
def test_noise_has_no_scale(level):
    random = np.random.default_rng(0)
    noise = [random.poisson(level, (256, 256)).astype(np.uint16) for _ in range(3)]
    assert find_scale(run_of(noise), DEFAULT_CATALOGUE) is None


@pytest.mark.parametrize(("own_is_sure", "promising"), [(False, (2.5, 3.8)), (True, (2.5, 4.0, 3.8))])
def test_another_scale_needs_clear_chains_where_the_own_one_shows_none(own_is_sure, promising, monkeypatch):
    """Contrast medium may explain a few electrodes at any scale, and a whole segmentation takes long."""
    explained = [
        Explanation(3.0, False, 2.0, own_is_sure),
        Explanation(2.5, False, 3.0, True),
        Explanation(4.0, False, 5.0, False),
        Explanation(3.5, False, 1.0, True),
        # Nearly as much in a few frames: the whole run may show a catheter more.
        Explanation(3.8, False, 1.7, True),
    ]
    monkeypatch.setattr(explanation, "_explanations", lambda *_: explained)
    run = run_of([np.zeros((8, 8), np.uint16)])
    assert promising_scales(run, DEFAULT_CATALOGUE, (2.5, 4.0, 3.5, 3.8), 0.75) == promising
