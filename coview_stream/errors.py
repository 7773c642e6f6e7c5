"""Errors of the package, as one tree, and the import of optional libraries.

Every message names the file, field or key and the remedy. The command prints it as one line and exits with 2.
"""

from __future__ import annotations

import shlex
import sys
import warnings
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from typing import Any


def printable(text: object) -> str:
    """Return text from anyone's file or message in a form safe for a terminal: no control characters, one line."""
    return "".join(c if c.isprintable() else " " for c in str(text))


def counted(count: int, noun: str) -> str:
    """Return ``1 frame`` or ``2 frames``."""
    return f"{count:,} {noun}{'s' * (count != 1)}"


class CoViewWarning(UserWarning):
    """Input that is used but may be a mistake; the message is one sentence on one line."""


class CoViewError(Exception):
    """Root of all errors that coview_stream raises on purpose."""


class ConfigError(CoViewError, ValueError):
    """An option or configuration field is out of its range."""


class InputError(CoViewError, ValueError):
    """Input cannot be used."""


class CloudError(InputError):
    """A point cloud is unreadable, empty, truncated or in another format."""


class RunError(InputError):
    """A recorded run cannot be read, or its frames, odometry and stamps do not match."""


class MapError(InputError):
    """A base map file is damaged, of another version, or not a base map at all."""


class MessageError(InputError):
    """A message from the network is malformed: truncated, oversized, or not in its stated encoding."""


class EncodingError(MessageError):
    """No codec knows a message's encoding."""


class TransportError(CoViewError):
    """A network connection cannot be opened or has failed, or its configuration is wrong."""


class DependencyError(CoViewError, ImportError):
    """A library that this operation needs is missing; the message says how to get it."""


def warn(message: str | None) -> None:
    """Issue a :class:`CoViewWarning`, unless there is no message."""
    if message is not None:
        warnings.warn(message, CoViewWarning, stacklevel=3)


def nearest(given: str, known: Sequence[str]) -> str | None:
    """Return the known name that is most similar to a mistyped one; None if none is similar."""
    from difflib import get_close_matches

    bare = {name.lstrip("-"): name for name in known}  # dashes of options do not make names similar
    near = get_close_matches(given.lstrip("-"), bare, 1, cutoff=0.65)  # at 0.6 merge is serve
    return bare[near[0]] if near else None


def did_you_mean(given: str, known: Sequence[str]) -> str:
    """Return the end of a message about an unknown name: the nearest known one, or all."""
    near = nearest(given, known)
    return f"did you mean {near!r}?" if near else f"there are {', '.join(known)}"


PIP_INSTALL = f"{shlex.quote(sys.executable or 'python')} -m pip install"
"""Command that installs for the running interpreter; a bare ``pip`` may belong to another one."""

EXTRA_OF = {
    "scipy": "node",
    "tqdm": "node",
    "taichi": "taichi",
    "quadrants": "node",
    "laspy": "node",
    "lazrs": "node",
    "rosbags": "messages",
    "foxglove_schemas_protobuf": "messages",
    "google": "messages",
    "pyproj": "geo",
    "distributed": "cluster",
    "obstore": "s3",
    "open3d": "open3d",
    "CSF": "build",
    "PIL": "plot",
    "matplotlib": "plot",
    "pye57": "e57",
    "kiss_icp": "kiss-icp",
    "cryptography": "sign",
    "rerun": "viz",
    "foxglove": "foxglove",
    "torch": "learn-train",
    "psutil": "bench",
    "rclpy": "ros2",
}
"""Extra that installs a third-party module, by its top-level name."""


def require_library(module: str, requirement: str, purpose: str) -> Any:
    """Import a module of one of the package's extras; DependencyError if it cannot be loaded.

    ``requirement`` is its distribution with the minimum version, as in the extra; ``purpose`` is for the message.
    """
    try:
        return import_module(module)
    except Exception as error:  # an incompatible version may raise anything
        library = module.partition(".")[0]
        absent = isinstance(error, ImportError) and error.name == library
        if absent and library in EXTRA_OF:
            raise DependencyError(_not_installed(library, purpose, EXTRA_OF[library])) from error
        missing = "is not installed" if absent else f"cannot be loaded ({error})"
        raise DependencyError(f"{purpose}: {_spelt(library)} {missing}; {PIP_INSTALL} '{requirement}'") from error


def require_installed(module: str, purpose: str) -> None:
    """Raise DependencyError if a module of an extra is missing; it is not imported."""
    if find_spec(module) is None:
        raise DependencyError(_not_installed(module, purpose, EXTRA_OF[module]))


@contextmanager
def naming_missing_libraries(purpose: str, extra: str | None = None) -> Iterator[None]:
    """Turn the ModuleNotFoundError of a missing library into a :class:`DependencyError` that names its extra.

    ``purpose`` is for the message; ``extra`` installs all modules needed, by default the one with this module.
    """
    try:
        yield
    except ModuleNotFoundError as error:
        library = (error.name or "").partition(".")[0]
        if library not in EXTRA_OF:
            raise
        raise DependencyError(_not_installed(library, purpose, extra or EXTRA_OF[library])) from error


def install_command(extra: str) -> str:
    """Return the command that installs an extra from this package's source: a checkout, a wheel, an address.

    The bare name is not enough: an index may lack it, or have another package of that name. A package from an index is
    named with its version, which pip finds installed and does not search for.
    """
    from importlib.metadata import PackageNotFoundError, distribution
    from json import loads
    from urllib.parse import unquote

    try:
        own = distribution("coview-stream")
    except PackageNotFoundError:  # run by its path
        return f"{PIP_INSTALL} '{Path(__file__).resolve().parents[1]}[{extra}]'"
    source = loads(own.read_text("direct_url.json") or "{}")
    address = str(source.get("url", ""))
    if "vcs_info" in source:
        address = f"{source['vcs_info'].get('vcs')}+{address}@{source['vcs_info'].get('commit_id')}"
    if address.startswith("file://"):
        editable = "-e " if source.get("dir_info", {}).get("editable") else ""
        return f"{PIP_INSTALL} {editable}'{unquote(address.removeprefix('file://'))}[{extra}]'"
    return f"{PIP_INSTALL} 'coview-stream[{extra}]" + (f" @ {address}'" if address else f"=={own.version}'")


def _not_installed(library: str, purpose: str, extra: str) -> str:
    return f"{purpose}: {_spelt(library)} is not installed; {install_command(extra)}"


def _spelt(library: str) -> str:
    return {"google": "protobuf", "CSF": "cloth-simulation-filter"}.get(library, library.replace("_", "-"))
