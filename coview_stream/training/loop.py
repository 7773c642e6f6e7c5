"""Training loop: batches through both encoders, with checkpoints."""

from __future__ import annotations

import math
import pickle
from collections.abc import Callable, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
import torch

from coview_stream.clouds.atomic_file import atomic_path
from coview_stream.errors import InputError
from coview_stream.training.batches import draw_batch
from coview_stream.training.losses import Losses, losses
from coview_stream.training.networks import VIEWS, PlaceNet
from coview_stream.training.recipe import TrainingConfig
from coview_stream.training.worlds import WorldViews

_WARM_UP = 0.03  # share of the steps over which the learning rate rises
_FINAL_RATE = 0.01  # share of the learning rate at the end
_MAX_GRADIENT = 5.0  # norm
_CHECKPOINT_STEPS = 100  # between checkpoints

Report = Callable[[int, Losses], None]  # called after each step with its number, from 0, and its losses


def train(
    worlds: Sequence[WorldViews], config: TrainingConfig, report: Report | None = None, checkpoint: Path | None = None
) -> PlaceNet:
    """Train from scratch, or resume from the file ``checkpoint``, which is written every 100 steps.

    Raises:
        InputError: the loss is not finite, or the checkpoint cannot be read or has another configuration.
    """
    torch.manual_seed(config.seed)
    net: PlaceNet = PlaceNet(config.width)
    net.to(memory_format=torch.channels_last)
    optimiser = torch.optim.AdamW(net.parameters(), config.rate, weight_decay=config.decay)
    first = _restore(checkpoint, net, optimiser, config)
    net.train()
    for step in range(first, config.steps):
        for group in optimiser.param_groups:
            rise = min(1.0, (step + 1) / max(1.0, _WARM_UP * config.steps))
            fall = _FINAL_RATE + (1 - _FINAL_RATE) * 0.5 * (1 + math.cos(math.pi * step / config.steps))
            group["lr"] = config.rate * (rise * fall)
        torch.manual_seed(config.seed + step)  # a resumed training continues as if it had not stopped
        loss = _step(net, worlds, config, np.random.default_rng([config.seed, step]))
        if not torch.isfinite(loss.total):
            raise InputError(f"step {step}: the loss is not finite; train with a lower rate")
        optimiser.zero_grad()
        loss.total.backward()
        torch.nn.utils.clip_grad_norm_(net.parameters(), _MAX_GRADIENT)
        optimiser.step()
        if report is not None:
            report(step, loss)
        if checkpoint is not None and (step + 1) % _CHECKPOINT_STEPS == 0:
            with atomic_path(checkpoint) as part:
                state = {"net": net.state_dict(), "optimiser": optimiser.state_dict()}
                torch.save(state | {"step": step + 1, "config": asdict(config)}, part)
    net.eval()
    return net


def _step(net: PlaceNet, worlds: Sequence[WorldViews], config: TrainingConfig, rng: np.random.Generator) -> Losses:
    batch = draw_batch(worlds, min(config.pieces, len(worlds)), config.each, rng)
    query, piece = (
        net((torch.from_numpy(images).float() / 255.0).contiguous(memory_format=torch.channels_last), VIEWS.index(view))
        for view, images in (("ground", batch.queries), ("aerial", batch.pieces))
    )
    wrong = rng.uniform(math.radians(12), 2 * math.pi - math.radians(12), (len(batch.queries), config.wrong))
    poses = torch.from_numpy(batch.poses).float()
    wrong_yaws = torch.from_numpy(batch.poses[:, 2:] + wrong).float()
    seen = _seen(batch.queries), _seen(batch.pieces)
    return losses(query, piece, torch.from_numpy(batch.piece_of), poses, wrong_yaws, seen)


def _seen(images: Any) -> torch.Tensor:
    """Return 1 for local cells (B, 1, H / 2, W / 2) in which anything except relief was seen, else 0."""
    anything = torch.from_numpy(images[:, :-1].any(axis=1, keepdims=True)).float()
    return torch.nn.functional.max_pool2d(anything, 2)


def _restore(path: Path | None, net: PlaceNet, optimiser: torch.optim.Optimizer, config: TrainingConfig) -> int:
    if path is None or not path.is_file():
        return 0
    try:
        state = torch.load(path, weights_only=True)
        same = state["config"] == asdict(config)
    except (OSError, RuntimeError, KeyError, TypeError, EOFError, pickle.UnpicklingError) as error:
        raise InputError(f"{path}: not the state of a training ({error}); delete it to start again") from error
    if not same:
        raise InputError(f"{path}: a training of other numbers; delete it to start again, or choose another folder")
    net.load_state_dict(state["net"])
    optimiser.load_state_dict(state["optimiser"])
    return int(state["step"])
