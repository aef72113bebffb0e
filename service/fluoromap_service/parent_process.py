"""The bond between a process and its parent: the process ends when the parent does."""

from __future__ import annotations

import ctypes
import os
import signal
import sys

_PR_SET_PDEATHSIG = 1
"""From <sys/prctl.h>."""


def end_with_parent(parent: int) -> None:
    """Let the kernel kill this process as soon as its parent has ended.

    A parent that is killed cannot stop its children. Without this they would go on and hold their port and their locks. The
    kernel kills also a child that hangs. It does nothing on systems other than Linux.

    Parameters
    ----------
    parent : int
        Process id of the parent. This process exits at once when it has another parent already.
    """
    if not sys.platform.startswith("linux"):
        return
    ctypes.CDLL(None, use_errno=True).prctl(_PR_SET_PDEATHSIG, signal.SIGKILL, 0, 0, 0)
    # The parent may have ended before the call.
    if os.getppid() != parent:
        os._exit(1)
