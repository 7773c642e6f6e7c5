"""Open3D, imported on first use and by this module only, with a remedy where a machine lacks what it needs."""

from __future__ import annotations

import ctypes
import functools
import importlib
import sys
from types import ModuleType

from coview_stream.errors import DependencyError

# Debian and Ubuntu packages that carry the system libraries Open3D's wheel links against.
_DEBIAN_PACKAGES = {
    "libusb-1.0": "libusb-1.0-0",
    "libgomp": "libgomp1",
    "libGL": "libgl1",
    "libEGL": "libegl1",
    "libX11": "libx11-6",
}


@functools.cache
def open3d() -> ModuleType:
    """Import Open3D, on first use (about a second), with its console output silenced.

    Raises:
        DependencyError: Open3D or a system library that it links against is missing; the message names both
            the library and the remedy.
    """
    try:
        module = _import_open3d()
    except ImportError as error:
        if not (sys.platform == "linux" and "libusb" in str(error) and _preload_libusb()):
            raise DependencyError(_remedy(error)) from error
        try:
            module = _import_open3d()
        except ImportError as second:
            raise DependencyError(_remedy(second)) from second
    # Open3D prints warnings where this library raises errors
    module.utility.set_verbosity_level(module.utility.VerbosityLevel.Error)
    return module


def _import_open3d() -> ModuleType:
    try:
        return importlib.import_module("open3d")
    except ImportError:
        # a half-imported package would make the next attempt fail for another reason
        for name in [name for name in sys.modules if name == "open3d" or name.startswith("open3d.")]:
            del sys.modules[name]
        raise
    except OSError as error:  # Open3D preloads its parts with ctypes, which raises OSError
        raise ImportError(str(error)) from error


def _preload_libusb() -> bool:
    """Load the libusb of the ``libusb-package`` wheel so that the linker finds it already there."""
    try:
        path = importlib.import_module("libusb_package").get_library_path()
        if path is None:
            return False
        ctypes.CDLL(str(path), mode=ctypes.RTLD_GLOBAL)
    except (ImportError, OSError):
        return False
    return True


def _remedy(error: ImportError) -> str:
    reason = str(error)
    for library, package in _DEBIAN_PACKAGES.items():
        if library in reason:
            extra = " or `pip install libusb-package`" if library.startswith("libusb") else ""
            return (
                f"Open3D cannot load the system library {library} ({reason}); install it, on Debian and "
                f"Ubuntu with `apt-get install {package}`{extra}"
            )
    if isinstance(error, ModuleNotFoundError) and error.name == "open3d":
        return "Open3D is not installed; pip install 'coview-stream[build]'"
    return f"Open3D cannot be loaded ({reason}); reinstall it with `pip install --force-reinstall open3d-cpu`"
