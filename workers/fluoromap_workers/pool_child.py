"""What a pool child does before its first stage."""

from __future__ import annotations

import resource

import structlog

from fluoromap.registry import DEFAULTS, UnknownPlugin, plugin, plugins
from fluoromap_service.settings import settings

log = structlog.get_logger(__name__)


def limit_memory() -> None:
    """Bound the address space, so that a runaway stage fails alone instead of taking the machine down."""
    limit = settings().worker_memory_mib * 2**20
    hard = resource.getrlimit(resource.RLIMIT_AS)[1]
    resource.setrlimit(resource.RLIMIT_AS, (limit if hard == resource.RLIM_INFINITY else min(limit, hard), hard))


def warm_up() -> None:
    """Load the plugins and let the default ones compile their kernels, so that the first run does not wait for it.

    A plugin that has something to prepare has a class method ``warm_up()``; one that fails is told in the log, and its
    stage will tell the user.
    """
    for row in plugins():
        if row.error is not None:
            log.warning("plugin_broken", kind=row.kind, plugin=row.name)
    for kind, name in DEFAULTS.items():
        try:
            prepare = getattr(plugin(kind, name).stage, "warm_up", None)
            if prepare is not None:
                prepare()
        except UnknownPlugin:
            log.warning("plugin_missing", kind=kind, plugin=name)
        except Exception:
            log.warning("plugin_not_warm", kind=kind, plugin=name, exc_info=True)
