"""The routes of the pages for people, their assets, and the browser's session.

The pages use the public API as any client does.
"""

from __future__ import annotations

import functools
import hashlib
from dataclasses import dataclass
from pathlib import Path

from fastapi import Request, Response
from pydantic import BaseModel, Field

import fluoromap_service
from fluoromap_service.api.http.etags import is_known
from fluoromap_service.api.http.hosts import check_host
from fluoromap_service.api.http.routers import new_router
from fluoromap_service.api.http.security import SESSION, SIGN_IN, Reader, bearer_token
from fluoromap_service.api.http.session import remove_cookie, session_id, set_cookie
from fluoromap_service.auth import OPEN, sessions, token_hash
from fluoromap_service.problem import Problem, not_found

router = new_router(include_in_schema=False)

ASSETS = Path(fluoromap_service.__file__).resolve().parent / "web" / "assets"
PAGE = "page.html"
"""The file of all pages behind the sign-in; its script reads the address."""

PAGE_POLICY = (
    "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self' blob: data:; connect-src 'self'; "
    "form-action 'self'; frame-ancestors 'none'; base-uri 'none'"
)
"""Content-Security-Policy of the pages: they load from this service only and contain no script."""

MEDIA_TYPES = {
    ".html": "text/html; charset=utf-8",
    ".js": "text/javascript; charset=utf-8",
    ".css": "text/css; charset=utf-8",
    ".svg": "image/svg+xml",
}


@dataclass(frozen=True, slots=True)
class Asset:
    """One file of the pages."""

    content: bytes
    media_type: str
    etag: str


def asset(name: str) -> Asset | None:
    """Return a file of the pages; None when there is no such file."""
    try:
        path = (ASSETS / name).resolve()
        if not (path.is_relative_to(ASSETS) and path.suffix in MEDIA_TYPES and path.is_file()):
            return None
    except (ValueError, OSError):
        # A name with NUL, or a longer one than the disk allows.
        return None
    return _read(path, path.stat().st_mtime_ns)


@functools.lru_cache(maxsize=256)
def _read(path: Path, changed_ns: int) -> Asset:
    content = path.read_bytes()
    return Asset(content, MEDIA_TYPES[path.suffix], f'"{hashlib.sha256(content).hexdigest()[:32]}"')


def _send(request: Request, name: str) -> Response:
    found = asset(name)
    if found is None:
        raise not_found("file")
    headers = {"ETag": found.etag, "Cache-Control": "no-cache"}
    if name.endswith(".html"):
        headers["Content-Security-Policy"] = PAGE_POLICY
    if is_known(request, found.etag):
        # A browser replaces the headers of its copy by those of this answer (RFC 9111 section 3.2).
        return Response(status_code=304, headers=headers)
    return Response(found.content, media_type=found.media_type, headers=headers)


@router.get("/")
def get_studies_page(request: Request, caller: Reader) -> Response:
    """Return the page of all studies."""
    return _send(request, PAGE)


@router.get("/studies/{study_id}")
def get_study_page(study_id: str, request: Request, caller: Reader) -> Response:
    """Return the page of one study."""
    return _send(request, PAGE)


@router.get(SIGN_IN)
def get_sign_in_page(request: Request) -> Response:
    """Return the page that asks for a token."""
    return _send(request, "sign-in.html")


class Link(BaseModel):
    """The secret part of a link that signs a browser in."""

    link: str = Field(max_length=100)


@router.post(SIGN_IN, status_code=204, response_class=Response)
def post_sign_in(request: Request, body: Link) -> Response:
    """Begin a session of this browser by a link, which works once."""
    check_host(request)
    new_id = sessions.open_link(body.link)
    if new_id is None:
        raise Problem(401, "unauthorized", "This link was used or is too old; make a new one with 'fluoromap sign-in'.")
    response = Response(status_code=204)
    set_cookie(request, response, new_id)
    return response


@router.get("/assets/{name:path}")
def get_asset(name: str, request: Request) -> Response:
    """Return a file of the pages."""
    return _send(request, name)


@router.get(SESSION)
def get_session(caller: Reader) -> dict[str, str | None]:
    """Return the name of this browser's token.

    It is null where the service is open.
    """
    return {"name": None if caller == OPEN.name else caller}


@router.post(SESSION, status_code=204, response_class=Response)
def post_session(request: Request, caller: Reader) -> Response:
    """Begin a session of this browser with the token of the header."""
    response = Response(status_code=204)
    token = bearer_token(request)
    new_id = None if token is None else sessions.begin(token_hash(token))
    if new_id is not None:
        set_cookie(request, response, new_id)
    return response


@router.delete(SESSION, status_code=204, response_class=Response)
def delete_session(request: Request, caller: Reader) -> Response:
    """End the session of this browser."""
    response = Response(status_code=204)
    ended = session_id(request)
    if ended is not None:
        sessions.end(token_hash(ended))
    remove_cookie(response)
    return response
