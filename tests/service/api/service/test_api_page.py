"""The page of the API shows every route and every shape, without scripts and other hosts."""

from __future__ import annotations

import re

from fastapi.testclient import TestClient


def test_the_page_shows_every_route_parameter_and_shape(service: TestClient) -> None:
    answer = service.get("/docs")
    assert (answer.status_code, answer.headers["content-type"]) == (200, "text/html; charset=utf-8")
    document = service.get("/v1/openapi.json").json()
    for path, methods in document["paths"].items():
        for operation in methods.values():
            section = re.search(rf'<details id="{operation["operationId"]}">.*?</details>', answer.text, re.S)
            assert section is not None
            assert f"<code>{path}</code>" in section[0]
            for parameter in operation.get("parameters", []):
                assert f"<code>{parameter['name']}</code>" in section[0]
    links = set(re.findall(r'href="([^"]+)"', answer.text))
    shapes = {f"#{name}" for name in document["components"]["schemas"]}
    assert links <= shapes | {"v1/openapi.json"}
    assert all(f'id="{name[1:]}"' in answer.text for name in shapes)


def test_the_page_needs_no_network_and_no_script(service: TestClient) -> None:
    page = service.get("/docs").text
    assert "<script" not in page
    assert not re.search(r"""(?:src|href)=["'](?:https?:)?//""", page)
    assert "`" not in page
