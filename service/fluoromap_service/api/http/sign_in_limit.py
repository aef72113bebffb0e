"""A limit on failed sign-ins, so that a flood of wrong tokens stays cheap and is seen.

A valid token always passes. So nobody can lock out the people behind the same proxy.
"""

from __future__ import annotations

import math

from fluoromap_service.auth import failures
from fluoromap_service.auth.failures import MOST_FAILURES
from fluoromap_service.problem import Problem


class SignInLimit:
    """The answer to wrong tokens, and their number.

    failures : all failures that this process has seen since its start.
    """

    def __init__(self) -> None:
        self.failures = 0

    def failed(self, address: str) -> None:
        """Count a wrong token of an address.

        Raises
        ------
        Problem
            429 ``too_many_failures`` when too many came from it in the last minute.
        """
        self.failures += 1
        wait_seconds = failures.add(address)
        if wait_seconds is not None:
            raise Problem(
                429,
                "too_many_failures",
                f"More than {MOST_FAILURES} wrong tokens came from this address in a minute; send a valid one, which is let in "
                "at any time.",
                headers={"Retry-After": str(max(math.ceil(wait_seconds), 1))},
            )
