"""Progress bars on the terminal."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager

from rich.console import Console
from rich.progress import BarColumn, Progress, SpinnerColumn, TaskProgressColumn, TextColumn, TimeElapsedColumn

from fluoromap.contracts import Silent


@contextmanager
def progress_bars(console: Console) -> Iterator[Progress]:
    """Show the progress bars of one command.

    Without a terminal, rich draws only the finished bars, at the end.
    """
    columns = (
        SpinnerColumn(), TextColumn("{task.description:<16}"), BarColumn(), TaskProgressColumn(), TimeElapsedColumn(),
    )  # fmt: skip
    with Progress(*columns, console=console) as progress:
        yield progress


class BarContext(Silent):
    """A :class:`~fluoromap.contracts.Context` that moves a progress bar and never stops the work.

    Parameters
    ----------
    move : callable
        Receives the part of the work that is done, 0 to 1.
    """

    def __init__(self, move: Callable[[float], None]) -> None:
        self._move = move

    def progress(self, fraction: float) -> None:
        """Move the bar to a fraction from 0 to 1."""
        self._move(fraction)


@contextmanager
def one_bar(title: str) -> Iterator[BarContext]:
    """Show one bar on standard error.

    So standard output holds the results alone.
    """
    with progress_bars(Console(stderr=True)) as progress:
        bar = progress.add_task(title, total=1.0)
        yield BarContext(lambda fraction: progress.update(bar, completed=fraction))
