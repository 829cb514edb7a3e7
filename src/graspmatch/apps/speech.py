"""What commands say to people, and where it goes."""

from __future__ import annotations

import contextlib
import sys
from collections.abc import Callable, Iterator
from dataclasses import dataclass

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn


class PipeConsole(Console):
    """A console that leaves a closed pipe to its caller, not to a status of its own."""

    def on_broken_pipe(self) -> None:
        raise  # called where the error is handled


@dataclass(frozen=True)
class Speech:
    """Where text for people goes: to stdout, to stderr where stdout is for JSON, or nowhere."""

    as_json: bool = False
    quiet: bool = False

    def show(self, what: object) -> None:
        """Print text or a table."""
        stream = sys.stderr if self.as_json else sys.stdout
        # A log file has room for whole tables; a terminal knows its own width.
        console = PipeConsole(file=stream, quiet=self.quiet, width=None if stream.isatty() else 140)
        console.print(what, highlight=False, markup=False, soft_wrap=isinstance(what, str))

    @property
    def is_watched(self) -> bool:
        """Whether someone is looking at progress."""
        return not self.quiet and Console(stderr=True).is_terminal

    @contextlib.contextmanager
    def progress(self, message: str, total: int | None = None) -> Iterator[Callable[[], None]]:
        """Show a bar while something runs, if someone is looking; what it prints goes to stderr.

        Yields what to call after each of `total` steps; without a number of steps the bar only shows that work goes on.
        """
        known = () if total is None else (MofNCompleteColumn(), TimeRemainingColumn())
        columns = (TextColumn("{task.description}"), BarColumn(), *known, TimeElapsedColumn())
        bar = Progress(*columns, console=Console(stderr=True), disable=not self.is_watched, transient=True)
        with bar, contextlib.redirect_stdout(sys.stderr):
            task = bar.add_task(message, total=total)
            yield lambda: bar.advance(task)
