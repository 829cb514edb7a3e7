"""The command line: options become a call of the library, errors become one line and an exit status."""

from __future__ import annotations

import json
import os
import select
import sys
import traceback
from collections.abc import Sequence
from typing import Literal, TextIO

import tyro

from graspmatch.apps.options import (
    Bench,
    Command,
    Convert,
    Demo,
    Grippers,
    ListGrippers,
    Parsed,
    Report,
    Simulate,
    View,
)
from graspmatch.errors import GraspmatchError

DESCRIPTION = """Plan 6-DoF grasps for any hand from a mesh or a point cloud.

Exit status: 0 done, 1 a fault of graspmatch, 2 something given cannot be used, 3 no grasp was found, or none held."""

SHORT_FORMS = {"--method": "--matching.method", "--count": "--ranking.count"}
"""Options of the configuration that are used often enough to have a second name."""
SIGPIPE_STATUS = 141
"""Of a program whose output nobody reads to the end: what a shell says of one that SIGPIPE ended."""


def main(argv: Sequence[str] | None = None) -> int:
    """Run one command; the result is the exit status. Options that cannot be parsed leave by SystemExit(2)."""
    try:
        try:
            return run_words(sys.argv[1:] if argv is None else argv)
        finally:
            sys.stdout.flush()
    except BrokenPipeError:  # what reads our output has seen enough of it, as `head` does
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return SIGPIPE_STATUS


def run_words(argv: Sequence[str]) -> int:
    """Run the command of a command line; errors become one line on stderr and an exit status."""
    command = parse(argv)
    try:
        return run(command)
    except GraspmatchError as error:
        return _failed(command, " ".join(str(error).split()), status=2)
    except KeyboardInterrupt:
        return _failed(command, "interrupted", status=130)
    except Exception as error:
        if isinstance(error, BrokenPipeError) and not _is_read(sys.stdout):
            raise
        message = " ".join(f"{type(error).__name__}: {error}".split())
        return _failed(command, f"unexpected {message} (--debug shows where)", status=1)


def parse(argv: Sequence[str]) -> Parsed:
    """The command of a command line."""
    words = _with_listing([_long_form(word) for word in argv])
    options = (tyro.conf.FlagCreatePairsOff, tyro.conf.OmitSubcommandPrefixes, tyro.conf.DisallowNone)
    return tyro.cli(Command, prog="graspmatch", description=DESCRIPTION, args=words, config=options)


def run(command: Parsed) -> int:
    """Do what a command says; the result is the exit status."""
    # Loaded now, not above: asking for help should not wait for them.
    from graspmatch.apps import commands
    from graspmatch.apps.speech import Speech

    if isinstance(command, Grippers):
        if isinstance(command.what, ListGrippers):
            return commands.list_grippers(as_json=command.json)
        from graspmatch.apps.add_gripper import add_gripper

        return add_gripper(command.what, Speech(as_json=command.json, quiet=command.what.quiet))
    say = Speech(as_json=command.json, quiet=command.quiet)
    if isinstance(command, Demo):
        return commands.demo(command.folder, command.config, say)
    if isinstance(command, Simulate):
        from graspmatch.apps.simulation import simulate_file

        return simulate_file(command, parse_table(command.table), say)
    if isinstance(command, Bench):
        from graspmatch.apps.bench.command import bench

        return bench(command, say)
    if isinstance(command, Convert):
        from graspmatch.apps.convert import convert

        return convert(command, say)
    if isinstance(command, View):
        from graspmatch.apps.viewer.command import view

        return view(command, parse_table(command.table), say)
    if isinstance(command, Report):
        from graspmatch.apps.report_page import report

        return report(command, parse_table(command.table), say)
    return commands.plan_command(command, parse_table(command.table), say)


def parse_table(text: str) -> float | Literal["auto"] | None:
    """`auto`, `none`, or a height [m] as `z=0.02` or `0.02`."""
    if text == "auto":
        return "auto"
    if text == "none":
        return None
    try:
        height = float(text.removeprefix("z="))
    except ValueError:
        raise GraspmatchError(
            f"No table '{text}'. Possible: auto, none, or a height in the unit of the input, as z=0.02."
        ) from None
    if not abs(height) < float("inf"):
        raise GraspmatchError(f"The table's height is '{text}'; it must be a finite number.")
    return height


def _with_listing(words: list[str]) -> list[str]:
    """`grippers` alone, or with options only, lists them."""
    is_bare = words[:1] == ["grippers"] and all(word.startswith("-") for word in words[1:])
    asks_help = "-h" in words or "--help" in words
    return ["grippers", "list", *words[1:]] if is_bare and not asks_help else words


def _long_form(word: str) -> str:
    """An option by its full name."""
    name, equals, value = word.partition("=")
    return SHORT_FORMS.get(name, name) + equals + value


def _is_read(stream: TextIO) -> bool:
    """Whether somebody is at the other end of it, as far as the system can tell."""
    if not hasattr(select, "poll"):
        return False
    poll = select.poll()
    poll.register(stream, 0)
    return not any(event & (select.POLLERR | select.POLLHUP) for _, event in poll.poll(0))


def _failed(command: Parsed, message: str, *, status: int) -> int:
    """Say in one line what went wrong."""
    if command.debug:
        traceback.print_exc()
    print(f"error: {message}", file=sys.stderr)
    if command.json:
        print(json.dumps({"error": message}))
    return status


if __name__ == "__main__":
    sys.exit(main())
