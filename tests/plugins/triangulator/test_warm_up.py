"""Compiling beforehand reaches the kernels of a real study, with the same types."""

import subprocess
import sys

IN_A_NEW_PROCESS = """
import numpy as np
from fluoromap.catheters import DEFAULT_CATALOGUE
from fluoromap.contracts import Silent
from fluoromap.phantom import StudySpec, simulate_study
from fluoromap.phantom.ideal_matching import matched_sites
from fluoromap.registry import build_triangulator
from numba.core.dispatcher import Dispatcher

triangulator = build_triangulator("maximum-likelihood", {})
triangulator.warm_up()
from fluoromap.triangulator import moment_kernel

def kernels():
    found = [kernel for kernel in vars(moment_kernel).values() if isinstance(kernel, Dispatcher)]
    return {kernel.py_func.__qualname__: tuple(kernel.signatures) for kernel in found}

warm = kernels()
assert warm["step"] and warm["covariances"]
study = simulate_study(StudySpec(seed=77, sites=2, frames=24))
triangulator.triangulate(matched_sites(study), DEFAULT_CATALOGUE, Silent())
print([name for name, signatures in kernels().items() if signatures != warm[name]])
"""


def test_a_study_compiles_nothing_after_warming_up():
    ran = subprocess.run([sys.executable, "-c", IN_A_NEW_PROCESS], capture_output=True, text=True, check=False)
    assert ran.stdout.strip() == "[]", ran.stderr
