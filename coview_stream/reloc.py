"""Whether a map's learned features can be used here; apart from the sources, for a node's parent imports it."""

from __future__ import annotations

from coview_stream.basemap.basemap import BaseMap
from coview_stream.config import Reloc
from coview_stream.errors import CoViewError, MapError


def check_reloc(base_map: BaseMap, reloc: Reloc, load: bool = True) -> str | None:
    """Try what the first query would stumble on: features, weights and onnxruntime.

    Args:
        base_map: the map.
        reloc: what is asked for.
        load: also load the network, which takes 0.3 s and 60 MB; whoever does not search need not.

    Returns:
        Why ``auto`` goes without the features that the map has, with the remedy; None if it does not have to.

    Raises:
        MapError: ``learned`` is asked for, and the map has no features, damaged ones, or some of other weights.
        InputError: likewise, and there are no weights, or some that cannot be loaded.
        DependencyError: likewise, and there is no onnxruntime, or one that cannot be loaded.
    """
    if reloc == "coview":
        return None
    try:
        if base_map.learned is not None:
            base_map.learned.check()
            if load:
                from coview_stream.place.learned.network import network

                network("ground", None, 1)
        elif reloc == "learned":
            raise MapError(
                "the map has no learned features; build it again without --no-learned, or go without "
                "them (--reloc coview)"
            )
    except CoViewError as error:
        if reloc == "learned":
            raise
        return f"going without learned features: {error}"
    return None
