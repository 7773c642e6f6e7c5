"""Rays on meshes: Open3D and our own kernel agree; and machines without Open3D or its system libraries."""

import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from coview_stream.errors import DependencyError
from coview_stream.sim import casting
from coview_stream.sim.mesh import EMPTY, Mesh, box, ellipsoid, join, placed


def meshes() -> list[Mesh]:
    return [join([box(40, 40, 0.1), placed(box(4, 6, 5), 8, 3)]), EMPTY, placed(ellipsoid(), -6, -4, 2.0)]


def rays(count: int) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(2)
    towards = rng.normal(size=(count, 3))
    towards[: count // 10, :2] = 0.0  # straight up and down
    towards[count // 10 : count // 5, 2] = 0.0
    towards /= np.linalg.norm(towards, axis=1, keepdims=True)
    return rng.uniform([-10, -10, 0.5], [5, 10, 4], (count, 3)).astype(np.float32), towards.astype(np.float32)


def test_kernel_hits_what_open3d_hits() -> None:
    """Distances to 0.1 mm, and the same mesh and normal; a ray in a thousand may pass the other side of an edge."""
    try:
        library = casting.open3d()
    except DependencyError as error:
        pytest.skip(str(error))
    origins, towards = rays(5000)
    theirs = casting.open3d_caster(library, meshes(), 1)(origins, towards)
    ours = casting.kernel_caster(meshes())(origins, towards)
    assert set(np.unique(ours.mesh)) == {-1, 0, 2}
    with np.errstate(invalid="ignore"):
        same = np.isclose(ours.distance, theirs.distance, rtol=0, atol=1e-4) & (ours.mesh == theirs.mesh)
    assert same.mean() > 0.999
    assert (np.abs(ours.normal - theirs.normal).max(axis=1)[same] < 1e-4).mean() > 0.999
    np.testing.assert_array_equal(ours.normal[ours.mesh < 0], 0.0)


def test_no_mesh_has_a_surface() -> None:
    hits = casting.caster_of([EMPTY, EMPTY], 1)(*rays(3))
    assert np.isinf(hits.distance).all()
    np.testing.assert_array_equal(hits.mesh, -1)


def test_rays_do_without_open3d(broken_open3d: Path) -> None:
    broken_open3d.write_text("raise ImportError('libEGL.so.1: cannot open shared object file')")
    hits = casting.caster_of([box(2, 2, 1)], 1)(np.array([[0, 0, 5]], np.float32), np.array([[0, 0, -1]], np.float32))
    assert hits.distance == pytest.approx(4.0)
    np.testing.assert_allclose(hits.normal, [[0, 0, 1]], atol=1e-6)


@pytest.fixture
def broken_open3d(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Iterator[Path]:
    """Return the file of an ``open3d`` that is imported instead of the real one."""
    for name in [name for name in sys.modules if name == "open3d" or name.startswith("open3d.")]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.syspath_prepend(tmp_path)
    casting.open3d.cache_clear()
    yield tmp_path / "open3d.py"
    casting.open3d.cache_clear()
    sys.modules.pop("open3d", None)


@pytest.mark.parametrize(
    ("error", "remedy"),
    [
        ("ImportError('libusb-1.0.so.0: cannot open shared object file')", "libusb-1.0-0.*libusb-package"),
        ("OSError('libGL.so.1: cannot open shared object file')", "apt-get install libgl1"),
        ("ImportError('libgomp.so.1: cannot open shared object file')", "apt-get install libgomp1"),
        ("ModuleNotFoundError('none', name='open3d')", r"pip install .*\[open3d\]"),
        ("ImportError('undefined symbol: xyz')", "undefined symbol: xyz.*reinstall"),
    ],
)
def test_missing_open3d_library_is_named_with_remedy(broken_open3d: Path, error: str, remedy: str) -> None:
    broken_open3d.write_text(f"raise {error}")
    with pytest.raises(DependencyError, match=remedy):
        casting.open3d()


@pytest.mark.skipif(sys.platform != "linux", reason="libusb is preloaded on Linux only")
def test_libusb_is_preloaded_and_open3d_import_retried(broken_open3d: Path) -> None:
    broken_open3d.write_text(
        "from pathlib import Path\nfrom unittest import mock\nutility = mock.Mock()\n"
        "if not Path(__file__).with_name('tried').exists():\n    Path(__file__).with_name('tried').touch()\n"
        "    raise ImportError('libusb-1.0.so.0: cannot open shared object file')\n"
    )
    assert casting.open3d().__file__ == str(broken_open3d)
