"""Ctrl-C ends a command with 130 wherever it comes, and its cleanup is done."""

import contextlib
import os
import signal
import subprocess
import time

import pytest

from coview_stream.cli import main
from coview_stream.clouds.python_child import python_command, python_environment

pytestmark = pytest.mark.skipif(os.name != "posix", reason="sends signals")
MOMENTS = 6


def interrupt():
    os.kill(os.getpid(), signal.SIGINT)
    time.sleep(60)


@pytest.mark.slow
def test_interrupt_that_is_dropped_is_raised_again(command):
    def run(args):
        for _ in range(2):  # as __del__ and weak references do
            with contextlib.suppress(KeyboardInterrupt):
                interrupt()
        time.sleep(60)
        return 0

    command(run)
    assert main(["info"]) == 130


@pytest.mark.slow
def test_cleanup_is_not_interrupted_by_the_same_interrupt(command):
    done = []

    def run(args):
        try:
            interrupt()
        finally:
            time.sleep(1.2)
            done.append("cleanup")

    command(run)
    assert main(["info"]) == 130
    assert done == ["cleanup"]


def test_error_that_a_library_makes_of_an_interrupt_is_not_told(command, capsys):
    def run(args):
        try:
            interrupt()
        except KeyboardInterrupt as error:
            raise ImportError("initialization failed") from error

    command(run)
    assert main(["info"]) == 130
    assert capsys.readouterr().err == "\n"


def test_command_in_the_background_goes_on(command):
    before = signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        command(lambda args: os.kill(os.getpid(), signal.SIGINT) or 0)
        assert main(["info"]) == 0
        assert signal.getsignal(signal.SIGINT) is signal.SIG_IGN
    finally:
        signal.signal(signal.SIGINT, before)


@pytest.mark.slow
@pytest.mark.parametrize("end", [".coview", "/"])
def test_build_ends_at_every_moment_and_leaves_nothing(map_cloud_file, tmp_path, end):
    def start(name):
        words = python_command("coview_stream", "build", str(map_cloud_file), "-o", f"{tmp_path}/{name}{end}")
        return subprocess.Popen(words, env=python_environment(), stderr=subprocess.PIPE, start_new_session=True)

    begin = time.monotonic()
    with start("whole") as whole:
        whole.communicate()
    assert whole.returncode == 0
    seconds = time.monotonic() - begin
    codes = []
    for moment in range(MOMENTS):
        with start(moment) as process:
            time.sleep(seconds * moment / MOMENTS)
            if process.poll() is not None:  # the machine is faster now
                continue
            os.killpg(process.pid, signal.SIGINT)
            _, error = process.communicate()
        codes.append(process.returncode)
        if process.returncode == 130:
            assert error == b"\n"
        elif process.returncode == 1:  # of the interpreter, before it imports anything of ours
            assert error.startswith((b"Fatal Python error: init_", b"Could not import runpy module")), error
        else:  # by the signal, while the interpreter starts or ends; at its end native threads rarely fault
            assert process.returncode in (-signal.SIGINT, -signal.SIGSEGV), error
        assert ends(process.pid)
    assert codes.count(130) >= 0.3 * MOMENTS
    assert not list(tmp_path.glob(".*.part"))


def ends(group):
    """Wait until no process of a group is left."""
    for _ in range(200):
        try:
            os.killpg(group, 0)
        except ProcessLookupError:
            return True
        time.sleep(0.05)
    return False
