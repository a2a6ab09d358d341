"""How many pixels a ball of L_local must have, and the images in which none has them."""

from __future__ import annotations

import pytest
import torch

from dyfn_core.losses.full.local import (
    FEWEST,
    RELEASED_LEVELS,
    TEXT_LEVELS,
    LocalLevel,
    local_loss,
)
from dyfn_core.losses.full.objective import RELEASED, Objective
from dyfn_core.losses.target import target_from_depth


def plane(size: tuple[int, int]) -> tuple[torch.Tensor, torch.Tensor]:
    """Depth of a plane that faces the camera, and intrinsics."""
    return torch.full((1, *size), 2.0), torch.tensor([[1.0, size[1] / size[0], 0.5, 0.5]])


@pytest.mark.parametrize("level", TEXT_LEVELS[1:])
@pytest.mark.parametrize("size", [(64, 80), (80, 112), (96, 128), (240, 320)])
def test_a_level_of_the_text_counts_at_every_training_size(
    level: LocalLevel, size: tuple[int, int]
) -> None:
    level.check_size(size)
    target = target_from_depth(*plane(size), size[1] / size[0])
    wavy = target.points * (1 + 0.01 * torch.sin(torch.arange(size[1]) / 2)[:, None])
    anchors = torch.tensor([[size[0] // 2 * size[1] + size[1] // 2]])
    assert float(local_loss(wavy, target, None, level, anchors)) > 0


def test_the_rule_is_the_released_one_where_balls_are_large() -> None:
    for level in TEXT_LEVELS:
        assert level.fewest_at((433, 577)) == FEWEST
    assert TEXT_LEVELS[2].fewest_at((96, 128)) == 8


@pytest.mark.parametrize(
    ("level", "small", "large", "named"),
    [
        (RELEASED_LEVELS[2], (240, 320), (243, 324), "243 x 324"),
        (LocalLevel(1 / 32, 9, 4, FEWEST), (112, 112), (144, 144), "144 x 144"),
        (TEXT_LEVELS[2], (48, 64), (55, 73), "55 x 73"),
    ],
)
def test_the_smallest_size_is_named_and_works(
    level: LocalLevel, small: tuple[int, int], large: tuple[int, int], named: str
) -> None:
    with pytest.raises(ValueError, match=f"smallest image of that shape is {named}"):
        level.check_size(small)
    level.check_size(large)


def test_the_text_has_no_global_term_and_the_released_form_has() -> None:
    assert set(Objective().weights()) == {
        "align_first", "temporal", "local_0", "local_1", "local_2", "normal", "mask",
    }  # fmt: skip
    released = Objective.from_dict({"form": "released", "mask": 0.5})
    assert released.weights()["frame"] == 1
    assert released.mask == 0.5
    assert released.levels == RELEASED["levels"]
    assert Objective.from_dict({"form": "released", "frame": 0}).frame == 0
