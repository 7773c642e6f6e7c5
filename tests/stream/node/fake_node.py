"""A node without threads, its robots, and the network between them."""

import json
import time

from fake_robot import SHA, cloud, odometry, search_result, tracking

from coview_stream.config.node import NodeConfig
from coview_stream.messages import decode_pose
from coview_stream.stream.node.engine_process import DiedError, attempt, unwrap
from coview_stream.stream.node.engine_queue import FrameJob
from coview_stream.stream.node.node import Node, OpenedMap
from coview_stream.stream.node.session import Session
from coview_stream.stream.transport.keys import robot_keys
from coview_stream.stream.transport.memory_transport import MemoryTransport

STEP = 0.05
PATIENT = NodeConfig(
    odometry_timeout=30.0, pairing_wait=30.0, dead_reckoning_timeout=30.0
)  # however slow the machine is
THREADS = ("coview-track", "coview-search", "coview-poses", "coview-status")


class Engine:
    """Knows every robot's place at once; searches without success."""

    def __init__(self):
        self.answer = tracking
        self.failing = {}
        self.served = []

    def run(self, job):
        self.served.append(job.robot)
        if job.robot in self.failing:
            raise self.failing[job.robot]
        return self.answer(job) if isinstance(job, FrameJob) else search_result()

    def forget(self, robot):
        pass


class Runner:
    """Runs jobs on the caller's thread; its engine dies when it is told to."""

    pid, ready = None, True

    def __init__(self, engine, name="track"):
        self.engine, self.name = engine, name
        self.dead = False
        self.closed = 0

    def run(self, job):
        if self.dead:
            self.dead = False
            raise DiedError(f"the {self.name} engine died")
        return unwrap(*attempt(self.engine, job))

    def watch(self):
        pass

    def end_stopped(self):
        pass

    def close(self):
        self.closed += 1


class Site:
    """A node without threads, its robots, and the network between them.

    ``session``: more options of the sessions; ``odometry``: runs the engine of lidar odometry, if there is one.
    """

    def __init__(
        self, *names, preset="native", engines=None, config=PATIENT, net=None, session=None, odometry=None, **more
    ):
        self.net = net or MemoryTransport()
        self.engine = Engine()
        track, search = engines or (self.engine, self.engine)
        self.track, self.search = Runner(track), Runner(search)
        self.keys = {name: robot_keys(preset, "coview", name) for name in names}
        sessions = [Session(keys, SHA, config, **(session or {})) for keys in self.keys.values()]
        self.sessions = dict(zip(names, sessions, strict=True))
        runners = ({"odometry": odometry} if odometry else {}) | {"track": self.track, "search": self.search}
        self.node = Node(OpenedMap(SHA, runners, sessions), self.net, config, **more)

    def moves(self, name, seconds, **place):
        self.net.publish(odometry(seconds, keys=self.keys[name], **place))

    def sees(self, name, seconds, **fields):
        """A cloud with the odometry of its stamp."""
        self.moves(name, seconds)
        self.net.publish(cloud(seconds, keys=self.keys[name], **fields))

    def work(self, name):
        """Let the engines do the work that waits for a robot."""
        session = self.sessions[name]
        for engine in self.node.feeds[0].engines:
            if (job := session.take_job(engine)) is not None:
                self.node.feeds[0].work(engine, session, job)

    def frame(self, name, seconds, **fields):
        self.sees(name, seconds, **fields)
        self.work(name)

    def poses(self, name):
        self.node.publish_poses(time.monotonic())
        return [decode_pose(s) for s in self.net.samples(self.keys[name].pose)]

    def statuses(self, name):
        return [json.loads(s.payload) for s in self.net.samples(self.keys[name].status)]

    def status(self, name):
        self.node.reporter.publish(time.monotonic())
        return self.statuses(name)[-1]


def declared(*names, **more):
    """A site whose node is on the network."""
    site = Site(*names, **more)
    site.node.declare()
    return site
