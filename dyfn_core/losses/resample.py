"""Coarse samples of a masked map: in every cell the valid pixel nearest to the cell's centre."""

from __future__ import annotations

import math

import torch
from torch import Tensor


def nearest_valid(mask: Tensor, size: tuple[int, int]) -> tuple[Tensor, Tensor]:
    """Find the valid pixel nearest to the centre of each cell of a grid.

    A cell looks as far as it reaches, at least one pixel.

    Args:
        mask: Valid pixels, B x H x W bool.
        size: Rows h and columns w of the grid.

    Returns:
        Flat indices into H x W, and whether the cell has a valid pixel, both B x h * w. The index
        of a cell without one is somewhere inside the map.
    """
    height, width = mask.shape[-2:]
    rows, row_distance = _window(height, size[0], mask.device)
    cols, col_distance = _window(width, size[1], mask.device)
    inside = ((rows >= 0) & (rows < height))[:, None, :, None]
    inside = inside & ((cols >= 0) & (cols < width))[None, :, None, :]
    index = rows.clamp(0, height - 1)[:, None, :, None] * width
    index = (index + cols.clamp(0, width - 1)[None, :, None, :]).flatten(2).flatten(0, 1)
    distance = row_distance[:, None, :, None].square() + col_distance[None, :, None, :].square()
    distance = distance.sqrt().flatten(2).flatten(0, 1)
    valid = mask.flatten(1)[:, index] & inside.flatten(2).flatten(0, 1)
    nearest = torch.where(valid, distance, torch.inf).argmin(-1)
    chosen = index.expand(len(mask), -1, -1).gather(-1, nearest[..., None])[..., 0]
    return chosen, valid.any(-1)


def _window(length: int, cells: int, device: torch.device) -> tuple[Tensor, Tensor]:
    """The pixels that each cell may take and their distance to its centre, both cells x reach."""
    reach = max(1.0, length / cells)
    centre = (torch.arange(cells, device=device) + 0.5) * (length / cells)
    first = torch.round(centre - reach / 2).long()
    pixels = first[:, None] + torch.arange(math.ceil(reach), device=device)
    return pixels, pixels + 0.5 - centre[:, None]


def pick(values: Tensor, index: Tensor) -> Tensor:
    """Read a map at flat indices.

    Args:
        values: B x H x W or B x H x W x D.
        index: Flat indices into H x W, B x N.

    Returns:
        B x N or B x N x D.
    """
    flat = values.flatten(1, 2)
    if flat.dim() == 3:
        index = index[..., None].expand(-1, -1, flat.shape[-1])
    return flat.gather(1, index)
