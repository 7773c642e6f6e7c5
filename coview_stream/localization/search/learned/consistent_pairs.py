"""The largest set of pairs that all agree: a maximum clique of the consistency graph.

:func:`relaxed` climbs a weighted relaxation whose penalty for contradicting pairs grows until none is left together
(the idea of Lusk et al., "CLIPPER: A Graph-Theoretic Framework for Robust Data Association", ICRA 2021);
:func:`largest` starts from its clique and proves, by branch and bound with greedy colours, that there is no larger
one, or finds it. Both are deterministic.
"""

# FOLDED coview_stream/localization/search/learned/consistent_pairs.py: """Which pairs of keypoints can all be true at once: gravity is known, so distances from above must agree."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from coview_stream.config.search import LearnedMatchConfig
from coview_stream.geometry.arrays import Bools, Floats, Floats32, Ints

_OUTER, _INNER, _TRIES = 40, 25, 12

_STILL = 1e-4  # change of the unit vector below which a climb has ended

_FASTER, _SLOWER = 3.0, 0.25

_LONGEST = 1e6  # step of a climb: beyond, only the slope's direction matters


@dataclass(frozen=True)
class Clique:
    """``members`` in ascending order; ``exact``: it is proved that there is no larger one."""

    members: Ints
    exact: bool

    def __len__(self) -> int:
        """Return how many members it has."""
        return len(self.members)


def maximum_clique(weights: Floats32, nodes: int) -> Clique:
    """Relax, then search: see :func:`relaxed` and :func:`largest`."""
    return largest(weights > 0, relaxed(weights), nodes)


def relaxed(weights: Floats32) -> Ints:
    """Find a heavy clique of a weighted graph (N, N), symmetric, 0 for no edge; usually the largest or nearly.

    Maximises ``u^T (W + I - d B) u`` over unit vectors u >= 0 by projected gradients, where B marks the pairs
    without an edge and d grows. Whatever u comes out, its heaviest entries are taken in order as long as they agree.

    Returns:
        Members of the clique, ascending; none for a graph without nodes.
    """
    count = len(weights)
    if not count:
        return np.empty(0, dtype=np.int64)
    apart = (weights <= 0).astype(np.float32)
    np.fill_diagonal(apart, 0.0)
    own = weights.astype(np.float32)
    np.fill_diagonal(own, 1.0)
    u = np.full(count, 1.0 / np.sqrt(count), dtype=np.float32)
    for _ in range(10):  # towards the leading eigenvector, which sees the densest part
        u = own @ u
        u /= np.linalg.norm(u)
    penalty = 0.0
    for _ in range(_OUTER):
        conflict = apart @ u
        torn = (u > 1e-6) & (conflict > 1e-6)
        if not torn.any():
            break
        penalty += float(np.mean((own @ u)[torn] / conflict[torn])) if penalty == 0 else penalty
        u = _climb(own - np.float32(penalty) * apart, u)
    return _agreeing(weights > 0, np.argsort(-u, kind="stable"))


def _climb(matrix: Floats32, u: Floats32) -> Floats32:
    """Projected gradient ascent of ``u^T matrix u`` over unit vectors u >= 0 (N,)."""
    slope = matrix @ u
    value, step = float(u @ slope), 1.0
    for _ in range(_INNER):
        step = min(step * _FASTER, _LONGEST)
        for _ in range(_TRIES):
            tried = np.maximum(u + np.float32(step) * slope, np.float32(0.0))
            norm = float(np.linalg.norm(tried))
            if norm > 0:
                tried /= np.float32(norm)
                steep = matrix @ tried
                if (reached := float(tried @ steep)) >= value:
                    break
            step *= _SLOWER
        else:
            break
        moved = float(np.linalg.norm(tried - u))
        u, slope, value = tried, steep, reached
        if moved < _STILL:
            break
    return u


def _agreeing(adjacent: Bools, order: Ints) -> Ints:
    """Take nodes in ``order`` (N,), each that is adjacent to all before it: a clique that nothing can be added to."""
    free = np.ones(len(adjacent), dtype=bool)
    members = []
    for node in order:
        if free[node]:
            members.append(int(node))
            free &= adjacent[node]
            free[node] = False
    return np.array(sorted(members), dtype=np.int64)


def largest(adjacent: Bools, start: Ints, nodes: int) -> Clique:
    """Search for the maximum clique of a graph.

    Args:
        adjacent: (N, N) symmetric; the diagonal does not matter.
        start: members of a clique that is known, possibly none.
        nodes: branches after which the search ends with the best that it has found.

    Raises:
        ValueError: ``start`` is no clique.
    """
    edges = adjacent.copy()
    np.fill_diagonal(edges, False)
    inner = edges[np.ix_(start, start)]
    if len(set(start.tolist())) < len(start) or inner.sum() < len(start) * (len(start) - 1):
        raise ValueError(f"the {len(start)} nodes to start from are no clique")
    kept = _core(edges, len(start))
    if not len(kept):
        return Clique(np.sort(start), True)
    edges = edges[np.ix_(kept, kept)]
    order = np.argsort(-edges.sum(axis=1), kind="stable")  # many neighbours first: fewer colours
    packed = np.packbits(edges[np.ix_(order, order)], axis=1, bitorder="little")
    found, exact = _search([int.from_bytes(row.tobytes(), "little") for row in packed], len(start), nodes)
    members = kept[order[found]] if found else start
    return Clique(np.sort(members), exact)


def _core(edges: Bools, size: int) -> Ints:
    """Nodes with at least ``size`` neighbours among themselves: a clique of more than ``size`` is made of these."""
    kept = np.arange(len(edges))
    while len(kept):
        enough = edges[np.ix_(kept, kept)].sum(axis=1) >= size
        if enough.all():
            break
        kept = kept[enough]
    return kept


def _search(neighbours: list[int], size: int, nodes: int) -> tuple[list[int], bool]:
    """Find a largest clique of more than ``size`` (empty: there is none) in bit sets, and say if that is proved."""
    best: list[int] = []
    path: list[int] = []
    everything = (1 << len(neighbours)) - 1
    # a level: its candidates by colour, their colours, and which candidates are left
    levels = [(*_coloured(everything, neighbours, size), everything)]
    while levels:
        order, colours, left = levels[-1]
        if not order or len(path) + colours[-1] <= size:
            levels.pop()
            if path:
                path.pop()
            continue
        if nodes <= 0:
            return best, False
        nodes -= 1
        node = order.pop()
        colours.pop()
        levels[-1] = (order, colours, left & ~(1 << node))
        path.append(node)
        if len(path) > size:
            best, size = path.copy(), len(path)
        beyond = left & neighbours[node]
        levels.append((*_coloured(beyond, neighbours, size - len(path)), beyond))
    return best, True


def _coloured(candidates: int, neighbours: list[int], spare: int) -> tuple[list[int], list[int]]:
    """Colour candidates so that neighbours differ, greedily; those of more than ``spare`` colours, ascending.

    So many colours bound the clique among a candidate and those before it. What needs no more than ``spare`` colours
    cannot lead to a larger clique and is left out.
    """
    order: list[int] = []
    colours: list[int] = []
    colour = 0
    while candidates:
        colour += 1
        alike = candidates
        while alike:
            bit = alike & -alike
            node = bit.bit_length() - 1
            candidates ^= bit
            alike &= ~(neighbours[node] | bit)
            if colour > spare:
                order.append(node)
                colours.append(colour)
    return order, colours


def consistency_graph(query: Floats, known: Floats, config: LearnedMatchConfig) -> Floats32:
    """Weigh how well every two pairs of points agree: a turn about the vertical and a shift keep distances.

    Args:
        query: (N, 2) metres, the pairs' points in the scan.
        known: (N, 2) metres, the same pairs' points in the map.
        config: tolerances.

    Returns:
        (N, N) symmetric, 0 where two pairs contradict each other, lie too close together or are the same one, else
        exp(-d^2 / 2 spread^2) of the difference d of their distances. Mirror images keep distances too: what follows
        has to look at the residuals.

    Raises:
        ValueError: the two sides are of different numbers.
    """
    if query.shape != known.shape or query.shape[1:] != (2,):
        raise ValueError(f"pairs of points {query.shape} and {known.shape}: both have to be (N, 2)")
    here, there = _distances(query), _distances(known)
    apart = np.minimum(here, there) >= config.min_separation
    here -= there
    fits = apart & (np.abs(here) < config.tolerance)
    np.fill_diagonal(fits, False)
    here *= here
    here *= np.float32(-0.5 / config.spread**2)
    return np.where(fits, np.exp(here), np.float32(0.0))


def _distances(xy: Floats) -> Floats32:
    """Distances (N, N) between points; they are subtracted before single precision takes over."""
    step = [(xy[:, None, k] - xy[None, :, k]).astype(np.float32) for k in (0, 1)]
    return np.asarray(np.hypot(*step))
