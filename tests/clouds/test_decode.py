"""The child that decodes: a dead decoder costs one error, and nothing is imported from the current directory."""

import os
import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from coview_stream.clouds import write_cloud
from coview_stream.clouds.cloud import CloudBuilder
from coview_stream.clouds.decode import DecodingChild
from coview_stream.clouds.python_child import python_command, python_environment
from coview_stream.errors import CloudError

POINTS = np.random.default_rng(2).normal(0, 20, (60, 3)).astype(np.float32)


class Deadly(CloudBuilder):
    """Builder that kills every child of this process, or raises, at the first chunk."""

    def __init__(self, error=None):
        super().__init__()
        self.error = error

    def add(self, raw, classification=None, dropped=0):
        if self.error is not None:
            raise self.error
        children = Path(f"/proc/{os.getpid()}/task/{os.getpid()}/children").read_text().split()
        for child in children:
            if b"decode_child" in Path(f"/proc/{child}/cmdline").read_bytes():
                os.kill(int(child), signal.SIGKILL)


def decoded(child, path):
    builder = CloudBuilder()
    child.ask({"path": str(path)}, builder)
    return len(builder.finish("cloud"))


@pytest.mark.slow
@pytest.mark.skipif(not Path("/proc/self/task").exists(), reason="finds the child by Linux's /proc")
def test_decoder_that_dies_costs_one_error_and_the_next_file_is_read(tmp_path):
    write_cloud(tmp_path / "a.laz", np.tile(POINTS, (40_000, 1)))  # several chunks, more than a pipe holds
    write_cloud(tmp_path / "b.laz", POINTS)
    child = DecodingChild()
    assert decoded(child, tmp_path / "b.laz") == 60
    with pytest.raises(CloudError, match=r"a\.laz: damaged or truncated LAZ \(the decoder broke off"):
        child.ask({"path": str(tmp_path / "a.laz")}, Deadly())
    assert decoded(child, tmp_path / "b.laz") == 60
    child.close()


@pytest.mark.slow
def test_file_given_up_half_way_leaves_nothing_for_the_next(tmp_path):
    write_cloud(tmp_path / "a.laz", np.tile(POINTS, (40_000, 1)))
    write_cloud(tmp_path / "b.laz", POINTS)
    child = DecodingChild()
    with pytest.raises(OSError, match="disk full"):
        child.ask({"path": str(tmp_path / "a.laz")}, Deadly(OSError("disk full")))
    assert decoded(child, tmp_path / "b.laz") == 60
    child.close()


@pytest.mark.slow
def test_the_process_that_decodes_laz_imports_nothing_from_the_current_directory(tmp_path):
    write_cloud(tmp_path / "a.laz", POINTS)
    (tmp_path / "laspy.py").write_text("open('executed', 'w')")
    code = "import os; from coview_stream.clouds import read_cloud; assert len(read_cloud('a.laz')) == 60"
    paths = os.pathsep.join(path for path in sys.path if path)
    subprocess.run(
        [sys.executable, "-P", "-c", code], cwd=tmp_path, check=True, env=os.environ | {"PYTHONPATH": paths}, timeout=60
    )
    assert not (tmp_path / "executed").exists()


def test_relative_entries_of_the_search_path_are_not_handed_on(monkeypatch, tmp_path):
    for entry in ("folder", ".", ""):
        monkeypatch.syspath_prepend(entry)
    monkeypatch.chdir(tmp_path)
    for name in ("numpy.py", "this.py"):
        (tmp_path / name).write_text("raise SystemExit('imported from the current directory')")
    ended = subprocess.run(
        python_command("this"), env=python_environment(), capture_output=True, text=True, timeout=60, check=False
    )
    assert (ended.returncode, ended.stderr) == (0, "")
    assert "Zen of Python" in ended.stdout
