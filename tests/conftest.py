"""What all tests share: annotations that are executed, the device of a test, the data beside the repository."""

from __future__ import annotations

from pathlib import Path

import jaxtyping
import pytest

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
