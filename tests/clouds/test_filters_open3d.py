"""What a machine without Open3D's system libraries sees."""

from __future__ import annotations

import sys
from collections.abc import Iterator

import pytest

from coview_stream.clouds import filters
from coview_stream.errors import DependencyError


@pytest.fixture(autouse=True)
def _fresh_cache() -> Iterator[None]:
    filters.open3d.cache_clear()
    yield
    filters.open3d.cache_clear()


@pytest.mark.parametrize(
    ("error", "remedy"),
    [
        (ImportError("libusb-1.0.so.0: cannot open shared object file"), "libusb-1.0-0.*libusb-package"),
        (ImportError("libGL.so.1: cannot open shared object file"), "apt-get install libgl1"),
        (ImportError("libgomp.so.1: cannot open shared object file"), "apt-get install libgomp1"),
        (ModuleNotFoundError("No module named 'open3d'", name="open3d"), "pip install 'coview-stream\\[build\\]'"),
        (ImportError("undefined symbol: xyz"), "undefined symbol: xyz.*reinstall"),
    ],
)
def test_missing_open3d_library_is_named_with_remedy(
    monkeypatch: pytest.MonkeyPatch, error: ImportError, remedy: str
) -> None:
    def fail() -> None:
        raise error

    monkeypatch.setattr(filters, "_import_open3d", fail)
    with pytest.raises(DependencyError, match=remedy):
        filters.open3d()


@pytest.mark.skipif(sys.platform != "linux", reason="libusb is preloaded on Linux only")
def test_libusb_is_preloaded_and_open3d_import_retried(monkeypatch: pytest.MonkeyPatch) -> None:
    attempts = []
    real = filters._import_open3d

    def first_without_libusb() -> object:
        attempts.append(1)
        if len(attempts) == 1:
            raise ImportError("libusb-1.0.so.0: cannot open shared object file")
        return real()

    monkeypatch.setattr(filters, "_import_open3d", first_without_libusb)
    assert filters.open3d().__name__ == "open3d"
    assert len(attempts) == 2
