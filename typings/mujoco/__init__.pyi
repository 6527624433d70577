# MuJoCo's names live in a compiled module that a type checker cannot read; to it, they are all Any.
from typing import Any

def __getattr__(name: str) -> Any: ...
