"""RobotClient in an event loop: poses by ``async for``, cancellation that loses none, the end of both."""

from __future__ import annotations

import asyncio
import threading

import numpy as np
import pytest

from coview_stream import RobotClient
from coview_stream.errors import TransportError
from coview_stream.messages import encode_pose
from coview_stream.messages.types import PoseMessage, Sample
from coview_stream.stream.client.latest_queue import LatestQueue
from coview_stream.stream.transport.memory_transport import MemoryTransport


def run(main):
    """Run a coroutine; one that waits for ever fails."""
    return asyncio.run(asyncio.wait_for(main, 20.0))


@pytest.fixture
def net():
    return MemoryTransport()


def publish(net, *stamps):
    """Publish from another thread, as a network does."""

    def send():
        for stamp in stamps:
            pose = PoseMessage(stamp, "r1", "TRACKING", np.eye(4), np.eye(6), 0.9, "ab" * 32)
            encoded = encode_pose(pose, "json")
            net.publish(Sample("coview/r1/out/pose", encoded.payload, encoded.encoding, encoded.attachment))

    thread = threading.Thread(target=send)
    thread.start()
    return thread


def test_poses_come_by_async_for_until_none_come(net):
    async def drive():
        async with RobotClient("r1", transport=net) as robot:
            publish(net, 1, 2).join()
            stamps = []
            async for pose in robot.poses(timeout=0.05):
                stamps.append(pose.stamp_ns)
                if pose.stamp_ns == 2:
                    thread = publish(net, 3)  # while the loop waits
            thread.join()
        with pytest.raises(TransportError, match="closed"):
            robot.send_cloud(np.zeros((9, 3)), 1.0)
        return stamps

    assert run(drive()) == [1, 2, 3]


def test_other_tasks_go_on_while_poses_are_awaited(net):
    async def drive():
        async with RobotClient("r1", transport=net) as robot:
            waiting = asyncio.ensure_future(anext(robot.poses()))
            await asyncio.sleep(0)
            assert not waiting.done()
            publish(net, 7)
            return (await waiting).stamp_ns

    assert run(drive()) == 7


def test_cancelled_reader_takes_no_pose(net):
    async def drive():
        async with RobotClient("r1", transport=net) as robot:
            poses = robot.poses()
            waiting = asyncio.ensure_future(anext(poses))
            await asyncio.sleep(0)
            publish(net, 8).join()  # it has arrived, and the reader has not run since
            waiting.cancel()
            with pytest.raises(asyncio.CancelledError):
                await waiting
            assert not robot._poses._waking
            return (await anext(poses)).stamp_ns

    assert run(drive()) == 8


def test_closing_ends_async_iteration_and_what_was_unread_is_given(net):
    async def drive():
        robot = RobotClient("r1", transport=net)
        publish(net, 1, 2).join()
        robot.close()
        return [pose.stamp_ns async for pose in robot.poses()]

    assert run(drive()) == [1, 2]


def test_queue_outlives_the_loop_of_a_reader():
    queue = LatestQueue[int](3)

    async def give_up():
        return await queue.next(timeout=0.01)

    assert run(give_up()) is None
    queue.put(5)
    assert run(queue.next()) == 5
    queue.close()
    assert run(queue.next()) is None


def test_iterator_that_has_ended_stays_so(net):
    with RobotClient("r1", transport=net) as robot:
        poses = robot.poses(timeout=0.0)
        assert list(poses) == []
        publish(net, 1).join()
        assert list(poses) == []
        assert [pose.stamp_ns for pose in robot.poses(timeout=0.0)] == [1]


def test_client_says_what_it_is_in_one_line(net):
    with RobotClient("r1", transport=net) as robot:
        assert repr(robot) == "RobotClient('r1', sends on coview/r1/in/cloud, no status yet)"
        net.publish(Sample("coview/r1/out/status", b'{"state": "LOST"}', "application/json"))
        assert "state LOST" in repr(robot)
    assert repr(robot).endswith(", closed)")
