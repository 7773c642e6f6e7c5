import json
import logging
import socket
import subprocess
import sys
import threading
import time
from contextlib import closing
from pathlib import Path
from types import SimpleNamespace

import pytest
from sockets import free_endpoint, until
from zenoh_routers import Router, RouterProcess

from coview_stream.errors import TransportError
from coview_stream.messages.types import Encoded, Sample
from coview_stream.stream.transport.error_guard import RateLimitedErrors
from coview_stream.stream.transport.transport import Connection
from coview_stream.stream.transport.zenoh_config import compose, reason
from coview_stream.stream.transport.zenoh_io import MAX_INBOX, THREADS, Inboxes
from coview_stream.stream.transport.zenoh_transport import open_transport

ROOT = Path(__file__).parents[3]


@pytest.fixture
def pair():
    """Two transports that talk: a listening peer and its client."""
    endpoint = free_endpoint()
    with closing(open_transport(listen=[endpoint])) as node, closing(open_transport([endpoint])) as robot:
        yield node, robot


def test_closed_inbox_handles_nothing():
    inboxes = Inboxes(RateLimitedErrors(logging.getLogger("test")))
    worker = threading.Thread(target=inboxes.run)
    handled = []
    closed = inboxes.open("a", handled.append, 10)
    closed.close()
    first, second = SimpleNamespace(payload=b"1", attachment=None), SimpleNamespace(payload=b"2", attachment=None)
    closed.put(first)
    inboxes.open("b", handled.append, 10).put(second)
    worker.start()
    until(lambda: bool(handled))
    inboxes.end()
    worker.join(5.0)
    assert handled == [second]


def test_large_samples_that_wait_are_bounded_and_the_newest_is_kept():
    inboxes = Inboxes(RateLimitedErrors(logging.getLogger("test")))
    handled = []
    inbox = inboxes.open("a", handled.append, 1000)
    samples = [SimpleNamespace(payload=range(MAX_INBOX // 4), attachment=None) for _ in range(50)]
    samples += [
        SimpleNamespace(payload=b"", attachment=range(2 * MAX_INBOX)),
        SimpleNamespace(payload=b"", attachment=b""),
    ]
    for sample in samples[:-2]:
        inbox.put(sample)
    inbox.work()
    assert handled == [samples[46]]  # four remain of fifty, the oldest is the first
    inbox.put(samples[-2])  # larger than all of the room
    inbox.put(samples[-1])
    for _ in range(10):
        inbox.work()
    assert handled == [samples[46], samples[-1]]


@pytest.mark.parametrize("selector", ["**", "coview/**", "coview/*/rpc/*", "coview/@node/**", "*/r1/rpc/reset"])
def test_question_with_a_wildcard_calls_no_handler(pair, selector):
    node, robot = pair
    called = []
    for key in ("coview/r1/rpc/reset", "coview/@node/r1/rpc/reload"):
        node.answer(key, lambda _, key=key: called.append(key) or {"ok": True})
    until(lambda: robot.query("coview/r1/rpc/reset")["ok"], 20.0)
    assert robot.query("coview/@node/r1/rpc/reload")["ok"]
    called.clear()
    replies = ask(robot, selector)
    assert called == []
    assert replies
    assert all(reply.ok is None for reply in replies)
    assert robot.query("coview/r1/rpc/reset")["ok"]  # its own key still does


def ask(transport, selector):
    return list(transport.session.get(selector, timeout=5.0))


def test_samples_arrive_unchanged(pair):
    node, robot = pair
    got = []
    node.subscribe("r1/in/*", got.append, "all")
    odometry = robot.publisher("r1/in/odom", "data")
    cloud = robot.publisher("r1/in/cloud", "bulk")
    frame = bytes(range(256)) * 8192  # 2 MB: fragmented
    odometry.put(Encoded(b"{}", "application/json", b"\x01\x02"))
    cloud.put(Encoded(frame, "application/octet-stream;layout=xyz"))
    odometry.put(Encoded(b"bare"))
    until(lambda: len(got) == 3)
    assert sorted(got, key=lambda sample: len(sample.payload)) == [
        Sample("r1/in/odom", b"{}", "application/json", b"\x01\x02"),
        Sample("r1/in/odom", b"bare", "", None),
        Sample("r1/in/cloud", frame, "application/octet-stream;layout=xyz", None),
    ]


def test_deletes_are_not_delivered(pair):
    node, robot = pair
    got = []
    node.subscribe("r1/in/odom", got.append, "all")
    publisher = robot.publisher("r1/in/odom", "data")
    robot.session.delete("r1/in/odom")
    publisher.put(Encoded(b"after"))
    until(lambda: got)
    assert [sample.payload for sample in got] == [b"after"]


def test_newest_subscription_skips_and_all_subscription_does_not(pair):
    node, robot = pair
    go = threading.Event()
    newest, every = [], []

    def slow(sample):
        newest.append(sample.payload)
        assert go.wait(10)

    node.subscribe("r1/x", slow, "newest")
    node.subscribe("r1/x", lambda sample: every.append(sample.payload), "all")
    publisher = robot.publisher("r1/x", "data")
    publisher.put(Encoded(b"first"))
    until(lambda: newest)
    for number in range(200):
        publisher.put(Encoded(str(number).encode()))
    until(lambda: len(every) == 201)
    go.set()
    until(lambda: newest[-1] == b"199")
    assert newest[0] == b"first"
    assert len(newest) <= 3  # the last may still have been on its way to this reader
    assert every == [b"first", *(str(number).encode() for number in range(200))]


def test_slow_handlers_hold_up_no_others_while_a_thread_is_free(pair):
    node, robot = pair
    go = threading.Event()
    got = []
    for number in range(THREADS - 1):
        node.subscribe(f"slow/{number}", lambda _: go.wait(10.0), "all")
    node.subscribe("quick", lambda sample: got.append(sample.payload), "all")
    publishers = [robot.publisher(f"slow/{number}", "data") for number in range(THREADS - 1)]
    publishers.append(robot.publisher("quick", "data"))
    for number in range(5):
        for publisher in publishers:
            publisher.put(Encoded(bytes([number])))
    until(lambda: got == [bytes([number]) for number in range(5)])
    go.set()


def test_raising_handler_is_kept_and_logged_once(pair, caplog):
    node, robot = pair
    got = []

    def handler(sample):
        got.append(sample.payload)
        raise ValueError("cannot decode this")

    node.subscribe("r1/x", handler, "all")
    publisher = robot.publisher("r1/x", "data")
    for number in range(5):
        publisher.put(Encoded(bytes([number])))
    until(lambda: len(got) == 5)
    lines = [record.getMessage() for record in caplog.records if record.levelno == logging.ERROR]
    assert lines == ["r1/x: ValueError: cannot decode this"]


def test_queries_reply_json_and_errors(pair):
    node, robot = pair

    def refuse(_):
        raise ValueError("not now")

    end = node.answer("r1/rpc/reset", lambda parameters: {"got": parameters})
    node.answer("r1/rpc/relocalize", refuse)
    until(lambda: ask(robot, "r1/rpc/*"))
    (reply,) = ask(robot, "r1/rpc/reset?why=test;x=1")
    assert json.loads(reply.ok.payload.to_bytes()) == {"got": {"why": "test", "x": "1"}}
    assert str(reply.ok.encoding) == "application/json"
    (reply,) = ask(robot, "r1/rpc/relocalize")
    assert json.loads(reply.err.payload.to_bytes()) == {"error": "not now"}
    assert len(ask(robot, "r1/rpc/*")) == 2  # each on its own key
    end()
    end()
    until(lambda: not ask(robot, "r1/rpc/reset"))


@pytest.mark.slow
def test_transport_recovers_after_router_is_killed(caplog):
    endpoint = free_endpoint()
    clouds, poses = [], []

    def works():
        cloud.put(Encoded(b"cloud"))
        pose.put(Encoded(b"pose"))
        return bool(clouds and poses and ask(robot, "r1/rpc/reset") and robot.tokens("r1/alive"))

    # both before their router
    with closing(open_transport(connect=[endpoint])) as node, closing(open_transport(connect=[endpoint])) as robot:
        node.subscribe("r1/in/**", clouds.append, "newest")
        node.answer("r1/rpc/reset", lambda _: {"ok": True})
        node.announce("r1/alive")
        pose = node.publisher("r1/out/pose", "realtime")
        robot.subscribe("r1/out/pose", poses.append, "all")
        cloud = robot.publisher("r1/in/cloud", "bulk")
        assert node.connection() == Connection()
        assert any("no node or router" in record.getMessage() for record in caplog.records)
        for _ in range(3):
            clouds.clear()
            poses.clear()
            pose.put(Encoded(b"without reader"))  # never raises
            with RouterProcess(endpoint):
                until(lambda: node.connection().routers and robot.connection().routers)
                until(works)
            until(lambda: node.connection() == robot.connection() == Connection())
        assert b"without reader" not in [sample.payload for sample in poses]


@pytest.mark.slow
def test_silent_host_does_not_block_opening():
    with socket.socket() as silent:
        silent.bind(("127.0.0.1", 0))
        silent.listen()
        start = time.monotonic()
        transport = open_transport(connect=[f"tcp/127.0.0.1:{silent.getsockname()[1]}"])
        transport.subscribe("a", print, "all")
        assert transport.connection() == Connection()
        middle = time.monotonic()
        transport.close()
        assert time.monotonic() - middle < 1.0
        assert middle - start < 5.0  # zenoh alone would wait for 10


@pytest.mark.slow
def test_process_without_close_exits_cleanly():
    program = (
        "import socket\n"
        "from coview_stream.stream.transport.zenoh_transport import open_transport\n"
        "silent = socket.socket(); silent.bind(('127.0.0.1', 0)); silent.listen()\n"
        "a = open_transport(connect=[f'tcp/127.0.0.1:{silent.getsockname()[1]}'])\n"
        "b = open_transport()\n"
        "b.subscribe('x', print, 'newest')\n"
    )
    done = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True, timeout=30, cwd=ROOT, check=False
    )
    assert done.returncode == 0, done.stderr
    assert "FATAL" not in done.stderr


@pytest.mark.slow
def test_close_ends_all_threads_and_is_idempotent():
    with Router() as router:
        transport = open_transport(connect=[router.endpoint])
        transport.subscribe("a", print, "all")
        transport.subscribe("b", print, "newest")
        transport.answer("c", lambda _: {})
        publisher = transport.publisher("d", "data")
        mine = {thread for thread in threading.enumerate() if thread.name.startswith("coview ")}
        assert {"coview inboxes 1", "coview answers"} <= {thread.name for thread in mine}
        start = time.monotonic()
        transport.close()
        assert time.monotonic() - start < 1.0
        transport.close()
        assert not any(thread.is_alive() for thread in mine)
        publisher.put(Encoded(b"late"))
        publisher.close()
        assert transport.connection() == Connection()
        with pytest.raises(TransportError, match="closed"):
            transport.subscribe("a", print, "all")


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"connect": ["127.0.0.1:7447"]}, "--connect.*tcp/127.0.0.1:7447"),
        ({"connect": ["tcp/127.0.0.1"]}, "--connect.*<host>:<port>"),
        ({"connect": ["tcp/127.0.0.1:70000"]}, r"--connect 'tcp/127.0.0.1:70000'.*port must be 1\.\.65535"),
        ({"listen": ["tcp/[::1]:65536"]}, r"--listen.*1\.\.65535"),
        ({"connect": ["tls/robot.local:0"]}, r"--connect.*1\.\.65535"),
        ({"listen": ["http/127.0.0.1:80"]}, "--listen.*protocols"),
        ({"listen": ["tcp/203.0.113.7:7447"]}, "203.0.113.7.*assign.*no address of this machine: --listen on"),
        ({"config": '{connect: {endpoints: ["foo"]}}'}, "foo"),
        ({"config": "{transport: {unicast: {lowlatency: true, qos: {enabled: false}}}}"}, "lowlatency"),
        (
            {"config": '{transport: {link: {tls: {root_ca_certificate: "no/ca.pem"}}}}'},
            "root_ca_certificate.*no/ca.pem",
        ),
    ],
)
def test_invalid_configuration_is_refused_at_once(options, message, tmp_path):
    if "config" in options:
        path = tmp_path / "zenoh.json5"
        path.write_text(options["config"])
        options = {**options, "config": path}
        message = f"zenoh.json5.*{message}"
    with pytest.raises(TransportError, match=message) as caught:
        open_transport(**options)
    assert "\n" not in str(caught.value)
    assert ".rs:" not in str(caught.value)


def test_missing_config_file_and_busy_port_are_named(tmp_path):
    with pytest.raises(TransportError, match=r"gone\.json5: No such file"):
        open_transport(config=tmp_path / "gone.json5")
    endpoint = free_endpoint()
    with (
        closing(open_transport(listen=[endpoint])),
        pytest.raises(TransportError, match=r"in use.*holds the port: --connect to it, or another --listen") as caught,
    ):
        open_transport(listen=[endpoint])
    assert endpoint in str(caught.value)


def test_invalid_key_is_refused_without_router():
    transport = open_transport(connect=[free_endpoint()])
    with pytest.raises(TransportError, match="a//b"):
        transport.subscribe("a//b", print, "all")
    transport.close()


def settings(config, *keys):
    return [json.loads(config.get_json(key)) for key in keys]


ENDPOINTS = ("mode", "connect/endpoints", "listen/endpoints")


def test_mode_follows_from_the_endpoints():
    assert settings(compose(["tcp/h:1"]), *ENDPOINTS) == ["client", ["tcp/h:1"], []]
    assert settings(compose((), ["tcp/h:2"]), *ENDPOINTS) == ["peer", [], ["tcp/h:2"]]
    assert settings(compose(["tcp/h:1"], ["tcp/h:2"]), *ENDPOINTS) == ["peer", ["tcp/h:1"], ["tcp/h:2"]]
    assert settings(compose(), *ENDPOINTS) == ["peer", [], []]


def test_config_file_overrides_defaults_and_options_override_its_endpoints(tmp_path):
    keys = (
        *ENDPOINTS,
        "scouting/multicast/enabled",
        "transport/shared_memory/enabled",
        "transport/unicast/open_timeout",
    )
    assert settings(compose(), *keys)[3:] == [False, False, 3000]
    path = tmp_path / "zenoh.json5"
    path.write_text("""{ // a comment about shared_memory decides nothing
        connect: { endpoints: ["tcp/h:1"], retry: { period_init_ms: 7 } },
        scouting: { multicast: { enabled: true } },
        transport: { unicast: { open_timeout: 1234 } },
    }""")
    composed = compose(path=path)
    assert settings(composed, *keys) == ["client", ["tcp/h:1"], [], True, False, 1234]
    assert settings(composed, "connect/retry")[0]["period_init_ms"] == 7
    assert settings(compose(["tcp/h:9"], ["tcp/h:8"], path), *ENDPOINTS) == ["peer", ["tcp/h:9"], ["tcp/h:8"]]
    path.write_text('{ mode: "router", transport: { shared_memory: { enabled: true } } }')
    mode, _, listen, _, shared, _ = settings(compose(path=path), *keys)
    assert (mode, shared) == ("router", True)
    assert listen["router"] == ["tcp/[::]:7447"]


def test_subscription_that_is_ended_hears_nothing(pair):
    node, robot = pair
    heard, others = [], []
    end = node.subscribe("coview/r1/in/cloud", lambda sample: heard.append(bytes(sample.payload)), "newest")
    node.subscribe("coview/r1/in/odom", lambda sample: others.append(bytes(sample.payload)), "all")
    cloud, odom = (robot.publisher(f"coview/r1/in/{name}", "report") for name in ("cloud", "odom"))

    def sent():
        cloud.put(Encoded(b"1", ""))
        odom.put(Encoded(b"2", ""))
        return bool(heard and others)

    until(sent)
    end()
    end()  # more than once does no harm
    count, other = len(heard), len(others)
    until(lambda: sent() and len(others) > other + 3)
    assert len(heard) == count
    again = node.subscribe("coview/r1/in/cloud", lambda sample: heard.append(b"again"), "newest")
    until(lambda: sent() and b"again" in heard)
    again()


def test_lease_is_what_is_asked_for_unless_the_file_says():
    assert "2000" in str(compose(lease_ms=2000).get_json("transport/link/tx/lease"))
    assert "10000" in str(compose().get_json("transport/link/tx/lease"))


@pytest.mark.parametrize(
    ("name", "text", "said"),
    [
        ("a.json5", "{\n conect: {}\n}", "line 2: unknown key 'conect'; did you mean 'connect'?"),
        ("a.json5", "{transport: {auth: {usrpwd: {usr: 1}}}}", "line 1: unknown key 'usr'; did you mean 'user'?"),
        ("a.json5", "{qwertz: 1}", "line 1: unknown key 'qwertz'; take it out"),
        ("a.yaml", "mode: client\nconect: 3\n", "unknown key 'conect'; did you mean 'connect'?"),
        ("a.json5", '{mode: "klient"}', "line 1: unknown variant `klient`, expected one of `router`, `peer`, `client`"),
        ("a.json5", '{connect: {endpoints: "x"}}', 'line 1: invalid type: string "x", expected'),
        ("a.json5", "{mode:", "line 1, column 7: expected"),
    ],
)
def test_configuration_errors_are_one_short_line(tmp_path, name, text, said):
    path = tmp_path / name
    path.write_text(text)
    with pytest.raises(TransportError) as caught:
        compose(path=path)
    message = str(caught.value)
    assert message.startswith(f"zenoh configuration {path}: {said}")
    assert len(message) < len(str(path)) + 150
    assert "\n" not in message


def test_other_errors_are_unchanged():
    assert reason(ValueError("it broke\n at io/x.rs:12.")) == "it broke"
    assert reason(ValueError("")) == "ValueError"
