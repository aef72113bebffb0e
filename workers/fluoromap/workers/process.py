"""What a pool child does before its first stage."""

from __future__ import annotations

import resource

import numpy as np
import structlog

from fluoromap.catheters import DEFAULT_CATALOGUE
from fluoromap.contracts import PixelFacts, Run, Silent
from fluoromap.registry import DEFAULTS, UnknownPlugin, build_segmenter, plugins
from fluoromap.settings import settings

log = structlog.get_logger(__name__)


class _Blank:
    """Two frames of nothing, to compile the kernels on."""

    shape = (64, 64)

    def __len__(self) -> int:
        return 2

    def __getitem__(self, index: int) -> np.ndarray:
        if not 0 <= index < 2:
            raise IndexError(index)
        return np.random.default_rng(index).integers(900, 1100, self.shape).astype(np.uint16)

    def __iter__(self):  # type: ignore[no-untyped-def]
        return (self[index] for index in range(2))


def limit_memory() -> None:
    """Bound the address space, so that a runaway stage fails alone instead of taking the machine down."""
    limit = settings().worker_memory_mib * 2**20
    hard = resource.getrlimit(resource.RLIMIT_AS)[1]
    resource.setrlimit(resource.RLIMIT_AS, (limit if hard == resource.RLIM_INFINITY else min(limit, hard), hard))


def warm_up() -> None:
    """Load the plugins and let the default segmenter compile its kernels, so that the first run does not wait for it."""
    for row in plugins():
        if row.error is not None:
            log.warning("plugin_broken", kind=row.kind, plugin=row.name)
    run = Run(_Blank(), np.array([0.0, 66.7]), 5.75, PixelFacts(False, 12, False))
    try:
        build_segmenter(DEFAULTS["segmenter"], {}).segment(run, DEFAULT_CATALOGUE, {}, Silent())
    except UnknownPlugin:
        log.warning("plugin_missing", plugin=DEFAULTS["segmenter"])
