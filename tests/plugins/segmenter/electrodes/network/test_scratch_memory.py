"""Memory that is used again, and never by two threads."""

from concurrent.futures import ThreadPoolExecutor

import numpy as np

from fluoromap.segmenter.electrodes.network.scratch_memory import ScratchMemory


def test_a_name_gets_the_same_memory_again_in_any_shape():
    scratch = ScratchMemory()
    first = scratch.array("tiles", 4, 6)
    assert first.shape == (4, 6)
    assert first.dtype == np.float32
    assert np.shares_memory(first, scratch.array("tiles", 2, 3))
    assert not np.shares_memory(first, scratch.array("lines", 4, 6))
    assert scratch.array("tiles", 10, 6).shape == (10, 6)


def test_each_thread_has_memory_of_its_own():
    scratch = ScratchMemory()
    mine = scratch.array("tiles", 8)
    with ThreadPoolExecutor(1) as pool:
        theirs = pool.submit(scratch.array, "tiles", 8).result()
    assert not np.shares_memory(mine, theirs)


def test_zeros_stay_around_a_picture_of_the_same_shape_only():
    scratch = ScratchMemory()
    for value in (1.0, 2.0):
        padded = scratch.around("padded", (2, 2), 4, 4)
        assert not padded[0].any()
        assert not padded[:, 0].any()
        padded[1:3, 1:3] = value
    assert not scratch.around("padded", (1, 3), 4, 4).any()
    large = scratch.around("padded", (1, 3), 8, 8)
    assert large.shape == (8, 8)
    assert not large.any()
