"""Runs from ROS recordings: PointCloud2 or Livox frames, each with the odometry at its stamp.

Odometry comes from a topic or ``/tf``; the lidar's mount from ``/tf_static``, unless it is given. Messages go through
the decoders and deskewing of the live stream. Clouds are read on demand, and deskewed if their points have times.
"""

from __future__ import annotations

import contextlib
import threading
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from coview_stream.clouds.cloud import Cloud, CloudBuilder
from coview_stream.clouds.trajectory import read_tum
from coview_stream.config.mount import MAX_LEVER, Mount
from coview_stream.config.node import NodeConfig
from coview_stream.errors import CloudError, MessageError, RunError
from coview_stream.geometry.arrays import Bools, Floats, Ints
from coview_stream.geometry.transforms import Points, Poses, interpolate, inverse, transform
from coview_stream.geometry.validation import MAX_COORDINATE
from coview_stream.messages import livox, ros2
from coview_stream.messages.ros2 import frame_id, header_stamp
from coview_stream.messages.types import CloudMessage, Sample
from coview_stream.odometry.buffer import Segment
from coview_stream.odometry.deskew import SweepCorrection, deskew
from coview_stream.recordings import frame_tree
from coview_stream.recordings.bag_reader import BagReader, readable
from coview_stream.recordings.frame_tree import FrameTree
from coview_stream.recordings.run import Run

SAME_NS = 1000
"""Stamps this close are equal: text files and float64 seconds are accurate to a microsecond."""

_NS = 1e-9
_JUMP_DISTANCE = 1.0  # metres; a shorter step is never a jump
_MAX_SETBACK_NS = 5_000_000_000  # stamps that go back by less are out of order
_MAX_STRAYS = 0.01  # share of stamps that may go back farther, and are dropped


class Track:
    """Odometry by stamp, interpolated except across gaps and jumps, as in the node.

    Attributes:
        stamps: (K,) nanoseconds, increasing.
        poses: (K, 4, 4) odometry <- body, metres.
    """

    def __init__(self, stamps: Ints, poses: Poses) -> None:
        """Sort the samples, at least one; the first of equal stamps counts."""
        config = NodeConfig()
        self.stamps, first = np.unique(stamps, return_index=True)
        self.poses = poses[first]
        seconds = _NS * np.diff(self.stamps)
        driven = np.linalg.norm(np.diff(self.poses[:, :3, 3], axis=0), axis=1)
        steady = (seconds <= config.max_gap) & (driven <= np.maximum(_JUMP_DISTANCE, config.max_speed * seconds))
        self._part = np.concatenate([[0], np.cumsum(~steady)])

    def at(self, stamps: Ints) -> tuple[Poses, Bools]:
        """Interpolate poses (N, 4, 4) at stamps (N,); also return where they are known (N,)."""
        last = len(self.stamps) - 1
        after = np.clip(np.searchsorted(self.stamps, stamps), 0, last)
        before = np.clip(after - 1, 0, last)
        share = (stamps - self.stamps[before]) / np.maximum(self.stamps[after] - self.stamps[before], 1)
        known = (share >= 0) & (share <= 1) & (self._part[before] == self._part[after]) & (before < after)
        share = np.clip(share, 0.0, 1.0)
        for side, value in ((before, 0.0), (after, 1.0)):
            same = np.abs(stamps - self.stamps[side]) <= SAME_NS
            share, known = np.where(same, value, share), known | same
        return interpolate(self.poses[before], self.poses[after], share), known

    def around(self, begin_ns: int, end_ns: int, stamp_ns: int) -> Segment:
        """Return the samples from the last at or before ``begin_ns`` to the first at or after ``end_ns``.

        Samples beyond a gap or jump, seen from ``stamp_ns``, are left out.
        """
        first = np.searchsorted(self.stamps, begin_ns + 1) - 1
        last = np.searchsorted(self.stamps, end_ns) + 1
        part = self._part[max(0, int(np.searchsorted(self.stamps, stamp_ns + SAME_NS, side="right")) - 1)]
        low, high = np.searchsorted(self._part, part, "left"), np.searchsorted(self._part, part, "right")
        chosen = slice(max(0, first, low), min(last, high))
        return Segment(self.stamps[chosen], self.poses[chosen])


_CLOUDS = (ros2.CLOUD, *livox.TYPES)
_Topic = tuple[str, str]
"""Type and name."""

OdometryFromClouds = Callable[["BagClouds"], Track]
"""Computes odometry from the clouds alone, which are not deskewed."""


def open_bag(
    path: Path,
    explicit: Path | None = None,
    cloud_topic: str | None = None,
    odometry_topic: str | None = None,
    from_clouds: OdometryFromClouds | None = None,
    mount: Mount | None = None,
) -> Run:
    """Read all stamps and odometry of a recording in one pass, and remember where each cloud is.

    One cloud at a time is in memory, plus 16 bytes per cloud and 150 per odometry sample.

    Args:
        path: as returned by :func:`~coview_stream.recordings.layouts.find_bag`.
        explicit: TUM file with the odometry, at any stamps; None: the recording's.
        cloud_topic: required if several topics have PointCloud2, or several Livox clouds and none PointCloud2.
        odometry_topic: required if several topics have Odometry; ``/tf`` takes the odometry from there.
        from_clouds: computes the odometry, even if the recording has some.
        mount: pose of the lidar; clouds are read into the body frame. None: from ``/tf_static``.

    Raises:
        RunError: unreadable; no such topic, or several; or no cloud has odometry at its stamp.
    """
    reader = BagReader(path)
    counts = reader.counts()
    kinds = (ros2.CLOUD,) if any(kind == ros2.CLOUD for kind, _ in counts) and cloud_topic is None else _CLOUDS
    clouds = _choose(path, counts, kinds, cloud_topic, "--cloud-topic")
    topics = {topic: kind for kind, topic in counts if kind in frame_tree.TYPES} | {clouds[1]: clouds[0]}
    if from_clouds is not None:
        survey = _survey(reader, topics)
        stamps, arrivals, fresh, _ = _in_order(path, survey)
        identities = np.tile(np.eye(4), (int(fresh.sum()), 1, 1))
        still = Track(stamps[fresh], identities)
        placed = _mounted(path, survey, mount)
        bare = BagClouds(reader, clouds, stamps[fresh], arrivals[fresh], still, identities, placed)
        return _pair(reader, clouds, survey, from_clouds(bare), placed)
    if explicit is not None and odometry_topic is not None:
        raise RunError(f"{path}: --odometry {explicit} and --odometry-topic {odometry_topic}; give one of them")
    # a single scan needs no odometry, as for files
    lone = counts[clouds] == 1 and not any(kind == ros2.ODOMETRY for kind, _ in counts)
    in_topic = any(count and kind == ros2.ODOMETRY for (kind, _), count in counts.items())
    if odometry_topic is not None:
        in_topic = topics.get(odometry_topic) not in frame_tree.TYPES
    by_tree = explicit is None and not lone and not in_topic and len(topics) > 1
    if explicit is None and not lone and not by_tree:
        kind, topic = _choose(path, counts, (ros2.ODOMETRY,), odometry_topic, "--odometry-topic")
        topics[topic] = kind
    survey = _survey(reader, topics)
    if by_tree:
        _take_odometry(path, counts, survey)
    track = _track(path, survey, explicit, lone)
    return _pair(reader, clouds, survey, track, _mounted(path, survey, mount, explicit))


class BagClouds:
    """Clouds of a recording by index; reading in order takes one pass, otherwise each is found by its arrival.

    ``stamps`` and ``arrivals`` (K,) are nanoseconds, the latter of the recorder's clock; ``poses`` (K, 4, 4) are
    odometry <- body at the stamps.
    """

    def __init__(
        self,
        reader: BagReader,
        topic: _Topic,
        stamps: Ints,
        arrivals: Ints,
        track: Track,
        poses: Poses,
        mount: _Mounted,
    ) -> None:
        self.reader, self.track, self.mount = reader, track, mount
        self.kind, self.topic = topic
        self.stamps, self.arrivals, self.poses = stamps, arrivals, poses
        self._lock = threading.Lock()  # a replay reads on another thread
        self._pending: Iterator[tuple[str, int, bytes]] = iter(())
        self._next = -1

    def read(self, index: int, correction: SweepCorrection | None = None) -> Cloud:
        """Read frame ``index`` in the body frame at its stamp, deskewed by odometry with ``correction`` applied.

        Raises:
            CloudError: it is damaged or has no usable point.
        """
        message = self.message(index)
        # false for NaN too
        usable: Bools = np.all(np.abs(message.points) < MAX_COORDINATE, axis=1)
        builder = CloudBuilder(dropped=int((~usable).sum()))
        builder.add(self._deskewed(index, message, usable, correction))
        return builder.finish(self._name(index))

    def message(self, index: int) -> CloudMessage:
        """Read frame ``index`` as recorded, but in the body frame; CloudError if it is damaged."""
        name = self._name(index)
        with self._lock, readable(name, CloudError):
            payload = self._payload(index)
        try:
            message = ros2.decode_cloud(Sample(self.topic, payload))
        except MessageError as error:
            raise CloudError(f"{name}: {error}; skip it, or repair the recording") from error
        if self.mount.registered:
            points = transform(inverse(self.poses[index]), message.points.astype(np.float64)).astype(np.float32)
            return replace(message, points=points, times=None)
        return replace(message, points=self.mount.mount.to_body(message.points))

    def _name(self, index: int) -> str:
        return f"{self.reader.path}: cloud of {self.topic} at {_NS * int(self.stamps[index]):.6f}"

    def _payload(self, index: int) -> bytes:
        reads_on = index == self._next and self.arrivals[index] > self.arrivals[index - 1]
        self._next = -1  # after a failure the next one is searched for
        for _ in range(2):
            if not reads_on:
                start = int(self.arrivals[index])
                self._pending = self.reader.messages({self.topic: self.kind}, start)
            for _, arrived, payload in self._pending:
                with contextlib.suppress(MessageError):
                    if arrived == self.arrivals[index] and header_stamp(payload) == self.stamps[index]:
                        self._next = index + 1
                        return payload
            reads_on = False
        raise ValueError("it is not there any more")

    def _deskewed(self, index: int, message: CloudMessage, usable: Bools, correction: SweepCorrection | None) -> Points:
        points = message.points[usable]
        if message.times is None or not len(points):
            return points
        stamp, times = message.stamp_ns, message.times[usable]
        begin, end = (stamp + round(t / _NS) for t in (min(0.0, times.min()), max(0.0, times.max())))
        sweep = self.track.around(begin, end, stamp)
        return deskew(points, times, sweep, stamp, self.poses[index], correction)


@dataclass
class _Survey:
    """Result of one pass over a recording."""

    stamps: list[int] = field(default_factory=list)  # of the clouds, ns
    arrivals: list[int] = field(default_factory=list)  # of the clouds, ns of the recorder's clock
    odometry: list[tuple[int, Floats]] = field(default_factory=list)  # stamp in ns, pose (4, 4)
    damaged: int = 0  # messages
    lidar: str = ""  # frame id of the clouds
    frame: str = ""  # frame id of the odometry
    body: str = ""  # child frame id of the odometry
    tree: FrameTree = field(default_factory=FrameTree)
    notes: list[str] = field(default_factory=list)  # for the user
    source: str = ""  # topic of the tree's static transforms, if there are any


def _survey(reader: BagReader, topics: dict[str, str]) -> _Survey:
    survey = _Survey()
    with readable(reader.path):
        for topic, arrived, payload in reader.messages(topics):
            try:
                if topics[topic] in frame_tree.TYPES:
                    static = "static" in topic
                    survey.tree.add(payload, static)
                    survey.source = topic if static or not survey.source else survey.source
                elif topics[topic] in _CLOUDS:
                    survey.stamps.append(header_stamp(payload))
                    survey.arrivals.append(arrived)
                    survey.tree.lidar = survey.lidar = survey.lidar or frame_id(payload)
                else:
                    sample = ros2.decode_odometry(Sample(topic, payload))
                    survey.odometry.append((sample.stamp_ns, sample.T_odom_body))
                    survey.frame = survey.frame or frame_id(payload)
                    survey.body = survey.body or frame_id(payload, 1)
            except MessageError:
                survey.damaged += 1
    if not survey.stamps:
        raise RunError(f"{reader.path}: not one cloud in its topic; choose another one or record again")
    return survey


def _choose(path: Path, counts: dict[_Topic, int], kinds: tuple[str, ...], wanted: str | None, option: str) -> _Topic:
    """Return the wanted topic, or the only one of these types."""
    all_of_kind = {topic: count for topic, count in counts.items() if topic[0] in kinds}
    full = {topic: count for topic, count in all_of_kind.items() if count} or all_of_kind
    listed = ", ".join(f"{topic} ({count} messages)" for (_, topic), count in sorted(all_of_kind.items()))
    if wanted is not None:
        found = next((topic for topic in all_of_kind if topic[1] == wanted), None)
        if found is None:
            raise RunError(f"{path}: no topic {wanted!r} with {kinds[0]}; {option} may be {listed or 'none'}")
        return found
    if len(full) > 1:
        raise RunError(f"{path}: {len(full)} topics with {kinds[0]}; choose by {option}: {listed}")
    if not full:
        others = ", ".join(f"{topic} ({name})" for name, topic in sorted(counts)[:8]) or "no topics at all"
        remedy = _NO_ODOMETRY if kinds[0] == ros2.ODOMETRY else "record one"
        raise RunError(f"{path}: no topic with {kinds[0]}; {remedy}: it has {others}")
    return next(iter(full))


_NO_ODOMETRY = "make it of the clouds: --odometry kiss-icp, or give --odometry FILE"


def _take_odometry(path: Path, counts: dict[_Topic, int], survey: _Survey) -> None:
    """Take the odometry from the frame tree."""
    found = survey.tree.odometry()
    if found is None:
        others = ", ".join(f"{topic} ({name})" for name, topic in sorted(counts)[:8])
        above = " <- ".join(reversed(survey.tree.above(survey.lidar)))
        raise RunError(
            f"{path}: no topic with {ros2.ODOMETRY}, and nothing moves in /tf above the lidar ({above}); "
            f"{_NO_ODOMETRY}: it has {others}"
        )
    survey.frame, survey.body, survey.odometry = found
    survey.notes.append(f"{path}: odometry is read from /tf: {survey.frame} <- {survey.body}")


@dataclass(frozen=True)
class _Mounted:
    """Transformation of clouds into the body frame."""

    mount: Mount
    registered: bool = False  # clouds are in odometry's frame; the inverse of its pose takes them into the body frame
    notes: tuple[str, ...] = ()


def _mounted(path: Path, survey: _Survey, given: Mount | None, explicit: Path | None = None) -> _Mounted:
    """Return the clouds' transformation into the body frame: as ``given``, else from the recording's frames.

    Odometry from the file ``explicit`` may be of any frame: a mount in the recording is then noted, not applied.
    """
    lidar, tree = survey.lidar, survey.tree
    body = survey.body or tree.body()
    T = tree.mount(body) if lidar and body else None
    known = T is not None and float(np.linalg.norm(T[:3, 3])) <= MAX_LEVER
    stated = Mount().moved(T) if T is not None and known else Mount()
    where = f"{survey.source} has the lidar {lidar!r} on {body!r}: --mount={stated.option}"
    if given is not None:
        overridden = known and given.option != stated.option
        return _Mounted(given, notes=(f"{path}: --mount={given.option} is taken; {where}",) * overridden)
    if lidar and lidar == survey.frame != body:
        note = (
            f"{path}: clouds are in odometry's frame {lidar!r}, as FAST-LIO registers them: taken back into the body "
            "by it; if they are the lidar's own, say so: --mount=0,0,0"
        )
        return _Mounted(Mount(), True, (note,))
    if explicit is not None and stated.option != Mount().option:
        return _Mounted(Mount(), notes=(f"{path}: {where}; give it if {explicit} has the poses of {body!r}",))
    if known:
        note = f"{path}: {where} is taken; another --mount would override it"
        return _Mounted(stated, notes=(note,) * (stated.option != Mount().option))
    if lidar and lidar in tree.above(survey.frame):
        note = (
            f"{path}: clouds are in {lidar!r}, in which odometry itself moves; choose those of the lidar: --cloud-topic"
        )
        return _Mounted(Mount(), notes=(note,))
    if lidar and survey.body and lidar != survey.body:
        note = (
            f"{path}: clouds are in frame {lidar!r}, odometry moves {survey.body!r}: taken for one; "
            "if the lidar is mounted away from it, or turned, say how: --mount roll,pitch,yaw,x,y,z"
        )
        return _Mounted(Mount(), notes=(note,))
    return _Mounted(Mount())


def _track(path: Path, survey: _Survey, explicit: Path | None, lone: bool) -> Track:
    if explicit is not None:
        seconds, poses = read_tum(explicit)
        if not len(seconds):
            raise RunError(f"{explicit}: no poses; give the odometry of {path}")
        return Track(np.rint(1e9 * seconds).astype(np.int64), poses)
    if lone:
        return Track(np.array(survey.stamps, np.int64), np.tile(np.eye(4), (len(survey.stamps), 1, 1)))
    if not survey.odometry:
        raise RunError(f"{path}: not one usable odometry message; {_NO_ODOMETRY}")
    stamps = np.array([stamp for stamp, _ in survey.odometry], np.int64)
    steady = _steady(path, stamps, "odometry")
    return Track(stamps[steady], np.array([T for _, T in survey.odometry])[steady])


def _steady(path: Path, stamps: Ints, noun: str) -> Bools:
    """Return which stamps (N,) are not far behind an earlier one; RunError if the clock was reset."""
    back = np.maximum.accumulate(stamps) - stamps
    strays = back > _MAX_SETBACK_NS
    if strays.sum() > _MAX_STRAYS * len(stamps):
        at = int(np.argmax(strays))
        raise RunError(
            f"{path}: stamps of {noun} go back by {_NS * back[at]:.1f} s at message {at}: the clock started anew; "
            "split the recording there"
        )
    return ~strays


def _in_order(path: Path, survey: _Survey) -> tuple[Ints, Ints, Bools, Bools]:
    """Sort the clouds by their stamps.

    Returns:
        Stamps and arrivals (K,), ns; whether no earlier cloud has the same stamp (K,); and, in order of arrival (N,),
        whether a cloud is among the K: its stamp does not go far back.
    """
    stamps, arrivals = np.array(survey.stamps, np.int64), np.array(survey.arrivals, np.int64)
    steady = _steady(path, stamps, "clouds")
    order = np.argsort(stamps[steady], kind="stable")
    in_order = stamps[steady][order]
    fresh = np.diff(in_order, prepend=in_order[0] - SAME_NS - 1) > SAME_NS
    if len(fresh) > 1 and not fresh[1:].any():
        raise RunError(
            f"{path}: all {len(fresh)} clouds are stamped alike, {_span(in_order)}; stamp their headers at the sensor, "
            "in seconds and nanoseconds"
        )
    return in_order, arrivals[steady][order], fresh, steady


def _pair(reader: BagReader, topic: _Topic, survey: _Survey, track: Track, mount: _Mounted) -> Run:
    """Return the run of clouds in order of their stamps, without those that have no odometry."""
    path = reader.path
    stamps, arrivals, fresh, steady = _in_order(path, survey)
    poses, known = track.at(stamps)
    chosen = fresh & known
    if not chosen.any():
        raise RunError(
            f"{path}: not one of {len(steady)} clouds has odometry at its stamp: clouds are stamped "
            f"{_span(stamps)}, odometry {_span(track.stamps)}{_times(stamps, track.stamps)}; "
            "are their clocks the same, and their headers stamped in seconds and nanoseconds?"
        )
    reasons = (
        (int((fresh & ~known).sum()), "without odometry around their stamps"),
        (int((~fresh).sum()), "with a stamp that was there before"),
        (int((~steady).sum()), "with a stamp that goes far back"),
    )
    notes = []
    if not chosen.all() or not steady.all():
        text = ", ".join(f"{count} {reason}" for count, reason in reasons if count)
        notes.append(f"{path}: {len(steady) - int(chosen.sum())} of {len(steady)} clouds left out: {text}")
    if survey.damaged:
        notes.append(f"{path}: {survey.damaged} damaged messages left out")
    notes += (*survey.notes, *mount.notes)
    source = BagClouds(reader, topic, stamps[chosen], arrivals[chosen], track, poses[chosen], mount)
    return Run(path, (path,) * len(source.stamps), source.stamps / 1e9, source.poses, source, tuple(notes), mount.mount)


def _span(stamps: Ints) -> str:
    return f"{_NS * stamps.min():.13g} to {_NS * stamps.max():.13g} s"


def _times(stamps: Ints, others: Ints) -> str:
    """Return in words how many times larger some stamps are than others, if one is in a wrong unit."""
    for factor in (1e3, 1e6, 1e9):
        for small, large, noun in ((others, stamps, "clouds'"), (stamps, others, "odometry's")):
            if factor * small.max() >= large.min() and large.max() >= factor * small.min():
                return f": {noun} are {factor:,.0f} times as large"
    return ""
