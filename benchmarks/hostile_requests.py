"""The attacks of ``benchmarks/attack.py``: what each one tries against a running service, and when it counts as held.

Each attack knows the service from the outside: its routes, its program and its files. Times are bounds for a busy machine.
"""

from __future__ import annotations

import base64
import io
import json
import re
import socket
import sqlite3
import threading
import time
import uuid
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from urllib.parse import urlsplit

import httpx
import psutil
import pydicom
from attacked_service import HOST, LONGEST_SECONDS, START_SECONDS, AttackedService, Broken

BUSY_SECONDS = 2.0
"""Longest answer to a hostile request."""
HEALTH_SECONDS = 1.0
"""Longest answer of ``/v1/health`` beside an attack."""
MOST_GROWTH_MIB = 300.0


@dataclass(frozen=True)
class Attack:
    """An attack: its name, what it tries, and the function that returns its observation or raises ``Broken``."""

    name: str
    tried: str
    run: Callable[[AttackedService], str]
    short: bool


ATTACKS: dict[str, Attack] = {}


def _attack(
    tried: str, *, short: bool = True
) -> Callable[[Callable[[AttackedService], str]], Callable[[AttackedService], str]]:
    def register(run: Callable[[AttackedService], str]) -> Callable[[AttackedService], str]:
        name = run.__name__.replace("_", "-")
        ATTACKS[name] = Attack(name, tried, run, short)
        return run

    return register


def _hold(condition: bool, seen: str) -> str:
    if not condition:
        raise Broken(seen)
    return seen


@contextmanager
def _watched_health(service: AttackedService) -> Iterator[list[float]]:
    """Ask for the service's health repeatedly; yield the durations in seconds."""
    stop, seconds = threading.Event(), [0.0]

    def watch() -> None:
        while not stop.wait(0.02):
            try:
                seconds.append(service.health_seconds())
            except httpx.HTTPError:
                seconds.append(LONGEST_SECONDS)

    thread = threading.Thread(target=watch, daemon=True)
    thread.start()
    try:
        yield seconds
    finally:
        stop.set()
        thread.join()


# A reader who wants to stop the service.


@_attack("search patterns of many wildcards, by a token that may only read")
def wildcard_patterns(service: AttackedService) -> str:
    text = "a" * 64
    service.run(service.study(), StudyDescription=text, SeriesDescription=text, PatientName=text, PatientID=text)
    patterns = (
        "*?" * 10 + "~",
        "*a" * 30 + "~",
        "?*" * 16 + "b",
        "*" * 60 + "~",
        "(a+)+$",
        "[" * 40,
        "*a*a*a*a*a*a*a*a*a*a*a*~",
    )
    keys = ("StudyDescription", "PatientName", "PatientID", "SeriesDescription", "AccessionNumber", "00081030")
    slowest, statuses = 0.0, set()
    with service.client("reader") as client, _watched_health(service) as health:
        for pattern in patterns:
            for key in keys:
                for level in ("studies", "series", "instances")[: 3 if key == "SeriesDescription" else 1]:
                    start = time.monotonic()
                    statuses.add(client.get(f"/dicom-web/{level}", params={key: pattern}).status_code)
                    slowest = max(slowest, time.monotonic() - start)
                    _hold(slowest < BUSY_SECONDS, f"{key}={pattern} took {slowest:.1f} s")
    seen = f"slowest answer {slowest:.2f} s, slowest health {max(health):.2f} s, statuses {sorted(statuses)}"
    return _hold(max(health) < HEALTH_SECONDS and max(statuses) < 500, seen)


HOSTILE_VALUES = (
    "*" * 2000, "-1", "1e309", "NaN", "9" * 400, "%00", "\x00", "../../../etc/passwd", "'; DROP TABLE token; --", "\ud7ff\u202e",
    "{{7*7}}", "[" * 500, "0x10", "\u0661", "1,2,3,,", "true", "2026-02-30", "\r\nX-Injected: 1",
)  # fmt: skip


def _reading_routes(client: httpx.Client) -> list[tuple[str, list[str]]]:
    document = client.get("/v1/openapi.json").json()
    return [
        (path, [each["name"] for each in operations["get"].get("parameters", []) if each["in"] == "query"])
        for path, operations in sorted(document["paths"].items())
        if "get" in operations and not path.endswith("/events")
    ]


@_attack("odd values for each part and each parameter of every route that reads")
def hostile_values(service: AttackedService) -> str:
    study = service.study()
    uid, _ = service.run(study)
    known = {"study_id": study.rsplit("/", 1)[1], "uid": uid, "n": "1"}
    worst: list[str] = []
    requests, slowest = 0, 0.0
    with service.client("reader") as client, _watched_health(service) as health:
        # The first search of a process compiles its kernels, whatever the values are.
        client.get(f"{study}/instances/{uid}/frames/1/preview", timeout=START_SECONDS).raise_for_status()
        for number, (path, names) in enumerate(_reading_routes(client)):
            filled = re.sub(r"\{(\w+)\}", lambda part: known.get(part[1], "0" * 32), path)
            calls: list[tuple[str, dict[str, str]]] = []
            for place, name in enumerate(names):
                calls += [
                    (filled, {name: HOSTILE_VALUES[(number + place + k) % len(HOSTILE_VALUES)]}) for k in range(6)
                ]
            for place, part in enumerate(re.findall(r"\{\w+\}", path)):
                value = HOSTILE_VALUES[(number + place) % len(HOSTILE_VALUES)].encode("utf-8", "surrogatepass")
                quoted = "".join(f"%{byte:02X}" for byte in value[:300])
                calls.append((re.sub(r"\{\w+\}", "x", path.replace(part, quoted, 1)), {}))
            for address, query in calls:
                start = time.monotonic()
                try:
                    status = client.get(address, params=query).status_code
                except httpx.TimeoutException:
                    raise Broken(
                        f"no answer within {LONGEST_SECONDS:g} s from {path} with {list(query) or 'path'}"
                    ) from None
                seconds = time.monotonic() - start
                requests, slowest = requests + 1, max(slowest, seconds)
                # 503 says that the part of the service is away, which no value can cause.
                if status >= 500 or seconds > 10 * BUSY_SECONDS:
                    worst.append(f"{status} in {seconds:.1f} s from {path} with {list(query) or 'path'}")
    seen = f"{requests} requests, slowest {slowest:.2f} s, slowest health {max(health):.2f} s, {len(worst)} failed {worst[:3]}"
    return _hold(not worst and max(health) < HEALTH_SECONDS, seen)


@_attack("150 event streams and 150 waiting requests beside a list of studies")
def many_waiting_readers(service: AttackedService) -> str:
    job = service.queued_job()
    address = urlsplit(service.url)
    with service.client("reader") as client:
        alone = _median_seconds(lambda: client.get("/v1/studies"))
        token = service.tokens["reader"]
        lines = [f"GET {job}/events HTTP/1.1", f"GET {job}?wait=20 HTTP/1.1"] * 150
        held = []
        try:
            for line in lines:
                connection = socket.create_connection((address.hostname, address.port), timeout=10)
                connection.sendall(f"{line}\r\nHost: 127.0.0.1\r\nAuthorization: Bearer {token}\r\n\r\n".encode())
                held.append(connection)
            beside = _median_seconds(lambda: client.get("/v1/studies"))
        finally:
            for connection in held:
                connection.close()
    seen = f"a list took {alone:.3f} s alone and {beside:.3f} s beside {len(held)} waiting requests"
    return _hold(beside < max(2 * alone, alone + 0.25), seen)


def _median_seconds(request: Callable[[], httpx.Response]) -> float:
    seconds = []
    for _ in range(9):
        start = time.monotonic()
        request().raise_for_status()
        seconds.append(time.monotonic() - start)
    return sorted(seconds)[4]


@_attack("60 readers' requests at once for the electrodes of a frame, beside a list of studies and an upload")
def many_previews(service: AttackedService) -> str:
    study = service.study()
    uid, _ = service.run(study)
    route = f"{study}/instances/{uid}/frames/1/preview"
    with service.client("reader") as client:
        client.get(route, timeout=START_SECONDS).raise_for_status()
    stop = threading.Event()

    def ask() -> None:
        with service.client("reader") as client:
            while not stop.is_set():
                with suppress(httpx.HTTPError):
                    client.get(route, timeout=3)

    with ThreadPoolExecutor(60) as pool:
        for _ in range(60):
            pool.submit(ask)
        try:
            with service.client("writer") as client:
                beside = _median_seconds(lambda: client.get("/v1/studies"))
            start = time.monotonic()
            service.run(study)
            upload = time.monotonic() - start
        finally:
            stop.set()
    seen = f"a list took {beside:.2f} s, an upload {upload:.2f} s"
    return _hold(beside < BUSY_SECONDS and upload < 2 * BUSY_SECONDS, seen)


@_attack("eight archive-wide searches at once over 300 runs, beside an upload", short=False)
def many_searches(service: AttackedService) -> str:
    study = service.study()
    for _ in range(300):
        service.run(study)

    def search() -> float:
        with service.client("reader") as client:
            start = time.monotonic()
            client.get("/dicom-web/instances", params={"PatientID": "nobody", "includefield": "all"}).raise_for_status()
            return time.monotonic() - start

    with ThreadPoolExecutor(8) as pool:
        searches = [pool.submit(search) for _ in range(8)]
        start = time.monotonic()
        service.run(study)
        upload = time.monotonic() - start
        slowest = max(each.result() for each in searches)
    seen = f"slowest of eight searches {slowest:.2f} s, upload beside them {upload:.2f} s"
    return _hold(slowest < BUSY_SECONDS and upload < BUSY_SECONDS, seen)


@_attack("100 connections that never finish their header")
def unfinished_headers(service: AttackedService) -> str:
    address = urlsplit(service.url)
    held = []
    try:
        for _ in range(100):
            connection = socket.create_connection((address.hostname, address.port), timeout=10)
            connection.sendall(b"GET /v1/studies HTTP/1.1\r\nHost: 127.0.0.1\r\nX-Slow: ")
            held.append(connection)
        seconds = max(service.health_seconds() for _ in range(5))
    finally:
        for connection in held:
            connection.close()
    return _hold(seconds < HEALTH_SECONDS, f"health answered within {seconds:.2f} s")


@_attack("readers that ask for large answers and take nothing")
def readers_that_take_nothing(service: AttackedService) -> str:
    study = service.study()
    uid, _ = service.run(study)
    address, held = urlsplit(service.url), []
    before = _memory_mib(service.api)
    try:
        for number in range(60):
            path = f"{study}/instances/{uid}/frames" if number % 2 else "/v1/openapi.json"
            connection = socket.create_connection((address.hostname, address.port), timeout=10)
            connection.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 2048)
            head = f"GET {path} HTTP/1.1\r\nHost: 127.0.0.1\r\nAuthorization: Bearer {service.tokens['reader']}\r\n\r\n"
            connection.sendall(head.encode())
            held.append(connection)
        seconds = max(service.health_seconds() for _ in range(10))
        growth, pinned = _memory_mib(service.api) - before, _unlinked_mib(service.api)
    finally:
        for connection in held:
            connection.close()
    seen = f"health within {seconds:.2f} s, memory {growth:+.0f} MiB, {pinned:.0f} MiB of unlinked files"
    return _hold(seconds < HEALTH_SECONDS and growth < MOST_GROWTH_MIB and pinned < 64, seen)


def _memory_mib(process: psutil.Process) -> float:
    return float(process.memory_info().rss) / 2**20


def _unlinked_mib(process: psutil.Process) -> float:
    """Return the size of a process's unlinked open files, in MiB."""
    total = 0
    for descriptor in Path(f"/proc/{process.pid}/fd").iterdir():
        try:
            if descriptor.readlink().name.endswith("(deleted)"):
                total += descriptor.stat().st_size
        except OSError:
            continue
    return total / 2**20


@_attack("questions for readiness without a token")
def readiness_writes(service: AttackedService) -> str:
    folders = [
        service.data_dir,
        *(path for path in service.data_dir.rglob("*") if path.is_dir() and len(path.parts) < 12),
    ]
    changes: set[tuple[Path, int]] = set()
    start = time.monotonic()
    with service.client(None) as client:
        for folder in folders:
            changes.add((folder, folder.stat().st_mtime_ns))
        known = len(changes)
        for _ in range(60):
            client.get("/v1/ready")
            changes |= {(folder, folder.stat().st_mtime_ns) for folder in folders if folder.exists()}
    seconds = time.monotonic() - start
    writes = len(changes) - known
    # One look a second, in which a file may come and go in two folders; the broker of files counts too.
    return _hold(writes <= 3 * (seconds + 2), f"60 questions in {seconds:.1f} s changed folders {writes} times")


# Somebody without a token, or with the wrong one.


@_attack("every route without a token, and every route that writes with a token that reads")
def token_walk(service: AttackedService) -> str:
    wrong = []
    with service.client(None) as nobody, service.client("reader") as reader:
        document = reader.get("/v1/openapi.json").json()
        operations = [
            (method.upper(), re.sub(r"\{\w+\}", "0" * 32, path))
            for path, each in document["paths"].items()
            for method in each
        ]
        operations += [("GET", "/dicom-web/studies"), ("POST", "/dicom-web/studies"), ("GET", "/metrics")]
        for method, path in operations:
            if path not in ("/v1/health", "/v1/ready") and nobody.request(method, path).status_code != 401:
                wrong.append(f"{method} {path} without a token")
            is_session = path == "/session"
            if method not in ("GET", "HEAD") and not is_session and reader.request(method, path).status_code != 403:
                wrong.append(f"{method} {path} with the scope read")
    return _hold(not wrong, f"{len(operations)} operations, {len(wrong)} answered wrongly {wrong[:3]}")


@_attack("paths that leave the folder of the pages")
def paths_outside(service: AttackedService) -> str:
    answered = []
    with service.client("reader") as client:
        for path in (
            "/assets/../settings.py", "/assets/%2e%2e/settings.py", "/assets/..%2f..%2fsettings.py", "/assets//etc/passwd",
            "/assets/%2fetc%2fpasswd", "/assets/..%5c..%5csettings.py", "/assets/%00", "/assets/.%2e/report.html.j2",
        ):  # fmt: skip
            address = urlsplit(service.url)
            connection = socket.create_connection((address.hostname, address.port), timeout=10)
            head = f"GET {path} HTTP/1.1\r\nHost: 127.0.0.1\r\nConnection: close\r\n{_bearer(client)}\r\n\r\n"
            connection.sendall(head.encode())
            status = int(connection.recv(65536)[9:12])
            connection.close()
            if status == 200 or status >= 500:
                answered.append(f"{status} {path}")
    return _hold(not answered, f"answered {answered}" if answered else "none was answered")


def _bearer(client: httpx.Client) -> str:
    return f"Authorization: {client.headers['authorization']}"


@_attack("20 wrong tokens, then a valid one that the service has not seen; wrong ones under many addresses")
def guessed_tokens(service: AttackedService) -> str:
    made = service.call("token", "create", "--name", f"fresh-{uuid.uuid4().hex[:8]}", "--scope", "read")
    fresh = made.stdout.split()[-1]
    statuses = []
    with httpx.Client(base_url=service.url, trust_env=False, timeout=30) as client:
        for number in range(40):
            # The attacker writes the first address; the proxy that the service trusts adds the second.
            chain = f"10.9.8.{number}, 198.51.100.7"
            headers = {"Authorization": f"Bearer wrong{number}", "X-Forwarded-For": chain}
            statuses.append(client.get("/v1/studies", headers=headers).status_code)
        valid = client.get("/v1/studies", headers={"Authorization": f"Bearer {fresh}"}).status_code
        known = client.get("/v1/studies", headers={"Authorization": f"Bearer {service.tokens['reader']}"}).status_code
    seen = f"{statuses.count(401)} of 40 guesses answered 401 and {statuses.count(429)} 429; then the valid tokens {valid}, {known}"
    return _hold(valid == known == 200 and statuses.count(429) >= 10, seen)


@_attack("a proxy before a service without tokens: the headers that proxies add")
def open_behind_a_proxy(service: AttackedService) -> str:
    url = service.another("open")
    headers = (
        {"X-Forwarded-For": "198.51.100.7"}, {"Forwarded": "for=198.51.100.7"}, {"Via": "1.1 proxy"},
        {"X-Forwarded-Host": "fluoromap.example"}, {"X-Forwarded-Proto": "https"}, {"X-Real-IP": "198.51.100.7"},
        {"Host": "fluoromap.example"}, {"Origin": "http://127.0.0.1:9"}, {"Sec-Fetch-Site": "cross-site"},
    )  # fmt: skip
    with httpx.Client(base_url=url, trust_env=False, timeout=30) as client:
        answers = {next(iter(each)): client.get("/v1/studies", headers=each).status_code for each in headers}
    let_in = [name for name, status in answers.items() if status not in (401, 403)]
    return _hold(not let_in, f"let in with {let_in}" if let_in else f"all refused: {sorted(set(answers.values()))}")


@_attack("the cookie of a browser: the token in it, and its use after signing out")
def stolen_cookie(service: AttackedService) -> str:
    token = service.tokens["reader"]
    with httpx.Client(base_url=service.url, trust_env=False, timeout=30) as client:
        answer = client.post("/session", headers={"Authorization": f"Bearer {token}"})
        cookie = answer.headers["set-cookie"]
        value = cookie.split("=", 1)[1].split(";", 1)[0].strip('"')
        # A cookie of the example's name shows what a proxy's user gets.
        far = client.post("/session", headers={"Authorization": f"Bearer {token}", "Host": HOST})
        header = {"Cookie": f"{cookie.split('=', 1)[0]}={value}"}
        client.cookies.clear()
        before = client.get("/v1/studies", headers=header).status_code
        own = {"Origin": service.url, "Sec-Fetch-Site": "same-origin"}
        client.delete("/session", headers=header | own)
        after = client.get("/v1/studies", headers=header).status_code
    decoded = value
    with suppress(ValueError):
        decoded += base64.urlsafe_b64decode(value + "=" * (-len(value) % 4)).decode("latin-1")
    secure = far.status_code >= 400 or "secure" in far.headers.get("set-cookie", "").lower()
    seen = f"token in the cookie: {token in decoded}; before {before}, after signing out {after}; Secure for another host: {secure}"
    return _hold(token not in decoded and before == 200 and after == 401 and secure, seen)


@_attack("the token of a monitoring program reads studies; the first token of a service may only read")
def narrow_tokens(service: AttackedService) -> str:
    made = service.call("token", "create", "--name", "prometheus", "--scope", "metrics")
    _hold(made.returncode == 0, "no scope 'metrics' exists, so Prometheus needs a token that reads studies")
    header = {"Authorization": f"Bearer {made.stdout.split()[-1]}"}
    with httpx.Client(base_url=service.url, trust_env=False, timeout=30, headers=header) as client:
        answers = [
            client.get(path).status_code for path in ("/metrics", "/v1/studies", "/dicom-web/studies", "/v1/jobs")
        ]
    first = service.call(
        "token", "create", "--name", "first", "--scope", "read", FLUOROMAP_DATA_DIR=str(service.folder / "fresh")
    )
    seen = f"metrics {answers[0]}, the rest {answers[1:]}; a first token that only reads ends with {first.returncode}"
    return _hold(answers == [200, 403, 403, 403] and first.returncode != 0, seen)


@_attack("a Host of the attacker in addresses that the service writes")
def foreign_host(service: AttackedService) -> str:
    study = service.study()
    service.run(study)
    service.run(study)
    with service.client("reader", Host="evil.example") as client:
        answers = [
            client.get(f"{study}/instances", params={"limit": 1}), client.get("/dicom-web/instances", params={"limit": 1}),
            client.get("/v1/studies", params={"limit": 1}), client.get("/dicom-web/studies", params={"limit": 1}),
        ]  # fmt: skip
    reflected = [
        str(answer.request.url.path)
        for answer in answers
        if "evil.example" in answer.text + str(answer.headers.multi_items())
    ]
    return _hold(not reflected, f"written by {reflected}" if reflected else "written by no answer")


# Damage and loss.


def _place(content: bytes) -> str:
    """Return the DICOMweb address of a run."""
    run = pydicom.dcmread(io.BytesIO(content), stop_before_pixels=True)
    study, series, uid = run.StudyInstanceUID, run.SeriesInstanceUID, run.SOPInstanceUID
    return f"/dicom-web/studies/{study}/series/{series}/instances/{uid}"


@_attack("a stored run that is damaged or missing, on every route that reads its file")
def damaged_runs(service: AttackedService) -> str:
    wrong: list[str] = []
    for kind in ("damaged", "missing"):
        study = service.study()
        uid, content = service.run(study)
        path = service.stored(content)
        if kind == "missing":
            path.unlink()
        else:
            changed = bytearray(content)
            changed[-100] ^= 0xFF
            path.chmod(0o600)
            path.write_bytes(changed)
        run, place = f"{study}/instances/{uid}", _place(content)
        with service.client("reader") as client:
            for route in (
                f"{run}/frames", f"{run}/frames/1.png", f"{run}/frames/1/preview", place, f"{place}/frames/1",
                f"{place}/frames/1/rendered", f"{place}/rendered",
            ):  # fmt: skip
                try:
                    answer = client.get(route, headers={"Accept": "*/*"})
                except httpx.RemoteProtocolError:
                    wrong.append(f"an answer that broke off for a {kind} file from {route[-30:]}")
                    continue
                code = answer.json().get("code") if "json" in answer.headers.get("content-type", "") else None
                if (answer.status_code, code) != (409, "run_broken"):
                    wrong.append(f"{answer.status_code} {code} for a {kind} file from {route.removeprefix(run)[-30:]}")
    return _hold(not wrong, f"{len(wrong)} of 14 answers are not 409 run_broken {wrong[:4]}")


@_attack("two changes with the same If-Match, one after the other and at once")
def lost_updates(service: AttackedService) -> str:
    study = service.study()
    uid, _ = service.run(study)
    route = f"{study}/instances/{uid}/frames/1/electrodes"
    results = []
    for way in ("in turn", "at once"):
        with service.client() as client:
            etag = client.get(route).headers.get("etag", '"0"')
        body = [{"catheter": "mapping", "electrode": 1, "u_px": 10.0, "v_px": 10.0}]

        def put(etag: str = etag, body: object = body) -> int:
            with service.client() as own:
                return own.put(route, json=body, headers={"If-Match": etag}).status_code

        if way == "in turn":
            statuses = [put(), put()]
        else:
            with ThreadPoolExecutor(4) as pool:
                statuses = [each.result() for each in [pool.submit(put) for _ in range(4)]]
        results.append(statuses)
    good = all(sum(status < 300 for status in each) == 1 and set(each) <= {200, 412} for each in results)
    return _hold(good, f"statuses in turn {results[0]}, at once {results[1]}")


@_attack("the table of pseudonyms of a study that is deleted")
def remains_of_a_study(service: AttackedService) -> str:
    study = service.study()
    _, content = service.run(study)
    table = service.data_dir / "reidentification" / f"{study.rsplit('/', 1)[1]}.csv"
    table.parent.mkdir(exist_ok=True)
    table.write_text("pseudonym,patient\n1,TEST^PATIENT\n")
    path = service.stored(content)
    with service.client() as client:
        status = client.delete(study).status_code
    left = [file.parent.name for file in (table, path) if file.exists()]
    return _hold(status in (200, 204) and not left, f"delete {status}, left in the folders {left}")


# The trail.


def _trail(service: AttackedService) -> list[dict[str, object]]:
    # Entries are written at most half a second after the request.
    time.sleep(1.0)
    file = service.folder / f"audit-{uuid.uuid4().hex}.jsonl"
    service.call("audit", "export", str(file))
    return [json.loads(line) for line in file.read_text().splitlines()]


@_attack("refused requests, downloads by DICOMweb and equal reads of two studies: each must be in the trail")
def unseen_requests(service: AttackedService) -> str:
    first, second = service.study(), service.study()
    _, content = service.run(first)
    service.run(second)
    before = len(_trail(service))
    with service.client("reader") as client:
        client.get(first)
        client.get(second)
        client.patch(first, json={"label": "changed"})
        client.get(_place(content), headers={"Accept": "*/*"})
    # Refusals wait for their minute, or for the end of the service.
    service.restart()
    entries = _trail(service)[before:]
    ids = [study.rsplit("/", 1)[1] for study in (first, second)]
    reads = {str(entry.get("study")) for entry in entries if entry.get("status") == 200}
    refusals = [entry for entry in entries if entry.get("status") == 403]
    downloads = [
        entry for entry in entries if "/dicom-web/studies/{" in str(entry["what"]) and entry.get("status") == 200
    ]
    with_study = [entry for entry in downloads if entry.get("study") or entry.get("studies")]
    seen = (
        f"{len(entries)} entries; both studies read: {set(ids) <= reads}; refusals: {len(refusals)}; downloads with study: "
        f"{len(with_study)} of {len(downloads)}"
    )
    return _hold(set(ids) <= reads and bool(refusals) and bool(with_study), seen)


@_attack("the end of the trail is cut off in the database, against a hash that was kept elsewhere")
def shortened_trail(service: AttackedService) -> str:
    copy = service.folder / "copied"
    copy.mkdir(exist_ok=True)
    with service.client() as client:
        for _ in range(3):
            client.get(service.study())
    time.sleep(1.0)
    with (
        sqlite3.connect(service.data_dir / "fluoromap.sqlite") as source,
        sqlite3.connect(copy / "fluoromap.sqlite") as target,
    ):
        source.backup(target)
    settings = {"FLUOROMAP_DATA_DIR": str(copy)}
    head = re.findall(r"\b[0-9a-f]{64}\b", service.call("audit", "verify", **settings).stdout)[-1]
    with sqlite3.connect(copy / "fluoromap.sqlite") as database:
        for (name,) in database.execute("SELECT name FROM sqlite_master WHERE type = 'trigger'").fetchall():
            database.execute(f'DROP TRIGGER "{name}"')
        database.execute("DELETE FROM audit WHERE id > (SELECT max(id) - 2 FROM audit)")
    answer = service.call("audit", "verify", "--head", head, **settings)
    with sqlite3.connect(copy / "fluoromap.sqlite") as database:
        database.execute("DELETE FROM audit")
    emptied = service.call("audit", "verify", "--head", head, **settings)
    seen = f"exit codes: tail cut off {answer.returncode}, table emptied {emptied.returncode}"
    return _hold(answer.returncode != 0 and emptied.returncode != 0, seen)


@_attack("the last hash of the trail must leave the service every minute", short=False)
def trail_without_a_witness(service: AttackedService) -> str:
    time.sleep(70)
    log = (service.data_dir / "api.log").read_text()
    with service.client() as client:
        metrics = client.get("/metrics").text
    lines = [line for line in (log + metrics).splitlines() if "audit" in line and re.search(r"[0-9a-f]{64}", line)]
    return _hold(bool(lines), f"{len(lines)} lines of log and metrics hold a hash of the trail")


# A target of deliveries that is hostile.


@contextmanager
def _hostile_target(way: str) -> Iterator[tuple[str, list[int]]]:
    """Serve an endless answer; yield the address and the bytes of each answer."""
    sent: list[int] = []

    class Handler(BaseHTTPRequestHandler):
        def do_POST(self) -> None:
            self.rfile.read(int(self.headers.get("Content-Length", 0)))
            sent.append(0)
            place = len(sent) - 1
            try:
                self.send_response(200)
                self.send_header("Content-Length", str(600 * 2**20))
                self.end_headers()
                for _ in range(600):
                    self.wfile.write(b"0" * (2**20 if way == "huge" else 1))
                    sent[place] += 2**20 if way == "huge" else 1
                    if way == "dripping":
                        time.sleep(0.2)
            except OSError:
                return

        def log_message(self, *_: object) -> None:
            """Print nothing."""

    server = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
    server.daemon_threads = True
    threading.Thread(target=server.serve_forever, daemon=True).start()
    try:
        yield f"http://127.0.0.1:{server.server_address[1]}/", sent
    finally:
        server.shutdown()
        server.server_close()


@_attack("targets of deliveries that answer with 600 MB, or with a byte at a time")
def endless_answers(service: AttackedService) -> str:
    with _hostile_target("huge") as (huge, huge_bytes), _hostile_target("dripping") as (dripping, dripping_bytes):
        secret = service.folder / "secret"
        secret.write_text("0" * 64)
        secret.chmod(0o600)
        configuration = service.folder / "targets.toml"
        configuration.write_text(
            "".join(
                f'[targets.{name}]\nkind = "webhook"\nurl = "{url}"\njob_ends = ["cancelled", "failed", "succeeded"]\n'
                f'secret_file = "{secret}"\ntimeout_seconds = 2.0\n'
                for name, url in (("huge", huge), ("dripping", dripping))
            )
        )
        job = service.queued_job()
        sender = service.start("sender", "--config", str(configuration))
        before = _memory_mib(sender)
        with service.client() as client:
            client.post(f"{job}:cancel").raise_for_status()
            # Until the sender has read its configuration, the service knows no such target.
            start = time.monotonic()
            wanted = {"huge", "dripping"}
            while wanted and time.monotonic() - start < LONGEST_SECONDS:
                wanted -= {
                    name for name in wanted if client.post(f"{job}/deliveries", json={"target": name}).is_success
                }
                time.sleep(0.1)
            before = _memory_mib(sender)
        end, most, attempt = time.monotonic() + 25, before, {}
        while time.monotonic() < end and not {"huge", "dripping"} <= attempt.keys():
            most = max(most, _memory_mib(sender))
            with service.client() as client:
                for delivery in client.get("/v1/deliveries").json()["items"]:
                    if delivery["error"]:
                        attempt.setdefault(delivery["target"], delivery["error"]["code"])
            time.sleep(0.1)
        most = max(most, _memory_mib(sender))
    seen = (
        f"memory {most - before:+.0f} MiB, {sum(huge_bytes[:1]) / 2**20:.0f} MiB taken of the huge answer, "
        f"{len(dripping_bytes)} dripping answers begun; attempts that ended: {attempt}"
    )
    return _hold(bool(huge_bytes and dripping_bytes) and most - before < MOST_GROWTH_MIB and len(attempt) == 2, seen)


# Code from the folder in which the program was called: the last attack, because it looks at all processes of the others.


@_attack("modules with the names of libraries in the folder where all processes were started")
def code_of_the_current_folder(service: AttackedService) -> str:
    service.call("plugins")
    marks = service.marks()
    return _hold(not marks, f"imported: {marks}" if marks else "none was imported")
