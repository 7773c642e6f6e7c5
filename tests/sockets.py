"""What tests over real sockets need: a free endpoint, and patience with a deadline."""

import socket
import time


def free_endpoint() -> str:
    """Return a loopback endpoint without a listener right now."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return f"tcp/127.0.0.1:{probe.getsockname()[1]}"


def until(condition, seconds: float = 10.0) -> None:
    """Wait until ``condition()`` is true; fail after ``seconds``."""
    deadline = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < deadline, "it did not happen in time"
        time.sleep(0.01)
