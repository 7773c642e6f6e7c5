import logging

import pytest

from coview_stream.errors import ConfigError, TransportError
from coview_stream.messages.types import Encoded, Sample
from coview_stream.stream.transport.memory_transport import MemoryTransport


def test_raising_handler_is_recorded_and_called_again(caplog):
    net = MemoryTransport()
    calls = []

    def handler(sample):
        calls.append(sample.payload)
        raise ValueError("bad frame")

    net.subscribe("a", handler, "newest")
    with caplog.at_level(logging.ERROR):
        for number in range(3):
            net.publish(Sample("a", bytes([number])))
    assert calls == [b"\0", b"\1", b"\2"]
    assert [str(error) for error in net.raised] == ["bad frame"] * 3
    assert len(caplog.records) == 1


def test_network_outage_and_return():
    net = MemoryTransport()
    heard = []
    net.subscribe("a", heard.append, "all")
    net.answer("q", lambda _: {})
    net.announce("alive")
    publisher = net.publisher("a", "data")
    assert net.connection().routers == ("memory",)
    net.go_away()
    publisher.put(Encoded(b"lost"))
    assert (net.connection().routers, net.announced, net.lost, heard) == ((), (), 1, [])
    with pytest.raises(TransportError):
        net.query("q")
    assert net.tokens("**") == []
    net.come_back()
    assert net.tokens("*") == ["alive"]
    publisher.put(Encoded(b"here"))
    assert [sample.payload for sample in heard] == [b"here"]
    assert (net.connection().routers, net.announced, net.query("q")) == (("memory",), ("alive",), {})


def test_close_is_complete_and_idempotent():
    net, heard = MemoryTransport(), []
    net.subscribe("a", heard.append, "all")
    net.announce("alive")
    net.close()
    net.close()
    net.publish(Sample("a", b""))
    assert (heard, net.announced, net.closed, net.connection().routers) == ([], (), True, ())


def test_invalid_zenoh_key_is_refused():
    with pytest.raises(ConfigError):
        MemoryTransport().subscribe("a//b", print, "all")
    with pytest.raises(ConfigError):
        MemoryTransport().publisher("a/*", "data")
