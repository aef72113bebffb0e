"""The connection of a running stage to its worker, and the two ways in which a stage ends early."""

from __future__ import annotations

from collections.abc import Callable
from typing import Protocol, TypeVar

from fluoromap.reasons import Reason

T = TypeVar("T")


class StageStopped(Exception):
    """Raised by :meth:`Context.check` when the job was cancelled or taken over.

    A stage must not catch it.
    """


class Refusal(Exception):
    """Raised by a stage when the data cannot support a result.

    ``reason`` is the code; the message describes the remedy to the user.
    """

    def __init__(self, reason: Reason, message: str | None = None) -> None:
        super().__init__(message or reason.sentence)
        self.reason = reason


class Context(Protocol):
    """The connection of a running stage to its worker."""

    def progress(self, fraction: float) -> None:
        """Report the finished share of the work, 0 to 1.

        Frequent calls are cheap.
        """

    def check(self) -> None:
        """Raise :class:`StageStopped` when the work is no longer wanted."""

    def recall(self, kind: type[T], inputs: tuple[object, ...], compute: Callable[[], T]) -> T:
        """Return a partial result from an earlier job of the study, or compute it.

        A correction changes one run. With this method a stage computes again only the parts that depend on that run.

        Parameters
        ----------
        kind : type
            Dataclass of the partial result: numbers, strings, enums, arrays, tuples and dataclasses of them.
        inputs : tuple
            Everything that the partial result depends on, besides the plugin, its version and its parameters. A dataclass counts
            with all its fields.
        compute : callable
            Computes the partial result.
        """


class Silent:
    """A :class:`Context` for notebooks and tests: it reports nothing, never stops and remembers nothing."""

    def progress(self, fraction: float) -> None:
        pass

    def check(self) -> None:
        pass

    def recall(self, kind: type[T], inputs: tuple[object, ...], compute: Callable[[], T]) -> T:
        return compute()
