"""Ending on signals: waits are cut short, handlers are put back, a second interrupt is for good."""

from __future__ import annotations

import os
import signal
import threading
import time

import pytest

from coview_stream.cli.signals import Stop, stop_on_signals


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_cuts_a_wait_short_and_handlers_are_put_back(number):
    before = signal.getsignal(number)
    with stop_on_signals() as stop:
        assert stop.wait(0.001) is False
        threading.Thread(target=os.kill, args=(os.getpid(), number)).start()
        started = time.monotonic()
        assert stop.wait(30.0) is True
        assert time.monotonic() - started < 20.0
        assert stop.wait(30.0) is True  # and every wait after it
    assert signal.getsignal(number) is before


def test_a_second_interrupt_is_for_good():
    with stop_on_signals() as stop:
        os.kill(os.getpid(), signal.SIGINT)
        assert stop.wait(5.0)
        with pytest.raises(KeyboardInterrupt):
            signal.raise_signal(signal.SIGINT)


def test_another_thread_may_ask_too_and_use_it():
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


def test_its_clock_is_steady():
    stop = Stop()
    before = stop.now()
    assert stop.wait(0.02) is False
    assert stop.wait(-1.0) is False
    assert stop.now() >= before + 0.02
    stop.close()
