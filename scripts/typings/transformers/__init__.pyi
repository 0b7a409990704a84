# Everything is Any: reading the library's own 2,800 files takes pyright half a minute, and tells little more.
from typing import Any

def __getattr__(name: str) -> Any: ...
