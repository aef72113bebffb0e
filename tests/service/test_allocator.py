"""How the C library of a process handles freed memory."""

import subprocess
import sys

_FREED = """
from pathlib import Path
from fluoromap_service.allocator import return_freed_memory

def resident_mib():
    return int(Path("/proc/self/statm").read_text().split()[1]) * 4096 / 2**20

return_freed_memory()
bytearray(8 << 20)
before = resident_mib()
blocks = [bytearray(4 << 20) for _ in range(16)]
for block in blocks:
    block[::4096] = b"1" * 1024
held = bytearray(100_000)
del block, blocks
print(resident_mib() - before)
"""


def test_freed_memory_goes_back_to_the_system() -> None:
    ended = subprocess.run([sys.executable, "-c", _FREED], capture_output=True, text=True, check=True)
    assert float(ended.stdout) < 10
