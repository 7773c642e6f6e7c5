"""Recordings unpack to a limited size, whatever they claim."""

import bz2

import lz4.frame
import numpy as np
import pytest
from bag_files import cloud, odometry, write_bag

from coview_stream.errors import CoViewError, RunError
from coview_stream.recordings import bag_reader
from coview_stream.recordings.bag_reader import BagReader, bounded
from coview_stream.recordings.open_run import open_run


@pytest.fixture
def limit(monkeypatch):
    return lambda size: monkeypatch.setattr(bag_reader, "LIMIT", size)


WORDS = [b"", b"a", b"abc" * 1000]


@pytest.mark.parametrize(
    ("pack", "make"), [(bz2.compress, bz2.BZ2Decompressor), (lz4.frame.compress, lz4.frame.LZ4FrameDecompressor)]
)
def test_frames_come_back_whole_and_no_longer_than_allowed(limit, pack, make):
    unpack = bounded(make)
    for word in WORDS:
        assert unpack(pack(word)) == word
        assert unpack(pack(word) + pack(b"more")) == word + b"more"
    bomb = pack(bytes(10**7))
    with pytest.raises(ValueError, match="early"):
        unpack(bomb[: len(bomb) // 2])
    limit(10**7)
    assert len(unpack(bomb)) == 10**7
    limit(10**7 - 1)
    with pytest.raises(ValueError, match="more than"):
        unpack(bomb)


@pytest.mark.parametrize(("storage", "compression"), [("mcap", "MESSAGE"), ("mcap", "STORAGE"), ("sqlite3", "MESSAGE")])
def test_a_recording_that_unpacks_to_too_much_is_refused(tmp_path, limit, storage, compression):
    points = np.zeros((5000, 3), np.float32)
    topics = {"/points": [cloud(k * 10**8, points) for k in range(3)],
              "/odom": [odometry(k * 10**8, np.eye(4)) for k in range(3)]}  # fmt: skip
    bag = write_bag(tmp_path / "a", topics, storage, compression)
    assert len(open_run(bag)) == 3
    limit(1000)
    with pytest.raises(CoViewError, match=r"unpacks to more than|not one"):
        open_run(bag)


def test_a_recording_whose_files_unpack_to_too_much_is_refused(tmp_path, limit):
    points = np.zeros((50_000, 3), np.float32)
    topics = {"/points": [cloud(k * 10**8, points) for k in range(5)],
              "/odom": [odometry(k * 10**8, np.eye(4)) for k in range(5)]}  # fmt: skip
    bag = write_bag(tmp_path / "a", topics, "sqlite3", "FILE")
    packed = next(bag.glob("*.zstd")).stat().st_size
    limit(10_000_000)
    assert len(open_run(bag)) == 5
    limit(0)
    assert 5 * points.nbytes > bag_reader.RATIO * packed
    with pytest.raises(CoViewError, match="a hundred times its size"):
        open_run(bag)


def test_readers_are_bounded_once_opened(tmp_path):
    from rosbags.rosbag1 import reader
    from rosbags.rosbag2 import storage_mcap

    (tmp_path / "a.mcap").write_bytes(b"nothing")
    with pytest.raises(RunError):
        BagReader(tmp_path / "a.mcap")
    replaced = [storage_mcap.DECOMPRESSORS[name] for name in ("zstd", "lz4")]
    replaced += [reader.decompressors[name] for name in ("bz2", "lz4")]
    assert all(function.__module__ == bag_reader.__name__ for function in replaced)
