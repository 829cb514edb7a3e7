"""Trials on disk: one line each, as they end, so that a benchmark that was stopped goes on where it was."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Iterator
from dataclasses import asdict
from pathlib import Path
from typing import Any, ClassVar, Protocol, TypeVar, runtime_checkable

from graspmatch.errors import GraspmatchError


@runtime_checkable
class Keyed(Protocol):
    """A dataclass of one trial."""

    __dataclass_fields__: ClassVar[dict[str, Any]]

    @property
    def key(self) -> tuple[str, int]:
        """Of what, and which number."""
        ...


Record = TypeVar("Record", bound=Keyed)


def read_records(path: Path, header: dict[str, Any], kind: Callable[..., Record]) -> list[Record]:
    """The trials of an earlier run with the same settings; none where there is no file.

    Raises `GraspmatchError` where the file was made with other settings. A last line that was cut short is left out.
    """
    if not path.is_file():
        return []
    first, *lines = path.read_text(encoding="utf-8").splitlines() or [""]
    made_with = _parsed(first)
    if made_with != header:
        different = sorted(k for k in {*header, *(made_with or {})} if (made_with or {}).get(k) != header.get(k))
        raise GraspmatchError(
            f"{path} holds trials with other settings ({', '.join(different) or 'no header'}). "
            "Begin anew with --fresh, or write elsewhere with --output."
        )
    try:
        return [kind(**entry) for entry in map(_parsed, lines) if entry is not None]
    except TypeError as error:
        raise GraspmatchError(f"{path} holds trials of another version. Begin anew with --fresh.") from error


def recorded(trials: Iterable[Record], path: Path, header: dict[str, Any], *, done: int) -> Iterator[Record]:
    """Pass trials on and write each down; `done` earlier ones are in the file already."""
    path.parent.mkdir(parents=True, exist_ok=True)
    if not done:
        path.write_text(json.dumps(header) + "\n", encoding="utf-8")
    elif not path.read_bytes().endswith(b"\n"):
        with path.open("a", encoding="utf-8") as file:
            file.write("\n")  # after a line that was cut short
    with path.open("a", encoding="utf-8") as file:
        for trial in trials:
            file.write(json.dumps(asdict(trial)) + "\n")
            file.flush()
            yield trial


def _parsed(line: str) -> dict[str, Any] | None:
    try:
        return json.loads(line)
    except json.JSONDecodeError:
        return None
