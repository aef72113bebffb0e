"""Disturb the running service at random: ``python benchmarks/fault_campaign.py --stack both --faults 500 --seed 1``.

It runs jobs over a small simulated study, on the embedded stack (``fluoromap up``) and on PostgreSQL with Redis. Meanwhile it
kills and stops processes, takes database and broker away, moves the clock and sends messages that are none. A process that ends
is started again, as a service manager does. After each round it checks that

- every job has ended as succeeded, and there is one job for each request (none lost, doubled or hung);
- points, tracks, map and mesh have the bytes of an undisturbed run (none different);
- every stored result has its file.

Each job computes anew, because the campaign forgets the stored results before it. It ends with exit code 1 when something is
wrong. ``tests/integration/test_faults.py`` runs a short version.
"""

from __future__ import annotations

import argparse
import hashlib
import os
import random
import shutil
import sqlite3
import subprocess
import sys
import tempfile
import threading
import time
import uuid
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from typing import Any

import httpx
import psutil
import sqlalchemy
from redis import Redis

from fluoromap.phantom import StudySpec
from fluoromap_service.cli.own_token import read_token
from fluoromap_service.cli.submission import find_files
from fluoromap_service.cli.supervisor import free_port, program
from fluoromap_service.dicom.simulation import simulate

sys.path.insert(0, str(Path(__file__).parent.parent / "tests"))
import servers

LEASE_SECONDS = 3
PATIENCE_SECONDS = 180
"""A job that has not ended so long after the last fault hangs."""
SPEC = StudySpec(seed=7, sites=5, frames=12, frame_rate_hz=15.0)
JOBS_AT_ONCE = 2
RESULTS = ("points", "tracks", "map", "mesh.ply")
CLOCK_JUMP_SECONDS = 3600.0
UP_WEIGHT = 0.3
"""How often ``fluoromap up`` is hit, against other kinds. All its processes end with it, and it needs seconds to start."""


class Hung(Exception):
    """Something did not happen in time."""


class Program:
    """A program that a thread starts again whenever it ends, as a service manager does."""

    def __init__(self, command: list[str], log: Path, **options: Any) -> None:
        self._command, self._log, self._options = command, log, options
        self._stopping = threading.Event()
        self._held = threading.Event()
        self.starts = 0
        self._start()
        self._thread = threading.Thread(target=self._watch, daemon=True)
        self._thread.start()

    def _start(self) -> None:
        with self._log.open("ab") as log:
            self.process = subprocess.Popen(
                self._command, stdin=subprocess.DEVNULL, stdout=log, stderr=log, start_new_session=True, **self._options
            )  # fmt: skip
        self.starts += 1

    def _watch(self) -> None:
        while not self._stopping.wait(0.3):
            if self.process.poll() is not None and not self._held.is_set():
                self._start()

    @contextmanager
    def away(self) -> Iterator[None]:
        """Keep the program away for a while."""
        self._held.set()
        self.process.kill()
        self.process.wait()
        try:
            yield
        finally:
            self._held.clear()

    def members(self) -> list[psutil.Process]:
        """Return the program's processes."""
        try:
            root = psutil.Process(self.process.pid)
            return [root, *root.children(recursive=True)]
        except psutil.NoSuchProcess:
            return []

    def stop(self) -> None:
        self._stopping.set()
        self._thread.join()
        members = self.members()
        self.process.terminate()
        with suppress(subprocess.TimeoutExpired):
            self.process.wait(40)
        for member in members:
            with suppress(psutil.NoSuchProcess):
                member.kill()
        self.process.wait()


class Stack:
    """A running service with its programs, its address and its database."""

    def __init__(self, name: str, folder: Path) -> None:
        self.name, self.folder = name, folder
        self.port = free_port()
        self.url = f"http://127.0.0.1:{self.port}"
        self.data_dir = folder / "data"
        self.data_dir.mkdir(parents=True)
        own = {key: value for key, value in os.environ.items() if not key.startswith("FLUOROMAP_")}
        own.setdefault("NUMBA_CACHE_DIR", str(folder.parent / "numba"))
        self.environment = own | {
            "FLUOROMAP_DATA_DIR": str(self.data_dir),
            "FLUOROMAP_WORKERS": "2",
            "FLUOROMAP_LEASE_SECONDS": str(LEASE_SECONDS),
            "FLUOROMAP_HEARTBEAT_SECONDS": "1",
            "FLUOROMAP_REPUBLISH_SECONDS": "1",
            # A stage that is killed again and again must go on: the campaign counts results, not attempts.
            "FLUOROMAP_MAX_ATTEMPTS": "100000",
        }
        self.programs: dict[str, Program] = {}
        self.servers: dict[str, Program] = {}
        self.server_folder: Path | None = None
        self.broker_url = ""
        self.database_url = f"sqlite:///{self.data_dir / 'fluoromap.sqlite'}"
        if name == "servers":
            self._start_servers()
        # A pool would hold connections that a fault has broken.
        self.database = sqlalchemy.create_engine(self.database_url, poolclass=sqlalchemy.NullPool)
        self._start_programs()

    def _start_servers(self) -> None:
        self.server_folder = servers.session_folder()
        self.database_url = servers.postgresql(self.server_folder)
        self.broker_url = servers.redis(self.server_folder) + "/0"
        for name in ("postgresql", "redis"):
            command, options = servers.handed_over(self.server_folder, name)
            self.servers[name] = Program(command, self.folder / f"{name}.log", **options)
        self.environment["FLUOROMAP_DATABASE_URL"] = self.database_url
        self.environment["FLUOROMAP_BROKER_URL"] = self.broker_url

    def _start_programs(self) -> None:
        commands = {"up": ["up", "--port", str(self.port)]}
        if self.name == "servers":
            commands = {"api": ["api", "--port", str(self.port)], "worker": ["worker"]}
            _until(lambda: self._upgrade() == 0, "the database cannot be made")
        for name, arguments in commands.items():
            log = self.folder / f"{name}.log"
            self.programs[name] = Program([program(), *arguments], log, env=self.environment)

    def _upgrade(self) -> int:
        return subprocess.run([program(), "db", "upgrade"], env=self.environment, capture_output=True).returncode

    def stop(self) -> None:
        for each in (*self.programs.values(), *self.servers.values()):
            each.stop()
        if self.server_folder is not None:
            shutil.rmtree(self.server_folder, ignore_errors=True)

    def ask(self, method: str, path: str, **options: Any) -> httpx.Response:
        """Send a request until the service answers it.

        Only 429 and 503 may ask for patience.
        """
        # 'fluoromap up' has made it; the other stack is open.
        token = read_token(self.data_dir)
        headers = options.pop("headers", {}) | ({} if token is None else {"Authorization": f"Bearer {token}"})
        end = time.monotonic() + PATIENCE_SECONDS
        last = "no answer"
        while time.monotonic() < end:
            try:
                answer = httpx.request(method, self.url + path, headers=headers, timeout=60, trust_env=False, **options)
                if answer.status_code not in (429, 503):
                    return answer
                last = answer.text
            except httpx.TransportError as error:
                last = type(error).__name__
            time.sleep(0.3)
        raise Hung(f"{method} {path}: {last}")

    def execute(self, statement: str, **values: Any) -> None:
        """Change the database directly, as often as it takes."""

        def attempt() -> bool:
            try:
                with self.database.begin() as connection:
                    connection.execute(sqlalchemy.text(statement), values)
                return True
            except sqlalchemy.exc.DBAPIError:
                return False

        _until(attempt, "the database does not come back")

    def rows(self, query: str) -> list[Any]:
        with self.database.connect() as connection:
            return list(connection.execute(sqlalchemy.text(query)))


class Faults:
    """The faults of the campaign. Each method is one kind; ``counts`` says how often each one happened."""

    def __init__(self, stack: Stack, chance: random.Random) -> None:
        self._stack, self._chance = stack, chance
        self.counts: Counter[str] = Counter()

    def one(self) -> None:
        """Do one fault. Nine of ten are kills."""
        others = (self._stop, self._database_away, self._broker_away, self._clock_jump, self._garbage)
        (self._kill if self._chance.random() < 0.9 else self._chance.choice(others))()

    def _member(self) -> tuple[str, psutil.Process]:
        """Choose a kind of process, then a process of this kind."""
        while True:
            kinds: dict[str, list[psutil.Process]] = {}
            for each in (*self._stack.programs.values(), *self._stack.servers.values()):
                for member in each.members():
                    with suppress(psutil.NoSuchProcess):
                        kinds.setdefault(_kind(member), []).append(member)
            # Kills of the root alone would keep the service starting for ever.
            if len(kinds) > 1:
                names = sorted(kinds)
                weights = [UP_WEIGHT if name == "fluoromap up" else 1.0 for name in names]
                (kind,) = self._chance.choices(names, weights)
                return kind, self._chance.choice(kinds[kind])
            time.sleep(0.05)

    def _kill(self) -> None:
        with suppress(psutil.NoSuchProcess):
            kind, member = self._member()
            member.kill()
            self.counts[f"kill -9 {kind}"] += 1

    def _stop(self) -> None:
        with suppress(psutil.NoSuchProcess):
            kind, member = self._member()
            member.suspend()
            self.counts[f"SIGSTOP {kind}"] += 1
            time.sleep(LEASE_SECONDS + 2)
            member.resume()

    def _database_away(self) -> None:
        if self._stack.name == "servers":
            with self._stack.servers["postgresql"].away():
                time.sleep(self._chance.uniform(1, 6))
        else:
            with suppress(sqlite3.OperationalError):
                lock = sqlite3.connect(self._stack.data_dir / "fluoromap.sqlite", timeout=30, isolation_level=None)
                lock.execute("BEGIN EXCLUSIVE")
                time.sleep(self._chance.choice((2, 6, 35)))
                lock.rollback()
                lock.close()
        self.counts["database away"] += 1

    def _broker_away(self) -> None:
        if self._stack.name == "servers":
            with self._stack.servers["redis"].away():
                time.sleep(self._chance.uniform(1, 6))
        else:
            for message in (self._stack.data_dir / "queue" / "messages").glob("*"):
                message.unlink(missing_ok=True)
        self.counts["broker away, messages lost"] += 1

    def _clock_jump(self) -> None:
        """Move every stored time of the queue.

        The database's clock then is an hour behind or ahead of them.
        """
        seconds = self._chance.choice((-1, 1)) * CLOCK_JUMP_SECONDS
        move = "lease_until = lease_until + :s, published = published + :s"
        self._stack.execute(f"UPDATE stage SET {move} WHERE state IN ('ready', 'running')", s=seconds)
        self._stack.execute("UPDATE worker_seen SET seen = seen + :s", s=seconds)
        self.counts["clock set back 1 h" if seconds > 0 else "clock set ahead 1 h"] += 1

    def _garbage(self) -> None:
        content = self._chance.choice((b"no JSON", b"[]", b'{"body": 1}', b"\xff\xfe"))
        if self._stack.name == "servers":
            with suppress(Exception), Redis.from_url(self._stack.broker_url) as broker:
                broker.lpush("celery", content)
        else:
            folder = self._stack.data_dir / "queue" / "messages"
            (folder / f"0_{uuid.uuid4()}.celery.msg").write_bytes(content)
        self.counts["message that is none"] += 1


def _kind(process: psutil.Process) -> str:
    arguments = " ".join(process.cmdline())
    if "forkserver" in arguments:
        role = "stage process" if "pool_child" in arguments else "file process"
        parent = process.parent()
        server = parent is not None and "forkserver" not in " ".join(parent.cmdline())
        return f"server of {role}es" if server else role
    if "resource_tracker" in arguments:
        return "resource tracker"
    for name in ("fluoromap up", "fluoromap api", "fluoromap worker", "redis-server"):
        if name in arguments:
            return name
    return "postgres" if "postgres" in arguments else process.name()


def _until(condition: Callable[[], bool], complaint: str, seconds: float = PATIENCE_SECONDS) -> None:
    end = time.monotonic() + seconds
    while not condition():
        if time.monotonic() > end:
            raise Hung(complaint)
        time.sleep(0.1)


def send_study(stack: Stack, folder: Path) -> str:
    """Upload the simulated study and return its id."""
    study: str = stack.ask("POST", "/v1/studies", json={"label": "campaign"}).json()["id"]
    files = find_files(folder)
    for path in files.runs:
        with path.open("rb") as stream:
            part = {"file": (path.name, stream.read(), "application/dicom")}
        stack.ask("POST", f"/v1/studies/{study}/instances", files=part).raise_for_status()
    assert files.activation_times is not None
    table = files.activation_times.read_bytes()
    stack.ask(
        "PUT", f"/v1/studies/{study}/activation-times", content=table, headers={"Content-Type": "text/csv"}
    ).raise_for_status()
    return study


def results(stack: Stack, job: str) -> dict[str, bytes]:
    """Return each result of a job, without the job's own id."""
    contents = {}
    for name in RESULTS:
        answer = stack.ask("GET", f"/v1/jobs/{job}/{name}")
        answer.raise_for_status()
        contents[name] = answer.content.replace(job.encode(), b"job")
    return contents


class Campaign:
    """Rounds of jobs under faults on one stack, and what went wrong."""

    def __init__(self, stack: Stack, folder: Path, chance: random.Random) -> None:
        self._stack, self._chance = stack, chance
        self.faults = Faults(stack, chance)
        self.wrong: Counter[str] = Counter()
        self.jobs: list[str] = []
        self.slowest_end = 0.0
        self._study = send_study(stack, folder)
        self.expected = self._undisturbed()

    def _undisturbed(self) -> dict[str, bytes]:
        job = self._start()
        _until(lambda: self._state(job) == "succeeded", "the undisturbed job did not succeed")
        found = results(self._stack, job)
        self._write("undisturbed", found)
        return found

    def _write(self, name: str, contents: dict[str, bytes]) -> Path:
        folder = self._stack.folder / f"results-{name}"
        folder.mkdir()
        for part, content in contents.items():
            (folder / part).write_bytes(content)
        return folder

    def _compare(self, job: str) -> None:
        """Count a job whose results differ, and say where they lie."""
        found = results(self._stack, job)
        if found == self.expected:
            return
        self.wrong["different"] += 1
        names = ", ".join(name for name, content in found.items() if content != self.expected[name])
        failed = self._stack.rows(
            f"SELECT name, subject, error FROM stage WHERE job_id = '{job}' AND error IS NOT NULL"
        )
        print(f"  job {job}: {names} differ, see {self._write(job, found)}; failed stages: {failed}", flush=True)

    def _start(self) -> str:
        key = {"Idempotency-Key": uuid.uuid4().hex}
        answer = self._stack.ask("POST", f"/v1/studies/{self._study}/jobs", json={}, headers=key)
        if answer.status_code != 202:
            raise Hung(f"a job could not be started: {answer.status_code} {answer.text}")
        job: str = answer.json()["id"]
        self.jobs.append(job)
        return job

    def _state(self, job: str) -> str:
        answer = self._stack.ask("GET", f"/v1/jobs/{job}")
        if answer.status_code != 200:
            self.wrong[f"answers {answer.status_code}"] += 1
            return "unknown"
        return str(answer.json()["state"])

    def round(self, faults: int) -> None:
        """Run jobs, do some faults meanwhile, and compare the results."""
        self._stack.execute("DELETE FROM stage_result")
        jobs = [self._start() for _ in range(JOBS_AT_ONCE)]
        for _ in range(faults):
            time.sleep(self._chance.uniform(0.1, 1.2))
            self.faults.one()
        last_fault = time.monotonic()
        for job in jobs:
            try:
                _until(lambda job=job: self._state(job) in ("succeeded", "failed", "cancelled"), "the job hangs")  # type: ignore[misc]
                if self._state(job) != "succeeded":
                    self.wrong["lost"] += 1
                else:
                    self._compare(job)
            except Hung as hung:
                print(f"  job {job}: {hung}")
                self.wrong["hung"] += 1
        self.slowest_end = max(self.slowest_end, time.monotonic() - last_fault)

    def check_store(self) -> int:
        """Count doubled jobs and results without files.

        Return how many files have no row.
        """
        found = {row[0] for row in self._stack.rows("SELECT id FROM job")}
        self.wrong["doubled"] += len(found - set(self.jobs))
        self.wrong["lost"] += len(set(self.jobs) - found)
        known = {row[0] for row in self._stack.rows("SELECT sha256 FROM file")}
        files = self._stack.data_dir / "files"
        stored = {path.name for path in files.glob("??/*")}
        self.wrong["rows without file"] += len(known - stored)
        return len(stored - known)


def run(name: str, faults: int, each_round: int, seed: int, folder: Path, seconds: float) -> Counter[str]:
    """Run the campaign on one stack and print its report."""
    begin = time.monotonic()
    with ExitStack() as closing:
        stack = Stack(name, folder / name)
        closing.callback(stack.stop)
        _until(lambda: stack.ask("GET", "/v1/ready").status_code == 200, "the service is not ready")
        campaign = Campaign(stack, folder / "study", random.Random(seed))
        while sum(campaign.faults.counts.values()) < faults and time.monotonic() - begin < seconds:
            campaign.round(min(each_round, faults - sum(campaign.faults.counts.values())))
            done, minutes = sum(campaign.faults.counts.values()), (time.monotonic() - begin) / 60
            print(f"  {name}: {done} faults, {len(campaign.jobs)} jobs, {minutes:.1f} min", flush=True)
        orphans = campaign.check_store()
    counts = campaign.faults.counts
    kills = sum(count for kind, count in counts.items() if kind.startswith("kill"))
    print(f"{name}: {kills} kills among {sum(counts.values())} faults, {len(campaign.jobs)} jobs, seed {seed}")
    for kind, count in sorted(counts.items()):
        print(f"  {count:>5}  {kind}")
    wrong = {kind: campaign.wrong[kind] for kind in ("lost", "doubled", "different", "hung", "rows without file")}
    wrong |= {kind: count for kind, count in campaign.wrong.items() if kind not in wrong}
    print("  " + ", ".join(f"{count} {kind}" for kind, count in wrong.items()))
    print(
        f"  {orphans} files without row; all jobs of a round ended at most {campaign.slowest_end:.0f} s after its last fault"
    )
    hashes = {name: hashlib.sha256(content).hexdigest() for name, content in campaign.expected.items()}
    print(f"  {(time.monotonic() - begin) / 60:.1f} min, results {hashes}", flush=True)
    return +campaign.wrong


def main() -> int:
    """Run the campaign of the command line."""
    parser = argparse.ArgumentParser(description="Disturb the running service at random and compare its results.")
    parser.add_argument("--stack", choices=("embedded", "servers", "both"), default="both")
    parser.add_argument("--faults", type=int, default=60, help="Number of faults on each stack.")
    parser.add_argument("--each-round", type=int, default=12, help="Faults in one round of two jobs.")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--minutes", type=float, default=600.0, help="Longest time on each stack.")
    parser.add_argument("--keep", type=Path, help="Folder that keeps data and logs; it must not exist.")
    options = parser.parse_args()
    with ExitStack() as closing:
        folder = options.keep or Path(closing.enter_context(tempfile.TemporaryDirectory(prefix="fluoromap-faults-")))
        folder.mkdir(parents=True, exist_ok=options.keep is None)
        simulate(folder / "study", SPEC, processes=1)
        stacks = ("embedded", "servers") if options.stack == "both" else (options.stack,)
        wrong = [
            run(name, options.faults, options.each_round, options.seed, folder, 60 * options.minutes) for name in stacks
        ]
    return 1 if any(wrong) else 0


if __name__ == "__main__":
    sys.exit(main())
