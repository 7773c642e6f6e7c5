"""Offline pose graph: any constraints between poses and to the map, solved at once.

The unknowns are poses X_k. With e(A, B) = log(A^-1 B) and a constraint's covariance C, they minimise the sum of

    rho(|C^-1/2 e(Z, X_target^-1 X_source)|)        X_target = I for the map

with rho(d) = d^2 / 2, Huber's or Cauchy's. Levenberg-Marquardt solves (H + l diag H) xi = -g and moves the poses to
X_k exp(xi_k) if the sum falls. H and g have the weights rho'(d) / d of iteratively reweighted least squares.

H is factored by pose blocks, L D L^T. The pose with the fewest neighbours is eliminated first, which couples these
neighbours (Dellaert and Kaess, "Factor graphs for robot perception", 2017, chapter 3). A chain takes time proportional
to its length. The same blocks give the covariances, starting with the last pose (Takahashi, Fagan and Chin, 1973): with
the neighbours U of pose k, W_k = D_k^-1 H_kU and S = H^-1,

    S_kU = -W_k S_UU        S_kk = D_k^-1 - W_k S_Uk
"""

from __future__ import annotations

import heapq
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations
from typing import NamedTuple

import numpy as np

from coview_stream.geometry.arrays import Floats, Ints
from coview_stream.geometry.transforms import Pose, Poses, adjoint, log_se3, moved, relative

_SETTLED = 1e-7  # metres and radians of the last step, at most
_MAX_STEPS = 100
_DAMPING = 1e-9, 1e3  # first and largest share of the diagonal; divided by ten after a step that helps, else multiplied


@dataclass(frozen=True, eq=False)
class Constraint:
    """Measured pose of one node of a graph, on the map or relative to another node."""

    source: int  # index of the measured node
    target: int  # index of the node from which it is measured; -1 for the map
    T: Pose  # (4, 4) pose of the source's body, relative to the target's body or to the map's origin
    covariance: Floats  # (6, 6) over (rx, ry, rz, x, y, z), along the axes of the source's body


class _Linear(NamedTuple):
    """Sum of rho at poses, and the normal equations there, by blocks."""

    cost: float
    nodes: Floats  # (N, 6, 6) of H, on its diagonal
    pairs: Floats  # (P, 6, 6) of H, of pairs of coupled nodes
    g: Floats  # (N, 6, 1)


class BatchGraph:
    """Graph of any constraints: the most probable poses, and the covariance of each.

    Every connected part needs a constraint to the map.
    """

    def __init__(self, poses: Poses) -> None:
        """Start from poses (N, 4, 4) of the nodes."""
        self._poses = np.asarray(poses, dtype=np.float64).reshape(-1, 4, 4)
        self._constraints: list[Constraint] = []
        self._kernels: list[tuple[slice, tuple[str, float]]] = []

    def add(self, constraints: Sequence[Constraint], kernel: tuple[str, float] | None = None) -> None:
        """Add constraints, under a kernel (``"Huber"``, ``"Cauchy"``) with its width in sigmas; None is quadratic."""
        begin = len(self._constraints)
        self._constraints += constraints
        if kernel is not None:
            self._kernels.append((slice(begin, len(self._constraints)), kernel))

    def solve(self) -> Poses:
        """Return the most probable poses (N, 4, 4)."""
        damping, most = _DAMPING
        structure = _Structure(len(self._poses), self._constraints)
        here = self._linearized(structure, self._poses)
        for _ in range(_MAX_STEPS):
            step = -_Factor(structure, here, damping).solve(here.g)
            poses = moved(self._poses, step)
            there = self._linearized(structure, poses)
            if there.cost <= here.cost:
                self._poses, here, damping = poses, there, 0.1 * damping
            else:
                damping *= 10.0
            if not np.abs(step).max(initial=0.0) > _SETTLED or damping > most:
                break
        return self._poses.copy()

    def covariances(self) -> Floats:
        """Return the covariance (N, 6, 6) of each pose over (rx, ry, rz, x, y, z), along the axes of its body."""
        structure = _Structure(len(self._poses), self._constraints)
        return _Factor(structure, self._linearized(structure, self._poses), 0.0).covariances()

    def _linearized(self, structure: _Structure, poses: Poses) -> _Linear:
        source, target, on_map = structure.source, structure.target, structure.target < 0
        predicted = relative(np.where(on_map[:, None, None], np.eye(4), poses[target]), poses[source])
        gaps, D = log_se3(relative(structure.T, predicted))
        r, J = structure.whiten @ gaps[..., None], structure.whiten @ D
        J_target = np.where(on_map[:, None, None], 0.0, -J @ adjoint(relative(predicted, np.eye(4))))
        rho, weights = self._loss((r * r).sum(axis=(1, 2)))
        nodes, pairs = np.zeros((len(poses), 6, 6)), np.zeros((structure.pairs, 6, 6))
        g = np.zeros((len(poses), 6, 1))
        for ends, own, other in ((source, J, J_target), (target, J_target, J)):
            weighed = weights[:, None, None] * np.swapaxes(own, -1, -2)
            np.add.at(nodes, ends, weighed @ own)
            np.add.at(g, ends, weighed @ r)
            first = (structure.first == ends) & ~on_map  # of its pair, in the order of elimination
            np.add.at(pairs, structure.pair_of[first], (weighed @ other)[first])
        return _Linear(float(rho.sum()), nodes, pairs, g)

    def _loss(self, squared: Floats) -> tuple[Floats, Floats]:
        """Return rho (M,) and the weights (M,) of squared residuals (M,) in sigmas."""
        rho, weights = 0.5 * squared, np.ones_like(squared)
        for part, (kind, width) in self._kernels:
            share = squared[part] / width**2
            if kind == "Cauchy":
                rho[part], weights[part] = 0.5 * width**2 * np.log1p(share), 1.0 / (1.0 + share)
            else:
                far = np.sqrt(np.maximum(share, 1.0))
                rho[part], weights[part] = width**2 * np.where(share > 1.0, far - 0.5, 0.5 * share), 1.0 / far
        return rho, weights


class _Eliminated(NamedTuple):
    """A node, and the nodes to which it is coupled at its elimination."""

    node: int
    others: Ints  # (m,) in order of their own elimination
    pairs: slice  # of this node with each of them
    among: tuple[Ints, Ints, Ints]  # pairs of the others: first, second, as positions in ``others``, and the pair


class _Structure:
    """The part of a graph that is independent of the poses: constraints as arrays, and the elimination order."""

    def __init__(self, count: int, constraints: Sequence[Constraint]) -> None:
        self.source = np.array([c.source for c in constraints], dtype=np.int64)  # (M,)
        self.target = np.array([c.target for c in constraints], dtype=np.int64)
        self.T = np.array([c.T for c in constraints]).reshape(-1, 4, 4)
        covariances = np.array([c.covariance for c in constraints]).reshape(-1, 6, 6)
        self.whiten = np.linalg.inv(np.linalg.cholesky(covariances))  # (M, 6, 6)
        beside: list[set[int]] = [set() for _ in range(count)]
        ends = list(zip(self.source.tolist(), self.target.tolist(), strict=True))
        for a, b in ends:
            if b >= 0:
                beside[a].add(b)
                beside[b].add(a)
        heap = [(len(others), k) for k, others in enumerate(beside)]
        heapq.heapify(heap)
        place: dict[int, int] = {}  # position in the elimination order
        while heap:
            neighbours, k = heapq.heappop(heap)
            if k not in place and neighbours == len(beside[k]):
                place[k] = len(place)
                for other in beside[k]:
                    beside[other] |= beside[k]
                    beside[other] -= {k, other}
                    heapq.heappush(heap, (len(beside[other]), other))
        number: dict[tuple[int, int], int] = {}
        ordered = [(k, sorted(beside[k], key=place.__getitem__)) for k in place]
        for k, others in ordered:
            number.update({(k, other): len(number) + n for n, other in enumerate(others)})
        self.pairs, self.order, begin = len(number), list[_Eliminated](), 0
        for k, others in ordered:
            among = [(a, b, number[others[a], others[b]]) for a, b in combinations(range(len(others)), 2)]
            first, second, pair = np.array(among, dtype=np.int64).reshape(-1, 3).T
            own, begin = slice(begin, begin + len(others)), begin + len(others)
            self.order.append(_Eliminated(k, np.array(others, dtype=np.int64), own, (first, second, pair)))
        self.first = np.array([a if b < 0 or place[a] < place[b] else b for a, b in ends], dtype=np.int64)  # (M,)
        self.pair_of = np.array([number.get((a, b), number.get((b, a), -1)) for a, b in ends], dtype=np.int64)


class _Factor:
    """H, factored by blocks: for each eliminated node D^-1 (6, 6) and W = D^-1 H_kU (6, 6 m)."""

    def __init__(self, structure: _Structure, linear: _Linear, damping: float) -> None:
        self.order, self._parts = structure.order, list[tuple[Floats, Floats]]()
        nodes, pairs = linear.nodes.copy(), linear.pairs.copy()
        nodes[:, range(6), range(6)] *= 1.0 + damping
        for k, others, own, (first, second, among) in self.order:
            m = np.arange(len(others))
            D = np.linalg.inv(nodes[k])
            beside = pairs[own].transpose(1, 0, 2).reshape(6, -1)
            W = D @ beside
            fill = (beside.T @ W).reshape(len(m), 6, len(m), 6)
            nodes[others] -= fill[m, :, m]
            if len(among):
                pairs[among] -= fill[first, :, second]
            self._parts.append((D, W))

    def solve(self, b: Floats) -> Floats:
        """Return the solution (N, 6) of H x = b (N, 6, 1)."""
        x = b[..., 0].copy()
        for (k, others, _, _), (D, W) in zip(self.order, self._parts, strict=True):
            x[others] -= (x[k] @ W).reshape(-1, 6)
            x[k] = D @ x[k]
        for (k, others, _, _), (_, W) in zip(self.order[::-1], self._parts[::-1], strict=True):
            x[k] -= W @ x[others].ravel()
        return x

    def covariances(self) -> Floats:
        """Return the blocks (N, 6, 6) on the diagonal of H^-1."""
        nodes = np.empty((len(self.order), 6, 6))
        pairs = np.empty((sum(len(each.others) for each in self.order), 6, 6))
        for (k, others, own, (first, second, among)), (D, W) in zip(self.order[::-1], self._parts[::-1], strict=True):
            m = np.arange(len(others))
            S = np.empty((len(m), 6, len(m), 6))
            S[m, :, m] = nodes[others]
            S[first, :, second] = pairs[among]
            S[second, :, first] = np.swapaxes(pairs[among], -1, -2)
            across = -W @ S.reshape(6 * len(m), 6 * len(m))
            nodes[k] = D - across @ W.T
            pairs[own] = across.reshape(6, len(m), 6).transpose(1, 0, 2)
        return nodes
