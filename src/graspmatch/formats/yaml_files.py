"""YAML that anyone may have made: plain data only, of a depth and size that grasps have."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from graspmatch.errors import GraspmatchError
from graspmatch.formats.files import one_line, read_text, write_atomically

MOST_BYTES = 64 * 2**20
DEEPEST = 24
"""Levels of nesting; a grasp has up to seven."""


def read_yaml(path: Path) -> list[Any]:
    """The documents of a file, made of dicts, lists, texts and numbers."""
    import yaml

    text = read_text(path, most_bytes=MOST_BYTES)
    loader = getattr(yaml, "CSafeLoader", yaml.SafeLoader)
    try:
        _check_shape(text, loader)
        return list(yaml.load_all(text, Loader=loader))
    except Exception as error:  # not only YAMLError: a date of the 99th is a ValueError, long numbers are others
        reason = one_line(error).replace(' in "<unicode string>",', " in")
        raise GraspmatchError(f"{path} is not YAML that holds grasps: {reason}.") from error


def write_yaml(document: object, path: Path) -> None:
    """Write one document, short lists and mappings on one line."""
    import yaml

    dumper = getattr(yaml, "CSafeDumper", yaml.SafeDumper)
    text = yaml.dump(document, Dumper=dumper, sort_keys=False, default_flow_style=None, width=120, allow_unicode=True)
    write_atomically(path, lambda temporary: temporary.write_text(text, encoding="utf-8"))


def _check_shape(text: str, loader: type) -> None:
    """Refuse aliases and deep nesting before anything is built.

    Aliases to aliases grow without bound when they are merged, and the C loader descends by recursion until it crashes.
    Both are seen in the stream of events, which needs no memory.
    """
    import yaml

    depth = 0
    for event in yaml.parse(text, Loader=loader):
        if isinstance(event, yaml.AliasEvent):
            raise ValueError(f"line {event.start_mark.line + 1} has an alias, *{event.anchor}; write it out")
        if isinstance(event, yaml.CollectionStartEvent):
            depth += 1
        elif isinstance(event, yaml.CollectionEndEvent):
            depth -= 1
        if depth > DEEPEST:
            raise ValueError(f"line {event.start_mark.line + 1} is nested more than {DEEPEST} levels deep")
