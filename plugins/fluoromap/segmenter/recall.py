"""Partial results: a run's answers that a context keeps, so that a correction computes few of them again."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeVar

from fluoromap.catheters import Catalogue
from fluoromap.contracts import Context, Run

T = TypeVar("T")

Recall = Callable[[type[T], tuple[object, ...], Callable[[], T]], T]
"""(dataclass, all inputs besides the run and the catalogue, function that computes it) -> partial result."""


def compute_always(kind: type[T], inputs: tuple[object, ...], compute: Callable[[], T]) -> T:
    """Compute a partial result; the :data:`Recall` where nothing is stored."""
    return compute()


def recall_for(run: Run, catalogue: Catalogue, context: Context) -> Recall[Any]:
    """Return :meth:`Context.recall` for partial results of one run.

    A run without a hash of its content has none.
    """
    if run.content is None:
        return compute_always
    # One tuple for all answers: the context computes its hash once.
    shown = (run.content, run.frame_times_ms, run.px_per_mm, run.pixels, run.r_wave_frames, catalogue)
    return lambda kind, inputs, compute: context.recall(kind, (shown, *inputs), compute)
