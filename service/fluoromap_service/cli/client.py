"""A client of the service, as any program may write one."""

from __future__ import annotations

import json
import tempfile
import time
import zipfile
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Any, Self
from urllib.parse import quote

import httpx

from fluoromap_service.cli.failures import CommandFailed

POLL_SECONDS = 0.3


@dataclass(frozen=True, slots=True)
class Upload:
    """The service's answer to one DICOM file.

    Parameters
    ----------
    uid : str or None
        SOP Instance UID; None when the service rejected the file.
    objections : tuple of str
        Empty when the service accepted the file.
    """

    uid: str | None
    objections: tuple[str, ...] = ()


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

    def make_study(self, label: str, **more: Any) -> str:
        """Make a mapping study and return its id.

        ``more`` are further members of the request.
        """
        study: str = self._json("POST", "/v1/studies", json={"label": label, **more})["id"]
        return study

    def upload(self, study: str, path: Path, name: str | None = None) -> Upload:
        """Send one DICOM file under a name, by default its own."""
        with path.open("rb") as stream:
            part = {"file": (name or path.name, stream, "application/dicom")}
            answer = self._http.post(f"/v1/studies/{study}/instances", files=part)
        if answer.is_server_error:
            raise CommandFailed(_sentence(answer))
        if answer.is_error:
            return Upload(None, (_sentence(answer),))
        return Upload(answer.json()["instances"][0]["sop_instance_uid"])

    def instances(self, study: str) -> list[dict[str, Any]]:
        """Return the runs of a study in the order of arrival."""
        return self._all(f"/v1/studies/{study}/instances")

    def sites(self, study: str) -> list[dict[str, Any]]:
        """Return the sites of a study, then its pairs of runs without a name."""
        return self._all(f"/v1/studies/{study}/sites")

    def complete_gantry(self, study: str, gantry: Mapping[str, Any]) -> None:
        """Set gantry values for all runs of a study whose headers lack them."""
        self._json("PATCH", f"/v1/studies/{study}", json={"gantry": gantry})

    def put_site(self, study: str, site: str, change: Mapping[str, Any]) -> None:
        """Set the activation time or the runs of a site."""
        self._json("PUT", f"/v1/studies/{study}/sites/{quote(site, safe='')}", json=change)

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

    def start_job(self, study: str, request: Mapping[str, Any] | None = None) -> str:
        """Start a job and return its id; without a request it has the default plugins."""
        job: str = self._json("POST", f"/v1/studies/{study}/jobs", json=request or {})["id"]
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

    def _all(self, path: str) -> list[dict[str, Any]]:
        """Return the items of all pages of a list."""
        items: list[dict[str, Any]] = []
        cursor: str | None = None
        while True:
            page = self._json("GET", path, params={"limit": 500} | ({"cursor": cursor} if cursor else {}))
            items += page["items"]
            cursor = page["next"]
            if cursor is None:
                return items

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
