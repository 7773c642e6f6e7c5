"""Files that are complete or not there."""

import os
import subprocess
import sys

import pytest

from coview_stream.clouds import atomic_file as module
from coview_stream.clouds.atomic_file import atomic_file, atomic_path


@pytest.mark.parametrize("sync", [False, True])
def test_atomic_file_replaces_the_old_one(tmp_path, sync):
    path = tmp_path / "a.bin"
    path.write_bytes(b"old")
    with atomic_file(path, sync=sync) as stream:
        stream.write(b"new")
        assert path.read_bytes() == b"old"
    assert path.read_bytes() == b"new"
    assert list(tmp_path.iterdir()) == [path]


def test_atomic_file_keeps_the_old_one_after_an_error(tmp_path):
    path = tmp_path / "a.bin"
    path.write_bytes(b"old")

    def fail_half_way():
        with atomic_file(path) as stream:
            stream.write(b"ne")
            raise ValueError("half")

    with pytest.raises(ValueError, match="half"):
        fail_half_way()
    assert path.read_bytes() == b"old"
    assert list(tmp_path.iterdir()) == [path]


def test_atomic_path_uses_the_given_temporary_name(tmp_path):
    path, temporary = tmp_path / "a.json", tmp_path / "a.part"
    with atomic_path(path, temporary) as part:
        assert part == temporary
        part.write_text("{}")
    assert path.read_text() == "{}"
    assert not temporary.exists()


@pytest.mark.skipif(os.name != "posix", reason="modes and links as in POSIX")
def test_private_file_is_its_owners_and_follows_no_link(tmp_path):
    path, foreign = tmp_path / "a.json", tmp_path / "foreign"
    foreign.write_text("mine")
    with atomic_path(path) as part:
        part.symlink_to(foreign)
        with pytest.raises(FileExistsError), atomic_file(path, private=True):
            pass
        part.touch()
    with atomic_file(path, private=True):
        pass
    assert foreign.read_text() == "mine"
    assert path.stat().st_mode & 0o777 == 0o600


def test_parts_that_nobody_writes_are_removed_and_no_others(tmp_path):
    path = tmp_path / "a.bin"
    gone = subprocess.Popen([sys.executable, "-c", ""])
    gone.wait()
    with atomic_path(path) as part:
        here = part.name.split(".")[3]  # this host and its process numbers
        part.touch()
    path.unlink()
    left = f".a.bin.{here}.{gone.pid}.part"
    elsewhere = f".a.bin.0badc0de.{gone.pid}.part"  # a container of the same volume: its process may live
    kept = [f".a.bin.{here}.{os.getppid()}.part", elsewhere, f".b.bin.{here}.{gone.pid}.part", ".a.bin.x.part",
            ".a.bin..part", f".a.bin.{here}.-1.part", f".a.bin.{here}.{'9' * 40}.part", "a.bin.7.part",
            f".a.bin.{gone.pid}.part"]  # fmt: skip
    old = [".a.bin.0badc0de.7.part", ".a.bin.8.part"]  # of elsewhere, and of an earlier release
    for name in [left, *kept, *old]:
        (tmp_path / name).write_bytes(b"half")
    for name in [*old, "a.bin.7.part", ".a.bin.x.part"]:
        os.utime(tmp_path / name, (0, 0))
    with atomic_file(path) as stream:
        stream.write(b"new")
    assert {entry.name for entry in tmp_path.iterdir()} == {"a.bin", *kept}


def test_part_of_a_host_of_the_same_name_is_not_removed(tmp_path, monkeypatch):
    path, boot = tmp_path / "a.bin", tmp_path / "boot_id"
    gone = subprocess.Popen([sys.executable, "-c", ""])
    gone.wait()
    monkeypatch.setattr(module, "_BOOT", boot)
    boot.write_text("one")
    with atomic_path(path) as part:
        part.touch()
    of_one = part.with_name(part.name.replace(str(os.getpid()), str(gone.pid)))
    of_one.write_bytes(b"half")
    boot.write_text("other")
    with atomic_file(path):
        pass
    assert of_one.exists()
    boot.write_text("one")
    with atomic_file(path):
        pass
    assert not of_one.exists()
