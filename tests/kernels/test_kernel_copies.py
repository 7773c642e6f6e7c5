"""What holds prepared launches can be copied and sent to another process; settings that would harm are refused."""

import copy
import pickle

import numpy as np
import pytest

import coview_kernels as ck
from coview_stream.config import KeyframeConfig
from coview_stream.place.keyframes import KeyframeBuffer

EYE = np.eye(4)


@pytest.mark.parametrize("copied", [copy.deepcopy, lambda x: pickle.loads(pickle.dumps(x))])
def test_copies_answer_as_the_original(copied):
    rng = np.random.default_rng(0)
    cloud = rng.uniform(-20, 20, (500, 3)).astype(np.float32)
    intake = ck.FrameIntake(1.0, bins=(20, 60, 30.0))
    index = ck.MatchIndex(rng.uniform(0, 9, (50, 20, 60)).astype(np.float16))
    query = index.descriptors[7].astype(np.float32)
    points, nearest = intake(cloud, EYE).points.copy(), index.top_k(query, 3)
    np.testing.assert_array_equal(copied(intake)(cloud, EYE).points, points)
    for ours, theirs in zip(copied(index).top_k(query, 3), nearest, strict=True):
        np.testing.assert_array_equal(ours, theirs)


def test_a_buffer_of_keyframes_can_be_copied():
    cloud = np.random.default_rng(1).uniform(-20, 20, (500, 3)).astype(np.float32)
    buffer = KeyframeBuffer(KeyframeConfig())
    buffer.add(cloud, EYE, 0.0)
    assert copy.deepcopy(buffer).add(cloud, EYE, 1.0) is None


@pytest.mark.parametrize("every", [1000, 2**31, 10**18])
def test_every_nth_point_of_fewer_is_one(every):
    rng = np.random.default_rng(2)
    cloud = rng.uniform(-5, 5, (300, 3)).astype(np.float32)
    up = np.tile(np.float32([0, 0, 1]), (300, 1))
    scales = [ck.Scale(1.0, 0.1, every=every), ck.Scale(1.0, 0.1)]
    arguments = ck.PointGrid(cloud), up, cloud, np.zeros(300, bool), EYE, np.zeros(3)
    found = ck.align_planes(*arguments, scales, keep=0.7, iterations=3, least=1)
    assert found is not None
    with pytest.raises(ValueError, match="least must be at least 1"):
        ck.align_planes(*arguments, scales, keep=0.7, iterations=3, least=0)


@pytest.mark.parametrize("kind", [np.float64, np.int32])
def test_descriptors_of_another_type_are_refused(kind):
    with pytest.raises(ValueError, match="expected float16 or float32"):
        ck.MatchIndex(np.ones((3, 20, 60), dtype=kind))
