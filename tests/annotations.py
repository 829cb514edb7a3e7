"""How the tests execute annotations."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from beartype import BeartypeConf, beartype
from beartype.roar import BeartypeDecorHintNonpepException, BeartypeDecorHintPep673Exception

# An int may stand for a float, as for a type checker.
_check = beartype(conf=BeartypeConf(is_pep484_tower=True))


def checked(function: Callable[..., Any]) -> Callable[..., Any]:
    """The function with its annotations executed at each call."""
    try:
        return _check(function)
    except (BeartypeDecorHintNonpepException, BeartypeDecorHintPep673Exception):
        # A struct of Warp is not a class, and `Self` says nothing about a method that is taken alone.
        return function
