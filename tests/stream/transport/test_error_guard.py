"""Errors of handlers in the log: how often, of how many places, and in which letters."""

import logging

import pytest

from coview_stream.stream.transport.error_guard import RateLimitedErrors

LOGGER = logging.getLogger("test")


def test_one_line_a_place_and_interval_says_how_many_there_were(caplog):
    now = [0.0]
    errors = RateLimitedErrors(LOGGER, 10.0, lambda: now[0])
    for second in range(15):
        now[0] = float(second)
        errors.report("a", ValueError("bad"))
    assert [record.getMessage() for record in caplog.records] == [
        "a: ValueError: bad",
        "a: ValueError: bad (9 more since the last line)",
    ]


def test_keys_of_strangers_are_bounded_and_reach_no_terminal_raw(caplog):
    errors = RateLimitedErrors(LOGGER, 10.0, lambda: 0.0)
    errors.report("coview/\x1b[2J/x", ValueError("\x1b]0;owned\x07\nnext line"))
    (record,) = caplog.records
    assert record.getMessage().isprintable()
    for number in range(5000):
        errors.report(f"coview/x{number}", ValueError("bad"))
    assert len(errors._last) < 1000


def test_panics_of_rust_are_caught_and_interrupts_are_not():
    class PanicException(BaseException):
        pass

    errors = RateLimitedErrors(LOGGER)
    with errors.catch("k") as caught:
        raise PanicException("rust")
    assert "rust" in str(caught.error)
    with pytest.raises(KeyboardInterrupt), errors.catch("k"):
        raise KeyboardInterrupt
