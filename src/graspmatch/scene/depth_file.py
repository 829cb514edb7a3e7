"""Files of depth images and masks -> arrays, by suffix. Nothing is scaled here: the values are the file's own."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
from jaxtyping import Shaped

from graspmatch.scene.read import existing_file
from graspmatch.types import GraspmatchError

Array = np.ndarray

DEPTH_SUFFIXES = (".png", ".tif", ".tiff", ".npy", ".npz", ".exr", ".pgm")
DEPTH_KEYS = ("depth", "depth_image", "depth_map", "z")
MASK_KEYS = ("mask", "instance_mask", "labels", "seg", "segmentation")
EXR_CHANNELS = ("Z", "depth.Z", "Depth.Z", "Y", "V", "R")


def read_depth(path: str | os.PathLike[str]) -> Shaped[Array, "h w"]:
    """A depth image as its file has it: 16 bit PNG, PGM or TIFF, TIFF of floats, NPY, NPZ (`depth`) or EXR."""
    image = _read_image(existing_file(path), DEPTH_KEYS)
    name = Path(path).name
    if image.ndim == 3:
        if image.shape[2] > 1 and np.any(image != image[:, :, :1]):
            raise GraspmatchError(f"{name} is a colour image of {image.shape[2]} channels, not a depth image.")
        image = image[:, :, 0]
    if image.dtype in (np.uint8, np.int8, np.bool_):
        raise GraspmatchError(f"{name} has 8 bits a pixel, which is a picture of depth: 16 bits or floats are needed.")
    return image


def read_mask(path: str | os.PathLike[str]) -> Shaped[Array, "h w"]:
    """An instance mask: 0 is nothing, every other value an instance; of a colour image, its brightest channel."""
    image = _read_image(existing_file(path), MASK_KEYS)
    return image.max(axis=2) if image.ndim == 3 else image


def _read_image(path: Path, keys: tuple[str, ...]) -> Shaped[Array, "h w ..."]:
    suffix = path.suffix.lower()
    if suffix not in DEPTH_SUFFIXES:
        known = ", ".join(DEPTH_SUFFIXES)
        raise GraspmatchError(f"{path.name}: unknown kind of image {suffix or '(no suffix)'!r}. Known: {known}.")
    if suffix == ".exr":
        return _read_exr(path)
    try:
        if suffix in (".npy", ".npz"):
            content = np.load(path, allow_pickle=False)
            arrays = {"": content} if isinstance(content, np.ndarray) else {key: content[key] for key in content.files}
        else:
            from PIL import Image

            with Image.open(path) as image:
                colours = image.convert("RGB") if image.mode == "P" and keys is DEPTH_KEYS else image
                arrays = {"": np.array(colours)}
    except Exception as error:  # damaged files raise whatever their parsers do; each means the same to the user
        raise GraspmatchError(f"{path.name} could not be read as {suffix[1:].upper()}: {error}.") from error
    image = next((arrays[key] for key in ("", *keys) if key in arrays), None)
    if image is None:
        raise GraspmatchError(f"{path.name} has no image among {', '.join(arrays)}. Known names: {', '.join(keys)}.")
    if image.ndim not in (2, 3) or image.dtype.kind not in "buif" or 0 in image.shape:
        raise GraspmatchError(f"{path.name} holds {image.dtype} of shape {image.shape}; an image (h, w) is needed.")
    return image


def _read_exr(path: Path) -> Shaped[Array, "h w"]:
    try:
        import OpenEXR
    except ImportError as error:
        raise GraspmatchError(f"Reading {path.name} needs OpenEXR: pip install 'graspmatch[exr]'.") from error
    try:
        with OpenEXR.File(str(path), separate_channels=True) as file:
            channels = {name: np.array(channel.pixels) for name, channel in file.channels().items()}
    except Exception as error:  # damaged files raise whatever the library does
        raise GraspmatchError(f"{path.name} could not be read as EXR: {error}.") from error
    found = next((name for name in EXR_CHANNELS if name in channels), None)
    if found is None and len(channels) != 1:
        raise GraspmatchError(
            f"{path.name} has no depth among its channels {', '.join(channels)}. Known: {', '.join(EXR_CHANNELS)}."
        )
    image = channels[found] if found else next(iter(channels.values()))
    return np.where(image < 1e9, image, 0).astype(np.float32)  # renderers write 1e10 where there is nothing
