"""Answers about a whole study are made, kept and sent in pieces, so that their size does not bound the study."""

from __future__ import annotations

import asyncio
import io
import os
import zipfile
from collections import OrderedDict
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from fastapi.testclient import TestClient
from finished_study import DIASTOLE, FinishedStudy, matching

from fluoromap.contracts import Matching
from fluoromap_service.api.http import spooled_answers
from fluoromap_service.api.results import archive
from fluoromap_service.api.results.archive_files import ArchiveFile
from fluoromap_service.jobs import stage_results
from fluoromap_service.jobs.stage_results import SiteTracks
from fluoromap_service.results import placement
from fluoromap_service.results import tracks as tracks_of_sites
from fluoromap_service.results.fusion import fusion_of
from fluoromap_service.store import files
from fluoromap_service.store.codec import decode, encode
from fluoromap_service.store.engine import reading
from fluoromap_service.store.models import Job
from fluoromap_service.store.renderings import kept_file

pytestmark = pytest.mark.usefixtures("file_processes", "nothing_remembered")


@pytest.fixture
def nothing_remembered(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let the process forget the results that other tests read."""
    monkeypatch.setattr(stage_results, "_remembered", OrderedDict())


class _Piece(bytes):
    """A piece of an answer that counts the living ones."""

    living = 0
    most_living = 0

    def __new__(cls, content: bytes) -> _Piece:
        cls.living += 1
        cls.most_living = max(cls.most_living, cls.living)
        return super().__new__(cls, content)

    def __del__(self) -> None:
        _Piece.living -= 1


def _pieces(count: int) -> Iterator[bytes]:
    _Piece.living = _Piece.most_living = 0
    for number in range(count):
        yield _Piece(bytes([number]) * 100_000)


async def _sent(response: Any) -> list[bytes]:
    return [piece async for piece in response.body_iterator]


def test_an_answer_that_is_made_whole_waits_on_the_disk(data_dir: Path) -> None:
    response = spooled_answers.spooled_answer(_pieces(30), "text/csv", {"Vary": "Accept"})
    assert _Piece.most_living <= 2
    assert response.headers["content-length"] == str(30 * 100_000)
    assert response.headers["vary"] == "Accept"
    sent = asyncio.run(_sent(response))
    assert b"".join(sent) == b"".join(_pieces(30))
    assert max(map(len, sent)) <= spooled_answers.PIECE_BYTES
    # The file has no name that anybody would have to remove.
    assert list(files.made_incoming_folder().iterdir()) == []


def test_an_error_while_an_answer_is_made_is_its_error(data_dir: Path) -> None:
    def broken() -> Iterator[bytes]:
        yield from _pieces(30)
        raise ValueError("broken")

    with pytest.raises(ValueError, match="broken"):
        spooled_answers.spooled_answer(broken(), "text/csv", {})


def test_a_long_rendering_is_written_piece_by_piece(study: FinishedStudy) -> None:
    kept = kept_file(study.job_id, {"kind": "test"}, lambda file: file.writelines(_pieces(30)))
    assert _Piece.most_living <= 2
    assert kept.path.read_bytes() == b"".join(_pieces(30))
    assert kept.sha256 == files.sha256_of(kept.path)


def _as_written_whole(contents: list[tuple[str, bytes, bool]]) -> bytes:
    """Return the zip of whole contents in a stream that cannot seek."""

    class Stream(io.BytesIO):
        def seekable(self) -> bool:
            return False

        def tell(self) -> int:
            raise OSError

    stream = Stream()
    with zipfile.ZipFile(stream, "w") as written:
        for name, content, compress in contents:
            entry = zipfile.ZipInfo(name, (1980, 1, 1, 0, 0, 0))
            entry.compress_type = zipfile.ZIP_DEFLATED if compress else zipfile.ZIP_STORED
            entry.external_attr = 0o644 << 16
            written.writestr(entry, content, compresslevel=1)
    return stream.getvalue()


def test_the_archive_reads_and_sends_its_files_in_pieces(tmp_path: Path) -> None:
    noise, table = os.urandom(3_000_000), b"".join(b"S%d,1.25,mapping\r\n" % row for row in range(300_000))
    (tmp_path / "noise").write_bytes(noise)
    (tmp_path / "table").write_bytes(table)
    entries = [
        ArchiveFile("job.json", b"{}"),
        ArchiveFile("tracks.csv", tmp_path / "table"),
        ArchiveFile("overlays/S01-a.png", tmp_path / "noise", compress=False),
        ArchiveFile("noise", tmp_path / "noise"),
    ]
    pieces = list(archive._zipped(entries))
    assert max(map(len, pieces)) < 4 * archive.PIECE_BYTES
    whole = [
        ("job.json", b"{}", True), ("tracks.csv", table, True), ("overlays/S01-a.png", noise, False), ("noise", noise, True),
    ]  # fmt: skip
    assert b"".join(pieces) == _as_written_whole(whole)


def test_the_long_files_of_the_archive_are_kept_files(study: FinishedStudy) -> None:
    study.finish()
    paths = {entry.name for entry in archive.archive_files(study.job_id) if isinstance(entry.content, Path)}
    assert {"tracks.csv", "report.html", "map.png", "mesh/chamber.mat", "overlays/S01-a.png"} <= paths


@pytest.mark.parametrize("name", ["tracks", "tracks.csv", "report.html", "archive.zip"])
def test_the_tracks_of_a_whole_study_are_read_site_by_site(
    client: TestClient, study: FinishedStudy, name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    study.finish()
    found: list[str] = []
    load_once: Callable[..., Any] = stage_results.load_once

    def counted(kind: type, stage: Any) -> Any:
        found.append(stage.subject)
        assert not _remembered_tracks()
        return load_once(kind, stage)

    monkeypatch.setattr(tracks_of_sites, "load_once", counted)
    assert client.get(f"/v1/jobs/{study.job_id}/{name}").status_code == 200
    assert set(found) == {"S01", "S02"}
    assert not _remembered_tracks()


def _remembered_tracks() -> list[object]:
    return [value for value, _ in stage_results._remembered.values() if isinstance(value, SiteTracks)]


def test_only_overlays_of_other_frames_than_diastole_read_the_tracks(
    client: TestClient, study: FinishedStudy, monkeypatch: pytest.MonkeyPatch
) -> None:
    study.finish()
    path = f"/v1/jobs/{study.job_id}/overlays/{study.uids['S01', 'a']}.png"
    read: list[str] = []
    load_file: Callable[..., Any] = stage_results.load_file
    monkeypatch.setattr(
        placement, "load_file", lambda kind, sha256: read.append(kind.__name__) or load_file(kind, sha256)
    )
    assert client.get(path).status_code == 200
    assert client.get(f"{path}?frame={DIASTOLE + 1}").status_code == 200
    assert read == []
    assert client.get(f"{path}?frame={DIASTOLE + 2}").status_code == 200
    assert read == ["SiteTracks"]


def test_an_overlay_leaves_no_decoded_tracks_behind(study: FinishedStudy) -> None:
    study.finish()
    runs = decode(Matching, encode(matching())).sites[0].runs
    before = set(vars(runs))
    chains = placement._chains(runs, "a")
    assert [frame for frame, shown in chains.items() if shown] == [0, 1]
    assert set(vars(runs)) == before
    with reading() as session:
        fusion_of(session, session.get_one(Job, study.job_id), study.uids["S01", "a"], None)
    (remembered,) = [value for value, _ in stage_results._remembered.values() if isinstance(value, Matching)]
    assert {"diastole", "track_a"}.isdisjoint(vars(remembered.sites[0].runs))
