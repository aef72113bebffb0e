"""No request of one caller holds the interpreter, so that all others keep their answers: every route, with hostile values.

A watchdog thread looks at the processor time of this process again and again. While a thread holds the interpreter's lock, the
watchdog waits, and the processor time goes on. So the time between two looks is the time for which somebody held the lock; the
load of the machine does not change it. A value is judged by the best of some tries, so that a first import is not blamed.
"""

from __future__ import annotations

import re
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from urllib.parse import quote

import pytest
from fastapi.testclient import TestClient
from small_runs import STUDY_UID, edited, small_run
from starlette.routing import Route

from fluoromap_service.api.app import ROUTERS
from fluoromap_service.api.http import file_pool

LONGEST_HOLD_SECONDS = 0.1
TRIES = 4
TEXT_BYTES = 60_000
"""A server refuses longer addresses."""

PATTERNS = {
    "stars and questions": "*?" * 10 + "~",
    "many stars": "*A" * 500 + "~",
    "long pattern": "*?" * (TEXT_BYTES // 2),
    "nested groups": "(a+)+" * 500 + "$",
    "brackets": "[!a-" * 5000,
    "long text": "A" * TEXT_BYTES,
    "carets": "^*" * (TEXT_BYTES // 2),
    "groups of a name": "=" * TEXT_BYTES,
    "capitals that fold": "ẞİ" * (TEXT_BYTES // 10),
    "marks that compose": "a" + "\u0315\u0300" * (TEXT_BYTES // 10),
    "UIDs": ",".join(f"1.2.{number}" for number in range(7000)),
    "short UIDs": "1," * (TEXT_BYTES // 2),
    "digits": "9" * TEXT_BYTES,
    "questions": "?" * TEXT_BYTES,
    "hyphens": "-" * TEXT_BYTES,
    "spaces": " " * TEXT_BYTES + "x",
    "dots": "1." * (TEXT_BYTES // 2),
    "NUL": "\0" * 1000,
}
KEYS = (
    "PatientName", "StudyDescription", "StudyInstanceUID", "SOPClassUID", "ModalitiesInStudy", "ImageType", "StudyDate",
    "StudyTime", "AcquisitionDateTime", "SeriesNumber", "00101002.00100020", "InstanceAvailability",
)  # fmt: skip
QUERIES = {
    "huge page": "limit=999999999&offset=999999999",
    "digits of a page": "limit=" + "9" * TEXT_BYTES,
    "long includefield": "includefield=" + "PatientName," * (TEXT_BYTES // 12),
    "unknown includefield": "includefield=" + ",".join(f"F{number}" for number in range(7000)),
    "many parameters": "&".join(f"p{number}=1" for number in range(5000)),
    "one parameter often": "&".join(["PatientID=A*"] * 4000),
    "deep path": ".".join(["00101002"] * 6000) + "=x",
    "cursor": "limit=100&cursor=" + "A" * TEXT_BYTES,
}


class Watchdog:
    """A thread that measures for how much processor time it was kept from running."""

    def __init__(self) -> None:
        self._stop, self._looked = threading.Event(), threading.Event()
        self._longest = 0.0
        self._thread = threading.Thread(target=self._watch, daemon=True)
        self._thread.start()

    def _watch(self) -> None:
        before = time.process_time()
        while not self._stop.wait(0.002):
            now = time.process_time()
            self._longest = max(self._longest, now - before)
            before = now
            self._looked.set()

    def _look(self) -> None:
        self._looked.clear()
        assert self._looked.wait(60.0)

    @contextmanager
    def watching(self) -> Iterator[list[float]]:
        """Yield a list for the longest time of a held lock.

        It is filled at the end of the block.
        """
        found: list[float] = []
        self._look()
        self._longest = 0.0
        yield found
        self._look()
        found.append(self._longest)

    def end(self) -> None:
        self._stop.set()
        self._thread.join()


@pytest.fixture
def watchdog() -> Iterator[Watchdog]:
    dog = Watchdog()
    yield dog
    dog.end()
    file_pool.close()


def escaped(text: str, most: int = TEXT_BYTES) -> str:
    """Return the text as an address has it, cut to a length."""
    cut = quote(text, safe="*,=^!()")[:most]
    return cut[: cut.rindex("%")] if "%" in cut[-2:] else cut


def routes(method: str) -> list[str]:
    found = {
        route.path
        for router in ROUTERS
        for route in router.routes
        if isinstance(route, Route) and method in (route.methods or ())
    }
    return sorted(found)


def held(watchdog: Watchdog, service: TestClient, method: str, path: str, **request: object) -> float:
    """Return how long a request held the interpreter's lock, in seconds.

    The best of some tries.
    """
    best = float("inf")
    for _ in range(TRIES):
        with watchdog.watching() as found:
            answer = service.request(method, path, **request)  # type: ignore[arg-type]
        assert answer.status_code < 500, (method, path[:100], answer.text[:300])
        best = min(best, *found)
        if best < LONGEST_HOLD_SECONDS / 2:
            break
    return best


@pytest.fixture
def archive(service: TestClient, tmp_path: Path) -> TestClient:
    """A service with a run whose texts make patterns try every place."""
    file = edited(
        small_run(tmp_path, 1, 0.0), StudyDescription="A" * 64, PatientName="A" * 64, PatientComments="A" * 1024
    )
    answer = service.post("/v1/studies", json={"label": "x"})
    service.post(f"{answer.headers['location']}/instances", files={"file": ("r.dcm", file, "application/dicom")})
    return service


def test_the_watchdog_sees_a_lock_that_is_held(watchdog: Watchdog) -> None:
    pattern = re.compile("(A+A+)+~")
    with watchdog.watching() as found:
        pattern.match("A" * 24)
    assert found[0] > LONGEST_HOLD_SECONDS
    with watchdog.watching() as found:
        sum(number * number for number in range(3_000_000))
    assert found[0] < LONGEST_HOLD_SECONDS


def test_no_search_holds_it(archive: TestClient, watchdog: Watchdog) -> None:
    searches = ["/dicom-web/studies", "/dicom-web/series", f"/dicom-web/studies/{STUDY_UID}/instances"]
    slow = {}
    for path in searches:
        for name, pattern in PATTERNS.items():
            for key in KEYS if path == searches[0] else KEYS[:2]:
                seconds = held(watchdog, archive, "GET", f"{path}?{key}={escaped(pattern)}")
                if seconds > LONGEST_HOLD_SECONDS:
                    slow[path, key, name] = seconds
    assert not slow


def test_no_route_that_reads_holds_it(archive: TestClient, watchdog: Watchdog) -> None:
    paths = [path for path in routes("GET") if "events" not in path]
    assert len(paths) > 40
    slow = {}
    for path in paths:
        plain = re.sub(r"\{[^}]*\}", "1", path)
        for name, query in QUERIES.items():
            if (seconds := held(watchdog, archive, "GET", f"{plain}?{query}")) > LONGEST_HOLD_SECONDS:
                slow[path, name] = seconds
        if "{" in path:
            for name in ("stars and questions", "long text", "dots", "digits", "NUL", "UIDs"):
                address = re.sub(r"\{[^}]*\}", escaped(PATTERNS[name], 15_000).replace("\\", ""), path)
                if (seconds := held(watchdog, archive, "GET", address)) > LONGEST_HOLD_SECONDS:
                    slow[path, name] = seconds
    assert not slow


BODIES = {
    "long text": (b'{"label": "' + b"A" * 500_000 + b'"}', "application/json"),
    "deep lists": (b"[" * 20_000, "application/json"),
    "many keys": (b"{" + b",".join(b'"k%d":1' % number for number in range(20_000)) + b"}", "application/json"),
    "long number": (b'{"notes": ' + b"9" * 100_000 + b"}", "application/json"),
    "quotes": (b'site,lat_ms\n"' + b'"' * 200_000, "text/csv"),
    "separators": (b"site,lat_ms\n" + b"," * 200_000, "text/csv"),
    "boundaries": (b"--edge\r\n" * 20_000, "multipart/form-data; boundary=edge"),
    "related": (b"--edge\r\n" * 20_000, 'multipart/related; type="application/dicom"; boundary=edge'),
}


@pytest.mark.parametrize("method", ["POST", "PUT", "PATCH"])
def test_no_route_that_writes_holds_it(archive: TestClient, watchdog: Watchdog, method: str) -> None:
    study = archive.get("/v1/studies").json()["items"][0]["id"]
    slow = {}
    for path in routes(method):
        address = re.sub(r"\{[^}]*\}", "1", path.replace("{study_id}", study))
        for name, (content, kind) in BODIES.items():
            seconds = held(watchdog, archive, method, address, content=content, headers={"content-type": kind})
            if seconds > LONGEST_HOLD_SECONDS:
                slow[path, name] = seconds
    assert not slow
