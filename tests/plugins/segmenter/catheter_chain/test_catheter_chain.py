from collections import Counter
from dataclasses import replace

import numpy as np
import pytest
from pydantic import ValidationError

from fluoromap.catheters import DEFAULT_CATALOGUE, Catalogue, Catheter
from fluoromap.contracts import Chain, PixelFacts, Run, Segmenter, Silent, StageStopped
from fluoromap.phantom import APPEARANCES, FRONTAL, LATERAL, StudySpec, simulate_study
from fluoromap.phantom.fluoroscopy import detect, expected_photons
from fluoromap.phantom.torso import torso
from fluoromap.reasons import Reason
from fluoromap.segmenter.catheter_chain.plugin import CatheterChain
from fluoromap_service.store.value_hash import digest

PX_PER_MM = 512 / 178 * 2
CHI2_95_2D = 5.991464547107979


def run_of(frames, bits=12, monochrome1=False, frame_ms=1000 / 60):
    class Source:
        shape = np.asarray(frames[0]).shape

        def __len__(self):
            return len(frames)

        def __getitem__(self, index):
            return np.asarray(frames[index])

        def __iter__(self):
            return iter(frames)

    return Run(Source(), np.arange(len(frames)) * frame_ms, PX_PER_MM, PixelFacts(False, bits, monochrome1))


def segmented(frames, bits=12, monochrome1=False, catalogue=DEFAULT_CATALOGUE, marks=None, frame_ms=1000 / 60):
    run = run_of(frames, bits, monochrome1, frame_ms)
    return CatheterChain().segment(run, catalogue, marks or {}, Silent())


@pytest.fixture(scope="module", params=["LAT", "PA"])
def beating(request):
    """A run of either contrast at 60 frames a second, its truth and its segmentation."""
    study = simulate_study(StudySpec(313, sites=1, frames=30, frame_rate_hz=60.0, heart="dog", contrast=("LAT", "PA")))
    simulated = study.sites[0].runs[request.param == "PA"]
    frames = [simulated.frames[index] for index in range(30)]
    return frames, simulated.truth, segmented(frames)


def located(chains, truth_uv, within_px=5.0):
    """Return each catheter's chain whose electrodes all lie on true ones."""
    return {
        name: chain
        for name, points in truth_uv.items()
        for chain in chains
        if len(chain.electrodes) == len(points) and np.linalg.norm(chain.pixels_uv - points, axis=1).max() < within_px
    }


def test_it_is_a_segmenter():
    assert isinstance(CatheterChain(), Segmenter)
    with pytest.raises(ValidationError, match="unknown"):
        CatheterChain.Params(unknown=1)


def test_all_catheters_are_found_and_nothing_else(beating):
    frames, truth, found = beating
    hits = [
        located(entry.chains, {name: uv[entry.frame] for name, uv in truth.pixels_uv.items()}) for entry in found.frames
    ]
    assert sum(len(hit) for hit in hits) >= 0.95 * 3 * len(frames)
    assert sum(len(entry.chains) for entry in found.frames) - sum(len(hit) for hit in hits) <= 0.02 * 3 * len(frames)
    tracks = {(name, chain.track) for hit in hits for name, chain in hit.items()}
    assert len(tracks) == 3


def test_diastole_is_accurate(beating):
    _, truth, found = beating
    frames = list(found.diastole_frames)
    uv = {name: points[frames].mean(axis=0) for name, points in truth.pixels_uv.items()}
    hits = located(found.diastole.chains, uv)
    assert hits.keys() == set(DEFAULT_CATALOGUE.names)
    assert hits["mapping"].probability("mapping") > 0.5
    assert hits["reference"].probability("mapping") < 0.5
    errors = np.concatenate([chain.pixels_uv - uv[name] for name, chain in hits.items()])
    assert np.sqrt((errors**2).sum(axis=1).mean()) < 0.7
    numbers = {chain.track for entry in found.frames for chain in entry.chains}
    assert {chain.track for chain in found.diastole.chains} <= numbers


def test_ellipses_hold_the_truth(beating):
    """On average over many runs 95 % do; the frames of one run share their errors."""
    _, truth, found = beating
    squared = []
    for entry in found.frames:
        uv = {name: points[entry.frame] for name, points in truth.pixels_uv.items()}
        for name, chain in located(entry.chains, uv).items():
            error = chain.pixels_uv - uv[name]
            squared += np.einsum("ni,nij,nj->n", error, np.linalg.inv(chain.covariance_px2), error).tolist()
    assert np.mean(np.array(squared) <= CHI2_95_2D) > 0.85
    assert np.median(squared) > 0.1


@pytest.mark.parametrize(("contrast", "gantry"), [("LAT", LATERAL), ("PA", FRONTAL)])
def test_a_torso_without_catheters_gets_none(contrast, gantry):
    appearance = APPEARANCES[contrast]
    for seed in range(4):
        behind = torso(gantry, appearance, np.random.default_rng(seed), np.random.default_rng(seed + 50), 0.0)
        photons = expected_photons(behind, np.ones((512, 512), np.float32), appearance, 1.0)
        found = segmented([detect(photons, appearance.photons, 100 * seed + key) for key in range(3)])
        assert all(entry.chains == () and entry.manual_needed for entry in (*found.frames, found.diastole))


def test_monochrome1_eight_bits_and_a_turned_field_change_nothing(beating):
    frames, _, plain = beating
    few = frames[12:15]
    inverted = segmented([(4095 - frame).astype(np.uint16) for frame in few], monochrome1=True)
    eight = segmented([np.minimum(frame // 16, 255).astype(np.uint8) for frame in few], bits=8)
    turned = segmented([np.ascontiguousarray(np.rot90(frame)) for frame in few])
    upright = segmented(few)
    for index, entry in enumerate(upright.frames):
        ours = entry.chains
        theirs = inverted.frames[index].chains
        assert len(ours) == len(theirs)
        np.testing.assert_allclose([c.pixels_uv for c in ours], [c.pixels_uv for c in theirs], atol=0.05)
        back = [
            np.stack([few[0].shape[1] - 1 - chain.pixels_uv[:, 1], chain.pixels_uv[:, 0]], axis=1)
            for chain in turned.frames[index].chains
        ]
        for chain in ours:
            nearest = min(np.linalg.norm(points - chain.pixels_uv, axis=1).max() for points in back)
            assert nearest < 3.0
        assert sum(len(entry.chains) for entry in eight.frames) >= len(few)
    assert len(plain.frames[13].chains) == 3


@pytest.mark.parametrize(
    ("frames", "bits", "monochrome1"),
    [
        (np.zeros((3, 64, 64), np.uint8), 8, False),
        (np.full((3, 64, 64), 255, np.uint8), 8, False),
        (np.full((2, 64, 64), 4095, np.uint16), 12, True),
        (np.zeros((1, 8, 8), np.uint8), 8, False),
        (np.zeros((1, 1, 40), np.uint8), 8, False),
        (np.random.default_rng(0).integers(0, 256, (3, 64, 64)).astype(np.uint8), 8, True),
        (np.random.default_rng(0).integers(0, 65536, (2, 70, 131)).astype(np.uint16), 10, False),
        (np.random.default_rng(0).poisson(600, (4, 256, 256)).astype(np.uint16), 12, False),
        (np.random.default_rng(0).poisson(20, (3, 300, 300)).astype(np.uint8), 8, False),
    ],
)
def test_pictures_without_catheters_get_none(frames, bits, monochrome1):
    found = segmented(frames, bits, monochrome1)
    assert len(found.frames) == len(frames)
    for entry in (*found.frames, found.diastole):
        assert entry.chains == ()
        assert entry.manual_needed == Reason.MANUAL_NEEDED


def test_a_picture_of_dots_in_line_never_fails():
    found = segmented(np.eye(64, dtype=np.uint16)[None].repeat(5, axis=0) * 4095)
    assert len(found.frames) == 5


def test_frames_in_which_the_catheters_are_gone_stay_empty(beating):
    frames, _, _ = beating
    gone = np.random.default_rng(2).poisson(np.median(frames[0], axis=0)[None].repeat(512, axis=0)).astype(np.uint16)
    found = segmented([*frames[:6], gone, gone, gone, *frames[9:14]])
    assert [len(entry.chains) for entry in found.frames[6:9]] == [0, 0, 0]
    assert sum(len(entry.chains) for entry in found.frames) >= 0.9 * 3 * 11


def test_a_catalogue_that_does_not_fit_gets_no_electrodes_that_are_not_there(beating):
    frames, truth, _ = beating
    other = Catalogue(
        (
            Catheter("reference", 10, (8.0,) * 9, 2.0, 1.0),
            Catheter("lasso", 8, (13.0, 2.0, 13.0, 2.0, 13.0, 2.0, 13.0), 2.0, 1.0),
        ),
        "reference",
        "lasso",
    )
    found = segmented(frames[:6], catalogue=other)
    assert all(entry.chains == () for entry in found.frames)
    small = Catalogue(DEFAULT_CATALOGUE.catheters[1:], "pacing", "mapping")
    found = segmented(frames[:6], catalogue=small)
    for entry in found.frames:
        assert len(entry.chains) <= 2
        uv = {name: points[entry.frame] for name, points in truth.pixels_uv.items()}
        assert len(located(entry.chains, uv)) == len(entry.chains)


def test_a_catheter_more_than_the_study_has_is_reported_and_swaps_with_none(beating):
    frames, truth, plain = beating
    assert plain.diastole.manual_needed is None
    two = Catalogue(DEFAULT_CATALOGUE.catheters[1:], "pacing", "mapping")
    found = segmented(frames, catalogue=two)
    assert found.diastole.manual_needed == Reason.EXTRA_CATHETER
    followed = {}
    for entry in found.frames:
        uv = {name: points[entry.frame] for name, points in truth.pixels_uv.items()}
        for name, chain in located(entry.chains, uv).items():
            followed.setdefault(chain.track, set()).add(name)
    assert followed
    assert all(len(names) == 1 for names in followed.values())


def test_a_catheter_that_leaves_the_field_is_missing_and_reported(beating):
    frames, truth, _ = beating
    uv = {name: points[0] for name, points in truth.pixels_uv.items()}
    by_side = min(uv, key=lambda name: uv[name][:, 0].min())
    start = int(uv[by_side][:, 0].min()) - 40
    shown = []
    for index in range(30):
        cut = start + 11 * max(0, index - 17)
        shown.append(np.concatenate([frames[0][:, cut:], np.tile(frames[0][:, -40:], 13)[:, :cut]], axis=1))
    found = segmented(shown)
    assert by_side in located(found.frames[10].chains, {name: points - [start, 0] for name, points in uv.items()})
    gone = found.frames[29]
    assert gone.manual_needed in (Reason.OUT_OF_FIELD, Reason.MANUAL_NEEDED)
    expected = {name: points - [start + 132, 0] for name, points in uv.items()}
    assert len(gone.chains) < 3
    for chain in gone.chains:
        # Another catheter may be partly outside the picture, too.
        shown = [electrode - 1 for electrode in chain.electrodes]
        away = [np.linalg.norm(chain.pixels_uv - points[shown], axis=1).max() for points in expected.values()]
        assert min(away) < 5.0


def test_foreshortened_and_crossing_catheters_are_found():
    """Seeds in which a tip points along the ray, or two catheters cross."""
    whole = 0
    for seed, site, view in ((4011, 0, 0), (4102, 1, 1), (4106, 1, 0)):
        spec = (
            StudySpec(seed, sites=1, frames=8, frame_rate_hz=60.0, heart="dog", contrast=("LAT", "PA"))
            if seed < 4100
            else StudySpec(seed, sites=4, frames=8, contrast=("LAT", "PA"))
        )
        simulated = simulate_study(spec).sites[site].runs[view]
        found = segmented(list(simulated.frames), frame_ms=float(np.diff(simulated.frame_times_ms)[0]))
        whole += sum(len(entry.chains) == 3 for entry in found.frames)
        for entry in found.frames:
            everything = np.concatenate([uv[entry.frame] for uv in simulated.truth.pixels_uv.values()])
            for chain in entry.chains:
                away = np.linalg.norm(chain.pixels_uv[:, None] - everything[None], axis=2).min(axis=1)
                assert np.median(away) < 5
    assert whole >= 20


def manual(points, name="mapping"):
    n = len(points)
    return Chain(tuple(range(1, n + 1)), points, np.tile(np.eye(2), (n, 1, 1)), np.ones(n), ((name, 1.0),), manual=True)


def test_a_mark_replaces_its_frame_and_its_neighbours_follow_it(beating):
    frames, truth, _ = beating
    mark = manual(truth.pixels_uv["mapping"][4])
    found = segmented(frames[:8], marks={4: (mark,)})
    assert [chain.manual for chain in found.frames[4].chains] == [True]
    number = found.frames[4].chains[0].track
    for frame in (2, 3, 5, 6):
        followed = next(chain for chain in found.frames[frame].chains if chain.track == number)
        assert not followed.manual
        assert np.linalg.norm(followed.pixels_uv - truth.pixels_uv["mapping"][frame], axis=1).max() < 5


class Remembering(Silent):
    """A context that stores partial results by the kind and a hash of all inputs, and counts those that are computed."""

    def __init__(self):
        self.results, self.computed = {}, Counter()

    def recall(self, kind, inputs, compute):
        key = kind.__name__, digest(*inputs)
        if key not in self.results:
            self.computed[kind.__name__] += 1
            self.results[key] = compute()
        return self.results[key]


def test_a_correction_repeats_only_what_its_mark_changes(beating):
    frames, truth, _ = beating
    run = replace(run_of(frames[:16]), content="0" * 64)
    moved = truth.pixels_uv["mapping"][4] + [1.5, 0.0]
    marks = {4: (manual(truth.pixels_uv["mapping"][4]),)}
    context = Remembering()
    first = CatheterChain().segment(run, DEFAULT_CATALOGUE, marks, context)
    searched = Counter(context.computed)
    again = CatheterChain().segment(run, DEFAULT_CATALOGUE, marks, context)
    assert context.computed == searched
    assert digest(again) == digest(first)
    corrected = CatheterChain().segment(run, DEFAULT_CATALOGUE, {4: (manual(moved),)}, context)
    assert context.computed["RunDetections"] == 1
    assert digest(corrected) == digest(CatheterChain().segment(run, DEFAULT_CATALOGUE, {4: (manual(moved),)}, Silent()))


def test_a_mark_of_some_electrodes_only_is_kept():
    frames = np.random.default_rng(0).poisson(600, (4, 128, 128)).astype(np.uint16)
    mark = Chain((2, 3), [[40.0, 40], [60, 45]], np.tile(np.eye(2), (2, 1, 1)), np.ones(2), (("mapping", 1.0),))
    found = segmented(frames, marks={2: (mark,)})
    assert found.frames[2].chains[0].electrodes == (2, 3)
    assert 2 in found.diastole_frames


def test_it_stops_when_asked():
    class Stopped(Silent):
        def check(self):
            raise StageStopped

    run = Run([np.zeros((64, 64), np.uint8)], np.zeros(1), PX_PER_MM, PixelFacts(False, 8, False))
    with pytest.raises(StageStopped):
        CatheterChain().segment(run, DEFAULT_CATALOGUE, {}, Stopped())
