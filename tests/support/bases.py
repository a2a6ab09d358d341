"""Today's bases at a size that tests can pay: ViT-S encoders with small heads, random weights."""

from __future__ import annotations

import copy
from functools import cache
from typing import Any

import torch
from torch import nn

from dyfn_core.models.depth_anything3 import DepthAnything3Config, DepthAnything3Model
from dyfn_core.models.moge2 import MoGe2Model

_WIDTHS = [16, 16, 8, 8, 8]


def moge2_config() -> dict[str, Any]:
    """A model_config in the form of released files."""
    shared = {
        "dim_res_blocks": _WIDTHS,
        "num_res_blocks": [0, 1, 1, 0, 0],
        "res_block_in_norm": "none",
        "res_block_hidden_norm": "none",
        "resamplers": ["conv_transpose", "conv_transpose", "conv_transpose", "bilinear"],
    }
    head = {**shared, "dim_in": _WIDTHS}
    return copy.deepcopy(
        {
            "encoder": {
                "backbone": "dinov2_vits14",
                "intermediate_layers": [0, 1],
                "dim_out": 16,
            },
            "neck": {**shared, "dim_in": [18, 2, 2, 2, 2], "dim_out": None},
            "points_head": {**head, "dim_out": [None, None, None, None, 3]},
            "normal_head": {**head, "dim_out": [None, None, None, None, 3]},
            "mask_head": {**head, "dim_out": [None, None, None, None, 1]},
            "scale_head": {"dims": [384, 16, 1]},
            "remap_output": "exp",
            "num_tokens_range": [6, 12],
        }
    )


def small_moge2(**changed: Any) -> MoGe2Model:
    """A fresh model, the same weights each time. changed: entries of the config, None: without."""
    config = {key: value for key, value in {**moge2_config(), **changed}.items() if value}
    model = MoGe2Model.from_config(config).eval()
    wanted = model.state_dict()
    model.load_state_dict({key: value for key, value in _moge2_weights().items() if key in wanted})
    return model


@cache
def _moge2_weights() -> dict[str, torch.Tensor]:
    torch.manual_seed(0)
    model = MoGe2Model.from_config(moge2_config())
    assert model.mask_head is not None
    assert model.scale_head is not None
    with torch.no_grad():
        last = model.mask_head.output_blocks[4]
        assert isinstance(last, nn.Conv2d)
        assert last.bias is not None
        last.bias.fill_(1.0)  # a mask that is mostly True
        model.encoder.backbone.cls_token.normal_()  # metres that are not those of a zero token
        for part in (model.encoder.output_projections, model.neck, model.points_head):
            for weight in part.parameters():  # torch's start would let the latent fade away
                weight.mul_(1.5)
    return model.state_dict()


def small_da3(kind: str) -> DepthAnything3Model:
    """A fresh model, the same weights each time; depth around 2, some sky."""
    config = DepthAnything3Config(kind, encoder="dinov2_vits14", process_size=56)
    model = DepthAnything3Model(config).eval()
    model.load_state_dict(_da3_weights())
    return model


@cache
def _da3_weights() -> dict[str, torch.Tensor]:
    torch.manual_seed(0)
    model = DepthAnything3Model(DepthAnything3Config("mono", encoder="dinov2_vits14"))
    scratch = model.model.head.scratch
    with torch.no_grad():
        for stack, bias in ((scratch.output_conv2, 0.7), (scratch.sky_output_conv2, 0.1)):
            last = stack[2]
            assert isinstance(last, nn.Conv2d)
            assert last.bias is not None
            last.bias.fill_(bias)
            last.weight.mul_(10.0)  # a depth that varies
    return model.state_dict()
