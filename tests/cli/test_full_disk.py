"""A disk that is full while a map is built or a run is localized: one line, and the files before it stay."""

import subprocess
from pathlib import Path

import pytest

resource = pytest.importorskip("resource", reason="limits of processes are of POSIX")

from coview_stream.clouds.python_child import python_command, python_environment  # noqa: E402

pytestmark = pytest.mark.slow


def run_on_a_full_disk(*args):
    """Run a command that can write files of 30 kB at most, as on a full disk; return its stderr."""

    def limit():
        resource.setrlimit(resource.RLIMIT_FSIZE, (30_000, 30_000))

    command = python_command("coview_stream", *map(str, args))
    done = subprocess.run(command, env=python_environment(), preexec_fn=limit, capture_output=True, text=True)
    assert done.returncode == 2
    assert "Traceback" not in done.stderr
    return done.stderr


def test_map_that_cannot_be_written_leaves_the_one_before(map_cloud_file, world_file, tmp_path):
    site, before = tmp_path / "site.coview", Path(world_file).read_bytes()
    site.write_bytes(before)
    error = run_on_a_full_disk("build", map_cloud_file, "-o", site, "--no-learned")
    assert "site.coview: cannot write the map" in error
    assert [path.name for path in tmp_path.iterdir()] == ["site.coview"]
    assert site.read_bytes() == before


def test_results_that_cannot_be_written_are_one_line_and_no_halves(world_file, world_run, tmp_path):
    out = tmp_path / "out"
    assert "cannot be written" in run_on_a_full_disk("locate", world_file, world_run, "-o", out)
    assert not [path for path in out.iterdir() if path.name.endswith(".part")]
