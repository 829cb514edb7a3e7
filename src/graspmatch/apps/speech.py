"""What commands say to people, and where it goes."""

from __future__ import annotations

import contextlib
import sys
from collections.abc import Iterator
from dataclasses import dataclass

from rich.console import Console


@dataclass(frozen=True)
class Speech:
    """Where text for people goes: to stdout, to stderr where stdout is for JSON, or nowhere."""

    as_json: bool = False
    quiet: bool = False

    def show(self, what: object) -> None:
        """Print text or a table."""
        stream = sys.stderr if self.as_json else sys.stdout
        # A log file has room for whole tables; a terminal knows its own width.
        console = Console(file=stream, quiet=self.quiet, width=None if stream.isatty() else 140)
        console.print(what, highlight=False, markup=False, soft_wrap=isinstance(what, str))

    @property
    def is_watched(self) -> bool:
        """Whether someone is looking at progress."""
        return not self.quiet and Console(stderr=True).is_terminal

    @contextlib.contextmanager
    def progress(self, message: str) -> Iterator[None]:
        """Show one line while something runs, if someone is looking; what it prints goes to stderr."""
        console = Console(stderr=True, quiet=self.quiet)
        status = console.status(message) if self.is_watched else contextlib.nullcontext()
        with status, contextlib.redirect_stdout(sys.stderr):
            yield
