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
    descriptors = rng.uniform(0, 9, (50, 20, 60)).astype(np.float16)
    codes = ck.StationCodes.of([descriptors])
    query = codes.query(ck.unit_columns(descriptors[7]))
    points, best = voxel_filter(cloud, EYE)[0].copy(), codes.best(query)
    np.testing.assert_array_equal(copied(voxel_filter)(cloud, EYE)[0], points)
    np.testing.assert_array_equal(copied(codes).best(query), best)
