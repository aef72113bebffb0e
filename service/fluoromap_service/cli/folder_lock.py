"""The lock of a data folder: only one program may run the service on it."""

from __future__ import annotations

import fcntl
import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from fluoromap_service.cli.failures import CommandFailed

NAME = "service.lock"


@contextmanager
def only_one(data_dir: Path) -> Iterator[None]:
    """Hold the lock of a data folder.

    The kernel releases it when this process ends, also when it is killed.

    Raises
    ------
    CommandFailed
        When another program holds it.
    """
    data_dir.mkdir(parents=True, exist_ok=True)
    with (data_dir / NAME).open("a+") as lock:
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            lock.seek(0)
            holder = lock.read().strip() or "unknown"
            raise CommandFailed(
                f"The service runs already on the data folder {data_dir} (process {holder}); stop it, or choose another folder "
                "with --data-dir."
            ) from None
        lock.truncate(0)
        lock.write(str(os.getpid()))
        lock.flush()
        yield
