"""Circular catheters: found where the loop is seen face on, reported where it is not, never taken for another catheter."""

import numpy as np
import pytest

from fluoromap.catheters import CATHETER_TYPES, Catalogue, catheter_type
from fluoromap.contracts import PixelFacts, Run, Silent
from fluoromap.geometry import Gantry, camera_from_gantry
from fluoromap.phantom import APPEARANCES
from fluoromap.phantom.fluoroscopy import RenderedFrames, detect, expected_photons, transmission
from fluoromap.phantom.shaft import Shaft
from fluoromap.phantom.torso import torso
from fluoromap.reasons import Reason
from fluoromap.segmenter.learned_chain.plugin import LearnedChain

LOOP_TYPES = ["circular-10", "circular-20", "circular-20-2-6-2"]
FRAMES = 8
SPACING = 292.0 / 512
GANTRY = Gantry(90.0, 0.0, 1000.0, 500.0, (SPACING, SPACING), 512, 512)
CAMERA = camera_from_gantry(GANTRY)
ENTRY = np.array([-18.0, 8.0, 95.0])
SINUS = [np.array(place) for place in ((26.0, -6.0, 12.0), (12.0, 18.0, 4.0), (-22.0, 20.0, 2.0), (-20.0, 8.0, 95.0))]


def run_of(loop_type, normal):
    """Return a lateral run of a circular and an ablation catheter.

    The electrodes of each come with it, (frames, n, 2) pixels. Without a normal the circular one lies stretched in the sinus.
    """
    appearance = APPEARANCES["LAT"]
    ablation = Shaft.through(
        catheter_type("ablation-4", "ablation"), 1.17, True, np.array([4.0, -18.0, -24.0]), np.array([0.0, -8.0, -4.0]),
        np.array([-4.0, 6.0, 40.0]), np.array([-8.0, 10.0, 95.0]),
    )  # fmt: skip
    catheter = catheter_type(loop_type, "loop")
    if normal is None:
        loop = Shaft.through(catheter, 1.0, False, *SINUS)
    else:
        loop = Shaft.around(catheter, 0.75, np.array([0.0, 10.0, 5.0]), np.array(normal), ENTRY)
    shafts = [loop, ablation]
    moves = np.arange(FRAMES)[:, None] * np.array([0.0, 0.3, 0.2])
    behind = torso(GANTRY, appearance, np.random.default_rng(1), np.random.default_rng(2), 0.0)

    def render(frame):
        lines = [shaft.lines_mm(moves[frame : frame + 1]) for shaft in shafts]
        passed = np.asarray(transmission(CAMERA, shafts, lines, appearance), dtype=np.float32)
        return detect(expected_photons(behind, passed, appearance, 1.0), appearance.photons, frame)

    run = Run(
        RenderedFrames((512, 512), FRAMES, render),
        np.arange(FRAMES) * 66.7,
        CAMERA.px_per_mm,
        PixelFacts(False, 12, False),
    )
    return run, {shaft.catheter.name: CAMERA.project(shaft.electrodes_mm(shaft.lines_mm(moves))) for shaft in shafts}


def segmented(run, types):
    names = ("reference", "ablation")
    catalogue = Catalogue(tuple(catheter_type(kind, name) for kind, name in zip(types, names, strict=True)), *names)
    return LearnedChain().segment(run, catalogue, {}, Silent())


def chains_on(entry, truth):
    """Return the catheter on which each chain lies, else None.

    Nine tenths of its electrodes are within 5 px of that catheter's.
    """
    found = []
    for chain in entry.chains:
        share = {
            name: np.mean(np.linalg.norm(chain.pixels_uv[:, None] - uv[entry.frame][None], axis=2).min(axis=1) < 5.0)
            for name, uv in truth.items()
        }
        name = max(share, key=share.get)
        found.append(name if share[name] >= 0.9 else None)
    return found


def test_catheters_with_equal_rings_are_loops():
    assert all(catheter_type(loop_type, "x").is_circular for loop_type in LOOP_TYPES)
    straight = [name for name in CATHETER_TYPES if name not in LOOP_TYPES]
    assert not any(catheter_type(name, "x").is_circular for name in straight)


@pytest.mark.parametrize("loop_type", LOOP_TYPES)
def test_the_phantom_s_loop_keeps_its_spacings(loop_type):
    catheter = catheter_type(loop_type, "loop")
    shaft = Shaft.around(catheter, 0.75, np.zeros(3), np.array([1.0, 0.5, 0.2]), ENTRY)
    electrodes = shaft.electrodes_mm(shaft.rest_mm[None])[0]
    chords = np.linalg.norm(np.diff(electrodes, axis=0), axis=1)
    assert np.all(chords <= np.array(catheter.spacing_mm) + 0.02)
    assert np.all(chords >= 0.95 * np.array(catheter.spacing_mm))
    assert np.linalg.norm(electrodes[0] - electrodes[-1]) < 0.5 * float(catheter.arc_lengths_mm[-1])


@pytest.mark.parametrize("loop_type", LOOP_TYPES)
def test_a_loop_seen_face_on_is_found(loop_type):
    run, truth = run_of(loop_type, [1.0, 0.7, 0.2])
    found = segmented(run, (loop_type, "ablation-4"))
    for entry in found.frames:
        assert sorted(name or "" for name in chains_on(entry, truth)) == ["ablation", "loop"]
        assert all(
            chain.probability("reference" if name == "loop" else "ablation") > 0.9
            for chain, name in zip(entry.chains, chains_on(entry, truth), strict=True)
        )


@pytest.mark.parametrize("normal", [[1.0, 2.0, 0.5], [1.0, 8.0, 0.0]])
@pytest.mark.parametrize("loop_type", LOOP_TYPES)
def test_a_loop_seen_from_the_side_is_found_or_reported(loop_type, normal):
    run, truth = run_of(loop_type, normal)
    found = segmented(run, (loop_type, "ablation-4"))
    on = [name for entry in found.frames for name in chains_on(entry, truth)]
    assert None not in on
    assert on.count("ablation") == FRAMES
    assert on.count("loop") == FRAMES or found.diastole.manual_needed is Reason.EXTRA_CATHETER


@pytest.mark.parametrize("normal", [[1.0, 0.7, 0.2], [1.0, 8.0, 0.0]])
@pytest.mark.parametrize("loop_type", LOOP_TYPES)
@pytest.mark.parametrize("listed", ["quadripolar-2-5-2", "decapolar-2-5-2"])
def test_an_unlisted_loop_is_no_other_catheter(loop_type, normal, listed):
    run, truth = run_of(loop_type, normal)
    found = segmented(run, (listed, "ablation-4"))
    taken = {name for entry in found.frames for name in chains_on(entry, truth)}
    # Poles of a loop seen from the side may lie as those of a straight catheter, and pairs of poles as those of every catheter with
    # such pairs. The run is reported all the same.
    from_side = [("circular-20", "decapolar-2-5-2", 8.0), ("circular-10", "quadripolar-2-5-2", 8.0)]
    excused = loop_type == "circular-20-2-6-2" or (loop_type, listed, normal[1]) in from_side
    assert taken - ({"loop", None} if excused else set()) == {"ablation"}
    if (loop_type, normal[1]) != ("circular-10", 0.7):
        assert found.diastole.manual_needed is Reason.EXTRA_CATHETER


@pytest.mark.parametrize("loop_type", LOOP_TYPES)
def test_a_straight_catheter_that_is_described_as_a_loop_is_found(loop_type):
    run, truth = run_of(loop_type, None)
    found = segmented(run, (loop_type, "ablation-4"))
    for entry in found.frames:
        assert sorted(name or "" for name in chains_on(entry, truth)) == ["ablation", "loop"]
