"""Libraries that only some installations have: imported when asked for, and named with their remedy when missing."""

from __future__ import annotations

from importlib import import_module
from typing import Any

from coview_stream.errors import DependencyError


def extra(module: str, requirement: str, purpose: str) -> Any:
    """Import a module that comes with one of the package's extras.

    Args:
        module: its full name.
        requirement: the distribution that has it, with the least version, as the package's extra says.
        purpose: what needs it, for the message.

    Raises:
        DependencyError: it is not installed, or cannot be loaded.
    """
    try:
        return import_module(module)
    except Exception as error:  # what is installed and does not fit raises what it likes
        library = module.partition(".")[0]
        absent = isinstance(error, ImportError) and error.name == library
        missing = "is not installed" if absent else f"cannot be loaded ({error})"
        # not by our extra: pip would look for us in a registry, where a copy from elsewhere is not
        remedy = f"pip install '{requirement}'"
        raise DependencyError(f"{purpose}: {library.replace('_', '-')} {missing}; {remedy}") from error
