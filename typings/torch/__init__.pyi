# PyTorch is optional and only for bench/: every name counts as Any, installed or not.
from typing import Any

def __getattr__(name: str) -> Any: ...
