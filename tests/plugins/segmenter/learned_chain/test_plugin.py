"""Catheters found by the network and the chain search: the phantom, pictures without catheters, wrong descriptions."""

import numpy as np
import pytest
from pydantic import ValidationError

from fluoromap.catheters import DEFAULT_CATALOGUE, Catalogue, Catheter, catheter_type
from fluoromap.contracts import PixelFacts, Run, Segmenter, Silent
from fluoromap.phantom import APPEARANCES, FRONTAL, LATERAL, StudySpec, simulate_study
from fluoromap.phantom.fluoroscopy import detect, expected_photons
from fluoromap.phantom.torso import torso
from fluoromap.reasons import Reason
from fluoromap.segmenter.learned_chain.plugin import LearnedChain, LearnedChainParams

PX_PER_MM = 512 / 178 * 2


def segmented(
    frames, bits=12, monochrome1=False, catalogue=DEFAULT_CATALOGUE, px_per_mm=PX_PER_MM, marks=None, frame_ms=1000 / 60
):
    class Source:
        shape = np.asarray(frames[0]).shape

        def __len__(self):
            return len(frames)

        def __getitem__(self, index):
            return np.asarray(frames[index])

        def __iter__(self):
            return iter(frames)

    run = Run(Source(), np.arange(len(frames)) * frame_ms, px_per_mm, PixelFacts(False, bits, monochrome1))
    return LearnedChain().segment(run, catalogue, marks or {}, Silent())


@pytest.fixture(scope="module")
def simulated():
    return (
        simulate_study(StudySpec(313, sites=1, frames=12, frame_rate_hz=60.0, heart="dog", contrast=("LAT", "PA")))
        .sites[0]
        .runs[0]
    )


def electrodes_right(found, truth, within_px=5.0):
    right = there = false = 0
    for entry in found.frames:
        points = np.concatenate([uv[entry.frame] for uv in truth.pixels_uv.values()])
        seen = np.concatenate([chain.pixels_uv for chain in entry.chains]) if entry.chains else np.zeros((0, 2))
        away = np.linalg.norm(seen[:, None] - points[None], axis=2)
        right += int((away.min(axis=0, initial=np.inf) <= within_px).sum())
        false += int((away.min(axis=1, initial=np.inf) > within_px).sum())
        there += len(points)
    return right / there, false


def test_it_is_a_segmenter():
    assert isinstance(LearnedChain(), Segmenter)
    with pytest.raises(ValidationError, match="unknown"):
        LearnedChain.Params(unknown=1)


def test_weights_that_are_not_there_are_named(simulated):
    run = Run(simulated.frames, simulated.frame_times_ms, PX_PER_MM, PixelFacts(False, 12, False))
    segmenter = LearnedChain(LearnedChainParams(weights="/missing.npz"))
    with pytest.raises(ValueError, match=r"missing\.npz"):
        segmenter.segment(run, DEFAULT_CATALOGUE, {}, Silent())


def test_all_catheters_of_the_phantom_are_found_and_nothing_else(simulated):
    found = segmented([simulated.frames[k] for k in range(12)])
    recall, false = electrodes_right(found, simulated.truth)
    assert recall >= 0.97
    assert false == 0
    assert found.diastole is not None
    assert {len(chain.electrodes) for chain in found.diastole.chains} == {4}


def test_eight_bits_at_half_the_scale(simulated):
    small = [(simulated.frames[k][::2, ::2] // 2 + simulated.frames[k][1::2, 1::2] // 2) // 16 for k in range(12)]
    found = segmented([np.minimum(frame, 255).astype(np.uint8) for frame in small], 8, px_per_mm=PX_PER_MM / 2)
    points = sum(len(chain.electrodes) for entry in found.frames for chain in entry.chains)
    assert points >= 0.8 * 12 * 12


@pytest.mark.parametrize(("beside_mm", "least"), [(2.3, 0.97), (1.2, 0.9)])
def test_a_catheter_close_to_a_collimator_blade_is_found(simulated, beside_mm, least):
    """The blade lies so far from the outermost electrode where that comes nearest."""
    places = np.concatenate(list(simulated.truth.pixels_uv.values()), axis=1)[:12]
    blade = int(places[..., 0].min() - beside_mm * PX_PER_MM)
    frames = [simulated.frames[k].copy() for k in range(12)]
    for frame in frames:
        frame[:, :blade] //= 60
    recall, false = electrodes_right(segmented(frames), simulated.truth)
    assert recall >= least
    assert false == 0


@pytest.mark.parametrize("wrong", [0.6, 1.4])
def test_a_scale_that_is_off_by_forty_per_cent_invents_nothing(simulated, wrong):
    found = segmented([simulated.frames[k] for k in range(4)], px_per_mm=wrong * PX_PER_MM)
    assert electrodes_right(found, simulated.truth)[1] <= 4


def test_a_stated_scale_that_is_a_quarter_too_small_still_shows_the_catheters():
    """Marks of all catheters in most frames do not change the scale that the others need."""
    spec = StudySpec(313, sites=1, frames=8, frame_rate_hz=60.0, heart="dog", contrast=("LAT", "PA"))
    frontal = simulate_study(spec).sites[0].runs[1]
    automatic = segmented(frontal.frames, px_per_mm=PX_PER_MM / 1.3, frame_ms=100.0)
    recall, _ = electrodes_right(automatic, frontal.truth)
    # At a wrong scale some electrodes are misplaced by more than 5 px, but each catheter is there.
    assert recall >= 0.75
    assert [len(entry.chains) for entry in automatic.frames] == [3] * 8
    marks = {frame: automatic.frames[frame].chains for frame in range(5)}
    corrected = segmented(frontal.frames, px_per_mm=PX_PER_MM / 1.3, frame_ms=100.0, marks=marks)
    assert electrodes_right(corrected, frontal.truth)[0] >= recall
    assert [len(entry.chains) for entry in corrected.frames] == [3] * 8


def test_a_decapolar_catheter_does_not_pass_for_two_quadripolar_ones():
    random = np.random.default_rng(0)
    deca = catheter_type("decapolar-2-5-2", "cs")
    v, u = np.mgrid[0:400, 0:400].astype(np.float64)
    frames = []
    for shift in range(3):
        along = (u - 60.0 - shift) * np.cos(0.5) + (v - 90.0) * np.sin(0.5)
        across = (v - 90.0) * np.cos(0.5) - (u - 60.0 - shift) * np.sin(0.5)
        level = 900.0 * np.where((np.abs(across) < 5.0) & (along > 0), 0.88, 1.0)
        for index, arc in enumerate(deca.arc_lengths_mm * PX_PER_MM):
            half = 0.5 * PX_PER_MM * (deca.tip_mm if index == 0 else deca.ring_mm)
            level = np.where((np.abs(along - arc) < half) & (np.abs(across) < 5.5), 350.0, level)
        frames.append(random.poisson(level).astype(np.uint16))
    quads = segmented(frames)
    assert all(entry.chains == () for entry in quads.frames)
    both = Catalogue((deca, DEFAULT_CATALOGUE["mapping"]), "cs", "mapping")
    found = segmented(frames, catalogue=both)
    assert [len(chain.electrodes) for entry in found.frames for chain in entry.chains] == [10, 10, 10]
    assert all(chain.probability("cs") > 0.9 for entry in found.frames for chain in entry.chains)


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
    for entry in (*found.frames, found.diastole):
        assert entry.chains == ()
        assert entry.manual_needed == Reason.MANUAL_NEEDED


@pytest.mark.parametrize("count", [1, 3])
@pytest.mark.parametrize("seed", [4, 6, 7])
def test_many_wires_without_electrodes_get_none(seed, count):
    random = np.random.default_rng(seed)
    v, u = np.mgrid[0:384, 0:384].astype(np.float64)
    level = np.full((384, 384), 700.0)
    for _ in range(9):
        angle, offset, wide = random.uniform(0, np.pi), random.uniform(-150, 150), random.uniform(1, 9)
        across = (v - 192) * np.cos(angle) - (u - 192) * np.sin(angle) - offset
        level *= np.where(np.abs(across) < wide, random.uniform(0.5, 0.9), 1.0)
    found = segmented([random.poisson(level).astype(np.uint16) for _ in range(count)], px_per_mm=3.5)
    assert all(entry.chains == () for entry in (*found.frames, found.diastole))


def test_a_wrong_catalogue_gets_no_electrodes(simulated):
    other = Catalogue(
        (
            Catheter("reference", 10, (8.0,) * 9, 2.0, 1.0),
            Catheter("odd", 8, (13.0, 2.0, 13.0, 2.0, 13.0, 2.0, 13.0), 2.0, 1.0),
        ),
        "reference",
        "odd",
    )
    found = segmented([simulated.frames[k] for k in range(6)], catalogue=other)
    assert all(entry.chains == () for entry in found.frames)


def test_a_catalogue_that_lacks_a_catheter_gets_no_more_than_it_lists(simulated):
    two = Catalogue(DEFAULT_CATALOGUE.catheters[1:], "pacing", "mapping")
    found = segmented([simulated.frames[k] for k in range(8)], catalogue=two)
    assert all(len(entry.chains) <= 2 for entry in found.frames)
    assert electrodes_right(found, simulated.truth)[1] == 0
    assert found.diastole.manual_needed == Reason.EXTRA_CATHETER


@pytest.mark.parametrize("inverted", [False, True])
def test_a_single_frame_shows_its_catheters_or_none(simulated, inverted):
    frame = simulated.frames[0]
    found = segmented([np.uint16(4095) - frame if inverted else frame])
    recall, false = electrodes_right(found, simulated.truth)
    assert recall >= 0.6
    assert false == 0


@pytest.mark.parametrize(("contrast", "gantry"), [("LAT", LATERAL), ("PA", FRONTAL)])
@pytest.mark.parametrize("count", [1, 5])
def test_a_torso_without_catheters_gets_none(contrast, gantry, count):
    appearance = APPEARANCES[contrast]
    for seed in range(2):
        behind = torso(gantry, appearance, np.random.default_rng(seed), np.random.default_rng(seed + 50), 0.0)
        photons = expected_photons(behind, np.ones((512, 512), np.float32), appearance, 1.0)
        found = segmented([detect(photons, appearance.photons, 100 * seed + key) for key in range(count)])
        assert all(entry.chains == () and entry.manual_needed for entry in (*found.frames, found.diastole))


def test_frames_in_which_the_catheters_are_gone_stay_empty(simulated):
    frames = [simulated.frames[k] for k in range(11)]
    gone = np.random.default_rng(2).poisson(np.median(frames[0], axis=0)[None].repeat(512, axis=0)).astype(np.uint16)
    found = segmented([*frames, gone, gone])
    assert [len(entry.chains) for entry in found.frames[11:]] == [0, 0]
    assert sum(len(entry.chains) for entry in found.frames[:11]) >= 28


def test_nothing_is_said_of_bright_electrodes_where_the_inverted_picture_shows_none(monkeypatch, caplog):
    monkeypatch.setattr("fluoromap.segmenter.learned_chain.plugin.is_inverted", lambda *_: True)
    found = segmented([np.full((200, 200), 2000, np.uint16)] * 2)
    assert not any(entry.chains for entry in found.frames)
    assert not caplog.records
