import numpy as np
import pytest
from pydantic import ValidationError

from fluoromap.catheters import DEFAULT_CATALOGUE
from fluoromap.contracts import Chain, PixelFacts, Run, Segmenter, Silent, StageStopped
from fluoromap.reasons import Reason
from fluoromap.segmenter.four_step.plugin import FourStep

PX_PER_MM = 512 / 178 * 2


@pytest.fixture(scope="module")
def simulated(study):
    """A lateral run of the phantom, its truth and its segmentation."""
    simulated = study.sites[0].runs[0]
    run = Run(simulated.frames, simulated.frame_times_ms, PX_PER_MM, PixelFacts(False, 12, False))
    return run, simulated.truth, FourStep().segment(run, DEFAULT_CATALOGUE, {}, Silent())


def located(chains, truth_uv, within_px=4.0):
    """Return each catheter's chain whose electrodes all lie on true ones."""
    return {
        name: chain
        for name, points in truth_uv.items()
        for chain in chains
        if len(chain.electrodes) == len(points) and np.linalg.norm(chain.pixels_uv - points, axis=1).max() < within_px
    }


def test_it_is_a_segmenter():
    assert isinstance(FourStep(), Segmenter)
    with pytest.raises(ValidationError, match="unknown"):
        FourStep.Params(unknown=1)
    with pytest.raises(ValidationError, match="gamma_low"):
        FourStep.Params(gamma_low=-1)


def test_lateral_frames_show_reference_and_mapping(simulated):
    run, truth, found = simulated
    right = wrong = 0
    for entry in found.frames:
        hits = located(entry.chains, {name: uv[entry.frame] for name, uv in truth.pixels_uv.items()})
        right += {"reference", "mapping"} <= hits.keys()
        wrong += len(entry.chains) - len(hits)
    assert right >= 0.8 * len(run.frames)
    assert wrong <= 0.1 * len(run.frames)


def test_diastole_is_complete_and_accurate(simulated):
    _, truth, found = simulated
    frames = list(found.diastole_frames)
    uv = {name: points[frames].mean(axis=0) for name, points in truth.pixels_uv.items()}
    hits = located(found.diastole.chains, uv)
    assert {"reference", "mapping"} <= hits.keys()
    assert hits["mapping"].probability("mapping") > 0.9
    assert hits["reference"].probability("mapping") < 0.1
    assert hits["reference"].probability("reference") == pytest.approx(hits["reference"].probability("pacing"))
    errors = np.concatenate([chain.pixels_uv - uv[name] for name, chain in hits.items()])
    assert np.sqrt((errors**2).sum(axis=1).mean()) < 0.7
    assert np.linalg.norm(hits["mapping"].pixels_uv[0] - uv["mapping"][0]) < 1.2


def test_diastole_stands_still(simulated):
    _, truth, found = simulated
    frames = list(found.diastole_frames)
    moved = np.ptp(truth.pixels_uv["mapping"][frames][:, 0], axis=0)
    assert moved.max() < 3.0
    assert found.diastole.frame in frames


def test_tracks_are_catheters(simulated):
    _, truth, found = simulated
    names_of_track = {}
    for entry in (*found.frames, found.diastole):
        uv = {name: points[entry.frame] for name, points in truth.pixels_uv.items()}
        for name, chain in located(entry.chains, uv, 6.0).items():
            names_of_track.setdefault(chain.track, set()).add(name)
    assert all(len(names) == 1 for names in names_of_track.values())
    mapping = {track for track, names in names_of_track.items() if names == {"mapping"}}
    assert len(mapping) <= 2


def test_an_empty_picture_needs_a_hand(run_of):
    rng = np.random.default_rng(0)
    u = np.arange(256)[None].repeat(256, axis=0)
    frames = rng.poisson(600 + 200 * np.sin(u / 40), (4, 256, 256)).astype(np.uint16)
    found = FourStep().segment(run_of(frames), DEFAULT_CATALOGUE, {}, Silent())
    for entry in (*found.frames, found.diastole):
        assert entry.chains == ()
        assert entry.manual_needed == Reason.MANUAL_NEEDED


@pytest.mark.parametrize(
    ("frames", "bits", "monochrome1"),
    [
        (np.zeros((3, 64, 64), np.uint8), 8, False),
        (np.full((3, 64, 64), 255, np.uint8), 8, False),
        (np.full((2, 64, 64), 4095, np.uint16), 12, True),
        (np.zeros((1, 8, 8), np.uint8), 8, False),
        (np.random.default_rng(0).integers(0, 256, (3, 64, 64)).astype(np.uint8), 8, True),
        (np.random.default_rng(0).integers(0, 65536, (2, 70, 131)).astype(np.uint16), 10, False),
        (np.eye(64, dtype=np.uint16)[None].repeat(5, axis=0) * 4095, 12, False),
    ],
)
def test_odd_images_never_fail(run_of, frames, bits, monochrome1):
    found = FourStep().segment(run_of(frames, bits, monochrome1), DEFAULT_CATALOGUE, {}, Silent())
    assert len(found.frames) == len(frames)
    assert all(entry.manual_needed for entry in found.frames if not entry.chains)


def manual(points, name="mapping"):
    n = len(points)
    return Chain(tuple(range(1, n + 1)), points, np.tile(np.eye(2), (n, 1, 1)), np.ones(n), ((name, 1.0),), manual=True)


def test_marks_replace_their_frame_and_reach_diastole(simulated):
    run, truth, found = simulated
    frame = found.diastole.frame
    mark = manual(truth.pixels_uv["mapping"][frame] + 0.5)
    marked = FourStep().segment(run, DEFAULT_CATALOGUE, {frame: (mark,)}, Silent())
    assert [chain.manual for chain in marked.frames[frame].chains] == [True]
    at_diastole = [chain for chain in marked.diastole.chains if chain.probability("mapping") == 1.0 and chain.manual]
    assert len(at_diastole) == 1
    np.testing.assert_allclose(at_diastole[0].pixels_uv, mark.pixels_uv)
    assert len(marked.diastole.chains) == len(found.diastole.chains)


def test_a_mark_helps_where_nothing_was_found(run_of):
    rng = np.random.default_rng(0)
    frames = rng.poisson(600, (6, 128, 128)).astype(np.uint16)
    points = np.array([[40.0, 40], [60, 45], [90, 50], [105, 55]])
    found = FourStep().segment(run_of(frames), DEFAULT_CATALOGUE, {2: (manual(points),)}, Silent())
    assert found.diastole.manual_needed is None
    assert 2 in found.diastole_frames
    np.testing.assert_allclose(found.diastole.chains[0].pixels_uv, points)


def test_it_reports_progress_and_stops_when_asked(run_of):
    class Stopping(Silent):
        def __init__(self):
            self.told = []

        def progress(self, fraction):
            self.told.append(fraction)

        def check(self):
            if len(self.told) == 3:
                raise StageStopped

    context = Stopping()
    with pytest.raises(StageStopped):
        FourStep().segment(run_of(np.zeros((9, 64, 64), np.uint8), 8), DEFAULT_CATALOGUE, {}, context)
    assert len(context.told) == 3
    assert context.told == sorted(context.told)
