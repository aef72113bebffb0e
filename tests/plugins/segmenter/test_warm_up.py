"""The drawn run reaches every kernel that a real one does, with the same types."""

import subprocess
import sys

import numpy as np
import pytest

from fluoromap.catheters import DEFAULT_CATALOGUE
from fluoromap.contracts import PixelFacts, Run, Silent
from fluoromap.reasons import Reason
from fluoromap.registry import build_segmenter
from fluoromap.segmenter.warm_up import SyntheticFrames

CHAINS = "catheter-chain", "learned-chain"
IN_A_NEW_PROCESS = """
import sys
from numba.core.dispatcher import Dispatcher
from fluoromap.catheters import DEFAULT_CATALOGUE
from fluoromap.contracts import PixelFacts, Run, Silent
from fluoromap.phantom import StudySpec, simulate_study
from fluoromap.registry import build_segmenter

def kernels():
    modules = [module for name, module in sorted(sys.modules.items()) if name.startswith("fluoromap.segmenter")]
    found = [kernel for module in modules for kernel in vars(module).values() if isinstance(kernel, Dispatcher)]
    return {kernel.py_func.__qualname__: tuple(kernel.signatures) for kernel in found}

simulated = simulate_study(StudySpec(seed=77, sites=1, frames=4, contrast=("LAT", "PA"))).sites[0].runs
segmenter = build_segmenter(sys.argv[1], {})
segmenter.warm_up()
warm = kernels()
assert any(warm.values())
# The declared types are those of the calls: no kernel is compiled for other ones too.
assert all(len(signatures) <= 1 for signatures in warm.values()), warm
for view in simulated:
    run = Run(view.frames, view.frame_times_ms, 5.75, PixelFacts(False, 12, False))
    segmenter.segment(run, DEFAULT_CATALOGUE, {}, Silent())
print([name for name, signatures in kernels().items() if signatures != warm[name]])
"""


@pytest.mark.parametrize("name", CHAINS)
def test_after_warm_up_a_run_compiles_nothing(name):
    done = subprocess.run([sys.executable, "-c", IN_A_NEW_PROCESS, name], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


@pytest.mark.parametrize("name", CHAINS)
def test_the_drawn_run_shows_its_catheters_and_hides_one_once(name):
    frames = SyntheticFrames(DEFAULT_CATALOGUE)
    run = Run(frames, 66.7 * np.arange(len(frames)), 5.75, PixelFacts(False, 12, False))
    found = build_segmenter(name, {}).segment(run, DEFAULT_CATALOGUE, {}, Silent())
    assert [len(entry.chains) for entry in found.frames] == [3, 3, 2, 3, 3]
    assert found.frames[2].manual_needed is Reason.TRACK_INTERRUPTED
