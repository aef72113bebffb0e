"""Mutated inputs to the doors: DICOM files, tables and multipart bodies.

Run ``python benchmarks/fuzz.py --inputs 10000``. It mutates the files of ``tests/corpus/`` with a fixed seed, sends them to the
service in this process, and prints the crashes, the answers over 5 s, the 5xx and the growth of memory. Exit code 1 when one of
them is not 0, or memory grew by more than 300 MiB. An input that failed is written to ``fuzz-failures/``.
"""

from __future__ import annotations

import argparse
import os
import random
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable
from pathlib import Path

import psutil

CORPUS = Path(__file__).parent.parent / "tests" / "corpus"
FAILURES = Path("fuzz-failures")
SLOW_SECONDS = 5.0
MOST_GROWTH_MIB = 300.0
WORDS = (
    b"\x00", b"\xff" * 4, b"\xff\xff\xff\x7f", b"\xfe\xff\x00\xe0", b"\xfe\xff\xdd\xe0", b"\xe0\x7f\x10\x00", b"OB", b"SQ", b"UN",
    b"\r\n", b"--b0undary", b"--b0undary--", b"1e309", b"nan", b"-", b";", b",", b'"', b"\t", b"=cmd", b"\xef\xbb\xbf",
)  # fmt: skip
"""Pieces that mean something to one of the parsers."""

Mutation = Callable[[random.Random, bytearray], None]


def _flip(chance: random.Random, content: bytearray) -> None:
    place = chance.randrange(len(content))
    content[place] ^= 1 << chance.randrange(8)


def _overwrite(chance: random.Random, content: bytearray) -> None:
    place, length = chance.randrange(len(content)), chance.randrange(1, 9)
    content[place : place + length] = chance.randbytes(length)


def _insert(chance: random.Random, content: bytearray) -> None:
    place = chance.randrange(len(content))
    content[place:place] = chance.choice(WORDS) * chance.choice((1, 1, 1, 50))


def _delete(chance: random.Random, content: bytearray) -> None:
    place = chance.randrange(len(content))
    del content[place : place + chance.choice((1, 2, 4, 64))]


def _cut(chance: random.Random, content: bytearray) -> None:
    del content[chance.randrange(len(content)) :]


def _repeat(chance: random.Random, content: bytearray) -> None:
    place, length = chance.randrange(len(content)), chance.randrange(1, 200)
    content[place:place] = content[place : place + length] * chance.randrange(1, 5)


def _head(chance: random.Random, content: bytearray) -> None:
    """Change a byte in the first part, where most of the structure is."""
    place = chance.randrange(min(len(content), 1500))
    content[place] = chance.choice((0, 1, 0x7F, 0x80, 0xFF, chance.randrange(256)))


MUTATIONS: tuple[Mutation, ...] = (_flip, _overwrite, _insert, _delete, _cut, _repeat, _head, _head)


def mutated(chance: random.Random, content: bytes) -> bytes:
    """Return the content after one to six random changes."""
    changed = bytearray(content)
    for _ in range(chance.choice((1, 1, 2, 3, 6))):
        if changed:
            chance.choice(MUTATIONS)(chance, changed)
    return bytes(changed)


def main() -> int:
    """Run the campaign and print its result."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--inputs", type=int, default=10_000)
    parser.add_argument("--seed", type=int, default=1)
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        os.environ |= {"FLUOROMAP_DATA_DIR": folder, "FLUOROMAP_DATABASE_URL": "", "FLUOROMAP_BROKER_URL": "eager"}
        return _campaign(options.inputs, random.Random(options.seed))


def _campaign(inputs: int, chance: random.Random) -> int:
    import structlog
    from fastapi.testclient import TestClient

    from fluoromap_service.api.app import create_app
    from fluoromap_service.api.http import file_pool
    from fluoromap_service.store import schema

    structlog.configure(wrapper_class=structlog.make_filtering_bound_logger(50))
    schema.upgrade()
    statuses: Counter[str] = Counter()
    crashes, errors, slowest, slow = 0, 0, 0.0, 0
    process = psutil.Process()
    # The first request would otherwise wait for the start of the file processes.
    file_pool.start()
    with TestClient(create_app(), base_url="http://127.0.0.1") as client:
        study = client.post("/v1/studies", json={"label": "fuzz"}).headers["location"]
        targets = {
            ".dcm": ("POST", f"{study}/instances", "application/dicom"),
            ".multipart": ("POST", f"{study}/instances", "multipart/form-data; boundary=b0undary"),
            "times.csv": ("PUT", f"{study}/activation-times", "text/csv"),
            "electrogram.csv": ("PUT", f"{study}/electrograms/S01", "text/csv"),
        }
        seeds = [
            (path, target)
            for path in sorted(CORPUS.iterdir())
            for end, target in targets.items()
            if path.name.endswith(end)
        ]
        before = 0.0
        for number in range(inputs):
            path, (method, address, kind) = seeds[number % len(seeds)]
            content = mutated(chance, path.read_bytes())
            start = time.perf_counter()
            try:
                status = client.request(method, address, content=content, headers={"Content-Type": kind}).status_code
            except Exception as error:
                status, crashes = 599, crashes + 1
                print(f"crash on a mutation of {path.name}: {type(error).__name__}: {error}", file=sys.stderr)
            seconds = time.perf_counter() - start
            slowest, slow = max(slowest, seconds), slow + (seconds > SLOW_SECONDS)
            statuses[f"{path.suffix} {status}"] += 1
            if status >= 500 or seconds > SLOW_SECONDS:
                errors += status >= 500
                FAILURES.mkdir(exist_ok=True)
                (FAILURES / f"{number}-{status}-{path.name}").write_bytes(content)
            if number == min(inputs, 500) // 2:
                before = _memory_mib(process)
        growth = _memory_mib(process) - before
        file_pool.close()
    for name, count in sorted(statuses.items()):
        print(f"{name}: {count}")
    print(
        f"inputs {inputs}: crashes {crashes}, 5xx {errors}, over {SLOW_SECONDS:g} s {slow} (slowest {slowest:.2f} s), "
        f"memory {growth:+.0f} MiB"
    )
    return int(bool(crashes or errors or slow or growth > MOST_GROWTH_MIB))


def _memory_mib(process: psutil.Process) -> float:
    """Return the memory of this process and its file processes, in MiB."""
    total = process.memory_info().rss
    for child in process.children(recursive=True):
        try:
            total += child.memory_info().rss
        except psutil.NoSuchProcess:
            continue
    return total / 2**20


if __name__ == "__main__":
    sys.exit(main())
