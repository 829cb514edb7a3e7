"""What all tests share: annotations that are executed, the device of a test, the data beside the repository."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import jaxtyping
import pytest

if TYPE_CHECKING:
    from graspmatch.types import Gripper

# Warp reads the source of its kernels, so the modules that hold or launch them stay as they are.
CHECKED = [
    "config",
    "types",
    "geometry",
    "kernels.reference",
    "gripper",
    "scene",
    "formats",
    "planner",
    "simulate",
    "apps",
]
jaxtyping.install_import_hook([f"graspmatch.{name}" for name in CHECKED], "annotations.checked")

SHARED_DATA = Path(__file__).parents[1] / ".." / "shared" / "data"


@pytest.fixture(params=["cpu", pytest.param("cuda:0", marks=pytest.mark.gpu)])
def device(request: pytest.FixtureRequest) -> str:
    """Every device that kernels run on."""
    return request.param


@pytest.fixture
def shared_data() -> Path:
    """Real objects, hands and captures."""
    if not SHARED_DATA.is_dir():
        pytest.skip("needs the data of ../shared/data, which is not part of the repository")
    return SHARED_DATA.resolve()


@pytest.fixture(scope="session")
def toy(tmp_path_factory: pytest.TempPathFactory) -> Gripper:
    """The hand of `toy_hand`: pads at y = +-0.03, +-0.021, +-0.012 and, of fingertip preshapes, +-0.03, +-0.015,
    +-0.0075; tips at z = 0.06."""
    from graspmatch.gripper.load import load_gripper
    from toy_hand import COARSE, write_toy

    folder = tmp_path_factory.mktemp("toy")
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("GRASPMATCH_CACHE", str(folder / "cache"))
        return load_gripper(write_toy(folder), baking=COARSE)


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Leave out the tests marked `gpu` where there is no CUDA device."""
    needs_gpu = [item for item in items if item.get_closest_marker("gpu")]
    if not needs_gpu or cuda_is_present():
        return
    config.hook.pytest_deselected(items=needs_gpu)
    items[:] = [item for item in items if item not in needs_gpu]


def cuda_is_present() -> bool:
    """Does Warp see a CUDA device?"""
    from graspmatch.kernels.launch import resolve_device

    return resolve_device("auto") != "cpu"
