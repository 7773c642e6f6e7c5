"""``--web`` of ``serve`` and ``watch``: the page of a live session, and addresses that are none."""

import json
import queue
import re
import socket
import threading
import urllib.request

import pytest
from sockets import free_endpoint


@pytest.mark.parametrize("command", [["serve", "--robot", "r1", "--web", "site.coview"], ["watch", "--web", "here"]])
def test_what_is_no_address_is_refused(command, refused):
    assert "not HOST:PORT; write --web=127.0.0.1:8642" in refused(*command)


def test_a_port_that_is_taken_ends_watch_with_one_line(refused):
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        address = f"127.0.0.1:{taken.getsockname()[1]}"
        assert "in use" in refused("watch", "--web", address)


def test_a_map_that_is_none_ends_watch(tmp_path, refused):
    assert "none.coview" in refused("watch", "--web", "127.0.0.1:0", "--map", tmp_path / "none.coview")


def test_a_demo_without_a_node_has_no_page(refused):
    assert "leave --web away" in refused("demo", "--offline", "--web")


class Command:
    """A command with a page, and the events of that page."""

    def __init__(self, process):
        self.process, self.events = process, queue.Queue()
        self.url = next(found[1] for line in process.stderr if (found := re.match(r"page at (http://\S+)\n", line)))
        for read in (process.stdout.read, process.stderr.read, self._listen):
            threading.Thread(target=read, daemon=True).start()

    def _listen(self):
        with urllib.request.urlopen(f"{self.url}events", timeout=60) as stream:
            kind = ""
            for line in stream:
                if line.startswith(b"event: "):
                    kind = line[7:].decode().strip()
                elif line.startswith(b"data: "):
                    self.events.put((kind, json.loads(line[6:])))

    def wait(self, *kinds):
        """The first event of each kind."""
        found = {}
        while set(kinds) - set(found):
            kind, data = self.events.get(timeout=30)
            found.setdefault(kind, data)
        return found

    def end(self):
        self.process.terminate()
        return self.process.wait(10.0)


@pytest.mark.slow
def test_serve_and_watch_show_robot_and_map(world_file, start):
    web, endpoint = ("--web", "127.0.0.1:0"), free_endpoint()
    serve = Command(start("serve", world_file, "--robot", "r1", "--listen", endpoint, "--no-state", *web))
    watch = Command(start("watch", "--connect", endpoint, *web))
    for command in (serve, watch):
        seen = command.wait("status", "map")
        assert (seen["status"]["robot"], seen["status"]["state"]) == ("r1", "SEARCHING")
        assert seen["status"]["map_sha256"] == seen["map"]["sha256"]
        with urllib.request.urlopen(f"{command.url}map/{seen['map']['sha256']}", timeout=30) as answer:
            assert len(answer.read()) > 6 * seen["map"]["count"]
    assert [watch.end(), serve.end()] == [0, 0]
