"""The name under which a client reaches the service, which answers repeat in addresses."""

from __future__ import annotations

import re
from urllib.parse import urlsplit

from starlette.requests import HTTPConnection

from fluoromap_service.auth import is_loopback
from fluoromap_service.problem import Problem
from fluoromap_service.settings import settings

_HOST = re.compile(r"([A-Za-z0-9._-]{1,253}|\[[0-9A-Fa-f:.]{2,45}\])(:\d{1,5})?")
_FORWARDING = frozenset({"forwarded", "via", "x-real-ip"})


def is_forwarded(connection: HTTPConnection) -> bool:
    """Return whether the headers show that a proxy passed the request on.

    RFC 7239 defines Forwarded, RFC 9110 section 7.6.3 Via; the X-Forwarded headers are the custom of proxies.
    """
    return any(name in _FORWARDING or name.startswith("x-forwarded-") for name in connection.headers)


def host_name(connection: HTTPConnection) -> str | None:
    """Return the name in the header Host without its port.

    None when it is no host.
    """
    host = connection.headers.get("host", "")
    try:
        return urlsplit(f"//{host}").hostname if _HOST.fullmatch(host) else None
    except ValueError:
        return None


def check_host(connection: HTTPConnection) -> None:
    """Check that answers may repeat the header Host.

    Raises
    ------
    Problem
        400 ``malformed`` when it is no host; 421 ``unknown_host`` when FLUOROMAP_ALLOWED_HOSTS does not allow it.
    """
    allowed = settings().allowed_host_names
    if "host" not in connection.headers and not allowed:
        # HTTP/1.0: answers name the address that the service listens on.
        return
    name = host_name(connection)
    if name is None:
        raise Problem(400, "malformed", "The header Host is no name or address; correct the client's URL.")
    if allowed and name not in allowed and not is_loopback(name):
        raise Problem(
            421, "unknown_host", "The service does not answer under this name; add it to FLUOROMAP_ALLOWED_HOSTS."
        )
