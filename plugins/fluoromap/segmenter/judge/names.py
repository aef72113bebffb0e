"""Names: the probability of each catheter of the catalogue for each chain of a frame."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from fluoromap.contracts import Array
from fluoromap.segmenter.chains.families import CatheterFamily


def kind_probabilities(
    log_likelihoods: Array, families: Sequence[CatheterFamily]
) -> tuple[tuple[tuple[str, float], ...], ...]:
    """Return the probability of each catheter for each chain of one frame.

    Each catheter has at most one chain.

    Parameters
    ----------
    log_likelihoods : (chains, families)
        How well each chain fits each family; -inf where it cannot belong to it.
    families : sequence of CatheterFamily

    Returns
    -------
    tuple
        One ``kinds`` for each chain as in :class:`~fluoromap.contracts.Chain`: probabilities over all assignments that the
        catalogue allows. Look-alikes share their probability equally.
    """
    chains, count = log_likelihoods.shape
    marginal = np.zeros((chains, count))
    relative = np.exp(log_likelihoods - log_likelihoods.max(axis=1, keepdims=True))

    def assign(chain: int, left: list[int], weight: float, taken: tuple[int, ...]) -> None:
        if weight <= 0:
            return
        if chain == chains:
            for index, family in enumerate(taken):
                marginal[index, family] += weight
            return
        for family in range(count):
            if left[family]:
                # Each free look-alike is one more way to assign this family.
                left[family] -= 1
                assign(chain + 1, left, weight * relative[chain, family] * (left[family] + 1), (*taken, family))
                left[family] += 1

    assign(0, [len(family.names) for family in families], 1.0, ())
    marginal /= np.maximum(marginal.sum(axis=1, keepdims=True), math.ulp(0.0))
    return tuple(
        tuple(
            (name, float(row[index]) / len(family.names))
            for index, family in enumerate(families)
            for name in family.names
            if row[index] > 1e-6
        )
        for row in marginal
    )
