"""Station index: z-scores near the exact ones, the same from a map's file, and made anew where the file lacks it."""

import numpy as np
import pytest

from bench.accuracy.choices import TableVote
from coview_stream.basemap.basemap import BaseMap
from coview_stream.basemap.station_index import StationIndex
from coview_stream.errors import MapError
from coview_stream.localization.search.retrieval import exact_distances


@pytest.fixture(scope="module")
def query(world_map):
    """Descriptors of a place between two stations."""
    channels = world_map.descriptor_config.channels
    both = {name: world_map.descriptors(name)[40:42].astype(np.float32) for name in channels}
    return {
        name: np.roll(one, 7, axis=1) * 0.7 + np.roll(other, 7, axis=1) * 0.3 for name, (one, other) in both.items()
    }


def test_scores_are_near_those_of_the_exact_distances(world_map, query):
    index = world_map.station_index
    asked = index.query(query)
    exact = {name: exact_distances(world_map.descriptors(name), query[name]) for name in query}
    expected = TableVote.of_distances(np.zeros(3), exact.values()).scores
    found = index.all_shifts(asked, np.arange(len(index)))
    assert (
        np.unravel_index(found.argmin(), found.shape) == np.unravel_index(expected.argmin(), expected.shape) == (40, 7)
    )
    assert abs(np.median(found - expected)) < 0.1
    assert np.std(found - expected) < 0.25
    np.testing.assert_allclose(index.best(asked), found.min(axis=1), atol=0.2)
    single = index.at(asked, *(each.ravel() for each in np.indices(found.shape)))
    assert np.std(single - expected.ravel()) < 0.8 * np.std(found - expected)
    np.testing.assert_array_equal(index.at(asked, [40, -1, 3], [7, 7, 0]), [single[40 * 60 + 7], 0.0, single[3 * 60]])


@pytest.mark.slow
def test_index_of_a_file_is_that_of_the_descriptors(world_map, query, tmp_path):
    world_map.save(tmp_path / "site.coview")
    loaded = BaseMap.load(tmp_path / "site.coview")
    codes = loaded.station_index.codes.codes
    assert isinstance(codes, np.memmap)
    assert codes.__array_interface__["data"][0] % 64 == 0  # they begin with a cache line
    anew = StationIndex.of({name: loaded.descriptors(name) for name in loaded.descriptor_config.channels})
    for one, other in zip(loaded.station_index.arrays().values(), anew.arrays().values(), strict=True):
        np.testing.assert_array_equal(one, other)
    found, expected = (index.best(index.query(query)) for index in (loaded.station_index, anew))
    np.testing.assert_array_equal(found, expected)


@pytest.mark.slow
def test_index_of_other_shapes_is_made_anew_or_refused(world_map, query):
    arrays = world_map.arrays
    expected = world_map.station_index.best(world_map.station_index.query(query))
    without = {name: each for name, each in arrays.items() if not name.startswith("station_codes")}
    old = BaseMap(without, world_map.parameters).station_index
    np.testing.assert_array_equal(old.best(old.query(query)), expected)
    for name, damaged in (
        ("station_codes", arrays["station_codes"][:, :8]),
        ("station_codes", arrays["station_codes"].astype(np.int32)),
        ("station_codes.rest", arrays["station_codes.rest"][1:]),
        ("station_codes.step", arrays["station_codes.step"][:4]),
        ("station_codes.sample", arrays["station_codes.sample"][:, 1:]),
    ):
        index = BaseMap(arrays | {name: damaged}, world_map.parameters).station_index
        np.testing.assert_array_equal(index.best(index.query(query)), expected)
    fewer = StationIndex.of({name: world_map.descriptors(name)[:50] for name in query}).arrays()
    with pytest.raises(MapError, match="index is of 50 stations"):
        _ = BaseMap(arrays | fewer, world_map.parameters).station_index
