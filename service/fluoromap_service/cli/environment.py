"""The environment variables that a command sets for its own process and for its children."""

from __future__ import annotations

import os
import sys
from pathlib import Path

from fluoromap_service.parent_process import end_with_parent
from fluoromap_service.settings import settings

THREAD_LIMITS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "NUMBA_NUM_THREADS")

SUPERVISOR = "FLUOROMAP_SUPERVISOR"
"""Variable with the process id of the supervisor that started this program."""


def end_with_supervisor() -> None:
    """Let this process end when its supervisor has ended.

    Without a supervisor do nothing.
    """
    supervisor = os.environ.pop(SUPERVISOR, None)
    if supervisor is not None:
        end_with_parent(int(supervisor))


def use_safe_paths() -> None:
    """Keep the current folder out of the import paths of child processes.

    Python adds that folder when it starts a child of :mod:`multiprocessing` or a module (``-m``). So a file ``numpy.py`` among
    downloaded runs would become part of the program. An empty entry of ``PYTHONPATH`` means the same folder. A folder that the
    user names there stays.

    References
    ----------
    Python documentation, "Command line and environment", ``PYTHONSAFEPATH``.
    """
    os.environ["PYTHONSAFEPATH"] = "1"
    given = os.environ.pop("PYTHONPATH", "").split(os.pathsep)
    named = [entry for entry in given if entry]
    if named:
        os.environ["PYTHONPATH"] = os.pathsep.join(named)
    if "" in given:
        # Python has made the entries of the variable absolute.
        unnamed = {"", os.path.abspath("")} - set(map(os.path.abspath, named))
        sys.path[:] = [entry for entry in sys.path if entry not in unnamed]


def limit_threads() -> None:
    """Limit the numerical libraries to one thread for each process.

    NumPy and numba read these variables once, at import: call it before. A value that the user has set stays.
    """
    # A worker already runs one process for each processor. More threads would only compete.
    for name in THREAD_LIMITS:
        os.environ.setdefault(name, "1")


def apply_options(host: str | None = None, port: int | None = None, data_dir: Path | None = None) -> None:
    """Store the options of a command as environment variables.

    The settings of this process and of its children come from there. None leaves a setting unchanged.
    """
    apply_settings(host=host, port=port, data_dir=data_dir)


def apply_settings(**values: object) -> None:
    """Store settings by their names as environment variables; None leaves a setting unchanged."""
    for name, value in values.items():
        if value is not None:
            os.environ[f"FLUOROMAP_{name.upper()}"] = str(value)
    settings.cache_clear()


def keep_compiled_kernels() -> None:
    """Let numba keep compiled kernels in the data folder.

    numba reads this variable once, at import: a module that calls it must not import numba itself.
    """
    # The folder of the installed package may be read-only. The data folder is writable.
    os.environ.setdefault("NUMBA_CACHE_DIR", str(settings().data_dir.resolve() / "numba"))
