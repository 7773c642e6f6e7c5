"""Commands as processes, and another in the place of one."""

import contextlib
import subprocess
import sys
from types import SimpleNamespace

import pytest

from coview_stream.clouds.python_child import python_command, python_environment


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
