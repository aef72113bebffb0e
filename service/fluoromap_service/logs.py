"""Logs as JSON lines on standard error: events, ids and counts, never a name, a file name or a header's text."""

from __future__ import annotations

import sys

import structlog


def configure() -> None:
    """Set the process's logging up; call it once, before anything is logged."""
    structlog.configure(
        processors=[
            structlog.processors.add_log_level,
            structlog.processors.TimeStamper(fmt="iso", utc=True),
            structlog.processors.format_exc_info,
            structlog.processors.JSONRenderer(),
        ],
        # The process's own: sys.stderr may be somebody's stand-in that is closed later.
        logger_factory=structlog.PrintLoggerFactory(sys.__stderr__),
    )
