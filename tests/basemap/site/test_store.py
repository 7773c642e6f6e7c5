"""The cache keeps to its bound, and what is in use."""

import os

import numpy as np
import pytest

from coview_stream.basemap import file_format
from coview_stream.basemap.site.store import cache_folder, evict, hold
from coview_stream.errors import MapError


@pytest.fixture
def folder(tmp_path, monkeypatch):
    monkeypatch.setenv("COVIEW_CACHE", str(tmp_path))
    monkeypatch.setenv("COVIEW_CACHE_GB", "2.5e-5")  # three of the files below are more
    return cache_folder()


def made(folder, name, age):
    path = folder / name
    file_format.save(path, {"a": np.arange(1250, dtype=np.int64)}, {})
    os.utime(path, (age, age))
    return path


@pytest.mark.skipif(not hasattr(os, "getuid"), reason="modes are of POSIX")
@pytest.mark.parametrize("mode", [0o777, 0o770, 0o720, 0o702])
def test_folder_that_others_may_write_is_refused(tmp_path, monkeypatch, mode):
    folder = tmp_path / "cache"
    folder.mkdir()
    folder.chmod(mode)
    monkeypatch.setenv("COVIEW_CACHE", str(folder))
    with pytest.raises(MapError, match="others may write to it"):
        cache_folder()


@pytest.mark.skipif(not hasattr(os, "getuid"), reason="modes are of POSIX")
def test_folder_that_others_may_exchange_is_refused(tmp_path, monkeypatch):
    shared = tmp_path / "shared"
    shared.mkdir()
    monkeypatch.setenv("COVIEW_CACHE", str(shared / "cache"))
    assert cache_folder() == shared / "cache"
    shared.chmod(0o777)
    with pytest.raises(MapError, match="or to a folder that it is in"):
        cache_folder()


@pytest.mark.skipif(not hasattr(os, "getuid"), reason="modes are of POSIX")
def test_files_that_others_could_write_while_the_folder_was_open_are_deleted(folder, tmp_path):
    ours, theirs = (folder / f"{digit * 40}.1.coview" for digit in "ab")
    mirrored, letter = folder / "sites" / "a1" / "manifest.json", folder / "thesis" / "letter.txt"
    for parent in (mirrored.parent, letter.parent):
        parent.mkdir(parents=True)
    for path, mode in ((ours, 0o644), (theirs, 0o666), (mirrored, 0o664), (letter, 0o664)):
        path.write_bytes(b"map")
        path.chmod(mode)
    assert cache_folder() == folder
    assert theirs.exists()  # nobody else reaches it
    folder.chmod(0o755)
    assert cache_folder() == folder
    assert (ours.exists(), theirs.exists(), mirrored.exists(), letter.exists()) == (True, False, False, True)


@pytest.mark.skipif(not hasattr(os, "getuid"), reason="modes are of POSIX")
def test_others_do_not_reach_the_folder_with_any_umask(tmp_path, monkeypatch):
    (tmp_path / "b").mkdir()
    (tmp_path / "b").chmod(0o755)
    before = os.umask(0)
    try:
        for name in "ab":
            monkeypatch.setenv("COVIEW_CACHE", str(tmp_path / name))
            assert cache_folder().stat().st_mode & 0o777 == 0o700
    finally:
        os.umask(before)


def test_what_was_not_used_for_longest_goes(folder):
    paths = [made(folder, f"{k}.coview", 1000 * k) for k in range(3)]
    evict(folder)
    assert [path.exists() for path in paths] == [False, True, True]


def test_what_is_asked_for_and_what_is_open_stays(folder):
    paths = [made(folder, f"{k}.coview", 1000 * k) for k in range(3)]
    held = file_format.open_file(paths[0], opened=hold)
    evict(folder, paths[1])
    assert [path.exists() for path in paths] == [True, True, False]
    assert held.arrays["a"].sum() > 0
    del held
    made(folder, "2.coview", 2000)
    evict(folder)
    assert [path.exists() for path in paths] == [False, True, True]


def test_mirror_that_was_used_stays(folder):
    old, new = (folder / "sites" / name for name in ("old", "new"))
    for path in (old, new):
        path.mkdir(parents=True)
        (path / "x").write_bytes(bytes(15_000))
    os.utime(old, (1, 1))
    evict(folder)
    assert (old.exists(), new.exists()) == (False, True)
