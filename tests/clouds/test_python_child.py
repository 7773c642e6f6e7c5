"""Children that run our modules import nothing from the current directory."""

from __future__ import annotations

import subprocess
import sys

from coview_stream.clouds.python_child import python_command, python_environment


def test_relative_entries_of_the_search_path_are_not_handed_on(monkeypatch, tmp_path):
    monkeypatch.setattr(sys, "path", ["", ".", "folder", *sys.path])
    monkeypatch.chdir(tmp_path)
    for name in ("numpy.py", "this.py"):
        (tmp_path / name).write_text("raise SystemExit('imported from the current directory')")
    ended = subprocess.run(
        python_command("this"), env=python_environment(), capture_output=True, text=True, timeout=60, check=False
    )
    assert (ended.returncode, ended.stderr) == (0, "")
    assert "Zen of Python" in ended.stdout
