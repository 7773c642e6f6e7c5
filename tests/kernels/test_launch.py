"""Objects that hold prepared launches can be copied and pickled."""

import copy
import pickle

import numpy as np
import pytest

import coview_kernels as ck

EYE = np.eye(4)


@pytest.mark.slow
@pytest.mark.parametrize("copied", [copy.deepcopy, lambda x: pickle.loads(pickle.dumps(x))])
def test_copies_compute_the_same_results(copied):
    rng = np.random.default_rng(0)
    cloud = rng.uniform(-20, 20, (500, 3)).astype(np.float32)
    voxel_filter = ck.VoxelFilter(1.0)
    index = ck.MatchIndex(rng.uniform(0, 9, (50, 20, 60)).astype(np.float16))
    query = index.descriptors[7].astype(np.float32)
    points, nearest = voxel_filter(cloud, EYE)[0].copy(), index.top_k(query, 3)
    np.testing.assert_array_equal(copied(voxel_filter)(cloud, EYE)[0], points)
    for ours, theirs in zip(copied(index).top_k(query, 3), nearest, strict=True):
        np.testing.assert_array_equal(ours, theirs)
