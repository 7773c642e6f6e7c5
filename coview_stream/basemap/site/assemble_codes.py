"""Codes of a map's stations, made tile by tile: the descriptors of all stations are never in memory at once."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator

import numpy as np

from coview_kernels import StationCodes
from coview_stream.basemap.file_format import Arrays
from coview_stream.basemap.site.array_files import ArrayFiles
from coview_stream.basemap.site.earlier import Earlier
from coview_stream.basemap.site.manifest import HALO, Key
from coview_stream.basemap.site.tile_clouds import TileClouds
from coview_stream.basemap.station_index import CODES, StationIndex, sampled_stations
from coview_stream.basemap.stations import Described, describe_storeys
from coview_stream.geometry.arrays import Ints

_PORTION = 8192  # stations described at a time: 60 MB of descriptors; set by hand
_COPIED = 1 << 15  # stations copied at a time: 16 MB of each tier; set by hand


def station_codes(clouds: TileClouds, earlier: Earlier, into: ArrayFiles, step: Callable[[], None]) -> Arrays:
    """Return the arrays of the station index but for the codes, which are made in files under the same names.

    Args:
        clouds: the tiles.
        earlier: an earlier working file: its tiles' codes are copied, and those of the others are made in its terms.
        into: the files.
        step: called after each tile.
    """
    counts = {key: len(each) for key, each in clouds.stations.items()}
    stations = sum(counts.values())
    made = [into.zeros(name, StationCodes.shape_of(stations), np.int16) for name in CODES]
    tiers, wanted = earlier.tiers(made), sampled_stations(stations)
    takes = tiers is not None
    if tiers is None:
        learned = StationCodes.learned_from(stations)
        some, kept = _together(clouds, np.union1d(learned, wanted))
        sample = [values[np.searchsorted(some, learned)] for values in kept.values()]
        tiers = StationCodes.empty_tiers(sample, 2, stations, made)
        kept = {name: values[np.searchsorted(some, wanted)] for name, values in kept.items()}
    else:
        kept = _together(clouds, wanted)[1]
    begin = 0
    for key, count in counts.items():
        taken = earlier.stations(key) if takes else None
        if taken is None:
            for part, numbers in _described(clouds, np.arange(begin, begin + count), [key]):
                StationCodes.encode_tiers(tiers, slice(int(numbers[0]), int(numbers[-1]) + 1), list(part.values()))
                into.release()
        else:
            for start in range(0, count, _COPIED):
                end = min(start + _COPIED, count)
                for name, codes in zip(CODES, made, strict=True):
                    codes[begin + start : begin + end] = earlier.codes(name, taken)[start:end]
                into.release()
                earlier.release()
        begin += count
        step()
    arrays = StationIndex(tiers[0], tiers[1], kept).arrays()
    return {name: values for name, values in arrays.items() if name not in CODES}


def _together(clouds: TileClouds, wanted: Ints) -> tuple[Ints, Described]:
    """Return the descriptors of some stations of all tiles, and their numbers."""
    parts, numbers = zip(*_described(clouds, wanted), strict=True)
    return np.concatenate(numbers), {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}


def _described(
    clouds: TileClouds, wanted: Ints, keys: Collection[Key] | None = None
) -> Iterator[tuple[Described, Ints]]:
    """Yield the descriptors of some stations of all tiles or some, portion by portion, with their numbers."""
    config = clouds.grid.config
    begin = 0
    for key, stations in clouds.stations.items():
        numbers = wanted[(wanted >= begin) & (wanted < begin + len(stations))]
        if len(numbers) and (keys is None or key in keys):
            margin = max(HALO, config.descriptor.radius + 2.0 * config.block)
            points, _ = clouds.around(key, margin)
            for start in range(0, len(numbers), _PORTION):
                some = numbers[start : start + _PORTION]
                yield describe_storeys(points, stations, config.block, config.descriptor, None, some - begin), some
        begin += len(stations)
