# MuJoCo ships no stubs for its compiled modules: every name counts as Any.
from typing import Any

def __getattr__(name: str) -> Any: ...
