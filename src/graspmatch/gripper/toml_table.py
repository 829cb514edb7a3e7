"""Reading a TOML file that people write: each mistake is told with its file, its place and what would be right."""

from __future__ import annotations

import difflib
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from graspmatch.errors import GraspmatchError


def unknown(what: str, name: str, known: Iterable[str]) -> str:
    """The sentence for a name that does not exist: what is known, and the nearest of it."""
    names = list(known)
    near = difflib.get_close_matches(name, names, n=1)
    hint = f" Did you mean '{near[0]}'?" if near else ""
    return f"no {what} '{name}'.{hint} Known: {', '.join(names) or 'none'}."


@dataclass(frozen=True)
class Table:
    """A TOML table that knows where it is, so that its errors do."""

    path: Path
    place: str
    values: dict[str, Any]

    def error(self, key: str, problem: str) -> GraspmatchError:
        """The error to raise about a key."""
        return GraspmatchError(f"{self.path}: {self._place(key)} {problem}")

    def only(self, keys: Iterable[str]) -> None:
        """Refuse keys that have no meaning."""
        known = sorted(keys)
        for key in self.values:
            if key not in known:
                raise GraspmatchError(f"{self.path}: {self.place or 'the card'} has {unknown('key', key, known)}")

    def string(self, key: str, default: str | None = None) -> str:
        """Text that is not empty."""
        return self._get(key, default, "text", lambda v: isinstance(v, str) and v != "")

    def strings(self, key: str) -> tuple[str, ...]:
        """A list of names, possibly empty."""
        is_list = lambda v: isinstance(v, list) and all(isinstance(x, str) for x in v)  # noqa: E731
        return tuple(self._get(key, None, "a list of names", is_list))

    def number(self, key: str, default: float | None = None) -> float:
        """A finite number."""
        return float(self._get(key, default, "a finite number", _is_number))

    def positive(self, key: str, default: float | None = None) -> float:
        """A number above zero."""
        return float(self._get(key, default, "a number above zero", lambda v: _is_number(v) and v > 0))

    def boolean(self, key: str, default: bool | None = None) -> bool:
        """True or false."""
        return self._get(key, default, "true or false", lambda v: isinstance(v, bool))

    def numbers(self, key: str, length: int | None, default: list[float] | None = None) -> tuple[float, ...]:
        """A list of `length` numbers, or of any number but none where `length` is None."""
        what = "a list of numbers" if length is None else f"a list of {length} numbers"
        fits = lambda v: isinstance(v, list) and all(map(_is_number, v)) and len(v) == (length or len(v) or 1)  # noqa: E731
        return tuple(float(x) for x in self._get(key, default, what, fits))

    def table(self, key: str) -> Table:
        """The table under a key, empty where there is none."""
        return Table(self.path, self._place(key), self._get(key, {}, "a table", lambda v: isinstance(v, dict)))

    def tables(self, key: str, default: dict | None = None) -> dict[str, Table]:
        """The tables under a key, by their names."""
        values = self._get(key, default, "a table", lambda v: isinstance(v, dict))
        places = {name: f"{key}.{name}" for name in values}
        return {n: Table(self.path, self._place(places[n]), self._as_table(places[n], v)) for n, v in values.items()}

    def list_of_tables(self, key: str) -> list[Table]:
        """The tables of [[key]], none where there are none."""
        values = self._get(key, [], f"a list of tables, as [[{key}]]", lambda v: isinstance(v, list))
        return [Table(self.path, f"{self._place(key)}[{i}]", self._as_table(key, v)) for i, v in enumerate(values)]

    def _as_table(self, key: str, value: object) -> dict[str, Any]:
        if not isinstance(value, dict):
            raise self.error(key, f"is {value!r}; it must be a table")
        return value

    def _place(self, key: str) -> str:
        return f"{self.place}.{key}" if self.place else key

    def _get(self, key: str, default: Any, what: str, fits: Any) -> Any:
        value = self.values.get(key, default)
        if value is None:
            raise self.error(key, f"is missing; it must be {what}")
        if not fits(value):
            raise self.error(key, f"is {value!r}; it must be {what}")
        return value


def _is_number(value: object) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and bool(np.isfinite(value))
