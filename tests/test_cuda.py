"""The kernels' one source also compiles for CUDA; Warp needs no device for that."""

from __future__ import annotations

import importlib

import pytest
import warp as wp

MODULES = (
    "warp_fields",
    "warp_steps",
    "warp_stein",
    "warp_avoid",
    "warp_wrench",
    "warp_hold",
    "warp_bake",
    "warp_render",
    "warp_film",
)


@pytest.mark.parametrize("name", MODULES)
def test_kernels_compile_to_ptx(name, tmp_path):
    module = importlib.import_module(f"graspmatch.kernels.{name}")
    wp.compile_aot_module(wp.get_module(module.__name__), arch=80, module_dir=str(tmp_path), use_ptx=True)
    (ptx,) = tmp_path.glob("*.ptx")
    kernels = [kernel.key for kernel in wp.get_module(module.__name__).kernels.values()]
    assert kernels
    text = ptx.read_text()
    assert all(f"{key.split('.')[-1]}_" in text for key in kernels)
