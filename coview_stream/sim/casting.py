"""First hits of rays on meshes, by Open3D (Embree) if it is installed, else by our slower kernel."""

from __future__ import annotations

import contextlib
import ctypes
import functools
import importlib
import sys
from collections.abc import Callable, Sequence
from types import ModuleType
from typing import Any, NamedTuple

import numpy as np

from coview_kernels import cast_rays, triangle_tree
from coview_stream.errors import PIP_INSTALL, DependencyError, install_command
from coview_stream.geometry.arrays import Floats32, Indices
from coview_stream.sim.mesh import Mesh

_DEBIAN_PACKAGES = {  # of the system libraries that Open3D's wheel links against
    "libusb-1.0": "libusb-1.0-0",
    "libgomp": "libgomp1",
    "libGL": "libgl1",
    "libEGL": "libegl1",
    "libX11": "libx11-6",
}


@functools.cache
def open3d() -> ModuleType:
    """Import Open3D on first use (about a second), with its console output silenced.

    Raises:
        DependencyError: Open3D or one of its system libraries is missing; the message names library and remedy.
    """
    try:
        try:
            module = _import_open3d()
        except ImportError as error:
            if sys.platform != "linux" or "libusb" not in str(error):
                raise
            with contextlib.suppress(ImportError, OSError):  # loads the wheel's libusb for the linker
                library = importlib.import_module("libusb_package").get_library_path()
                ctypes.CDLL(str(library), mode=ctypes.RTLD_GLOBAL)
            module = _import_open3d()
    except ImportError as error:
        raise DependencyError(_remedy(error)) from error
    # Open3D prints warnings for errors that this library raises
    module.utility.set_verbosity_level(module.utility.VerbosityLevel.Error)
    return module


def _import_open3d() -> ModuleType:
    try:
        return importlib.import_module("open3d")
    except ImportError:
        # a half-imported package would fail the next attempt for another reason
        for name in [name for name in sys.modules if name == "open3d" or name.startswith("open3d.")]:
            del sys.modules[name]
        raise
    except OSError as error:  # Open3D preloads its parts with ctypes, which raises OSError
        raise ImportError(str(error)) from error


def _remedy(error: ImportError) -> str:
    reason = str(error)
    for library, package in _DEBIAN_PACKAGES.items():
        if library in reason:
            extra = f" or `{PIP_INSTALL} libusb-package`" if library.startswith("libusb") else ""
            return (
                f"Open3D cannot load the system library {library} ({reason}); install it, on Debian and "
                f"Ubuntu with `apt-get install {package}`{extra}"
            )
    if isinstance(error, ModuleNotFoundError) and error.name == "open3d":
        return f"Open3D is not installed; {install_command('open3d')}"
    return f"Open3D cannot be loaded ({reason}); reinstall it with `{PIP_INSTALL} --force-reinstall open3d-cpu`"


class FirstHits(NamedTuple):
    """First hits of (N,) rays."""

    distance: Floats32
    """(N,) metres; inf without a hit."""
    mesh: Indices
    """(N,) index of the mesh; -1 without a hit."""
    normal: Floats32
    """(N, 3) unit normals of the triangles by the order of their corners; zeros without a hit."""


Cast = Callable[[Floats32, Floats32], FirstHits]
"""Casts rays from origins (N, 3), metres, along unit directions (N, 3)."""


def caster_of(meshes: Sequence[Mesh], threads: int) -> Cast:
    """Return a ray caster for meshes, on ``threads`` cores, Open3D's if it can be loaded."""
    if not any(len(mesh.triangles) for mesh in meshes):
        return lambda origins, rays: _nothing(len(rays))
    library = _open3d_if_it_loads()
    return kernel_caster(meshes) if library is None else open3d_caster(library, meshes, threads)


@functools.cache
def _open3d_if_it_loads() -> ModuleType | None:
    with contextlib.suppress(DependencyError):
        return open3d()
    return None


def _nothing(count: int) -> FirstHits:
    return FirstHits(np.full(count, np.inf, np.float32), np.full(count, -1, np.intp), np.zeros((count, 3), np.float32))


def open3d_caster(library: Any, meshes: Sequence[Mesh], threads: int) -> Cast:
    """Return Open3D's ray caster for meshes, at least one of which has triangles."""
    scene, tensor = library.t.geometry.RaycastingScene(nthreads=threads), library.core.Tensor
    numbers = [index for index, mesh in enumerate(meshes) if len(mesh.triangles)]
    for mesh in (meshes[index] for index in numbers):
        scene.add_triangles(tensor(mesh.vertices.astype(np.float32)), tensor(mesh.triangles.astype(np.uint32)))
    named = np.array([*numbers, -1], dtype=np.intp)

    def cast(origins: Floats32, rays: Floats32) -> FirstHits:
        packed = np.ascontiguousarray(np.concatenate([origins, rays], axis=1), dtype=np.float32)
        answer = scene.cast_rays(tensor(packed), nthreads=threads)
        # a missed ray has a number beyond all meshes; copy, as the arrays belong to the tensors of the answer
        mesh = named[np.minimum(answer["geometry_ids"].numpy(), len(numbers))]
        return FirstHits(answer["t_hit"].numpy().copy(), mesh, answer["primitive_normals"].numpy().copy())

    return cast


def kernel_caster(meshes: Sequence[Mesh]) -> Cast:
    """Return our kernel's ray caster for meshes, at least one of which has triangles."""
    first = np.cumsum([0, *(len(mesh.vertices) for mesh in meshes)])
    vertices = np.concatenate([mesh.vertices.astype(np.float32) for mesh in meshes])
    triangles = np.concatenate([mesh.triangles + begin for mesh, begin in zip(meshes, first[:-1], strict=True)])
    owner = np.append(np.repeat(np.arange(len(meshes)), [len(mesh.triangles) for mesh in meshes]), -1)
    corners = vertices[triangles]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), np.float32(1e-30))
    normals = np.vstack([normals, np.zeros((1, 3), np.float32)])
    tree = triangle_tree(vertices, triangles)

    def cast(origins: Floats32, rays: Floats32) -> FirstHits:
        distance, row = cast_rays(tree, origins, rays)
        return FirstHits(distance, owner[row], normals[row])

    return cast
