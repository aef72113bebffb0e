"""A service that ``benchmarks/attack.py`` attacks: its processes, tokens and files.

Everything runs in a folder of traps: modules that leave a mark when a process imports them.
"""

from __future__ import annotations

import contextlib
import hashlib
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field
from pathlib import Path

import httpx
import psutil

from fluoromap_service.cli.supervisor import free_port, program

for _folder in ("tests", "tests/integration", "tests/service"):
    sys.path.append(str(Path(__file__).parent.parent / _folder))
from processes import kill_group, process  # noqa: E402
from small_runs import edited, small_run  # noqa: E402

START_SECONDS = 120
LONGEST_SECONDS = 15.0
"""A request without an answer for so long shows that the service hangs."""
HOST = "fluoromap.example"
"""The name under which a proxy reaches the service."""
TOKENS = {"admin": "admin", "writer": "write", "reader": "read"}
TRAPPED = (
    "numpy",
    "scipy",
    "json",
    "pydicom",
    "gdcm",
    "dl",
    "celery",
    "celeryconfig",
    "sqlalchemy",
    "sitecustomize",
    "fluoromap",
)


class Broken(Exception):
    """An attack that reached its aim. The message is the observation."""


@dataclass
class AttackedService:
    """A running API with tokens of every scope, on a data folder and port of its own.

    Parameters
    ----------
    folder : Path
        Holds the data of all services, the traps and their marks.
    url : str
        Address of the API.
    tokens : dict
        Text of a token by its name, see ``TOKENS``.
    """

    folder: Path
    url: str
    data_dir: Path
    environment: dict[str, str]
    tokens: dict[str, str]
    api: psutil.Process
    stack: ExitStack
    _runs: int = field(default=0)

    def client(self, token: str | None = "admin", **headers: str) -> httpx.Client:
        """Return a client with a token of this name; without a token for None."""
        own = {} if token is None else {"Authorization": f"Bearer {self.tokens[token]}"}
        return httpx.Client(base_url=self.url, headers=own | headers, trust_env=False, timeout=LONGEST_SECONDS)

    def call(self, *arguments: str, **settings: str) -> subprocess.CompletedProcess[str]:
        """Call the program ``fluoromap`` on the data of this service."""
        return subprocess.run(
            [program(), *arguments], env=self.environment | settings, stdin=subprocess.DEVNULL, capture_output=True, text=True
        )  # fmt: skip

    def another(self, name: str, *arguments: str, **settings: str) -> str:
        """Start another API without data and tokens; return its address."""
        environment = self.environment | {"FLUOROMAP_DATA_DIR": str(self.folder / name)} | settings
        return _start_api(self.stack, environment, arguments)[0]

    def start(self, *arguments: str, **settings: str) -> psutil.Process:
        """Start another process of the program on the data of this service."""
        return psutil.Process(
            self.stack.enter_context(process(*arguments, environment=self.environment | settings)).pid
        )

    def study(self) -> str:
        """Make a study and return its address."""
        with self.client() as client:
            return str(client.post("/v1/studies", json={"label": "attacked"}).raise_for_status().headers["location"])

    def run(self, study: str, **attributes: object) -> tuple[str, bytes]:
        """Upload a new small run; return its SOP Instance UID and file."""
        self._runs += 1
        angle = -30.0 if self._runs % 2 else 60.0
        content = edited(small_run(self.folder, self._runs, angle), **attributes)
        with self.client() as client:
            answer = client.post(f"{study}/instances", content=content, headers={"Content-Type": "application/dicom"})
        answer.raise_for_status()
        return str(answer.json()["instances"][0]["sop_instance_uid"]), content

    def stored(self, content: bytes) -> Path:
        """Return the file in which the service stores a content."""
        digest = hashlib.sha256(content).hexdigest()
        for path in (self.data_dir / "files").rglob("*"):
            if (
                path.is_file()
                and path.stat().st_size == len(content)
                and (digest.startswith(path.stem) or path.read_bytes() == content)
            ):
                return path
        raise FileNotFoundError("the service stores this run in no file")

    def queued_job(self) -> str:
        """Start a job that waits, because no worker runs; return its address."""
        study = self.study()
        self.run(study)
        self.run(study)
        with self.client() as client:
            table = "site,lat_ms\nS1,10\n"
            sites = client.get(f"{study}/sites").json()["items"]
            if sites:
                table = "site,lat_ms\n" + "".join(f"{site['site']},10\n" for site in sites)
            client.put(f"{study}/activation-times", content=table, headers={"Content-Type": "text/csv"})
            uids = [item["sop_instance_uid"] for item in client.get(f"{study}/instances").json()["items"]]
            for site in client.get(f"{study}/sites").json()["items"]:
                body = {"lat_ms": 10, "view_a": uids[0], "view_b": uids[1]}
                client.put(f"{study}/sites/{site['site']}", json=body)
            return str(client.post(f"{study}/jobs", json={}).raise_for_status().headers["location"])

    def health_seconds(self) -> float:
        """Return how long the API takes to say that it lives."""
        start = time.monotonic()
        httpx.get(f"{self.url}/v1/health", trust_env=False, timeout=LONGEST_SECONDS)
        return time.monotonic() - start

    def restart(self) -> None:
        """Stop the API as an operator does, and start it again."""
        self.api.terminate()
        self.api.wait(START_SECONDS)
        self.url, self.api = _start_api(self.stack, self.environment)

    def revive(self) -> bool:
        """Start a dead or hanging API again; return whether it was."""
        with contextlib.suppress(httpx.HTTPError):
            if self.api.is_running():
                self.health_seconds()
                return False
        kill_group(self.api.pid)
        self.url, self.api = _start_api(self.stack, self.environment)
        return True

    def marks(self) -> list[str]:
        """Return the traps that a process has imported."""
        file = self.folder / "marks"
        return sorted(set(file.read_text().split())) if file.exists() else []


@contextmanager
def attacked_service() -> Iterator[AttackedService]:
    """Start a service in a temporary folder and stop all its processes at the end."""
    with tempfile.TemporaryDirectory(prefix="fluoromap-attack-") as name, ExitStack() as stack:
        folder = Path(name)
        stack.enter_context(_trapped(folder))
        environment = {key: value for key, value in os.environ.items() if not key.startswith("FLUOROMAP_")}
        environment.pop("PYTHONSAFEPATH", None)
        environment.setdefault("NUMBA_CACHE_DIR", str(folder / "numba"))
        environment |= {
            "FLUOROMAP_DATA_DIR": str(folder / "data"), "FLUOROMAP_WORKERS": "1", "FLUOROMAP_ALLOWED_HOSTS": HOST,
        }  # fmt: skip
        tokens = {
            name: subprocess.run(
                [program(), "token", "create", "--name", name, "--scope", scope],
                env=environment, check=True, capture_output=True, text=True,
            ).stdout.split()[-1]
            for name, scope in TOKENS.items()
        }  # fmt: skip
        url, api = _start_api(stack, environment)
        yield AttackedService(folder, url, folder / "data", environment, tokens, api, stack)


def _start_api(
    stack: ExitStack, environment: dict[str, str], arguments: tuple[str, ...] = ()
) -> tuple[str, psutil.Process]:
    Path(environment["FLUOROMAP_DATA_DIR"]).mkdir(exist_ok=True)
    subprocess.run([program(), "db", "upgrade"], env=environment, check=True, capture_output=True)
    port = free_port()
    api = stack.enter_context(process("api", "--port", str(port), *arguments, environment=environment))
    url, end = f"http://127.0.0.1:{port}", time.monotonic() + START_SECONDS
    while time.monotonic() < end and api.poll() is None:
        with contextlib.suppress(httpx.TransportError):
            if httpx.get(f"{url}/v1/health", trust_env=False, timeout=5).status_code == 200:
                return url, psutil.Process(api.pid)
        time.sleep(0.05)
    raise RuntimeError(f"The API did not start; see {environment['FLUOROMAP_DATA_DIR']}/api.log.")


@contextmanager
def _trapped(folder: Path) -> Iterator[None]:
    """Change into a folder of traps."""
    traps = folder / "downloads"
    traps.mkdir()
    for name in TRAPPED:
        (traps / f"{name}.py").write_text(
            f"open({str(folder / 'marks')!r}, 'a').write(__name__ + '\\n')\nraise ImportError\n"
        )
    (traps / ".env").write_text("FLUOROMAP_PORT=1\n")
    (traps / "alembic.ini").write_text("[alembic]\nscript_location = .\n")
    with contextlib.chdir(traps):
        yield
