"""Over real sockets: a message that is too large is not copied, and reports never wait."""

import os
import signal
import subprocess
import sys
import threading
import time
from contextlib import closing
from functools import partial

import pytest
import zenoh
from sockets import free_endpoint, until

from coview_stream.messages.types import Encoded, Sample
from coview_stream.stream.transport import zenoh_io as zenoh_samples
from coview_stream.stream.transport.zenoh_config import compose
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


def test_queries_beyond_the_bound_and_large_ones_are_refused_at_once_and_other_keys_answered():
    endpoint = free_endpoint()
    with closing(open_transport(listen=[endpoint])) as node, closing(open_transport(connect=[endpoint])) as robot:
        going_on, called, refused, answered = threading.Event(), [], [], []
        node.answer("r1/rpc/health", lambda parameters: {"ok": True})
        node.answer("r1/rpc/map_view", lambda parameters: called.append(1) or {"ok": going_on.wait(20.0)})
        until(lambda: robot.query("r1/rpc/health")["ok"])

        def take(reply):
            answered.append(1) if reply.ok else refused.append(reply.err.payload.to_bytes().decode())

        ask = partial(robot.session.get, "r1/rpc/map_view", take, timeout=20.0)
        ask(payload=bytes(2 * zenoh_samples.MAX_QUERY))
        ask(attachment=bytes(2 * zenoh_samples.MAX_QUERY))
        robot.session.get(f"r1/rpc/map_view?a={'x' * zenoh_samples.MAX_QUERY}", take, timeout=20.0)
        until(lambda: len(refused) == 3)
        assert all("at most" in text for text in refused)
        assert called == []
        for _ in range(zenoh_samples.MAX_QUERIES + 30):
            ask(payload=bytes(1000))
        until(lambda: len(refused) == 33)
        assert "ask later" in refused[-1]
        going_on.set()
        until(lambda: len(answered) == zenoh_samples.MAX_QUERIES)
        assert robot.query("r1/rpc/map_view")["ok"]  # there is room again
        assert len(called) == zenoh_samples.MAX_QUERIES + 1


@pytest.mark.slow
def test_answers_beyond_the_bound_are_not_received_and_the_session_goes_on():
    endpoint = free_endpoint()
    with (
        zenoh.open(compose((), [endpoint])) as server,
        zenoh.open(compose([endpoint], max_message=1_000_000)) as session,
    ):
        sizes = {"a/large": 20_000_000, "a/small": 900_000}
        queryable = server.declare_queryable("a/*", lambda q: q.reply(q.key_expr, bytes(sizes[str(q.key_expr)])))

        def ask(key):
            return [len(reply.ok.payload) for reply in session.get(key, timeout=10.0) if reply.ok is not None]

        until(lambda: ask("a/small") == [900_000])
        assert ask("a/large") == []
        until(lambda: ask("a/small") == [900_000])
        queryable.undeclare()


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
