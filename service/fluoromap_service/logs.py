"""Logs as JSON lines on standard error: events, ids and counts, no names, file names or header texts."""

from __future__ import annotations

import json
import logging
import sys
from datetime import UTC, datetime

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
    handler = logging.StreamHandler(sys.__stderr__)
    handler.setFormatter(_JsonFormatter())
    logging.basicConfig(handlers=[handler], level=logging.WARNING, force=True)


class _JsonFormatter(logging.Formatter):
    """Lines of libraries in the form of our own."""

    def format(self, record: logging.LogRecord) -> str:
        line = {"event": "library", "logger": record.name, "level": record.levelname.lower()}
        line |= {"message": record.getMessage(), "timestamp": datetime.fromtimestamp(record.created, UTC).isoformat()}
        if record.exc_info:
            line["exception"] = self.formatException(record.exc_info)
        return json.dumps(line)
