import numpy as np

from fluoromap.contracts import Chain
from fluoromap.segmenter.tracking import Tracker


def chain(points, name="reference"):
    n = len(points)
    return Chain(tuple(range(1, n + 1)), points, np.tile(np.eye(2), (n, 1, 1)), np.ones(n), ((name, 1.0),))


def test_two_beating_catheters_keep_their_numbers_through_a_gap():
    base = np.array([[0.0, 0], [20, 0], [50, 5], [70, 10]])
    tracker, seen = Tracker(), []
    for frame in range(40):
        shift = np.array([15 * np.sin(frame / 5), 10 * np.sin(frame / 5)])
        chains = [chain(base + 100 + shift), chain(base[:, ::-1] + 180 - shift)]
        if frame in range(12, 16):
            chains = chains[1:]
        if frame % 2:
            chains = chains[::-1]
        numbered = tracker.follow(chains, frame * 16.7)
        seen += [(float(np.ptp(item.pixels_uv[:, 0])) > 50, item.track) for item in numbered]
    assert set(seen) == {(True, seen[0][1]), (False, seen[1][1])}


def test_another_kind_is_another_track():
    points = np.array([[0.0, 0], [20, 0], [50, 5], [70, 10]])
    tracker = Tracker()
    first = tracker.follow([chain(points)], 0.0)
    second = tracker.follow([chain(points + 1, "mapping")], 16.7)
    assert first[0].track != second[0].track
