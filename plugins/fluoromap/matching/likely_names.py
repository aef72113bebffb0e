"""Catheter names of the chains of one frame, before or beside matching."""

from __future__ import annotations

from collections.abc import Sequence

from fluoromap.contracts import Chain


def likely_names(chains: Sequence[Chain], names: Sequence[str | None] = ()) -> list[str | None]:
    """Return a catheter for each chain, none twice.

    Parameters
    ----------
    chains : sequence of Chain
        Of one frame.
    names : sequence of str or None, optional
        The names that are known already, one for each chain; the other chains get their most probable kind.

    Returns
    -------
    list of str or None
        None where no kind is left.
    """
    chosen = list(names) or [None] * len(chains)
    likely = sorted(
        ((probability, index, name) for index, chain in enumerate(chains) for name, probability in chain.kinds),
        key=lambda item: (-item[0], item[1]),
    )
    for _, index, name in likely:
        if chosen[index] is None and name not in chosen:
            chosen[index] = name
    return chosen
