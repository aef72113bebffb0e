"""Several processes share the work of compiling kernels."""

from __future__ import annotations

import subprocess
import sys
from collections import Counter
from pathlib import Path
from types import SimpleNamespace
from typing import Any

from fluoromap.segmenter import kernels

MODULE = """
from fluoromap.segmenter.kernels import kernel

@kernel("f8[::1]")
def one(x):
    x[0] = 1.0

@kernel("f8[::1], i8")
def two(x, k):
    x[k] = 2.0 * k + x[0]

@kernel("f4[:,::1], f8", fastmath=False)
def three(x, y):
    for i in range(x.shape[0]):
        x[i, 0] = x[i, 1] * y + 3.0
"""
COMPILE = """
import sample
from fluoromap.segmenter.kernels import compile_kernels
compile_kernels()
of = sample.one, sample.two, sample.three
assert all(len(each.signatures) == 1 for each in of)
print(sum(each.stats.cache_misses.total() for each in of))
"""


def _start(folder: Path) -> subprocess.Popen[str]:
    environment = {"NUMBA_CACHE_DIR": str(folder / "cache"), "PATH": ""}
    return subprocess.Popen(
        [sys.executable, "-c", COMPILE], cwd=folder, env=environment, stdout=subprocess.PIPE, text=True
    )


def _compiled(process: subprocess.Popen[str]) -> int:
    printed, _ = process.communicate()
    assert process.returncode == 0
    return int(printed)


def test_no_kernel_is_compiled_twice(tmp_path: Path) -> None:
    (tmp_path / "sample.py").write_text(MODULE)
    # Their helper may have compiled the others.
    assert 1 <= sum(map(_compiled, [_start(tmp_path), _start(tmp_path)])) <= 3
    assert _compiled(_start(tmp_path)) == 0
    assert len(list(tmp_path.rglob("*.nbi"))) == 3


class Sample:
    """A kernel whose cache lies in a folder."""

    def __init__(self, folder: Path) -> None:
        self.py_func = SimpleNamespace(__module__="sample", __qualname__="one")
        self.stats = SimpleNamespace(cache_path=str(folder), cache_misses=Counter[Any]())

    def compile(self, types: str) -> None:
        self.stats.cache_misses[types] += 1


def test_a_kernel_without_a_cache_that_can_be_written_is_compiled(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    assert kernels._Kernel(Sample(tmp_path / "file"), "(f8,)").compile_alone(wait=False) is True


def test_a_kernel_that_another_process_compiles_is_left_to_it(tmp_path: Path) -> None:
    hold = (
        "import fcntl, sys; lock = open(sys.argv[1], 'w'); fcntl.flock(lock, fcntl.LOCK_EX); print(flush=True); input()"
    )
    held, free = kernels._Kernel(Sample(tmp_path), "(f8,)"), kernels._Kernel(Sample(tmp_path), "(f4,)")
    command = [sys.executable, "-c", hold, str(tmp_path / "sample.one.lock")]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as other:
        assert other.stdout is not None
        other.stdout.readline()
        assert held.compile_alone(wait=False) is None
        other.communicate("\n")
    assert free.compile_alone(wait=False) is True
