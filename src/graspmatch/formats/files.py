"""Reading files that anyone may have made, and writing files so that a reader never sees half of one."""

from __future__ import annotations

import os
import secrets
from collections.abc import Callable
from pathlib import Path

from graspmatch.errors import GraspmatchError

MOST_BYTES = 256 * 2**20
"""No file of grasps is larger; what is, is something else, or made to fill the memory."""
MOST_GRASPS = 1_000_000

SIGNATURES = {b"\x93NUMPY": ".npy", b"PK\x03\x04": ".npz", b"\x89HDF\r\n\x1a\n": ".h5"}
"""First bytes of the binary formats."""


def check_readable(path: Path, *, most_bytes: int = MOST_BYTES) -> None:
    """Refuse what is not there, is no file, or is too large to be grasps."""
    try:
        size = path.stat().st_size
    except (OSError, ValueError) as error:  # a name with a zero byte is a ValueError
        raise GraspmatchError(f"Cannot read {path}: {getattr(error, 'strerror', None) or error}.") from error
    if not path.is_file():
        raise GraspmatchError(f"Cannot read {path}: it is a folder or a device, not a file.")
    if size > most_bytes:
        raise GraspmatchError(
            f"Cannot read {path}: it has {size / 2**20:.0f} MiB, a file of grasps of this format at most "
            f"{most_bytes / 2**20:.0f} MiB."
        )
    try:
        path.open("rb").close()
    except OSError as error:
        raise GraspmatchError(f"Cannot read {path}: {error.strerror or error}.") from error


def read_text(path: Path, *, most_bytes: int = MOST_BYTES) -> str:
    """The text of a file in UTF-8."""
    check_readable(path, most_bytes=most_bytes)
    try:
        return path.read_text(encoding="utf-8-sig")
    except UnicodeDecodeError as error:
        raise GraspmatchError(f"{path} is no text in UTF-8 ({one_line(error)}){disguise(path)}.") from error


def disguise(path: Path) -> str:
    """What the first bytes say where the suffix says something else; empty where they agree or say nothing."""
    with path.open("rb") as file:
        start = file.read(8)
    found = next((suffix for signature, suffix in SIGNATURES.items() if start.startswith(signature)), None)
    return f"; its content is that of a {found} file" if found not in (None, path.suffix.lower()) else ""


def one_line(error: BaseException) -> str:
    """The message of an error without line breaks, and no longer than is of use."""
    text = " ".join(f"{type(error).__name__}: {error}".split())
    return text if len(text) <= 200 else f"{text[:197]}..."


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
