"""A minute's training of tiny networks: the loss falls, and places are found far more often than by chance."""

from dataclasses import asdict, replace
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("torch", reason="training needs PyTorch: pip install '.[learn-train]'")

import torch

from coview_stream.cli import main
from coview_stream.descriptors.birds_eye_view import LAYERS
from coview_stream.descriptors.network import Network
from coview_stream.errors import InputError
from coview_stream.training.networks import PlaceNet
from coview_stream.training.train import SMOKE, train_session


@pytest.mark.slow
def test_smoke_training_learns_to_find_places(tmp_path: Path) -> None:
    card = train_session(tmp_path, SMOKE)
    assert card["loss"]["last"] < 0.6 * card["loss"]["first"]
    assert card["validation"]["AR@1"] >= 5 * card["validation"]["chance"]
    assert card["validation"]["AR@1"] >= 0.4  # to answer the map's middle is right in a fifth of the cases
    image = np.full((LAYERS, 128, 128), 128, dtype=np.uint8)
    for view in ("aerial", "ground"):
        features = Network(view, tmp_path)(image)  # type: ignore[arg-type] # a literal, by name
        assert np.allclose(np.linalg.norm(features.local, axis=0), 1.0, atol=1e-4)
        assert (features.sigma > 0).all()


def test_training_resumes_with_its_own_settings_alone_and_tells_no_first_loss(tmp_path: Path) -> None:
    """Where a training of one step has been, another seed, width or recipe does not go on with it."""
    short = replace(SMOKE, worlds=1, most=2, training=replace(SMOKE.training, steps=1, pieces=1))
    train_session(tmp_path, short)
    assert not (tmp_path / "checkpoint.pt").exists()  # too short for one
    config = replace(short.training, steps=2)
    net = PlaceNet(config.width)
    state = {"net": net.state_dict(), "optimiser": torch.optim.AdamW(net.parameters()).state_dict()}
    torch.save(state | {"step": 1, "config": asdict(config)}, tmp_path / "checkpoint.pt")
    assert train_session(tmp_path, replace(short, training=config))["loss"].keys() == {"last"}
    with pytest.raises(InputError, match="another recipe"):
        train_session(tmp_path, replace(short, recipe=replace(SMOKE.recipe, rays=50_000)))
    (tmp_path / "checkpoint.pt").write_bytes(b"no checkpoint")
    with pytest.raises(InputError, match="not the state of a training"):
        train_session(tmp_path, short)


@pytest.mark.parametrize(
    ("option", "number", "says"),
    [
        *(("--first-world", number, "held out") for number in (18_999, 20_000, -5)),
        *((option, number, option.strip("-")) for option, number in (("--worlds", 0), ("--steps", 0), ("--seed", -1))),
    ],
)
def test_held_out_worlds_and_invalid_settings_are_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], option: str, number: int, says: str
) -> None:
    assert main(["train", str(tmp_path), "--smoke", option, str(number)]) == 2
    assert says in capsys.readouterr().err
    assert not any(tmp_path.iterdir())
