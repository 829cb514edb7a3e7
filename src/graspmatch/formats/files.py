"""Writing files so that a reader never sees half of one."""

from __future__ import annotations

import os
import secrets
from collections.abc import Callable
from pathlib import Path

from graspmatch.errors import GraspmatchError


def write_atomically(path: Path, write: Callable[[Path], object]) -> None:
    """Let `write` fill a temporary file in the same folder, then move it to `path`; a failure leaves nothing behind."""
    # The suffix stays last: some writers choose their format by it.
    temporary = path.with_name(f".{path.stem}-{secrets.token_hex(4)}{path.suffix}")
    try:
        write(temporary)
        os.replace(temporary, path)
    except OSError as error:
        raise GraspmatchError(f"Cannot write {path}: {_reason(path, error)}.") from error
    finally:
        if temporary.exists():
            temporary.unlink()


def check_place(path: Path) -> None:
    """Refuse a path that can be seen not to be writable before anything is computed for it."""
    if path.is_dir() or not path.parent.is_dir():
        raise GraspmatchError(f"Cannot write {path}: {_reason(path, OSError())}.")
    if not os.access(path.parent, os.W_OK):
        raise GraspmatchError(f"Cannot write {path}: nothing may be written to the folder {path.parent.absolute()}.")


def _reason(path: Path, error: OSError) -> str:
    """What is in the way, in the user's words."""
    if path.is_dir():
        return "it is a folder; give the name of a file"
    if not path.parent.is_dir():
        return f"there is no folder {path.parent}; make it first"
    return error.strerror or str(error)
