"""Routers on loopback for tests: one in this process, and one in another that can be killed."""

from __future__ import annotations

import json
import subprocess
import sys
from typing import Any

import zenoh
from sockets import free_endpoint

ROUTER_PROGRAM = """
import sys, zenoh
session = zenoh.open(zenoh.Config.from_json5(sys.argv[1]))
print("up", flush=True)
sys.stdin.read()
"""


def router_config(endpoint: str, **more: Any) -> str:
    return json.dumps(
        {"mode": "router", "listen": {"endpoints": [endpoint]}, "scouting": {"multicast": {"enabled": False}}, **more}
    )


class Router:
    """A Python session in router mode; may stop and start again at the same endpoint."""

    def __init__(self, endpoint: str = "", **more: Any) -> None:
        self.endpoint = endpoint or free_endpoint()
        self._more = more
        self._session: Any = None

    def __enter__(self) -> Router:
        return self.start()

    def __exit__(self, *exc: object) -> None:
        self.stop()

    def start(self) -> Router:
        self._session = zenoh.open(zenoh.Config.from_json5(router_config(self.endpoint, **self._more)))
        return self

    def stop(self) -> None:
        if self._session is not None:
            self._session.close()
            self._session = None


class RouterProcess:
    """A router that can be killed without a goodbye."""

    def __init__(self, endpoint: str) -> None:
        config = router_config(endpoint)
        self._process = subprocess.Popen(
            [sys.executable, "-c", ROUTER_PROGRAM, config], stdin=subprocess.PIPE, stdout=subprocess.PIPE
        )
        assert self._process.stdout is not None
        assert self._process.stdout.readline() == b"up\n"

    def __enter__(self) -> RouterProcess:
        return self

    def __exit__(self, *exc: object) -> None:
        self.kill()

    def kill(self) -> None:
        self._process.kill()
        self._process.communicate()
