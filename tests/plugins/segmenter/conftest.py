import numpy as np
import pytest
from frame_sources import Frames

from fluoromap.contracts import PixelFacts, Run
from fluoromap.phantom import StudySpec, simulate_study

PX_PER_MM = 512 / 178 * 2


@pytest.fixture
def run_of():
    def build(frames, bits=12, monochrome1=False, frame_ms=1000 / 15, shutter=None, **more):
        source = Frames(frames)
        times = np.arange(len(source)) * frame_ms
        return Run(source, times, PX_PER_MM, PixelFacts(False, bits, monochrome1, shutter), **more)

    return build


@pytest.fixture(scope="session")
def study():
    return simulate_study(StudySpec(seed=301, sites=2, frames=16))
