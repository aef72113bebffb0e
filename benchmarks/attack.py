"""Attack a running service: ``python benchmarks/attack.py``, or ``--short`` for what fits into a minute.

It starts a private service on a loopback address and tries the attacks of ``hostile_requests.py``: readers who want to stop it,
strangers, damage, holes in the audit trail, hostile targets, and code in the current folder. For each it prints the name,
whether it held, the attempt and the observation. Exit code 1 when an
attack did not hold. ``--only NAME`` tries one. The supply of packages has no attack here: ``tests/test_release.py`` and
``tests/integration/test_tls.py`` hold it.
"""

from __future__ import annotations

import argparse
import sys
import time

import httpx
from attacked_service import LONGEST_SECONDS, AttackedService, Broken, attacked_service
from hostile_requests import ATTACKS, Attack


def main() -> int:
    """Run the campaign and print its result."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--short", action="store_true", help="Leave out the attacks that take long.")
    parser.add_argument(
        "--only", action="append", choices=ATTACKS, metavar="NAME", help="Try only this attack; repeatable."
    )
    options = parser.parse_args()
    chosen = [
        each
        for each in ATTACKS.values()
        if each.name in (options.only or ATTACKS) and (each.short or not options.short)
    ]
    start = time.monotonic()
    with attacked_service() as service:
        held = [_try(attack, service) for attack in chosen]
    print(f"{sum(held)} of {len(held)} attacks held, in {time.monotonic() - start:.0f} s")
    return int(not all(held))


def _try(attack: Attack, service: AttackedService) -> bool:
    start = time.monotonic()
    try:
        held, seen = True, attack.run(service)
    except Broken as broken:
        held, seen = False, str(broken)
    except httpx.TimeoutException:
        held, seen = False, f"no answer within {LONGEST_SECONDS:g} s"
    except Exception as error:
        # An attack that cannot be carried out shows nothing about its defence.
        held, seen = False, f"not carried out: {type(error).__name__}: {error}"
    seconds = time.monotonic() - start
    if service.revive():
        held, seen = False, f"{seen}; the API did not live on and was started again"
    print(
        f"{'held  ' if held else 'FAILED'} {attack.name} ({seconds:.1f} s)\n  tried: {attack.tried}\n  seen:  {seen}",
        flush=True,
    )
    return held


if __name__ == "__main__":
    sys.exit(main())
