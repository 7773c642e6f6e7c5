"""Ending on signals: waits are cut short, handlers are put back, a second interrupt is for good."""

from __future__ import annotations

import os
import signal
import threading
import time

import pytest

from coview_stream.cli.signals import Stop, stop_on_signals


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


def test_stop_clock_is_monotonic():
    stop = Stop()
    before = stop.now()
    assert stop.wait(0.02) is False
    assert stop.wait(-1.0) is False
    assert stop.now() >= before + 0.02
    stop.close()
