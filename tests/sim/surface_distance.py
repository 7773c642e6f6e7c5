"""Distance of points from the surfaces of a scene."""

import numpy as np
import pytest


def distance_to_surfaces(scene, points):
    """(N,) metres to the nearest triangle of the scene as it is now."""
    from coview_stream.errors import DependencyError
    from coview_stream.sim.casting import open3d

    try:
        o3d = open3d()
    except DependencyError as error:
        pytest.skip(str(error))
    surfaces = o3d.t.geometry.RaycastingScene(nthreads=1)
    for mesh in (scene.now.solid, scene.now.foliage):
        if len(mesh.triangles):
            vertices = o3d.core.Tensor(mesh.vertices.astype(np.float32))
            surfaces.add_triangles(vertices, o3d.core.Tensor(mesh.triangles.astype(np.uint32)))
    queries = o3d.core.Tensor(points.astype(np.float32))
    return surfaces.compute_distance(queries, nthreads=1).numpy()
