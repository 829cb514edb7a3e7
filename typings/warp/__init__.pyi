# Kernels, structs and arrays of Warp are not Python's types: every name counts as Any.
from typing import Any

def __getattr__(name: str) -> Any: ...
