"""The kernels' one source also compiles for CUDA; Warp needs no device for that."""

from __future__ import annotations

import importlib
from pathlib import Path

import pytest
import warp as wp

from graspmatch import kernels

KERNELS = Path(kernels.__file__).parent
MODULES = sorted(path.stem for path in KERNELS.glob("warp_*.py") if "@wp.kernel" in path.read_text())


@pytest.mark.parametrize("name", MODULES)
def test_kernels_compile_to_ptx(name, tmp_path):
    module = importlib.import_module(f"graspmatch.kernels.{name}")
    wp.compile_aot_module(wp.get_module(module.__name__), arch=80, module_dir=str(tmp_path), use_ptx=True)
    (ptx,) = tmp_path.glob("*.ptx")
    keys = [kernel.key for kernel in wp.get_module(module.__name__).kernels.values()]
    assert keys
    text = ptx.read_text()
    assert all(f"{key.split('.')[-1]}_" in text for key in keys)
