"""Where the file of a hand is: a path, or a name in MuJoCo Menagerie, in robot_descriptions or in a ROS package."""

from __future__ import annotations

import importlib
import importlib.util
import os
from collections.abc import Callable
from pathlib import Path

from graspmatch.errors import GraspmatchError
from graspmatch.gripper.mesh_files import find_file

MENAGERIE_ROOT = "MENAGERIE_ROOT"
"""Environment variable with the folder of MuJoCo Menagerie."""
DEFAULT_MODELS = ("hand", "gripper", "right_hand")
"""Files of a Menagerie folder that are taken where its name alone is given, in this order."""


def find_description(reference: Path | str) -> Path:
    """The file that a card or an option means.

    `menagerie:FOLDER/FILE`, with or without `.xml`; `robot_descriptions:NAME`; `package://PACKAGE/FILE`; or a path.
    Raises `GraspmatchError` where there is no such file, with what to do.
    """
    scheme, colon, rest = str(reference).partition(":")
    finder = SCHEMES.get(scheme) if colon else None
    return Path(reference).absolute() if finder is None else finder(rest.lstrip("/"))


def has_scheme(reference: str) -> bool:
    """Whether a reference is no path."""
    return reference.partition(":")[0] in SCHEMES and ":" in reference


def _menagerie(name: str) -> Path:
    roots = _menagerie_roots()
    if not roots:
        raise GraspmatchError(
            f"menagerie:{name} needs MuJoCo Menagerie: clone github.com/google-deepmind/mujoco_menagerie and set "
            f"{MENAGERIE_ROOT} to its folder, or pip install robot_descriptions; or give the file with --description."
        )
    for root in roots:
        files = [root / name, root / f"{name}.xml", *(root / name / f"{model}.xml" for model in DEFAULT_MODELS)]
        found = next((file for file in files if file.is_file()), None)
        if found is None and (root / name).is_dir():
            inside = sorted((root / name).glob("*.xml"))
            found = inside[0] if len(inside) == 1 else None
        if found is not None:
            return found.resolve()
    folder = roots[0] / name.partition("/")[0]
    models = ", ".join(sorted(f"{folder.name}/{file.stem}" for file in folder.glob("*.xml")))
    known = f"It has {models}." if models else f"{roots[0]} has no folder {folder.name}."
    raise GraspmatchError(f"There is no menagerie:{name}. {known}")


def _menagerie_roots() -> list[Path]:
    """Folders of MuJoCo Menagerie: the environment's, an installed package's, the cache of robot_descriptions."""
    if root := os.environ.get(MENAGERIE_ROOT):
        return [Path(root)]
    found = []
    spec = importlib.util.find_spec("mujoco_menagerie")
    if spec is not None and spec.submodule_search_locations:
        found += [Path(location) for location in spec.submodule_search_locations]
    cache = os.environ.get("ROBOT_DESCRIPTIONS_CACHE") or Path.home() / ".cache" / "robot_descriptions"
    found.append(Path(cache) / "mujoco_menagerie")
    found = [root for root in found if root.is_dir()]
    if not found and importlib.util.find_spec("robot_descriptions") is not None:
        module = importlib.import_module("robot_descriptions.panda_mj_description")  # fetches the repository
        found = [Path(module.REPOSITORY_PATH)]
    return found


def _robot_descriptions(name: str) -> Path:
    name = name.removesuffix("_description").removesuffix("_mj")
    if importlib.util.find_spec("robot_descriptions") is None:
        raise GraspmatchError(f"robot_descriptions:{name} needs that package: pip install robot_descriptions.")
    for suffix, attribute in (("_mj_description", "MJCF_PATH"), ("_description", "URDF_PATH")):
        module_name = f"robot_descriptions.{name}{suffix}"
        if importlib.util.find_spec(module_name) is None:
            continue
        try:
            module = importlib.import_module(module_name)
        except Exception as error:  # git and the network fail in many ways
            raise GraspmatchError(f"robot_descriptions cannot fetch {name}: {error}") from error
        if hasattr(module, attribute):
            return Path(getattr(module, attribute))
    raise GraspmatchError(f"robot_descriptions has no '{name}'; its list is at pypi.org/project/robot_descriptions.")


def _package(name: str) -> Path:
    found = find_file(f"package://{name}", Path.cwd())
    if found is None:
        package = name.partition("/")[0]
        raise GraspmatchError(
            f"No package://{name}: put the folder that holds '{package}' on ROS_PACKAGE_PATH, or give the file with "
            "--description."
        )
    return found


SCHEMES: dict[str, Callable[[str], Path]] = {
    "menagerie": _menagerie,
    "robot_descriptions": _robot_descriptions,
    "package": _package,
}
