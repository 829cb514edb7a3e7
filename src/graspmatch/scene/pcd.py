"""The Point Cloud Library's PCD files: ascii, binary and binary_compressed."""

from __future__ import annotations

import io
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float, Shaped

from graspmatch.types import GraspmatchError

Array = np.ndarray

REQUIRED = ("FIELDS", "SIZE", "TYPE", "WIDTH", "HEIGHT", "DATA")


@dataclass(frozen=True)
class Pcd:
    """All fields of a PCD file, row by row; points without a return are NaN, as in the file."""

    fields: dict[str, Shaped[Array, "n ..."]]
    """Columns by name; fields with COUNT c are (n, c). `rgb` and `label` are as stored."""
    width: int
    height: int
    """Above one for an organised cloud: point (row, column) has index row * width + column."""
    viewpoint: Float[Array, "3"] | None
    """Position of the sensor [unit of the file], None where the header has none."""

    def columns(self, *names: str) -> Float[Array, "n c"] | None:
        """The named fields side by side, None unless all are there."""
        if any(name not in self.fields for name in names):
            return None
        return np.stack([self.fields[name].astype(np.float64) for name in names], axis=-1)

    @property
    def points(self) -> Float[Array, "n 3"]:
        """Fields x, y and z [unit of the file]."""
        points = self.columns("x", "y", "z")
        assert points is not None  # read_pcd has checked
        return points

    @property
    def normals(self) -> Float[Array, "n 3"] | None:
        """Fields normal_x, normal_y and normal_z, if all are there."""
        return self.columns("normal_x", "normal_y", "normal_z")


def read_pcd(path: Path) -> Pcd:
    """Read a PCD file of any of the three encodings."""
    raw = path.read_bytes()
    try:
        header, body = _header(raw)
        layout = _layout(header)
        count = int(header["WIDTH"][0]) * int(header["HEIGHT"][0])
        decode = {"ascii": _ascii, "binary": _binary, "binary_compressed": _compressed}[header["DATA"][0]]
        fields = decode(body, layout, count)
        viewpoint = np.array(header["VIEWPOINT"][:3], dtype=np.float64) if "VIEWPOINT" in header else None
    except KeyError as error:
        raise GraspmatchError(
            f"{path.name}: unknown PCD encoding or type {error}. "
            "Known: ascii, binary, binary_compressed; types I, U, F."
        ) from error
    except (ValueError, IndexError) as error:
        raise GraspmatchError(f"{path.name} is not a readable PCD file: {error}.") from error
    if not {"x", "y", "z"} <= set(fields):
        raise GraspmatchError(f"{path.name} has no fields x, y and z. Its fields: {', '.join(fields)}.")
    return Pcd(fields, int(header["WIDTH"][0]), int(header["HEIGHT"][0]), viewpoint)


def _header(raw: bytes) -> tuple[dict[str, list[str]], bytes]:
    """The lines of the header as words by keyword, and all that follows the DATA line."""
    header: dict[str, list[str]] = {}
    start = 0
    while "DATA" not in header:
        end = raw.find(b"\n", start)
        if end < 0:
            raise ValueError("the header has no DATA line")
        words = raw[start:end].decode("ascii", errors="replace").split()
        if words and not words[0].startswith("#"):
            header[words[0]] = words[1:]
        start = end + 1
    missing = [key for key in REQUIRED if not header.get(key)]
    if missing:
        raise ValueError(f"the header has no {', '.join(missing)}")
    return header, raw[start:]


def _layout(header: dict[str, list[str]]) -> np.dtype:
    """The record of one point. Padding, which PCL calls `_`, gets names of its own."""
    kinds = {"I": "i", "U": "u", "F": "f"}
    counts = header.get("COUNT", ["1"] * len(header["FIELDS"]))
    columns = zip(header["FIELDS"], header["TYPE"], header["SIZE"], counts, strict=True)
    fields = []
    for i, (name, kind, size, count) in enumerate(columns):
        shape = (int(count),) if int(count) != 1 else ()
        fields.append((name if name != "_" else f"_{i}", f"<{kinds[kind]}{size}", shape))
    return np.dtype(fields)


def _ascii(body: bytes, layout: np.dtype, count: int) -> dict[str, Array]:
    widths = [layout[name].shape[0] if layout[name].shape else 1 for name in _names(layout)]
    table = np.loadtxt(io.BytesIO(body), dtype=np.float64, ndmin=2) if count else np.zeros((0, sum(widths)))
    if table.shape != (count, sum(widths)):
        raise ValueError(f"its header announces {count} points of {sum(widths)} values, its data has {table.shape}")
    parts = np.split(table, np.cumsum(widths)[:-1], axis=1)
    return {name: part if layout[name].shape else part[:, 0] for name, part in zip(_names(layout), parts, strict=True)}


def _binary(body: bytes, layout: np.dtype, count: int) -> dict[str, Array]:
    if len(body) < count * layout.itemsize:
        raise ValueError(f"its data ends after {len(body) // layout.itemsize} of {count} points")
    table = np.frombuffer(body, dtype=layout, count=count)
    return {name: table[name] for name in _names(layout)}


def _compressed(body: bytes, layout: np.dtype, count: int) -> dict[str, Array]:
    """LZF over the columns, one field after the other."""
    if len(body) < 8:
        raise ValueError("its data ends before the sizes of the compressed block")
    packed, unpacked = np.frombuffer(body, dtype="<u4", count=2)
    if unpacked < count * layout.itemsize:
        raise ValueError(f"its compressed block holds {unpacked} bytes, {count} points need {count * layout.itemsize}")
    data = lzf_decompress(body[8 : 8 + int(packed)], int(unpacked))
    fields, start = {}, 0
    for name in _names(layout):
        kind = layout[name]
        fields[name] = np.frombuffer(data, dtype=kind, count=count, offset=start)
        start += count * kind.itemsize
    return fields


def _names(layout: np.dtype) -> tuple[str, ...]:
    return layout.names or ()


def lzf_decompress(packed: bytes, size: int) -> bytes:
    """Expand an LZF block of known size.

    A control byte below 32 is followed by that many literal bytes and one more. Any other names a run of what is
    already there: its upper three bits are the length minus two (seven: add the next byte), the lower five and the
    next byte the distance back minus one.
    """
    out = bytearray()
    at = 0
    while at < len(packed):
        control = packed[at]
        at += 1
        if control < 32:
            out += packed[at : at + control + 1]
            at += control + 1
            continue
        length = control >> 5
        if length == 7:
            length += packed[at]
            at += 1
        length += 2
        start = len(out) - ((control & 31) << 8) - packed[at] - 1
        at += 1
        if start < 0:
            raise ValueError("its compressed block refers to bytes before its beginning")
        run = out[start : start + length]
        while len(run) < length:  # a run may overlap its own output: then it repeats
            run += run[: length - len(run)]
        out += run
    if len(out) != size:
        raise ValueError(f"its compressed block expands to {len(out)} bytes, not {size}")
    return bytes(out)
