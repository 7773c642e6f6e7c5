"""Logs for machines: every record is one line of JSON."""

from __future__ import annotations

import json
import logging
import sys

from coview_stream.cli.process import JsonFormatter


def record(message, *args, error=None):
    info = None
    if error is not None:
        try:
            raise error
        except type(error):
            info = sys.exc_info()
    return logging.LogRecord("coview_stream.node", logging.WARNING, __file__, 1, message, args, info)


def test_record_is_one_line_of_json():
    line = JsonFormatter().format(record('r1: %s\n(second "line" é)', "LOST"))
    assert "\n" not in line
    read = json.loads(line)
    assert read["message"] == 'r1: LOST\n(second "line" é)'
    assert (read["level"], read["logger"]) == ("WARNING", "coview_stream.node")
    assert read["time"].endswith("+00:00")
    assert "exception" not in read


def test_exception_is_part_of_the_line():
    line = JsonFormatter().format(record("failed", error=ValueError("what was wrong")))
    assert "\n" not in line
    assert "ValueError: what was wrong" in json.loads(line)["exception"]
