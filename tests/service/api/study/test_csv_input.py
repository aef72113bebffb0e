"""Tables of activation times and electrograms: what spreadsheets write is taken, what is wrong is refused as a whole."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from fastapi.testclient import TestClient

from fluoromap_service.api.study.csv_input import activation_times
from fluoromap_service.problem import Problem

GOOD = {
    "plain": "site,lat_ms\nA,1.5\nB,-20\n",
    "bom": "\ufeffsite,lat_ms\nA,1.5\nB,-20\n",
    "crlf": "site,lat_ms\r\nA,1.5\r\nB,-20\r\n",
    "semicolon and decimal comma": "site;lat_ms\nA;1,5\nB;-20,0\n",
    "tab": "site\tlat_ms\nA\t1,5\nB\t-20\n",
    "quotes": '"site","lat_ms"\n"A","1.5"\n"B","-20"\n',
    "quotes and decimal comma": '"site";"lat_ms"\n"A";"1,5"\n"B";"-20"\n',
    "minus sign of typography": "site,lat_ms\nA,1.5\nB,\N{MINUS SIGN}20\n",
    "separator line": "sep=;\nsite;lat_ms\nA;1,5\nB;-20\n",
    "separator line in quotes": '"sep=\t"\r\nsite\tlat_ms\r\nA\t1,5\r\nB\t-20\r\n',
    "blank columns": "site,lat_ms,,\nA,1.5,,\nB,-20,,\n",
    "blank columns in the header only": "site,lat_ms,,\nA,1.5\nB,-20\n",
    "end of file of DOS": "site,lat_ms\r\nA,1.5\r\nB,-20\r\n\x1a",
    "carriage returns": "site;lat_ms\rA;1,5\rB;-20\r",
    "comments before the header": "# exported; by a recorder\n#\nsite,lat_ms\nA,1.5\nB,-2.0e1\n",
    "column order, case, spaces, blank lines": " LAT_MS , site \n\n 1.5 , A\n-2e1,B\n,\n",
    "views": "site,lat_ms,view_a,view_b\nA,1.5,,\nB,-20,3,4\n",
    "no line end": "site,lat_ms\nA,1.5\nB,-20",
}


def _put(service: TestClient, study_path: str, content: str | bytes, kind: str = "text/csv") -> Any:
    return service.put(f"{study_path}/activation-times", content=content, headers={"Content-Type": kind})


def _times(service: TestClient, study_path: str) -> dict[str, float]:
    return {site["site"]: site["lat_ms"] for site in service.get(f"{study_path}/sites").json()["items"]}


@pytest.mark.parametrize("text", GOOD.values(), ids=GOOD.keys())
def test_tables_as_programs_write_them(service: TestClient, study_path: str, text: str) -> None:
    answer = _put(service, study_path, text.encode(), "text/csv; charset=utf-8")
    assert answer.status_code == 200, answer.text
    assert answer.json() == {"sites": 2, "unmatched": ["A", "B"]}
    assert _times(service, study_path) == {"A": 1.5, "B": -20}


BAD = {
    "unknown column": ("site,lat_ms,lat_s\nA,1,2\n", "row 1, column lat_s"),
    "column without a name": ("site,lat_ms,\nA,1,2\n", "row 1, column 3"),
    "header without rows": ("site,lat_ms\n", "row 1"),
    "missing column": ("site,time\nA,1\n", "row 1"),
    "column twice": ("site,lat_ms,lat_ms\nA,1,2\n", "row 1"),
    "empty": ("", "row 1"),
    "doubled site": ("site,lat_ms\nA,1\nA,2\n", "row 3, column site"),
    "text": ("site,lat_ms\nB,1\nA,soon\n", "row 3, column lat_ms"),
    "nan": ("site,lat_ms\nA,NaN\n", "row 2, column lat_ms"),
    "inf": ("site,lat_ms\n\nA,-inf\n", "row 3, column lat_ms"),
    "overflow": ("site,lat_ms\nA,1e999\n", "row 2, column lat_ms"),
    "no number": ("site,lat_ms\nA,\n", "row 2, column lat_ms"),
    "thousands": ('site,lat_ms\nA,"1.000,5"\n', "row 2, column lat_ms"),
    "underscore": ("site,lat_ms\nA,1_0\n", "row 2, column lat_ms"),
    "far too late": ("site,lat_ms\nA,20000\n", "row 2, column lat_ms"),
    "no site": ("site,lat_ms\n,4\n", "row 2, column site"),
    "site with slash": ("site,lat_ms\na/b,4\n", "row 2, column site"),
    "decimal comma between commas": ("site,lat_ms\nA,1,5\n", "row 2"),
    "thousands in quotes": ('site,lat_ms\nA,"1,234"\nB,"25.8"\n', "row 2, column lat_ms"),
    "decimal comma in quotes between commas": ('site,lat_ms\nA,"1,5"\n', "row 2, column lat_ms"),
    "both decimal signs": ("site;lat_ms\nA;1.234\nB;-25,8\n", "row 3, column lat_ms"),
    "en dash": ("site,lat_ms\nA,\N{EN DASH}20\n", "row 2, column lat_ms"),
    "no-break space": ("site;lat_ms\nA;1\N{NO-BREAK SPACE}234\n", "row 2, column lat_ms"),
    "full-width digits": ("site,lat_ms\nA,\N{FULLWIDTH DIGIT ONE}2\n", "row 2, column lat_ms"),
    "unit": ("site,lat_ms\nA,-25 ms\n", "row 2, column lat_ms"),
    "percent": ("site,lat_ms\nA,25%\n", "row 2, column lat_ms"),
    "unknown separator line": ("sep=|\nsite|lat_ms\nA|1\n", "row 1"),
    "comment between rows": ("site,lat_ms\nA,1\n#B,2\nC,3\n", "row 3"),
    "line break in a name": ('site,lat_ms\n"A\nB",1\n', "row 2, column site"),
    "composed and decomposed name": ("site,lat_ms\nM\u00fcller,1\nMu\u0308ller,2\n", "row 3, column site"),
    "same view twice": ("site,lat_ms,view_a,view_b\nA,1,7,7\n", "row 2, column view_b"),
}


@pytest.mark.parametrize(("text", "where"), BAD.values(), ids=BAD.keys())
def test_a_wrong_table_is_refused_as_a_whole(service: TestClient, study_path: str, text: str, where: str) -> None:
    _put(service, study_path, "site,lat_ms\nkept,7\n")
    answer = _put(service, study_path, text)
    assert (answer.status_code, answer.json()["code"]) == (422, "invalid_table")
    assert where in [error["where"] for error in answer.json()["errors"]]
    assert _times(service, study_path) == {"kept": 7}


@pytest.mark.parametrize(
    ("text", "named"),
    [
        ("site,lat_ms\nA,\N{EN DASH}20\n", "en dash (U+2013)"),
        ("site;lat_ms\nA;1\N{NARROW NO-BREAK SPACE}234\n", "narrow no-break space (U+202F)"),
        ("site;lat_ms\nA;1.5\nB;2,5\n", "row 2, column lat_ms has '.'"),
        ('site,lat_ms\nA,"1,5"\n', "comma"),
        ("site,lat_ms\nA,-25 ms\n", "unit"),
        ("site,lat_ms\n#A,1\n", "'#'"),
    ],
)
def test_the_message_names_the_thing(text: str, named: str) -> None:
    with pytest.raises(Problem) as caught:
        activation_times(text)
    assert any(named in message for _, message in caught.value.errors), caught.value.errors


def test_a_name_that_begins_with_the_comment_sign_is_read_in_quotes() -> None:
    assert [one.site for one in activation_times('site,lat_ms\n"#1",2\n')] == ["#1"]


def test_every_mistake_is_reported_at_once() -> None:
    with pytest.raises(Problem) as caught:
        activation_times("site,lat_ms\nA,x\nA,nan\n")
    assert [where for where, _ in caught.value.errors] == [
        "row 2, column lat_ms",
        "row 3, column site",
        "row 3, column lat_ms",
    ]
    assert caught.value.detail.startswith("The table has 3 mistakes,")
    with pytest.raises(Problem, match="has 1 mistake,"):
        activation_times("site,lat_ms\nA,x\n")


@pytest.mark.parametrize(
    ("content", "kind", "status"),
    [
        (b"site,lat_ms\nA,1\n", "application/json", 415),
        (b"site,lat_ms\nA,1\n", "text/csv; charset=latin-1", 415),
        ("site,lat_ms\nÄ,1\n".encode("latin-1"), "text/csv", 400),
        ("site,lat_ms\nA,1\n".encode("utf-16"), "text/csv", 400),
        ("site,lat_ms\nA,1\n".encode("utf-16-le"), "text/csv", 400),
        (b'site,lat_ms\n"A,1\n', "text/csv", 400),
    ],
    ids=["json", "charset", "latin-1", "utf-16", "utf-16 without mark", "open quote"],
)
def test_bodies_that_are_no_table(service: TestClient, study_path: str, content: bytes, kind: str, status: int) -> None:
    assert _put(service, study_path, content, kind).status_code == status


def test_a_new_table_replaces_the_old_one(service: TestClient, study_path: str) -> None:
    _put(service, study_path, "site,lat_ms\nA,1\nB,2\n")
    service.put(f"{study_path}/sites/C", json={"lat_ms": 9})
    _put(service, study_path, "site,lat_ms\nB,3\n")
    assert _times(service, study_path) == {"B": 3, "C": 9}


def test_a_table_for_no_study(service: TestClient) -> None:
    assert _put(service, "/v1/studies/none", "site,lat_ms\nA,1\n").status_code == 404


def _electrogram() -> str:
    time = np.arange(0, 400.0)

    def deflection(at: float) -> Any:
        return -np.tanh((time - at) / 2) * np.exp(-(((time - at) / 12) ** 2))

    noise = np.random.default_rng(1).normal(0, 0.005, (2, len(time)))
    rows = zip(time, deflection(120.0) + noise[0], deflection(161.0) + noise[1], strict=True)
    return "time_ms,reference,mapping\n" + "".join(f"{t:.1f},{r:.5f},{m:.5f}\n" for t, r, m in rows)


def test_an_electrogram_gives_the_activation_time(service: TestClient, study_path: str) -> None:
    path = f"{study_path}/electrograms/S09"
    answer = service.put(path, content=_electrogram(), headers={"Content-Type": "text/csv"})
    assert answer.status_code == 200, answer.text
    assert answer.json()["lat_ms"] == pytest.approx(41, abs=1.5)
    assert answer.json()["lat_ms"] == pytest.approx(answer.json()["mapping_ms"] - answer.json()["reference_ms"])
    assert _times(service, study_path) == {"S09": answer.json()["lat_ms"]}


def _recording(time: Any, reference: Any, mapping: Any) -> str:
    rows = zip(time, reference, mapping, strict=True)
    return "time_ms,reference,mapping\n" + "".join(f"{t:.3f},{r:.5f},{m:.5f}\n" for t, r, m in rows)


def test_a_recording_of_several_beats_is_timed_in_the_same_beat(service: TestClient, study_path: str) -> None:
    time = np.arange(0, 900.0)
    noise = np.random.default_rng(1).normal(0, 0.005, (2, len(time)))

    def deflection(at: float) -> Any:
        return -np.tanh((time - at) / 2) * np.exp(-(((time - at) / 5) ** 2))

    reference = deflection(200) + 1.5 * deflection(640)
    mapping = 1.5 * deflection(241.3) + deflection(681.3)
    content = _recording(time, reference + noise[0], mapping + noise[1])
    answer = service.put(f"{study_path}/electrograms/S1", content=content, headers={"Content-Type": "text/csv"}).json()
    assert answer["lat_ms"] == pytest.approx(41.3, abs=1)
    assert (answer["beats"], answer["warnings"]) == (2, [])
    assert _times(service, study_path) == {"S1": answer["lat_ms"]}
    in_microseconds = _recording(1000 * time, reference + noise[0], mapping + noise[1])
    refused = service.put(
        f"{study_path}/electrograms/S2", content=in_microseconds, headers={"Content-Type": "text/csv"}
    )
    assert (refused.status_code, refused.json()["code"]) == (422, "unusable_electrogram")
    assert "milliseconds" in refused.json()["detail"]
    assert list(_times(service, study_path)) == ["S1"]


@pytest.mark.parametrize(
    ("content", "code"),
    [
        ("time_ms,reference,mapping\n0,0,0\n1,0,0\n", "unusable_electrogram"),
        ("time_ms,reference,mapping\n", "invalid_table"),
        ("time_ms,reference,mapping\n0,0,x\n", "invalid_table"),
        ("time_ms,reference\n0,0\n", "invalid_table"),
    ],
)
def test_an_electrogram_without_an_activation_time(
    service: TestClient, study_path: str, content: str, code: str
) -> None:
    answer = service.put(f"{study_path}/electrograms/X", content=content, headers={"Content-Type": "text/csv"})
    assert (answer.status_code, answer.json()["code"]) == (422, code)
    assert _times(service, study_path) == {}
