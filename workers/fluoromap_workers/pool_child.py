"""The preparation of a pool child before its first stage."""

from __future__ import annotations

import resource

import structlog

from fluoromap.registry import DEFAULTS, UnknownPlugin, plugin, plugins
from fluoromap_service.settings import settings

log = structlog.get_logger(__name__)


def limit_memory() -> None:
    """Bound the address space, so that a stage that grows without end fails alone."""
    limit = settings().worker_memory_mib * 2**20
    hard = resource.getrlimit(resource.RLIMIT_AS)[1]
    resource.setrlimit(resource.RLIMIT_AS, (limit if hard == resource.RLIM_INFINITY else min(limit, hard), hard))


def warm_up() -> None:
    """Load the plugins and compile the kernels of the default ones.

    So the first run does not wait. A plugin may offer a class method ``warm_up()``. A failure there is logged; later the
    stage reports it to the user.
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
