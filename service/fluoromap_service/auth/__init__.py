"""Who may use the service: access tokens, sessions of browsers, and the callers that they belong to."""

from fluoromap_service.auth.addresses import is_loopback
from fluoromap_service.auth.callers import Callers, Credential
from fluoromap_service.auth.tokens import (
    OPEN,
    SHORTEST_TOKEN,
    Caller,
    Scope,
    TokenInfo,
    any_token,
    check_first_token,
    check_may_start,
    create_token,
    list_tokens,
    revoke_token,
    token_hash,
    verify,
)

__all__ = [
    "OPEN",
    "SHORTEST_TOKEN",
    "Caller",
    "Callers",
    "Credential",
    "Scope",
    "TokenInfo",
    "any_token",
    "check_first_token",
    "check_may_start",
    "create_token",
    "is_loopback",
    "list_tokens",
    "revoke_token",
    "token_hash",
    "verify",
]
