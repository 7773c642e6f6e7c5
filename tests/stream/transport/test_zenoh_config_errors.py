"""What zenoh refuses is told in one short line, with what to do."""

from __future__ import annotations

from pathlib import Path

import pytest
from sockets import free_endpoint

from coview_stream.errors import TransportError
from coview_stream.stream.transport.zenoh_config import compose, reason
from coview_stream.stream.transport.zenoh_transport import open_transport


def test_port_in_use_names_the_remedy() -> None:
    endpoint = free_endpoint()
    first = open_transport(listen=[endpoint])
    try:
        with pytest.raises(TransportError, match="holds the port: --connect to it, or another --listen") as caught:
            open_transport(listen=[endpoint])
    finally:
        first.close()
    assert endpoint in str(caught.value)


def test_address_of_another_host_is_explained() -> None:
    with pytest.raises(TransportError, match=r"203\.0\.113\.7.*no address of this machine: --listen on"):
        open_transport(listen=["tcp/203.0.113.7:7447"])


@pytest.mark.parametrize(
    "options",
    [{"connect": ["tcp/127.0.0.1:99999"]}, {"listen": ["tcp/[::1]:65536"]}, {"connect": ["tls/robot.local:0"]}],
)
def test_port_out_of_range_is_explained(options: dict[str, list[str]]) -> None:
    (endpoint,) = next(iter(options.values()))
    with pytest.raises(TransportError, match=r"port must be 1\.\.65535") as caught:
        compose(**options)
    assert repr(endpoint) in str(caught.value)


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
def test_configuration_errors_are_one_short_line(tmp_path: Path, name: str, text: str, said: str) -> None:
    path = tmp_path / name
    path.write_text(text)
    with pytest.raises(TransportError) as caught:
        compose(path=path)
    message = str(caught.value)
    assert message.startswith(f"zenoh configuration {path}: {said}")
    assert len(message) < len(str(path)) + 150
    assert "\n" not in message


def test_other_errors_are_unchanged() -> None:
    assert reason(ValueError("it broke\n at io/x.rs:12.")) == "it broke"
    assert reason(ValueError("")) == "ValueError"
