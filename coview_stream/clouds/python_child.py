"""Commands and environments of child processes that run our own modules."""

from __future__ import annotations

import os
import sys
from pathlib import Path


def python_command(module: str, *args: str) -> list[str]:
    """Return the command that runs one of our modules, without imports from the current directory."""
    return [sys.executable, "-P", "-m", module, *args]


def python_environment() -> dict[str, str]:
    """Return the environment for such a command, which imports this package but not from the current directory."""
    # empty and relative entries refer to the current directory
    paths = os.pathsep.join(path for path in sys.path if Path(path).is_absolute())
    return os.environ | {"PYTHONPATH": paths, "PYTHONSAFEPATH": "1"}
