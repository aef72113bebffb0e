"""Numbers of electrodes that begin at the wrong end, or at another electrode of a loop."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from fluoromap.catheters import Catalogue, catheter_type
from fluoromap.contracts import Array, Chain, FrameChains, Segmentation, Silent
from fluoromap.geometry import Camera, Gantry, camera_from_gantry
from fluoromap.matching import SiteRuns, match_study
from fluoromap.matching.numberings import AS_FOUND, Numbering, readings
from fluoromap.matching.run_catheters import RunCatheter

LOOP = catheter_type("circular-10", "loop")
CATALOGUE = Catalogue(
    (catheter_type("quadripolar-2-5-2", "reference"), catheter_type("ablation-4", "mapping"), LOOP),
    "reference",
    "mapping",
)
VIEWS = tuple(camera_from_gantry(Gantry(angle, 0, 1000, 500, (0.3, 0.3), 512, 512)) for angle in (90.0, 0.0))
EVERY = [Numbering(turned, rotated) for turned in (False, True) for rotated in range(10)]


def straight(name: str, tip: tuple[float, float, float], way: tuple[float, float, float]) -> Array:
    return np.array(tip) + CATALOGUE[name].arc_lengths_mm[:, None] * np.array(way) / np.linalg.norm(way)


def on_a_loop() -> Array:
    """Return the electrodes of a loop that is tilted against both views."""
    angles = LOOP.angles_on_loop_rad
    assert angles is not None
    radius = 1 / LOOP.curvature_per_mm
    across, along = np.array([0.6, 0.1, 0.8]), np.array([-0.5, 0.8, 0.4])
    across /= np.linalg.norm(across)
    along -= along @ across * across
    along /= np.linalg.norm(along)
    return np.array([-5.0, 20.0, -10.0]) + radius * (np.cos(angles)[:, None] * across + np.sin(angles)[:, None] * along)


PLACES = {
    "reference": straight("reference", (22.0, -22.0, -8.0), (0.3, 0.5, 1.0)),
    "mapping": straight("mapping", (-10.0, 5.0, 12.0), (0.5, -0.4, 0.7)),
    "loop": on_a_loop(),
}


def seen(view: Camera, loop: Numbering, odds: float | None, manual: bool = False) -> Segmentation:
    """Return a run of one frame whose segmenter numbered the loop so."""
    chains = []
    for track, (name, places) in enumerate(PLACES.items()):
        count, pixels = len(places), view.project(places)
        if name == "loop":
            order = np.argsort([loop.number(electrode, count) for electrode in range(1, count + 1)])
            pixels = pixels[order]
        chains.append(
            Chain(
                tuple(range(1, count + 1)), pixels, np.tile(0.04 * np.eye(2), (count, 1, 1)), np.full(count, 9.0),
                ((name, 1.0),), track, manual and name == "loop", odds if name == "loop" else 9.0,
            )
        )  # fmt: skip
    entry = FrameChains(0, tuple(chains))
    return Segmentation((entry,), entry, (0,), np.zeros(1), np.zeros(1))


def matched(in_a: Segmentation, in_b: Segmentation) -> list[Array]:
    """Return the pixels of the loop's electrodes 1 to 10 in each view."""
    (site,) = match_study((SiteRuns("S", *VIEWS, in_a, in_b),), CATALOGUE, Silent()).sites
    found = []
    for view in (site.runs.diastole.a, site.runs.diastole.b):
        (loop,) = [chain for chain in view.chains if chain.catheter == "loop"]
        assert loop.electrodes == tuple(range(1, 11))
        found.append(loop.pixels_uv)
    return found


@pytest.mark.parametrize("numbering", EVERY)
def test_new_numbers_are_the_old_ones_in_another_order(numbering: Numbering) -> None:
    numbers = [numbering.number(electrode, 10) for electrode in range(1, 11)]
    assert sorted(numbers) == list(range(1, 11))
    reverse = [numbering.from_other_end().number(electrode, 10) for electrode in range(1, 11)]
    assert reverse == [11 - number for number in numbers]


@pytest.mark.parametrize("rotated", [1, 2, 9])
@pytest.mark.parametrize("view", [0, 1])
def test_a_loop_that_one_view_begins_at_another_electrode_gets_its_numbers(view: int, rotated: int) -> None:
    runs = [seen(camera, Numbering(rotated=rotated) if view == k else AS_FOUND, 2.0) for k, camera in enumerate(VIEWS)]
    for pixels, camera in zip(matched(*runs), VIEWS, strict=True):
        np.testing.assert_allclose(pixels, camera.project(PLACES["loop"]), atol=1e-9)


def test_a_loop_may_be_turned_and_rotated() -> None:
    runs = seen(VIEWS[0], AS_FOUND, 6.0), seen(VIEWS[1], Numbering(True, 3), -1.0)
    for pixels, camera in zip(matched(*runs), VIEWS, strict=True):
        np.testing.assert_allclose(pixels, camera.project(PLACES["loop"]), atol=1e-9)


def test_numbers_that_a_person_gave_are_kept() -> None:
    by_hand = Numbering(rotated=4)
    runs = seen(VIEWS[0], by_hand, None, manual=True), seen(VIEWS[1], AS_FOUND, 2.0)
    (site,) = match_study((SiteRuns("S", *VIEWS, *runs),), CATALOGUE, Silent()).sites
    (loop,) = [chain for chain in site.runs.diastole.a.chains if chain.catheter == "loop"]
    (marked,) = [chain for chain in runs[0].frames[0].chains if chain.manual]
    np.testing.assert_array_equal(loop.pixels_uv, marked.pixels_uv)


def test_a_straight_catheter_is_read_from_its_two_ends_only() -> None:
    chain = seen(VIEWS[0], AS_FOUND, 1.0).frames[0].chains[2]
    catheter = RunCatheter({0: chain}, chain, 0, {"loop": 1.0}, None)
    assert len(readings((0, 0), catheter, catheter, on_loop=False)) == 2
    assert len(readings((0, 0), catheter, catheter, on_loop=True)) == 20


def test_new_numbers_of_some_electrodes_go_with_their_places() -> None:
    chain = seen(VIEWS[0], AS_FOUND, 1.0).frames[0].chains[2]
    some = replace(
        chain, electrodes=(1, 2, 9, 10), pixels_uv=chain.pixels_uv[[0, 1, 8, 9]],
        covariance_px2=chain.covariance_px2[:4], scores=np.arange(4.0),
    )  # fmt: skip
    found = Numbering(rotated=1).of(RunCatheter({0: chain, 1: some}, chain, 0, {}, None)).chains[1]
    assert found.electrodes == (1, 8, 9, 10)
    np.testing.assert_array_equal(found.pixels_uv, chain.pixels_uv[[1, 8, 9, 0]])
    assert found.scores.tolist() == [1.0, 2.0, 3.0, 0.0]
    turned = Numbering(turned=True).of(RunCatheter({0: some}, chain, 0, {}, None)).chains[0]
    assert turned.electrodes == some.from_other_end(10).electrodes
    np.testing.assert_array_equal(turned.pixels_uv, some.from_other_end(10).pixels_uv)
