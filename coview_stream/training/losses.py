"""Losses of the encoders: a query should correlate with its map at its pose and nowhere else."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn import functional

from coview_stream.descriptors.network import LOCAL_CELL, PLACE_CELL

_COARSE = 2  # local cells per coarse cell: the dense search runs on cells of 2 m
_RADIUS = 29.0  # metres around a query's centre within which cells count, as in train.py
_DENSE_SCALE = 20.0  # on scores in [-1, 1] before the softmax of the dense search
_LOCAL_TEMPERATURE = 0.07  # of the softmax over local descriptors
_PLACE_TEMPERATURE = 0.08  # of the softmax over global descriptors
_SAMPLES = 128  # corresponding points of a query and its map
_IGNORED_RADIUS = 2.5  # metres around a point within which other points are neither right nor wrong
_SAME_PLACE = 12.0  # metres: the same for global descriptors
_MIN_SIGMA = 0.05  # smaller uncertainties are raised to this
_LOCAL_WEIGHT, _PLACE_WEIGHT = 0.5, 0.5  # relative to the dense loss
_EXCLUDED = -1e4  # logit of a point that does not compete


@dataclass(frozen=True)
class Losses:
    """Three scalar losses, and the share of a batch's queries that the dense search places correctly."""

    dense: Tensor
    local: Tensor
    place: Tensor
    recall: float

    @property
    def total(self) -> Tensor:
        """The loss that is minimised."""
        return self.dense + _LOCAL_WEIGHT * self.local + _PLACE_WEIGHT * self.place


Encoded = tuple[Tensor, Tensor, Tensor]


def losses(
    query: Encoded, piece: Encoded, piece_of: Tensor, poses: Tensor, wrong_yaws: Tensor, seen: tuple[Tensor, Tensor]
) -> Losses:
    """Compare Q encoded queries with G encoded pieces.

    Args:
        query: local (Q, C, h, h), sigma (Q, 1, h, h), place (Q, P, ., .).
        piece: the same for G pieces of (H, H) local cells.
        piece_of: (Q,) the piece of each query.
        poses: (Q, 3) x, y (metres), heading (radians) in the piece's frame, from its centre.
        wrong_yaws: (Q, N) wrong headings that compete with the true heading, radians.
        seen: (Q, 1, h, h) and (G, 1, H, H), 1 for local cells in which anything was seen, else 0.
    """
    dense, recall = dense_loss(query, piece, piece_of, poses, wrong_yaws)
    local = local_loss(query, piece, piece_of, poses, seen)
    return Losses(dense, local, place_loss(query, piece, piece_of, poses), recall)


def dense_loss(
    query: Encoded, piece: Encoded, piece_of: Tensor, poses: Tensor, wrong_yaws: Tensor
) -> tuple[Tensor, float]:
    """Return the cross-entropy over all pieces, coarse cells and tried headings, and the share of correct queries."""
    local, sigma, _ = query
    axis = (torch.arange(local.shape[-1]) + 0.5 - local.shape[-1] / 2) * LOCAL_CELL
    weight = (torch.hypot(axis[:, None], axis[None]) < _RADIUS).to(local) / sigma
    coarse = functional.avg_pool2d(torch.cat([local * weight, weight], 1), _COARSE)
    yaws = torch.cat([poses[:, 2:], wrong_yaws], 1)
    count, tried = yaws.shape
    turned = turn(coarse.repeat_interleave(tried, 0), yaws.reshape(-1))
    values, mass = turned[:, :-1], turned[:, -1:].sum((2, 3), keepdim=True)
    values = values / mass.clamp(min=1e-6)
    maps = functional.avg_pool2d(piece[0], _COARSE)
    size, half = maps.shape[-1], values.shape[-1] // 2
    spectrum = torch.fft.rfft2(values, s=(size, size)).conj()
    product = torch.einsum("qcyx,gcyx->qgyx", spectrum, torch.fft.rfft2(maps))
    # the centre of a query with its upper left cell at (i, j) is the corner of cell (i + half, j + half)
    last = size - 2 * half + 1
    scores = torch.fft.irfft2(product, s=(size, size))[..., :last, :last]
    logits = _DENSE_SCALE * scores.reshape(count, -1)
    cell = LOCAL_CELL * _COARSE
    at = poses[:, :2] / cell + (size / 2 - half)
    target = _soft_target(at, piece_of, tried, len(maps), last).to(logits)
    best = logits.detach().argmax(1)
    right = target.reshape(count, -1).gather(1, best[:, None])[:, 0] > 0.05
    loss = -(target.reshape(count, -1) * functional.log_softmax(logits, 1)).sum(1).mean()
    return loss, float(right.float().mean())


def _soft_target(at: Tensor, piece_of: Tensor, tried: int, pieces: int, size: int) -> Tensor:
    """Return weights (Q, tried, G, size, size) of the four cells around ``at`` (Q, 2) x, y; heading 0 is true."""
    target = torch.zeros(len(at), tried, pieces, size, size)
    low = at.floor()
    rows = torch.arange(len(at))
    for dx in (0, 1):
        for dy in (0, 1):
            x, y = low[:, 0] + dx, low[:, 1] + dy
            share = (1 - (at[:, 0] - x).abs()) * (1 - (at[:, 1] - y).abs())
            x, y = x.long().clamp(0, size - 1), y.long().clamp(0, size - 1)
            target[rows, 0, piece_of, y, x] += share
    return target


def local_loss(query: Encoded, piece: Encoded, piece_of: Tensor, poses: Tensor, seen: tuple[Tensor, Tensor]) -> Tensor:
    """Return a loss that makes only corresponding cells similar, and makes sigma the error of this match.

    It is the cross-entropy e over corresponding points, in both directions, plus e / sigma + log sigma with e held
    constant, so that a high uncertainty is never cheaper than a good descriptor. Only points seen in both images count.
    """
    count = len(poses)
    radius = _RADIUS * 0.9 * torch.rand(count, _SAMPLES).sqrt()
    angle = 2 * torch.pi * torch.rand(count, _SAMPLES)
    there = torch.stack([radius * angle.cos(), radius * angle.sin()], -1)
    c, s = poses[:, 2].cos()[:, None], poses[:, 2].sin()[:, None]
    x, y = there[..., 0], there[..., 1]
    here = torch.stack([c * x - s * y, s * x + c * y], -1) + poses[:, None, :2]
    ours, sigma_q = _at(query[0], there), _at(query[1], there)[..., 0]
    theirs, sigma_p = _at(piece[0][piece_of], here), _at(piece[1][piece_of], here)[..., 0]
    similar = ours @ theirs.transpose(1, 2) / _LOCAL_TEMPERATURE
    near = (torch.cdist(here, here) < _IGNORED_RADIUS) & ~torch.eye(_SAMPLES, dtype=torch.bool)
    similar = similar.masked_fill(near, _EXCLUDED)
    wanted = torch.arange(_SAMPLES).expand(count, -1)
    both = (_at(seen[0], there)[..., 0] > 0.5) & (_at(seen[1][piece_of], here)[..., 0] > 0.5)
    weight = both.float() / both.sum().clamp(min=1)
    loss = torch.zeros(())
    for logits, sigma in ((similar, sigma_q), (similar.transpose(1, 2), sigma_p)):
        error = functional.cross_entropy(logits.transpose(1, 2), wanted, reduction="none")
        sigma = sigma.clamp(min=_MIN_SIGMA)  # outside the images it is 0
        loss = loss + 0.5 * (weight * (error + error.detach() / sigma + sigma.log())).sum()
    return loss


def place_loss(query: Encoded, piece: Encoded, piece_of: Tensor, poses: Tensor) -> Tensor:
    """Return a loss that makes a query's global descriptor most similar to the map's around its place."""
    maps, half = piece[2], query[2].shape[-1] // 2
    ours = functional.normalize(query[2][:, :, half - 1 : half + 1, half - 1 : half + 1].mean((2, 3)), dim=1)
    size = maps.shape[-1]
    flat = maps.flatten(2).transpose(1, 2).reshape(-1, maps.shape[1])
    logits = ours @ flat.T / _PLACE_TEMPERATURE
    axis = (torch.arange(size) + 0.5 - size / 2) * PLACE_CELL
    y, x = torch.meshgrid(axis, axis, indexing="ij")
    cells = torch.stack([x.flatten(), y.flatten()], -1)
    apart = torch.cdist(poses[:, :2], cells)
    same = (torch.arange(len(maps))[None] == piece_of[:, None]).repeat_interleave(size * size, 1)
    distance = apart.repeat(1, len(maps)).masked_fill(~same, torch.inf)
    wanted = distance.argmin(1)
    near = distance < _SAME_PLACE
    near[torch.arange(len(ours)), wanted] = False
    return functional.cross_entropy(logits.masked_fill(near, _EXCLUDED), wanted)


def turn(images: Tensor, yaws: Tensor) -> Tensor:
    """Rotate square images (N, C, n, n), row along y, about their centres by (N,) radians: ``p_out = R(yaw) p_in``."""
    c, s = yaws.cos(), yaws.sin()
    zero = torch.zeros_like(c)
    inverse = torch.stack([torch.stack([c, s, zero], -1), torch.stack([-s, c, zero], -1)], 1)
    grid = functional.affine_grid(inverse, list(images.shape), align_corners=False)
    return functional.grid_sample(images, grid, align_corners=False)


def _at(images: Tensor, points: Tensor) -> Tensor:
    """Interpolate local images (Q, C, n, n) bilinearly at (Q, K, 2) metres from their centres: (Q, K, C)."""
    grid = (points / (0.5 * LOCAL_CELL * images.shape[-1]))[:, :, None]
    return functional.grid_sample(images, grid, align_corners=False)[..., 0].transpose(1, 2)
