"""Each configuration in examples/zenoh works as its comments say, on loopback and another port."""

import subprocess
import sys
from contextlib import closing, contextmanager
from pathlib import Path

import pytest
import zenoh
from sockets import free_endpoint, until
from zenoh_routers import Router

from coview_stream.messages.types import Encoded
from coview_stream.stream.transport.keys import robot_keys
from coview_stream.stream.transport.zenoh_transport import open_transport

EXAMPLES = Path(__file__).parents[3] / "examples" / "zenoh"


def moved(source, folder, endpoint):
    """Copy an example into ``folder``, with the port of ``endpoint`` in place of zenoh's own."""
    text = source.read_text()
    assert ":7447" in text
    target = folder / source.name
    target.write_text(text.replace(":7447", ":" + endpoint.rpartition(":")[2]))
    return target


def check_round_trip(node, robot, name="r1"):
    """A cloud in, a pose out, a question answered, the node seen alive."""
    keys = robot_keys("native", "coview", name)
    clouds, poses = [], []
    node.subscribe(keys.cloud, clouds.append, "newest")
    node.answer(keys.reset, lambda _: {"ok": True})
    node.announce(keys.alive)
    robot.subscribe(keys.pose, poses.append, "all")
    cloud, pose = robot.publisher(keys.cloud, "bulk"), node.publisher(keys.pose, "realtime")

    def both():
        cloud.put(Encoded(bytes(100_000)))
        pose.put(Encoded(b"pose"))
        return bool(clouds and poses)

    until(both)
    until(lambda: any(reply.ok for reply in robot.session.get(keys.reset, timeout=2.0)))
    until(lambda: robot.tokens(keys.alive))


def test_peer_example_on_one_machine(tmp_path):
    endpoint = free_endpoint()
    config = moved(EXAMPLES / "peer.json5", tmp_path, endpoint)
    with closing(open_transport(config=config)) as node, closing(open_transport([endpoint])) as robot:
        check_round_trip(node, robot)


@pytest.mark.slow
def test_router_example_connects_clients(tmp_path):
    with Router() as router:
        config = moved(EXAMPLES / "client.json5", tmp_path, router.endpoint)
        with closing(open_transport(config=config)) as node, closing(open_transport(config=config)) as robot:
            check_round_trip(node, robot)
            assert len(node.connection().routers) == 1


@pytest.fixture(scope="module")
def certificates(tmp_path_factory):
    folder = tmp_path_factory.mktemp("mtls")
    program = EXAMPLES / "mtls" / "make_certificates.py"
    command = [sys.executable, str(program), "certificates", "--router", "127.0.0.1", "localhost"]
    subprocess.run([*command, "--names", "node", "r1", "r2"], cwd=folder, check=True, timeout=60)
    return folder


@contextmanager
def secured(folder):
    """Run the mTLS router; yields its endpoint. The copies of the other two examples point to it."""
    endpoint = free_endpoint()
    for name in ("router", "node", "robot"):
        moved(EXAMPLES / "mtls" / f"{name}.json5", folder, endpoint)
    text = (folder / "robot.json5").read_text()
    (folder / "robot2.json5").write_text(text.replace("certificates/r1.", "certificates/r2."))
    router = zenoh.open(zenoh.Config.from_file(str(folder / "router.json5")))
    try:
        yield endpoint.replace("tcp/", "tls/")
    finally:
        router.close()


@pytest.mark.slow
def test_access_control_example_limits_robots_to_their_keys(certificates, monkeypatch):
    monkeypatch.chdir(certificates)
    with (
        secured(certificates),
        closing(open_transport(config=Path("node.json5"))) as node,
        closing(open_transport(config=Path("robot.json5"))) as first,
        closing(open_transport(config=Path("robot2.json5"))) as second,
    ):
        check_round_trip(node, first, "r1")
        check_round_trip(node, second, "r2")
        heard, spied = [], []
        node.subscribe("coview/**", heard.append, "all")
        second.subscribe("coview/r1/**", spied.append, "all")
        until(lambda: put(first, "coview/r1/in/odom", b"before") or heard)
        for key in ("coview/r2/in/odom", "coview/r2/out/pose", "coview/r1/out/pose", "coview/r1/alive"):
            put(first, key, b"forged")
        until(lambda: put(first, "coview/r1/in/odom", b"after") or heard[-1].payload == b"after")
        ours = (b"before", b"after", b"forged")  # messages of the round trips may still arrive
        assert {(sample.key, sample.payload) for sample in heard if sample.payload in ours} == {
            ("coview/r1/in/odom", b"before"),
            ("coview/r1/in/odom", b"after"),
        }
        assert spied == []
        assert not [reply for reply in second.session.get("coview/r1/rpc/reset", timeout=1.0) if reply.ok]


def put(transport, key, payload):
    """Publish in order with all else of this transport, through a declared publisher and without one."""
    publisher = transport.publisher(key, "data")
    publisher.put(Encoded(payload))
    transport.session.put(key, payload)
    publisher.close()


@pytest.mark.slow
def test_tls_example_refuses_clients_without_certificate(certificates, monkeypatch):
    monkeypatch.chdir(certificates)
    with secured(certificates) as endpoint:
        anonymous = zenoh.Config()
        anonymous.insert_json5("mode", '"client"')
        anonymous.insert_json5("connect/endpoints", f'["{endpoint}"]')
        anonymous.insert_json5("transport/link/tls/root_ca_certificate", '"certificates/ca.pem"')
        with pytest.raises(zenoh.ZError, match="Unable to connect"):
            zenoh.open(anonymous)
        with closing(open_transport([endpoint.replace("tls/", "tcp/")])) as plain:
            assert plain.connection().routers == ()
        with closing(open_transport(config=Path("node.json5"))) as node:  # the router itself is well
            until(lambda: node.connection().routers)


@pytest.mark.slow
def test_tls_example_key_files_are_private(certificates):
    for key in (certificates / "certificates").glob("*.key"):
        assert key.stat().st_mode & 0o077 == 0


@pytest.mark.slow
def test_tls_example_names_missing_certificate_files():
    program = EXAMPLES / "mtls" / "make_certificates.py"
    code = f"import runpy, sys; sys.modules['cryptography'] = None; runpy.run_path({str(program)!r})"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=60)
    assert done.returncode == 1
    assert done.stderr.count("\n") == 1
    assert done.stderr.endswith("pip install cryptography\n")


def test_every_zenoh_example_is_tested():
    names = {path.relative_to(EXAMPLES).as_posix() for path in EXAMPLES.rglob("*.json5")}
    assert names == {"peer.json5", "client.json5", *(f"mtls/{name}.json5" for name in ("router", "robot", "node"))}
