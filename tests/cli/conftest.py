"""Refusals of the command line."""

from __future__ import annotations

import pytest

from coview_stream.cli import main


@pytest.fixture
def refused(capsys):
    """Run a command that must be refused: exit code 2, one line on stderr, which is returned, and nothing on stdout."""

    def run(*words):
        capsys.readouterr()
        assert main([*map(str, words)]) == 2
        captured = capsys.readouterr()
        assert captured.out == ""
        assert captured.err.startswith("coview-stream: error: ")
        assert captured.err.count("\n") == 1
        return captured.err

    return run
