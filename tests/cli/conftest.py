"""Refusals of the command line."""

import contextlib
import subprocess
import sys
from types import SimpleNamespace

import pytest

from coview_stream.cli import main
from coview_stream.clouds.python_child import python_command, python_environment


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


@pytest.fixture
def start():
    """Start a command as a process, which is killed when the test ends."""
    with contextlib.ExitStack() as stack:

        def run(*words):
            command, pipe = python_command("coview_stream", *map(str, words)), subprocess.PIPE
            process = subprocess.Popen(command, env=python_environment(), stdout=pipe, stderr=pipe, text=True)
            stack.enter_context(process)
            stack.callback(process.kill)
            return process

        yield run


@pytest.fixture
def command(monkeypatch):
    """Puts another command in the place of ``info``."""

    def install(run, add_arguments=lambda parser: None):
        module = SimpleNamespace(HELP="acts", add_arguments=add_arguments, run=run)
        monkeypatch.setitem(sys.modules, "coview_stream.cli.info", module)

    return install
