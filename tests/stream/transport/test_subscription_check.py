"""Subscriptions that are silent though something is sent: another session hears it, and the session is opened anew."""

from __future__ import annotations

import logging
import threading
import time

import pytest
from sockets import until
from zenoh_routers import Router

from coview_stream.errors import TransportError
from coview_stream.messages.types import Encoded
from coview_stream.stream.transport import subscription_check
from coview_stream.stream.transport.error_guard import RateLimitedErrors
from coview_stream.stream.transport.subscription_check import SubscriptionCheck
from coview_stream.stream.transport.zenoh_transport import open_transport

GUARD = RateLimitedErrors(logging.getLogger(__name__))


class World:
    """A clock, what another session would hear, and what was done."""

    def __init__(self) -> None:
        self.now = 100.0
        self.sent: set[str] = set()
        self.asked: list[tuple[float, set[str]]] = []
        self.reopened: list[str] = []
        self.check = SubscriptionCheck(self.listen, self.reopened.append, GUARD, lambda: self.now)

    def listen(self, keys, seconds):
        self.asked.append((self.now, set(keys)))
        self.now += seconds
        return self.sent & set(keys)

    def wait(self, seconds):
        self.now += seconds

    def run(self, seconds, each=lambda: None):
        end = self.now + seconds
        while self.now < end:
            self.now += 0.5
            each()
            self.check.check(self.wait)


def test_key_that_another_session_hears_and_ours_does_not_reopens():
    world = World()
    deaf, quick = world.check.add("robot/odometry"), world.check.add("robot/cloud")
    world.sent = {"robot/odometry", "robot/cloud"}
    world.run(8.0, lambda: world.check.heard(quick))
    assert world.reopened == ["robot/odometry"]
    assert world.asked[0] == (105.0, {"robot/odometry"})
    world.run(8.0, lambda: (world.check.heard(quick), world.check.heard(deaf)))
    assert len(world.reopened) == len(world.asked) == 1


def test_silence_that_the_other_session_shares_is_asked_about_ever_less():
    world = World()
    world.check.add("robot/odometry")
    world.run(3600.0)
    assert not world.reopened
    gaps = [b - a for (a, _), (b, _) in zip(world.asked, world.asked[1:], strict=False)]
    assert gaps[0] < 15.0
    assert max(gaps) < 305.0
    assert len(world.asked) < 20


def test_many_robots_that_are_switched_off_are_asked_about_together():
    world = World()
    for number in range(300):
        world.check.add(f"r{number}/odometry")
        world.now += 0.1
        world.check.check(world.wait)
    world.asked.clear()
    world.run(3600.0)
    assert len(world.asked) < 60
    assert set.union(*(keys for _, keys in world.asked)) == {f"r{number}/odometry" for number in range(300)}


def test_sample_that_comes_meanwhile_is_no_reason():
    world = World()
    late = world.check.add("robot/odometry")
    world.sent = {"robot/odometry"}
    listen = world.listen

    def listening(keys, seconds):
        world.check.heard(late)  # a robot that is switched on now: both hear it
        return listen(keys, seconds)

    world.check._listen = listening
    world.run(8.0)
    assert not world.reopened


def test_handler_at_work_is_not_deaf():
    world = World()
    slow = world.check.add("robot/cloud")
    slow.handling = True
    world.sent = {"robot/cloud"}
    world.run(30.0)
    assert not world.asked


def test_error_does_not_end_the_checks(monkeypatch):
    monkeypatch.setattr(subscription_check, "_LOOK", 0.001)
    stopping, looks = threading.Event(), []

    def listen(keys, seconds):
        looks.append(keys)
        if len(looks) == 3:
            stopping.set()
        raise ValueError("no such key")

    ticks = iter(range(10_000))
    check = SubscriptionCheck(listen, looks.append, GUARD, lambda: 100.0 * next(ticks))
    check.add("a")
    check.run(stopping)
    assert looks == [{"a"}] * 3


@pytest.mark.slow
def test_key_that_is_none_is_refused_and_not_checked():
    with Router() as router:
        transport = open_transport([router.endpoint], check_silence=True)
        with pytest.raises(TransportError, match="key"):
            transport.subscribe("bad//key", print, "all")
        assert not transport._check._all
        transport.close()


@pytest.mark.slow
def test_session_that_lost_a_declaration_is_opened_anew(caplog):
    caplog.set_level(logging.WARNING)
    with Router() as router:
        node = open_transport([router.endpoint], check_silence=True)
        robot = open_transport([router.endpoint])
        came: dict[str, int] = {"a": 0, "b": 0}
        calls = threading.Lock()

        def handler(sample):
            assert calls.acquire(blocking=False)  # one call at a time
            came[sample.key] += 1
            calls.release()

        node.subscribe("a", handler, "all")
        node.subscribe("b", lambda sample: came.update(b=came["b"] + 1), "newest")
        node.answer("c", lambda parameters: {"well": True})
        node.announce("d")
        heard: list[bytes] = []
        robot.subscribe("pose", lambda sample: heard.append(sample.payload), "all")
        poses = node.publisher("pose", "realtime")
        a, b = robot.publisher("a", "report"), robot.publisher("b", "report")
        stopping = threading.Event()

        def send():
            while not stopping.wait(0.05):
                a.put(Encoded(b"x"))
                b.put(Encoded(b"x"))
                poses.put(Encoded(b"x"))

        sender = threading.Thread(target=send)
        sender.start()
        try:
            until(lambda: min(came.values()) > 5, 10.0)
            first, zid = node.session, str(node.session.info.zid())
            node._declared[0].undeclare()  # as when the router lost it: the session goes on, and hears b
            before, at = came["a"], time.monotonic()
            time.sleep(1.0)
            assert came["a"] - before < 5
            until(lambda: came["a"] > before + 10, 30.0)
            assert time.monotonic() - at > 4.0  # it waited before it suspected anything
            assert node.session is not first
            assert str(node.session.info.zid()) != zid
            count, poses_before = came["b"], len(heard)
            until(lambda: came["b"] > count + 5 and len(heard) > poses_before + 5, 10.0)
            assert robot.query("c") == {"well": True}
            assert robot.tokens("d") == ["d"]
            assert "another session hears a and this one does not" in caplog.text
        finally:
            stopping.set()
            sender.join()
        node.close()
        robot.close()
