"""The address of the client and the scheme of its request, from the headers of trusted proxies only."""

from __future__ import annotations

import structlog
from starlette.datastructures import Headers
from starlette.types import ASGIApp, Receive, Scope, Send
from uvicorn.middleware.proxy_headers import ProxyHeadersMiddleware

log = structlog.get_logger(__name__)


class TrustedProxies:
    """ASGI middleware that believes X-Forwarded-For and X-Forwarded-Proto of trusted proxies.

    The client is the right-most address that is no trusted proxy: everything to its left the client could have written.

    Parameters
    ----------
    app : ASGI application
    proxies : sequence of str
        Addresses and networks.
    """

    def __init__(self, app: ASGIApp, proxies: tuple[str, ...]) -> None:
        self._app = app
        self._proxied = ProxyHeadersMiddleware(app, list(proxies))  # type: ignore[arg-type]
        self._has_warned = False

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] == "http" and not self._has_warned:
            self._warn(scope)
        await self._proxied(scope, receive, send)  # type: ignore[arg-type]

    def _warn(self, scope: Scope) -> None:
        """Log once that a proxy is not trusted.

        Its clients then count as one, and addresses in answers lack https.
        """
        peer = (scope.get("client") or ("",))[0]
        if "x-forwarded-for" in Headers(scope=scope) and peer not in self._proxied.trusted_hosts:
            self._has_warned = True
            log.warning("proxy_not_trusted", address=peer, setting="FLUOROMAP_TRUSTED_PROXIES")
