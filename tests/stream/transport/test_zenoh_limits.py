"""Over real sockets: a message that is too large is not copied, and reports never wait."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from contextlib import closing

import pytest
import zenoh
from sockets import free_endpoint, until

from coview_stream.messages.types import Encoded, Sample
from coview_stream.stream.transport import zenoh_io as zenoh_samples
from coview_stream.stream.transport.zenoh_transport import open_transport


def test_oversized_message_is_delivered_as_its_size():
    endpoint = free_endpoint()
    with (
        closing(open_transport(listen=[endpoint], max_payload=1000)) as node,
        closing(open_transport(connect=[endpoint])) as robot,
    ):
        got = []
        node.subscribe("r1/x", got.append, "all")
        publisher = robot.publisher("r1/x", "data")
        publisher.put(Encoded(bytes(1000), "a/b"))
        publisher.put(Encoded(bytes(1001), "a/b"))
        publisher.put(Encoded(bytes(5_000_000)))
        publisher.put(Encoded(b"small", "", bytes(996)))  # an attachment can be as large
        publisher.put(Encoded(b"last", "", b"!"))
        until(lambda: len(got) == 5)
        assert got == [
            Sample("r1/x", bytes(1000), "a/b"),
            Sample("r1/x", b"", "a/b", size=1001),
            Sample("r1/x", b"", size=5_000_000),
            Sample("r1/x", b"", size=1001),
            Sample("r1/x", b"last", "", b"!"),
        ]


def test_oversized_message_is_not_copied():
    class Bytes:
        def __len__(self):
            return 2000

        def to_bytes(self):
            raise AssertionError("copied")

    class Big:
        key_expr, encoding, payload, attachment = "k", "zenoh/bytes", Bytes(), None

    assert zenoh_samples.plain(Big(), 1999) == Sample("k", b"", size=2000)


def test_only_reliable_messages_may_block():
    quality = {name: zenoh_samples.quality(name) for name in ("realtime", "data", "report")}
    control = zenoh.CongestionControl
    assert quality["data"]["congestion_control"] == control.BLOCK
    assert quality["report"] == {"congestion_control": control.DROP}
    assert quality["realtime"]["congestion_control"] == control.DROP


READER = """
import sys, zenoh
config = zenoh.Config.from_json5(sys.argv[1])
session = zenoh.open(config)
got = session.declare_subscriber("**", lambda sample: None)
print("up", flush=True)
sys.stdin.read()
"""


@pytest.mark.slow
def test_status_reports_do_not_block_on_stuck_reader():
    address = free_endpoint()
    node = open_transport(listen=[f"{address}#so_sndbuf=8192"])
    config = f"""{{mode: "client", connect: {{endpoints: ["{address}#so_rcvbuf=8192"]}},
                   scouting: {{multicast: {{enabled: false}}}}}}"""
    command = [sys.executable, "-c", READER, config]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE) as reader:
        try:
            assert reader.stdout.readline() == b"up\n"
            until(lambda: node.connection().peers)
            os.kill(reader.pid, signal.SIGSTOP)
            report = node.publisher("r1/out/status", "report")
            begin = time.monotonic()
            for _ in range(1000):  # far more than the link holds
                report.put(Encoded(bytes(2500)))
            assert time.monotonic() - begin < 4.5  # waiting for a place takes zenoh 5 s, after which it closes the link
            assert node.connection().peers
        finally:
            reader.kill()
            node.close()
