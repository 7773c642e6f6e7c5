"""Consistent pairs of keypoints: the largest set in which all pairs agree, a maximum clique of the consistency graph.

Gravity is known, so two right pairs have the same horizontal distance in both views (:func:`consistency_graph`).
:func:`relaxed_clique` climbs a weighted relaxation whose penalty for contradicting pairs grows until none is left
together (the idea of Lusk et al., "CLIPPER: A Graph-Theoretic Framework for Robust Data Association", ICRA 2021);
:func:`largest_clique` starts from its clique and proves, by branch and bound with greedy colours, that there is no
larger one, or finds it. Both are deterministic.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from coview_stream.config.search import LearnedMatchConfig
from coview_stream.geometry.arrays import Bools, Floats, Floats32, Ints

# of the relaxation's climb; set by hand
_OUTER, _INNER, _TRIES = 40, 25, 12  # penalties, steps for each, step sizes for each
_MIN_CHANGE = 1e-4  # of the unit vector: with less, a climb has ended
_GROW, _SHRINK = 3.0, 0.25  # factors on the step size
_MAX_STEP = 1e6  # beyond it only the gradient's direction matters


@dataclass(frozen=True)
class Clique:
    """A set of nodes that are all adjacent.

    Attributes:
        members: (K,) in ascending order.
        exact: whether it is proved that there is no larger one.
    """

    members: Ints
    exact: bool

    def __len__(self) -> int:
        """Return how many members it has."""
        return len(self.members)


def consistency_graph(query: Floats, known: Floats, config: LearnedMatchConfig) -> Floats32:
    """Weigh how well every two pairs of points agree: rotation about the vertical and translation keep distances.

    Args:
        query: (N, 2) metres, the pairs' points in the scan.
        known: (N, 2) metres, the same pairs' points in the map.
        config: tolerances.

    Returns:
        (N, N) symmetric, 0 where two pairs contradict each other, lie too close together or are the same one, else
        exp(-d^2 / 2 spread^2) of the difference d of their distances. Mirror images keep distances too: the caller has
        to check the residuals.

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
    """Return the distances (N, N) between points, subtracted in double precision."""
    step = [(xy[:, None, k] - xy[None, :, k]).astype(np.float32) for k in (0, 1)]
    return np.asarray(np.hypot(*step))


def maximum_clique(weights: Floats32, nodes: int) -> Clique:
    """Return the maximum clique of a weighted graph (N, N): relaxed, then searched in up to ``nodes`` branches."""
    return largest_clique(weights > 0, relaxed_clique(weights), nodes)


def relaxed_clique(weights: Floats32) -> Ints:
    """Find a heavy clique of a weighted graph (N, N), symmetric, 0 for no edge; usually the largest or nearly.

    Maximises ``u^T (W + I - d B) u`` over unit vectors u >= 0 by projected gradients, where B marks the pairs
    without an edge and d grows. Of the u that results, the heaviest entries are taken in order as long as they agree.

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
        conflicting = (u > 1e-6) & (conflict > 1e-6)
        if not conflicting.any():
            break
        penalty += float(np.mean((own @ u)[conflicting] / conflict[conflicting])) if penalty == 0 else penalty
        u = _climb(own - np.float32(penalty) * apart, u)
    return _greedy_clique(weights > 0, np.argsort(-u, kind="stable"))


def _climb(matrix: Floats32, u: Floats32) -> Floats32:
    """Climb ``u^T matrix u`` over unit vectors u >= 0 (N,) by projected gradients."""
    gradient = matrix @ u
    value, step = float(u @ gradient), 1.0
    for _ in range(_INNER):
        step = min(step * _GROW, _MAX_STEP)
        for _ in range(_TRIES):
            trial = np.maximum(u + np.float32(step) * gradient, np.float32(0.0))
            norm = float(np.linalg.norm(trial))
            if norm > 0:
                trial /= np.float32(norm)
                trial_gradient = matrix @ trial
                if (trial_value := float(trial @ trial_gradient)) >= value:
                    break
            step *= _SHRINK
        else:
            break
        moved = float(np.linalg.norm(trial - u))
        u, gradient, value = trial, trial_gradient, trial_value
        if moved < _MIN_CHANGE:
            break
    return u


def _greedy_clique(adjacent: Bools, order: Ints) -> Ints:
    """Take nodes in ``order`` (N,), each that is adjacent to all taken before it: a maximal clique."""
    free = np.ones(len(adjacent), dtype=bool)
    members = []
    for node in order:
        if free[node]:
            members.append(int(node))
            free &= adjacent[node]
            free[node] = False
    return np.array(sorted(members), dtype=np.int64)


def largest_clique(adjacent: Bools, start: Ints, nodes: int) -> Clique:
    """Find the maximum clique of a graph by branch and bound.

    Args:
        adjacent: (N, N) symmetric; the diagonal does not matter.
        start: members of a known clique, possibly none.
        nodes: branches after which the search ends with the best clique so far.

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
    """Find the nodes with ``size`` or more neighbours among themselves: larger cliques consist of these."""
    kept = np.arange(len(edges))
    while len(kept):
        enough = edges[np.ix_(kept, kept)].sum(axis=1) >= size
        if enough.all():
            break
        kept = kept[enough]
    return kept


def _search(neighbours: list[int], size: int, nodes: int) -> tuple[list[int], bool]:
    """Find a largest clique of more than ``size`` (empty: there is none) in bit sets, and whether that is proved."""
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
