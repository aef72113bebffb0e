"""Which electrodes of a frame an overlay uses."""

from types import SimpleNamespace

import numpy as np
import pytest

from fluoromap.contracts import NamedChain, Observation, PhasePair
from fluoromap_service.results.placement import LocatedView, MapPlacement


def chain_at(catheter, u):
    return NamedChain(catheter, (1, 2), np.array([[u, 5.0], [u + 9.0, 5.0]]), np.tile(np.eye(2), (2, 1, 1)), 0)


class Matched:
    """A site whose diastole is in frame 3 of view a; counts how often the track is read."""

    def __init__(self):
        self.tracks_read = 0
        pair = Observation(3, 0.0, (chain_at("mapping", 50.0), chain_at("reference", 90.0)))
        self.diastole = PhasePair(0.0, pair, pair)

    @property
    def track_a(self):
        self.tracks_read += 1
        return tuple(Observation(frame, 0.1 * frame, (chain_at("mapping", 10.0 * frame),)) for frame in range(6))


@pytest.fixture
def matched():
    return Matched()


@pytest.fixture
def placement(matched):
    catheters = SimpleNamespace(mapping="mapping", reference="reference")
    return MapPlacement(LocatedView("S01", "a", "1.2", 3), None, None, catheters, None, matched, None)


def test_at_diastole_the_pair_counts_and_the_long_track_is_not_read(placement, matched):
    shown = placement.shown(3)
    assert {name: chain.pixels_uv[0, 0] for name, chain in shown.items()} == {"mapping": 50.0, "reference": 90.0}
    assert matched.tracks_read == 0


def test_other_frames_show_the_track_which_is_read_once(placement, matched):
    assert [placement.shown(frame)["mapping"].pixels_uv[0, 0] for frame in (0, 2, 5)] == [0.0, 20.0, 50.0]
    assert placement.shown(6) == {}
    assert matched.tracks_read == 1


def test_a_site_without_named_catheters_shows_none(placement):
    alone = MapPlacement(placement.view, None, None, placement.snapshot, None, None, None)
    assert alone.shown(3) == {}
