"""Processes of commands that run for long: signals end waits, and every record of the log is one line of JSON."""

import ctypes
import json
import logging
import os
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

import pytest

from coview_stream.cli.process import JsonFormatter, LineFormatter, Stop, stop_on_signals


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_signal_ends_wait_and_handlers_are_restored(number):
    before = signal.getsignal(number)
    with stop_on_signals() as stop:
        assert stop.wait(0.001) is False
        threading.Thread(target=os.kill, args=(os.getpid(), number)).start()
        started = time.monotonic()
        assert stop.wait(30.0) is True
        assert time.monotonic() - started < 20.0
        assert stop.wait(30.0) is True  # and every wait after it
    assert signal.getsignal(number) is before


def test_second_interrupt_raises_keyboard_interrupt():
    with stop_on_signals() as stop:
        os.kill(os.getpid(), signal.SIGINT)
        assert stop.wait(5.0)
        with pytest.raises(KeyboardInterrupt):
            signal.raise_signal(signal.SIGINT)


def test_stop_can_be_requested_and_used_from_other_threads():
    stop = Stop()
    threading.Thread(target=stop.request).start()
    assert stop.wait(30.0) is True
    stop.close()
    stop.request()  # too late to matter

    found = []

    def elsewhere():  # where Python delivers no signals
        with stop_on_signals() as own:
            found.append(own.wait(0.001))

    thread = threading.Thread(target=elsewhere)
    thread.start()
    thread.join(10)
    assert found == [False]


def test_request_is_seen_only_after_it_was_written(monkeypatch):
    stop, seen = Stop(), []
    monkeypatch.setattr(os, "write", lambda *_: seen.append(stop.requested))
    stop.request()
    assert (seen, stop.requested) == ([False], True)  # or the pipe might be closed, and another one have its number
    stop.close()


def test_stop_clock_is_monotonic():
    stop = Stop()
    before = stop.now()
    assert stop.wait(0.02) is False
    assert stop.wait(-1.0) is False
    assert stop.now() >= before + 0.02
    stop.close()


WAITS = """
import threading, time
from coview_stream.cli.process import stop_on_signals
threading.Thread(target=time.sleep, args=(90,), daemon=True).start()
with stop_on_signals() as stop:
    print("waits", flush=True)
    print(stop.wait(60), flush=True)
"""


def signal_another_thread(pid, number):
    """Have the kernel hand a signal to a thread of a process that is not its first."""
    other = next(int(task.name) for task in Path(f"/proc/{pid}/task").iterdir() if int(task.name) != pid)
    assert ctypes.CDLL(None).tgkill(pid, other, number) == 0


@pytest.mark.skipif(sys.platform != "linux", reason="chooses the thread by tgkill")
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_signal_that_another_thread_takes_ends_the_wait(number):
    paths = os.pathsep.join(p for p in sys.path if p)
    command = [sys.executable, "-c", WAITS]
    with subprocess.Popen(command, stdout=subprocess.PIPE, env=os.environ | {"PYTHONPATH": paths}) as process:
        try:
            assert process.stdout.readline() == b"waits\n"
            time.sleep(0.2)  # it may not have come to the wait yet, which no line could tell
            signal_another_thread(process.pid, number)
            assert process.wait(20.0) == 0  # not sixty
            assert process.stdout.read() == b"True\n"
        finally:
            process.kill()


@pytest.mark.skipif(not hasattr(signal, "SIGHUP"), reason="no such signal")
def test_hangup_wakes_the_wait_and_does_not_end_it():
    hangups = []
    wakeup, before = signal.set_wakeup_fd(-1), signal.getsignal(signal.SIGHUP)
    with stop_on_signals(lambda: hangups.append(1)) as stop:
        os.kill(os.getpid(), signal.SIGHUP)
        assert stop.wait(30.0) is False
        assert hangups == [1]
        assert stop.wait(0.001) is False
        os.kill(os.getpid(), signal.SIGTERM)
        assert stop.wait(30.0) is True
        assert stop.wait(30.0) is True
    assert signal.getsignal(signal.SIGHUP) is before
    assert signal.set_wakeup_fd(wakeup) == -1


@pytest.mark.parametrize("error", [None, ValueError("wrong")])
def test_record_is_one_line_of_json_with_its_exception(error):
    info = None if error is None else (ValueError, error, None)
    text, arguments = 'r1: %s\n(second "line" é)', ("LOST",)
    record = logging.LogRecord("coview_stream.node", logging.WARNING, __file__, 1, text, arguments, info)
    line = JsonFormatter().format(record)
    assert "\n" not in line
    fields = json.loads(line)
    assert fields["message"] == 'r1: LOST\n(second "line" é)'
    assert (fields["level"], fields["logger"]) == ("WARNING", "coview_stream.node")
    assert fields["time"].endswith("+00:00")
    assert ("exception" in fields) == (error is not None)
    assert error is None or "ValueError: wrong" in fields["exception"]


def test_log_line_is_printable_and_its_exception_follows():
    error = ValueError("wrong")
    arguments = (logging.WARNING, __file__, 1, "%s", ("\x1b[2J\nfake line",), (ValueError, error, None))
    first, *rest = LineFormatter("%(message)s").format(logging.LogRecord("a", *arguments)).splitlines()
    assert first == " [2J fake line"
    assert rest == ["ValueError: wrong"]
