"""The likelihood field beside the exact verification: how often the right place comes first, how the scores agree.

Places along the runs of held-out worlds: a keyframe votes, its hypotheses are scored by the field, and the places that
they come to are compared with the truth. At the best dozen of them the same pose is verified exactly.
"""

from __future__ import annotations

from argparse import Namespace
from collections.abc import Iterator

import numpy as np
from scipy.stats import beta

from bench.harness.rows import Row, bounded, informs, reached
from bench.harness.worlds import WORLDS, Place, opened, places
from coview_stream import BaseMap
from coview_stream.config import LocalizerConfig
from coview_stream.geometry.transforms import inverse, rotation_angle, transform
from coview_stream.localization.registration.local_map import LocalMaps
from coview_stream.localization.registration.prepare_scan import prepare_scan
from coview_stream.localization.registration.register import ScanInput
from coview_stream.localization.registration.verification import verify
from coview_stream.localization.search.global_search import GlobalSearch
from coview_stream.localization.search.request import SAME_ANGLE, SAME_DISTANCE, SearchRequest
from coview_stream.localization.search.scoring import Rivals

_COMPARED = 12
_MB_PER_KM2 = 60.0


def ranks_and_scores(
    base_map: BaseMap, place: Place, search: GlobalSearch, local_maps: LocalMaps
) -> tuple[list[int | None], list[tuple[float, float]]]:
    """Rank of the right place at each keyframe, None where it is not among them; scores by field and verification."""
    T_true = place.T_map_submap @ inverse(place.T_odom_submap)
    ranks: list[int | None] = []
    scores: list[tuple[float, float]] = []
    search.clear()
    for query in place.queries:
        rivals = search.update(query).rivals
        off = [inverse(T_true @ query.T_odom_body) @ T @ query.T_odom_body for T in rivals.T_map_odom]
        right = [np.linalg.norm(o[:3, 3]) < SAME_DISTANCE and rotation_angle(o) < SAME_ANGLE for o in off]
        ranks.append(right.index(True) if any(right) else None)
        scores += _both(base_map, query, rivals, local_maps)
    return ranks, scores


def _both(
    base_map: BaseMap, query: SearchRequest, rivals: Rivals, local_maps: LocalMaps
) -> Iterator[tuple[float, float]]:
    settings = LocalizerConfig().registration
    scan = ScanInput(prepare_scan(query.submap, query.position, settings), query.cloud, query.T_odom_body)
    for T, score in zip(rivals.T_map_odom[:_COMPARED], rivals.scores.tolist(), strict=False):
        target = local_maps.around(transform(T, query.position[None])[0])
        if target is not None:
            body = T @ scan.T_odom_body
            yield score, verify(scan.cloud, T, scan.range_image, body, target, base_map.survey).score


def rows(asked: Namespace) -> Iterator[Row]:
    """Score the hypotheses of some places of each world."""
    for scene in WORLDS:
        base_map, _, _ = opened(WORLDS[scene])
        local_maps = LocalMaps(base_map, LocalizerConfig().registration.source_range)
        search = GlobalSearch(base_map, LocalizerConfig(), local_maps)
        ranks: list[int | None] = []
        scores: list[tuple[float, float]] = []
        for place in places(scene, 3 if asked.quick else 20):
            found = ranks_and_scores(base_map, place, search, local_maps)
            ranks += found[0]
            scores += found[1]
        name = f"field/{scene}, {len(ranks)} keyframes"
        first = 100.0 * float(np.mean([rank == 0 for rank in ranks]))
        yield reached(f"{name}: right place first", first, "%", 95.0)
        yield informs(f"{name}: the same, lower 95 % bound", _lower_bound(ranks.count(0), len(ranks)), "%")
        named = [rank for rank in ranks if rank is not None]
        yield informs(f"{name}: right place among the hypotheses", 100.0 * len(named) / len(ranks), "%")
        field, exact = np.array(scores).T
        yield informs(f"{name}: correlation with the exact score", float(np.corrcoef(field, exact)[0, 1]), "")
        yield informs(f"{name}: mean of field less exact score", float((field - exact).mean()), "")
        kept = base_map.field
        size = sum(a.nbytes for a in (kept.tiles, kept.occupied, kept.ground, kept.edge)) * 1e-6
        area = float((base_map.survey.values > 0).sum()) * base_map.survey.cell**2 * 1e-6
        yield bounded(f"field/{scene}: size per km2", size / area, "MB", _MB_PER_KM2)


def _lower_bound(hits: int, of: int) -> float:
    """Return the lower 95 % bound of a share (Clopper and Pearson), per cent."""
    return 100.0 * float(beta.ppf(0.05, hits, of - hits + 1)) if hits else 0.0
