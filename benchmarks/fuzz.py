"""Mutated inputs to the doors: DICOM files, tables and multipart bodies.

Run ``python benchmarks/fuzz.py --inputs 10000``. It mutates the files of ``tests/corpus/`` with a fixed seed, sends them to the
service in this process, and prints the crashes, the answers over 5 s, the 5xx and the growth of memory. Every second DICOM file
gets a header of ``odd_headers.py`` in place of random changes. After each accepted file it asks for what reads the headers: the
list of the runs, metadata, archive-wide searches with all fields, and a de-identified copy. Exit code 1 when a count is not 0, or
memory grew by more than 300 MiB. An input that failed is written to ``fuzz-failures/``.
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
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any

import psutil
from odd_headers import odd_header

if TYPE_CHECKING:
    from fastapi.testclient import TestClient

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
            odd = path.suffix == ".dcm" and chance.random() < 0.5
            content = odd_header(chance, path.read_bytes()) if odd else mutated(chance, path.read_bytes())
            start = time.perf_counter()
            try:
                answer = client.request(method, address, content=content, headers={"Content-Type": kind})
                status, seconds = answer.status_code, time.perf_counter() - start
                if path.suffix == ".dcm" and status in (200, 201):
                    status = _ask(client, study, answer.json()["instances"], content, status)
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


def _ask(client: TestClient, study: str, stored: list[dict[str, Any]], content: bytes, status: int) -> int:
    """Ask for everything that reads the header of a stored file, then delete it.

    Return the status of the first answer that blames the service, else ``status``.
    """
    for item in stored:
        uid = item["sop_instance_uid"]
        paths = [
            f"{study}/instances", f"{study}/instances/{uid}", f"{study}/sites",
            *(f"/dicom-web/{level}?includefield=all" for level in ("studies", "series", "instances")),
            "/dicom-web/studies?PatientID=somebody-else", "/dicom-web/instances?PatientName=*&StudyDate=20200101-20301231",
        ]  # fmt: skip
        answers = [client.get(path, headers={"Accept": "application/dicom+json, application/json"}) for path in paths]
        found = client.get("/dicom-web/instances", params={"SOPInstanceUID": uid})
        if found.status_code == 200:
            place = f"/dicom-web/studies/{found.json()[0]['0020000D']['Value'][0]}/metadata"
            answers.append(client.get(place, headers={"Accept": "application/dicom+json"}))
        # One bad object may not change the answer about the others.
        wrong = [answer.status_code for answer in answers if answer.status_code not in (200, 204)]
        client.delete(f"{study}/instances/{uid}")
        if wrong:
            print(
                f"answers {[(str(a.request.url.path), a.status_code) for a in answers if a.status_code not in (200, 204)]}",
                file=sys.stderr,
            )
            return max(max(wrong), 500)
    _deidentify(content)
    return status


def _deidentify(content: bytes) -> None:
    """Make the copy that a de-identified export holds; a :class:`Problem` is an answer, anything else a crash."""
    from fluoromap_service.dicom.deidentification.pseudonyms import Dates, Pseudonyms
    from fluoromap_service.dicom.deidentification.run_file import deidentify_file
    from fluoromap_service.problem import Problem

    with tempfile.TemporaryDirectory() as folder:
        source = Path(folder) / "run.dcm"
        source.write_bytes(content)
        with suppress(Problem):
            deidentify_file(source, Path(folder) / "copy.dcm", Pseudonyms(bytes(32), "fuzz", "", Dates.SHIFT))


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
