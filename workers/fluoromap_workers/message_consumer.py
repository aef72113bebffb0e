"""The consumer of a worker's messages, which survives a message that is no message."""

from __future__ import annotations

from typing import Any

import structlog
from celery.worker.consumer import Consumer

log = structlog.get_logger(__name__)

_UNREADABLE = (ValueError, LookupError, TypeError, AttributeError)
"""The errors of Celery and kombu when a message is no JSON, or is JSON of another form."""


class MessageConsumer(Consumer):  # type: ignore[misc]
    """A consumer that drops an unreadable message and connects again.

    Celery would end the worker. The broker has handed the message out, so it does not come again. If it announced a stage, the
    service announces that stage again.
    """

    loop: Any

    def __init__(self, *arguments: Any, **options: Any) -> None:
        super().__init__(*arguments, **options)
        consume = self.loop

        def loop(*state: Any) -> Any:
            try:
                return consume(*state)
            except _UNREADABLE as error:
                log.warning("message_dropped", error=type(error).__name__)
                raise self.connection_errors[0]("a message could not be read") from error

        self.loop = loop
