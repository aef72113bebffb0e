"""Logs as JSON lines on standard error: events, ids and counts, no names, file names or header texts."""

from __future__ import annotations

import sys

import structlog


def configure() -> None:
    """Set up the logging of this process.

    Call it once, before the first log line.
    """
    structlog.configure(
        processors=[
            structlog.processors.add_log_level,
            structlog.processors.TimeStamper(fmt="iso", utc=True),
            structlog.processors.format_exc_info,
            structlog.processors.JSONRenderer(),
        ],
        # Not sys.stderr: a test may replace it and close the replacement.
        logger_factory=structlog.PrintLoggerFactory(sys.__stderr__),
    )
