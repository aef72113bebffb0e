"""The access token of the user who runs the service, in a file that only this user can read.

Commands of this user find it there, and so may the user's own programs. It also makes the links that sign a browser in.
"""

from __future__ import annotations

import os
import secrets
from pathlib import Path

from fluoromap_service import auth
from fluoromap_service.auth import Scope, sessions
from fluoromap_service.cli.failures import CommandFailed
from fluoromap_service.settings import settings
from fluoromap_service.store.private_folder import make_private_file, make_private_folder

FILE = "access-token"
"""Name of the file in the data folder."""

TOKEN = "local"
"""Name of the token, and beginning of the names of those that replace it."""

SCOPES = (Scope.READ, Scope.WRITE)


def token_file(data_dir: Path) -> Path:
    """Return the path of the token's file in a data folder."""
    return data_dir / FILE


def read_token(data_dir: Path) -> str | None:
    """Return the token in a data folder, valid or not; None without one."""
    try:
        return token_file(data_dir).read_text().strip() or None
    except FileNotFoundError:
        return None


def valid_token() -> str | None:
    """Return the valid token of this data folder; None without one."""
    text = read_token(settings().data_dir)
    return text if text is not None and auth.verify(text) is not None else None


def make_token() -> str:
    """Return the token of this data folder.

    Make one where there is no valid one.
    """
    text = valid_token()
    if text is not None:
        return text
    text = f"fm_{secrets.token_urlsafe(32)}"
    # The file comes first. A token without its file would close the service, and nobody could use it.
    _write(text)
    known = {token.name for token in auth.list_tokens()}
    names = (TOKEN, *(f"{TOKEN}-{number}" for number in range(2, len(known) + 3)))
    auth.create_token(next(name for name in names if name not in known), SCOPES, text=text)
    return text


def _write(text: str) -> None:
    path = token_file(settings().data_dir)
    make_private_folder(path.parent)
    part = path.with_name(f"{FILE}.part")
    make_private_file(part)
    part.write_text(text + "\n")
    os.replace(part, path)


def sign_in_link(url: str, token: str) -> str:
    """Return a link that signs a browser in, once and within ``LINK_SECONDS``.

    Its secret is behind a number sign, so that no browser sends it to a proxy and no server logs it.

    Raises
    ------
    CommandFailed
        When the token is not valid.
    """
    secret = sessions.make_link(token)
    if secret is None:
        raise CommandFailed("The access token was revoked just now; call the command again.")
    return f"{url}/sign-in#{secret}"
