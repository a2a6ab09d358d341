"""What every geometry model is: encode, (stabilize), decode around one latent."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from dyfn_core.geometry.camera import (
    depth_to_points,
    focal_from_fov,
    intrinsics_from_focal,
    recover_focal_shift,
)
from dyfn_core.models.dyfn import DyFN
from dyfn_core.prediction import DEPTH, DISPARITY, Prediction, StreamState

NOMINAL_FOV = 60.0  # degrees, of an unknown camera whose model gives no point map
RATIO_GRID = 64  # pixels of a side that two depths are compared at
FARTHEST = 1000.0  # times the unit; disparities closer to 0 say nothing but "far"


@dataclass(frozen=True)
class Prepared:
    """An image as the encoder sees it.

    pixels: B x 3 x h x w, resized and normalised.
    image_size: (H, W) of the caller's image.
    network_size: (H, W) of the resized image that the decoder works at.
    """

    pixels: Tensor
    image_size: tuple[int, int]
    network_size: tuple[int, int]


@dataclass(frozen=True)
class Latent:
    """The feature map F_t and what the decoder must know about the image it came from.

    features: B x C x h x w.
    image_size: (H, W) of the caller's image, the size that points come out at.
    network_size: (H, W) of the resized image that the decoder works at.
    summary: B x D, what the decoder knows of each image besides the features, which DyFN leaves
        alone (MoGe v2: the class token, from which it tells metres); None for nothing.
    """

    features: Tensor
    image_size: tuple[int, int]
    network_size: tuple[int, int]
    summary: Tensor | None = None

    def entry(self, index: int) -> Latent:
        """One image of the batch, as a batch of one."""
        summary = None if self.summary is None else self.summary[index : index + 1]
        return replace(self, features=self.features[index : index + 1], summary=summary)


@dataclass(frozen=True)
class AffinePoints:
    """An affine-invariant point map: true up to one scale and one shift along z.

    points: B x H x W x 3, after the model's remap (exp: z > 0, x and y proportional to z).
    mask: B x H x W, raw mask output; valid where it exceeds the model's mask threshold.
    metric_scale: B, metres in one unit by the model's word for each image, of the points of the
        latent that DyFN has not changed; None for models that know no metres.
    normal: B x H x W x 3, unit length; None for models without, and where not asked for.
    """

    points: Tensor
    mask: Tensor
    metric_scale: Tensor | None = None
    normal: Tensor | None = None

    @property
    def values(self) -> Tensor:
        """B x H x W: what an alignment compares with truth, here z."""
        return self.points[..., 2]

    def entry(self, index: int) -> AffinePoints:
        """One image of the batch, as a batch of one."""
        return AffinePoints(
            self.points[index : index + 1],
            self.mask[index : index + 1],
            None if self.metric_scale is None else self.metric_scale[index : index + 1],
            None if self.normal is None else self.normal[index : index + 1],
        )


@dataclass(frozen=True)
class AffineDepth:
    """Depth without a camera: true up to one scale, and one shift where the model says so.

    depth: B x H x W, > 0.
    mask: B x H x W, raw mask output; valid where it exceeds the model's mask threshold.
    metres_of_focal: Metres in one unit for each unit of the normalised focal lengths fx and fy, of
        the depth of a latent that DyFN has not changed; None for models that know no metres.
    """

    depth: Tensor
    mask: Tensor
    metres_of_focal: tuple[float, float] | None = None

    @property
    def values(self) -> Tensor:
        """B x H x W: what an alignment compares with truth."""
        return self.depth

    def entry(self, index: int) -> AffineDepth:
        """One image of the batch, as a batch of one."""
        return replace(self, depth=self.depth[index : index + 1], mask=self.mask[index : index + 1])

    def metric_scale(self, intrinsics: Tensor) -> Tensor | None:
        """B: metres in one unit, for normalised intrinsics B x 3 x 3; None if unknown."""
        if self.metres_of_focal is None:
            return None
        x, y = self.metres_of_focal
        return x * intrinsics[:, 0, 0] + y * intrinsics[:, 1, 1]


@dataclass(frozen=True)
class AffineDisparity:
    """What a disparity model says: a / z + b with a > 0 and b unknown, and no camera.

    disparity: B x H x W, >= 0; 0 is what the model takes for infinitely far.
    """

    disparity: Tensor

    @property
    def values(self) -> Tensor:
        """B x H x W: what an alignment compares with (the inverse of) truth."""
        return self.disparity

    def entry(self, index: int) -> AffineDisparity:
        """One image of the batch, as a batch of one."""
        return AffineDisparity(self.disparity[index : index + 1])


Affine = AffinePoints | AffineDepth | AffineDisparity


def plane(x: Tensor) -> tuple[int, int]:
    """(h, w) of a map ... x h x w, as plain numbers also while it is traced for an export."""
    return int(x.shape[-2]), int(x.shape[-1])


def own_entries(config: Mapping[str, Any]) -> dict[str, Any]:
    """A checkpoint's config without what is not of the model's class: its type and its DyFN."""
    return {key: value for key, value in config.items() if key not in ("type", "stabilizer")}


class GeometryModel(nn.Module, ABC):
    """An encoder and a decoder around one latent, with DyFN in between.

    stabilizer: the DyFN module, or None for a plain base model. Its parameters are
        "stabilizer.*" in the state dict of every model.
    mask_threshold: a pixel is valid where the raw mask exceeds it.
    quantity: "depth" (decode gives AffinePoints, or AffineDepth without a shift), "affine_depth"
        (AffineDepth) or "disparity" (AffineDisparity).
    has_normals: whether decode_all gives normals.
    backend: the library that runs the network.
    knows_metres: "" for no; "camera" when it needs the focal lengths for them; else "always".
    stabilizer_pool: the pooling that suits a new stabilizer on this latent.
    token_cell: pixels along the side of one token of num_tokens.
    preparation: what `prepare` does, in words for whoever does it elsewhere.
    """

    mask_threshold: float = 0.5
    quantity: str = DEPTH
    stabilizer_pool: int = 1
    token_cell: int = 14
    has_normals: bool = False
    knows_metres: str = ""
    preparation: str = "none"
    backend: str = "torch"
    # No class-level None here: it would hide the registered submodule.
    stabilizer: DyFN | None

    def __init__(self) -> None:
        super().__init__()
        self.stabilizer = None

    @classmethod
    @abstractmethod
    def from_config(cls, config: dict[str, Any]) -> GeometryModel:
        """The base model that `config` describes, untrained and without a stabilizer.

        The entries "type" and "stabilizer" are not for this class. Raises ValueError or
        TypeError for unknown or bad keys.
        """

    @property
    @abstractmethod
    def config(self) -> dict[str, Any]:
        """JSON-able values with the registered "type", from which from_config builds it again."""

    @property
    @abstractmethod
    def latent_channels(self) -> int:
        """C of the latent."""

    def prepare(self, image: Tensor, num_tokens: int | None = None) -> Prepared:
        """image: B x 3 x H x W float RGB in 0..1 -> what the encoder sees; here the image itself.

        num_tokens: see encode.
        """
        size = plane(image)
        return Prepared(image, size, size)

    @abstractmethod
    def encode_prepared(self, prepared: Prepared) -> Latent:
        """The encoder alone -> Latent."""

    def encode(self, image: Tensor, num_tokens: int | None = None) -> Latent:
        """image: B x 3 x H x W float RGB in 0..1 -> Latent.

        num_tokens: how finely to look; None for the model's default.
        """
        return self.encode_prepared(self.prepare(image, num_tokens))

    @abstractmethod
    def decode(self, latent: Latent) -> Affine:
        """Latent -> affine-invariant points (or depth, or disparity) at latent.image_size."""

    def decode_all(self, latent: Latent) -> Affine:
        """As decode, with the normals of models that have them."""
        return self.decode(latent)

    def stabilize(
        self, features: Tensor, state: StreamState | None
    ) -> tuple[Tensor, StreamState | None]:
        """features B x C x h x w, previous state -> stabilized features, next state."""
        if self.stabilizer is None:
            return features, None
        result: tuple[Tensor, StreamState | None] = self.stabilizer(features, state)
        return result

    def stabilize_latent(
        self, latent: Latent, state: StreamState | None
    ) -> tuple[Latent, StreamState | None]:
        """One streaming step on a latent; what inference does between encode and decode."""
        features, state = self.stabilize(latent.features, state)
        size = self.stabilized_size(latent.network_size)
        return replace(latent, features=features, network_size=size), state

    def stabilized_size(self, network_size: tuple[int, int]) -> tuple[int, int]:
        """The size (H, W) that a stabilized latent is decoded at, for that of the plain one."""
        return network_size

    def metres_of_focal(self, network_size: tuple[int, int]) -> tuple[float, float] | None:
        """See AffineDepth, for a network's image of (H, W); None for models that give no such."""
        del network_size
        return None

    @property
    def plain(self) -> GeometryModel:
        """The model in torch; itself, unless another library runs it."""
        return self

    @property
    def device(self) -> torch.device:
        """Where the parameters are."""
        return next(self.parameters()).device

    def predict_affine(
        self,
        image: Tensor,
        state: StreamState | None = None,
        num_tokens: int | None = None,
        stabilize: bool = True,
    ) -> tuple[Affine, StreamState | None]:
        """image B x 3 x H x W float RGB in 0..1 -> affine-invariant points or disparity, state.

        With stabilize=False nothing of the stabilizer runs and the state comes back as None.
        """
        latent, state = self.stabilized(self.encode(image, num_tokens), state, stabilize)
        return self.decode(latent), state

    def stabilized(
        self, latent: Latent, state: StreamState | None, stabilize: bool = True
    ) -> tuple[Latent, StreamState | None]:
        """As stabilize_latent; the latent itself and None for a base, or with stabilize=False."""
        if stabilize and self.stabilizer is not None:
            return self.stabilize_latent(latent, state)
        return latent, None

    @torch.inference_mode()
    def infer(
        self,
        image: np.ndarray | Tensor,
        state: StreamState | None = None,
        num_tokens: int | None = None,
        fov_x: float | Tensor | None = None,
        force_projection: bool = True,
        apply_mask: bool = True,
        stabilize: bool = True,
    ) -> Prediction:
        """Geometry of one image, or of a batch of images from independent streams.

        image: H x W x 3 uint8 RGB, or float 3 x H x W RGB in 0..1; a leading B for a batch.
        state: the previous prediction's state of the same stream(s); None at the first frame.
        num_tokens: how finely to look; None for the model's default.
        fov_x: horizontal field of view in degrees when the camera is known (one number or B);
            None recovers it from the point map, or takes NOMINAL_FOV where there is none.
        force_projection: points are the depth unprojected with the intrinsics; else the
            model's own points plus the shift.
        apply_mask: depth and points are +inf where the prediction is invalid.
        stabilize: False gives the base model's single-image output, bit for bit.
        A model that knows metres gives metres, unless it needs fov_x for them and has none. Where
        DyFN has changed the scale, they are those of the image's own latent, decoded as well.
        Raises TypeError or ValueError, naming what was wrong, for a bad image, fov_x or state.
        """
        batch, single = image_to_batch(image, self.device)
        latent = self.encode(batch, num_tokens)
        changed, state = self.stabilized(latent, state, stabilize)
        affine = self.decode_all(changed)
        prediction = self._geometry(affine, fov_x, state, force_projection, apply_mask)
        if self.knows_metres and (self.knows_metres != "camera" or fov_x is not None):
            scale = metric_scale(affine, prediction.intrinsics)
            if scale is not None and changed is not latent:
                own = self._geometry(self.decode(latent), fov_x, None)
                scale = scale * scale_ratio(own, prediction).nan_to_num(nan=1.0)
            prediction = prediction if scale is None else _in_metres(prediction, scale)
        return first_of_batch(prediction) if single else prediction

    def _geometry(
        self,
        affine: Affine,
        fov_x: float | Tensor | None,
        state: StreamState | None,
        force_projection: bool = True,
        apply_mask: bool = True,
    ) -> Prediction:
        """What the decoder says of each image by itself, up to scale, batched."""
        height, width = affine.values.shape[-2:]
        count, aspect = len(affine.values), width / height
        if isinstance(affine, AffinePoints):
            valid = affine.mask > self.mask_threshold
            known = None if fov_x is None else focal_from_fov(fov_x, aspect, count)
            focal, shift = recover_focal_shift(affine.points, valid, known)
            intrinsics = intrinsics_from_focal(focal, aspect).to(affine.points)
            shift = shift.to(affine.points)
            return assemble(affine, valid, shift, intrinsics, state, force_projection, apply_mask)
        focal = focal_from_fov(NOMINAL_FOV if fov_x is None else fov_x, aspect, count)
        intrinsics = intrinsics_from_focal(focal, aspect).to(affine.values)
        if isinstance(affine, AffineDepth):
            return from_depth(affine, self, intrinsics, state, apply_mask)
        unit = median_disparity(affine.disparity)
        return from_disparity(affine.disparity, unit, intrinsics, state, apply_mask)


def metric_scale(affine: Affine, intrinsics: Tensor) -> Tensor | None:
    """B: metres in one unit of the latent's own geometry, by the model; None if it knows none.

    intrinsics: B x 3 x 3, normalised, of the true camera.
    """
    if isinstance(affine, AffineDepth):
        return affine.metric_scale(intrinsics)
    return affine.metric_scale if isinstance(affine, AffinePoints) else None


def scale_ratio(own: Prediction, changed: Prediction) -> Tensor:
    """B: by how much the depth of a latent as it was exceeds that of the same latent after DyFN.

    The median over a grid of pixels that are valid in both; NaN where there is none.
    """
    rows, columns = (size // RATIO_GRID + 1 for size in own.depth.shape[-2:])
    grid = (slice(None), slice(None, None, rows), slice(None, None, columns))
    both = (own.mask & changed.mask)[grid]
    ratio = torch.where(both, own.depth[grid] / changed.depth[grid], torch.nan)
    return ratio.flatten(1).nanmedian(dim=1).values


def _in_metres(prediction: Prediction, scale: Tensor) -> Prediction:
    depth = prediction.depth * scale[:, None, None]
    points = prediction.points * scale[:, None, None, None]
    return replace(prediction, depth=depth, points=points, metric=True)


def assemble(
    affine: AffinePoints,
    valid: Tensor,
    shift: Tensor,
    intrinsics: Tensor,
    state: StreamState | None,
    force_projection: bool = True,
    apply_mask: bool = True,
) -> Prediction:
    """Affine points + the camera that was recovered (or known) -> Prediction, batched.

    valid: B x H x W bool; shift: B; intrinsics: B x 3 x 3 normalised. A pixel that the shift
    puts behind the camera is no valid pixel.
    """
    depth = affine.points[..., 2] + shift[:, None, None]
    valid = valid & (depth > 0)
    if force_projection:
        points = depth_to_points(depth, intrinsics)
    else:
        points = torch.cat([affine.points[..., :2], depth[..., None]], dim=-1)
    if apply_mask:
        depth = torch.where(valid, depth, torch.inf)
        invalid = (~valid).reshape(-1).nonzero()[:, 0]  # a mask broadcast over xyz is slow
        points = points.reshape(-1, 3).index_fill_(0, invalid, torch.inf).reshape(points.shape)
    normal = affine.normal
    if normal is not None and apply_mask:
        normal = normal * valid[..., None]
    return Prediction(points, depth, valid, intrinsics, state, normal=normal)


def from_depth(
    affine: AffineDepth,
    model: GeometryModel,
    intrinsics: Tensor,
    state: StreamState | None,
    apply_mask: bool = True,
) -> Prediction:
    """Depth without a camera -> Prediction, batched, in the model's unit; a shift is taken for 0.

    model: what gave the depth. intrinsics: B x 3 x 3, normalised.
    """
    depth = affine.depth
    valid = (affine.mask > model.mask_threshold) & (depth > 0) & torch.isfinite(depth)
    points = depth_to_points(depth, intrinsics)
    if apply_mask:
        depth = torch.where(valid, depth, torch.inf)
        points = torch.where(valid[..., None], points, torch.inf)
    return Prediction(points, depth, valid, intrinsics, state, model.quantity)


def from_disparity(
    disparity: Tensor,
    unit: Tensor,
    intrinsics: Tensor,
    state: StreamState | None,
    apply_mask: bool = True,
) -> Prediction:
    """Disparity B x H x W -> Prediction with depth = unit / disparity, batched.

    This takes the unknown offset b of a / z + b for 0. unit: B, the disparity that becomes depth
    1. Pixels FARTHEST times as far, or at disparity 0, are no valid pixels. intrinsics: B x 3 x 3.
    """
    unit = unit[:, None, None]
    valid = (disparity > unit / FARTHEST) & torch.isfinite(disparity)
    depth = torch.where(valid, unit / torch.where(valid, disparity, 1.0), FARTHEST)
    points = depth_to_points(depth, intrinsics)
    if apply_mask:
        depth = torch.where(valid, depth, torch.inf)
        points = torch.where(valid[..., None], points, torch.inf)
    return Prediction(points, depth, valid, intrinsics, state, DISPARITY, disparity)


def median_disparity(disparity: Tensor) -> Tensor:
    """B x H x W -> B: the median of each image's positive disparities, 1 where there is none."""
    positive = torch.where(disparity > 0, disparity, torch.nan).flatten(1)
    return positive.nanmedian(dim=1).values.nan_to_num(nan=1.0)


def first_of_batch(prediction: Prediction) -> Prediction:
    """A batch of one -> the prediction of that image (the state keeps its leading 1)."""
    return replace(
        prediction,
        points=prediction.points[0],
        depth=prediction.depth[0],
        mask=prediction.mask[0],
        intrinsics=prediction.intrinsics[0],
        disparity=None if prediction.disparity is None else prediction.disparity[0],
        normal=None if prediction.normal is None else prediction.normal[0],
    )


def image_to_batch(
    image: np.ndarray | Tensor, device: torch.device | str = "cpu"
) -> tuple[Tensor, bool]:
    """A caller's image(s) -> (B x 3 x H x W float32 in 0..1 on the device, whether it was one).

    Raises TypeError for something that is no array, ValueError for a wrong shape, an empty
    image, values that are not finite or not in 0..1.
    """
    if isinstance(image, np.ndarray):
        if image.dtype != np.uint8 and not np.issubdtype(image.dtype, np.floating):
            raise TypeError(f"image dtype must be uint8 or float, got {image.dtype}")
        image = np.ascontiguousarray(image)
        # torch warns about read-only arrays (a ROS message's bytes), which we never write to.
        image = torch.from_numpy(image) if image.flags.writeable else torch.tensor(image)
    if not isinstance(image, Tensor):
        raise TypeError(f"image must be a numpy array or a torch tensor, got {type(image)}")
    shape = tuple(image.shape)
    if image.dim() not in (3, 4) or 0 in shape:
        raise ValueError(f"image must be one image or a batch, none of them empty, got {shape}")
    if image.dtype == torch.uint8:
        batch = _uint8_to_float(image, device)
    elif image.dtype.is_floating_point:
        batch = _checked_float(image, device)
    else:
        raise TypeError(f"image dtype must be uint8 or float, got {image.dtype}")
    return (batch[None], True) if batch.dim() == 3 else (batch, False)


def _uint8_to_float(image: Tensor, device: torch.device | str) -> Tensor:
    if image.shape[-1] != 3:
        raise ValueError(f"a uint8 image must be H x W x 3 (RGB), got {tuple(image.shape)}")
    return image.to(device).movedim(-1, -3).to(torch.float32).div_(255)


def _checked_float(image: Tensor, device: torch.device | str) -> Tensor:
    if image.shape[-3] != 3:
        raise ValueError(f"a float image must be 3 x H x W (RGB in 0..1), got {tuple(image.shape)}")
    image = image.to(device=device, dtype=torch.float32)
    low, high = image.aminmax()
    # Resizing filters overshoot a little; values of another range go far beyond.
    if not (low > -1 and high < 2):
        raise ValueError(
            f"a float image must have finite values in 0..1, got {low:.4g} to {high:.4g}"
        )
    return image
