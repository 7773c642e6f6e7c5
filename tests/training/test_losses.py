"""The losses are least where query and map agree at the true pose."""

import numpy as np
import pytest

torch = pytest.importorskip("torch", reason="training needs PyTorch: pip install torch==2.13.0")

from coview_stream.training.losses import dense_loss, local_loss, place_loss, turn  # noqa: E402 - after the skip

CHANNELS, QUERY, PIECE = 8, 64, 112


SEEN = torch.ones(4, 1, QUERY, QUERY), torch.ones(2, 1, PIECE, PIECE)


def scene(seed: int) -> tuple[tuple, tuple, object, object]:
    """Two smooth random maps and four exact, turned looks at them."""
    torch.manual_seed(seed)
    maps = torch.nn.functional.avg_pool2d(torch.randn(2, CHANNELS, PIECE + 4, PIECE + 4), 5, 1)
    maps = torch.nn.functional.normalize(maps, dim=1)
    piece_of = torch.tensor([0, 0, 1, 1])
    poses = torch.tensor([[3.0, -8.0, 0.4], [-14.0, 6.0, 2.9], [0.0, 12.0, -1.2], [9.0, 9.0, 0.0]])
    at = torch.arange(QUERY) + 0.5 - QUERY / 2
    y, x = torch.meshgrid(at, at, indexing="ij")
    looks = []
    for owner, (px, py, yaw) in zip(piece_of, poses, strict=True):
        c, s = torch.cos(yaw), torch.sin(yaw)
        grid = torch.stack([c * x - s * y + px, s * x + c * y + py], -1) / (PIECE / 2)
        looks.append(torch.nn.functional.grid_sample(maps[owner][None], grid[None], align_corners=False)[0])
    local = torch.stack(looks)
    pooled = torch.nn.functional.avg_pool2d
    query, piece = ((each, ones, pooled(each, 4)) for each, ones in zip((local, maps), SEEN, strict=True))
    return query, piece, piece_of, poses


@pytest.mark.parametrize("error", [(6.0, 0.0, 0.0), (0.0, -6.0, 0.0), (0.0, 0.0, 0.5)])
def test_losses_are_lowest_at_true_poses(error: tuple[float, float, float]) -> None:
    query, piece, piece_of, poses = scene(0)
    wrong_yaws = poses[:, 2:] + 2.0
    shifted = poses + torch.tensor(error)
    right, recall = dense_loss(query, piece, piece_of, poses, wrong_yaws)
    wrong, lost = dense_loss(query, piece, piece_of, shifted, wrong_yaws)
    assert recall == 1.0
    assert lost < 0.5
    assert right < wrong
    assert local_loss(query, piece, piece_of, poses, SEEN) < local_loss(query, piece, piece_of, shifted, SEEN)


def test_losses_are_higher_on_another_map() -> None:
    query, piece, piece_of, poses = scene(1)
    other = 1 - piece_of
    assert place_loss(query, piece, piece_of, poses) < place_loss(query, piece, other, poses)
    assert local_loss(query, piece, piece_of, poses, SEEN) < local_loss(query, piece, other, poses, SEEN)


def test_unseen_cells_add_no_loss() -> None:
    query, piece, piece_of, poses = scene(2)
    local = query[0].clone()
    local[..., : QUERY // 2] = 0.0
    spoilt = (local, *query[1:])
    half = SEEN[0].clone()
    half[..., : QUERY // 2 + 2] = 0.0
    torch.manual_seed(0)
    masked = local_loss(spoilt, piece, piece_of, poses, (half, SEEN[1]))
    torch.manual_seed(0)
    assert masked < 0.8 * local_loss(spoilt, piece, piece_of, poses, SEEN)
    nothing = torch.zeros_like(half)
    assert float(local_loss(query, piece, piece_of, poses, (nothing, SEEN[1]))) == 0.0


def test_rotation_is_counter_clockwise_from_columns_to_rows() -> None:
    image = torch.zeros(1, 1, 9, 9)
    image[0, 0, 4, 8] = 1.0  # on the x axis
    turned = turn(image, torch.tensor([np.pi / 2], dtype=torch.float32))
    assert int(turned[0, 0].argmax()) == 8 * 9 + 4  # on the y axis
