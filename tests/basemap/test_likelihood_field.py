"""The likelihood field of a map: what its rasters say of a known scene, and that a file keeps them."""

import numpy as np
import pytest

from coview_stream.basemap.basemap import BaseMap
from coview_stream.basemap.likelihood_field import field_arrays, roof_edges
from coview_stream.errors import MapError

NO_GROUND, NOT_SURVEYED = -32768, -32767


def scene(slope=0.0, offset=0.0):
    """A plane of 40 x 40 m, points every quarter of a metre, and a block of 6 x 6 m, 5 m high, roof only."""
    x, y = (a.ravel() for a in np.meshgrid(np.arange(0.1, 40, 0.25), np.arange(0.1, 40, 0.25)))
    roof = (np.abs(x - 20) < 3) & (np.abs(y - 12) < 3)
    z = offset + slope * x + np.where(roof, 5.0, 0.0)
    normal = np.array([-slope, 0.0, 1.0]) / np.hypot(1.0, slope)
    points = np.column_stack([x, y, z]).astype(np.float32)
    surveyed = np.ones((20, 20), dtype=bool)
    return points, np.tile(normal, (len(x), 1)).astype(np.float32), surveyed, np.zeros(2)


def cell(arrays, name, x, y):
    """Value of a layer at a place, and the height that its tile counts from."""
    row, column = int(np.floor(2 * y)), int(np.floor(2 * x))
    tile = np.flatnonzero((arrays["field.tiles"][:, :2] == (row // 32, column // 32)).all(axis=1))[0]
    return arrays[f"field.{name}"][tile, row % 32, column % 32], arrays["field.tiles"][tile, 2]


def test_ground_is_the_plane_at_the_cells_middle():
    for slope, offset in ((0.0, 0.0), (0.2, -37.3)):
        arrays = field_arrays(*scene(slope, offset), 2.0)
        for x, y in ((5.25, 5.25), (31.75, 30.25), (0.25, 39.75)):
            centimetres, base = cell(arrays, "ground", x, y)
            assert abs(base + 0.01 * centimetres - offset - slope * x) < 0.03


def test_structure_has_the_bit_of_its_height():
    arrays = field_arrays(*scene(), 2.0)
    roof, _ = cell(arrays, "occupied", 20.25, 12.25)
    plain, _ = cell(arrays, "occupied", 5.25, 5.25)
    assert int(roof).bit_count() == int(plain).bit_count() == 1
    assert int(roof) >> 10 & 1  # 5 m in half metres
    assert int(plain) & 1


def test_roof_edge_stands_around_the_roof_only():
    arrays = field_arrays(*scene(), 2.0)
    edge, base = cell(arrays, "edge", 17.25, 12.25)
    assert base + 0.25 * edge == 5.0
    assert cell(arrays, "edge", 5.25, 5.25)[0] == 0
    assert cell(arrays, "edge", 20.25, 12.25)[0] == 0
    assert (roof_edges(np.full((9, 9), 3.0, dtype=np.float32)) < -1e5).all()


def test_cells_outside_the_survey_are_told_from_those_without_ground():
    points, normals, surveyed, corner = scene()
    surveyed[:, 10:] = False
    hole = np.hypot(points[:, 0] - 8, points[:, 1] - 8) > 3.0
    arrays = field_arrays(points[hole], normals[hole], surveyed, corner, 2.0)
    assert cell(arrays, "ground", 8.25, 8.25)[0] == NO_GROUND
    assert cell(arrays, "ground", 30.25, 8.25)[0] == NOT_SURVEYED
    # tiles without any surveyed cell are not stored
    assert arrays["field.tiles"][:, 1].max() == 1


def test_file_keeps_the_field_and_an_older_map_makes_its_own(world_map, tmp_path):
    site = tmp_path / "site.coview"
    world_map.save(site)
    kept = BaseMap.load(site).field
    older = {name: a for name, a in world_map.arrays.items() if not name.startswith("field.")}
    made = BaseMap(older, world_map.parameters).field
    for name in ("tiles", "occupied", "edge"):
        np.testing.assert_array_equal(getattr(kept, name), getattr(world_map.field, name))
        np.testing.assert_array_equal(getattr(made, name), getattr(kept, name))
    np.testing.assert_array_equal(made.ground, kept.ground)


def test_field_of_other_shapes_is_refused(world_map):
    arrays = world_map.arrays
    for name, damaged in (
        ("tiles", arrays["field.tiles"][:-1]),
        ("occupied", arrays["field.occupied"][:, :16]),
        ("ground", arrays["field.ground"].astype(np.int32)),
        ("edge", arrays["field.edge"][1:]),
        ("tiles", arrays["field.tiles"] * np.int32(100_000)),
    ):
        with pytest.raises(MapError, match="field cannot be used"):
            _ = BaseMap(arrays | {f"field.{name}": damaged}, world_map.parameters).field
    with pytest.raises(MapError, match="field cannot be used"):
        _ = BaseMap({name: a for name, a in arrays.items() if name != "field.edge"}, world_map.parameters).field
