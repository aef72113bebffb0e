"""The callers of requests: which token or session is valid, and who it belongs to."""

from __future__ import annotations

import time
from dataclasses import dataclass, field

from fluoromap_service.auth import sessions, tokens
from fluoromap_service.auth.tokens import OPEN, Caller, any_token
from fluoromap_service.store.changes import Change, last_change


@dataclass(frozen=True, slots=True)
class Credential:
    """What a request identifies itself with: the hash of a token's text, or of a session's id."""

    sha256: str
    is_session: bool = False

    def find(self) -> tuple[Caller, float | None] | None:
        """Return the caller and the time of expiry.

        None when the credential is not valid.
        """
        return sessions.find(self.sha256) if self.is_session else tokens.find(self.sha256)


class Callers:
    """The callers of requests, remembered until the database changes.

    Each request asks for the last change first. So a token or session ends with the commit that ends it, and an open service
    with the commit of its first token, as if each request queried the tables.
    """

    def __init__(self) -> None:
        self._memory = _Memory(None)

    def remembered(self, credential: Credential | None) -> Caller | None:
        """Return the caller of a credential; None when only a query can find it.

        ``credential`` None is a request without one.
        """
        memory = self._memory
        if memory.change is None or memory.change != last_change():
            return None
        if memory.open:
            return OPEN
        caller, expires = (None, None) if credential is None else memory.callers.get(credential, (None, None))
        # Only SQLite has a last change, and its clock is the clock of this machine.
        return caller if expires is None or time.time() < expires else None

    def look_up(self, credential: Credential | None) -> Caller | None:
        """Return the caller of a credential; None when nobody may be let in.

        ``credential`` None is a request without one. While no token was ever made, the caller is :data:`OPEN`.
        """
        # Before the queries: a change between here and them makes the memory old, never wrong.
        change = last_change()
        found = None if credential is None else credential.find()
        is_open = found is None and not any_token()
        if change is not None:
            memory = self._memory
            if memory.change != change:
                memory = self._memory = _Memory(change, is_open)
            if credential is not None and found is not None:
                memory.callers[credential] = found
        if is_open:
            return OPEN
        return None if found is None else found[0]


@dataclass(frozen=True, slots=True)
class _Memory:
    """The callers of valid credentials, and when these expire, as of one change of the database.

    open : whether there was no token at all.
    """

    change: Change | None
    open: bool = False
    callers: dict[Credential, tuple[Caller, float | None]] = field(default_factory=dict)
