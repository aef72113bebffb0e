"""A client of the service, as any program may write one."""

from __future__ import annotations

import json
import tempfile
import time
import zipfile
from collections.abc import Iterator
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import httpx

from fluoromap_service.cli.failures import CommandFailed

POLL_SECONDS = 0.3


class Client:
    """A client of one running service.

    Parameters
    ----------
    url : str
        Address of the service.
    token : str, optional
        Access token; an open loopback service needs none.
    """

    def __init__(self, url: str, token: str | None = None) -> None:
        headers = {"Authorization": f"Bearer {token}"} if token else {}
        # A proxy from the environment must not sit between this machine and itself.
        self._http = httpx.Client(base_url=url, headers=headers, timeout=120, trust_env=False)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._http.close()

    def make_study(self, label: str) -> str:
        """Make a mapping study and return its id."""
        study: str = self._json("POST", "/v1/studies", json={"label": label})["id"]
        return study

    def upload(self, study: str, path: Path) -> list[str]:
        """Send one DICOM file and return the service's objections.

        They are empty when it accepts the file.
        """
        with path.open("rb") as stream:
            part = {"file": (path.name, stream, "application/dicom")}
            answer = self._http.post(f"/v1/studies/{study}/instances", files=part)
        if answer.is_server_error:
            raise CommandFailed(_sentence(answer))
        if answer.is_error:
            return [_sentence(answer)]
        return [problem["detail"] for problem in answer.json()["rejected"]]

    def put_activation_times(self, study: str, table: Path) -> list[str]:
        """Send the activation-time table and return its sites without runs."""
        answer = self._json(
            "PUT",
            f"/v1/studies/{study}/activation-times",
            content=table.read_bytes(),
            headers={"Content-Type": "text/csv"},
        )
        unmatched: list[str] = answer["unmatched"]
        return unmatched

    def start_job(self, study: str) -> str:
        """Start the pipeline with its defaults and return the job's id."""
        job: str = self._json("POST", f"/v1/studies/{study}/jobs", json={})["id"]
        return job

    def follow(self, job: str) -> Iterator[dict[str, Any]]:
        """Yield the job as the API shows it, until it has ended.

        The client asks again and again.
        """
        while True:
            state = self._json("GET", f"/v1/jobs/{job}")
            yield state
            if state["state"] in ("succeeded", "failed", "cancelled"):
                return
            time.sleep(POLL_SECONDS)

    def points(self, job: str) -> list[dict[str, Any]]:
        """Return all points of a job, in mm along LPS axes.

        They are relative to the reference catheter.
        """
        points: list[dict[str, Any]] = self._json("GET", f"/v1/jobs/{job}/points")["points"]
        return points

    def fetch(self, job: str, out: Path) -> dict[str, Any] | None:
        """Write all results of an ended job into a folder.

        Returns
        -------
        dict or None
            The map as the API answers it. None when no site could be located.
        """
        out.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile() as archive:
            with self._http.stream("GET", f"/v1/jobs/{job}/archive.zip") as answer:
                if answer.is_error:
                    answer.read()
                    raise CommandFailed(_sentence(answer))
                for chunk in answer.iter_bytes():
                    archive.write(chunk)
            with zipfile.ZipFile(archive) as files:
                files.extractall(out)
                if "map.json" not in files.namelist():
                    return None
        chamber: dict[str, Any] = json.loads((out / "map.json").read_text())
        return chamber

    def _json(self, method: str, path: str, **request: Any) -> dict[str, Any]:
        answer = self._http.request(method, path, **request)
        if answer.is_error:
            raise CommandFailed(_sentence(answer))
        content: dict[str, Any] = answer.json()
        return content


def _sentence(answer: httpx.Response) -> str:
    """Return the problem that an answer reports, with the places in the request."""
    try:
        problem = answer.json()
        places = "; ".join(f"{place['where']}: {place['message']}" for place in problem.get("errors", []))
        return f"{problem['detail']} ({places})" if places else str(problem["detail"])
    except (ValueError, KeyError, TypeError):
        request = answer.request
        return (
            f"The service answered {request.method} {request.url.path} with {answer.status_code}, without a reason; "
            "look into the service's log."
        )
