"""Configs of `dyfn-train stabilizer` and `dyfn-train scale`, in the form of `dyfn-train dyfn`."""

from __future__ import annotations

import copy
import logging
from collections.abc import Mapping
from typing import Any

STABILIZER, SCALE = "stabilizer", "scale"
METHODS = {STABILIZER: "unrolled", SCALE: "linearized"}

_CLIPS = ("cache", "cache_seed", "cache_length", "strides", "clips", "length")
_TERMS = {
    name: name
    for name in (
        "decoded",
        "windows",
        "align_differentiable",
        "align_first_weight",
        "align_all_weight",
        "temporal_weight",
        "frame_weight",
        "spread_weight",
    )
}
_DISPARITY = {
    "decoded": "decoded",
    "windows": "windows",
    "temporal_weight": "temporal_weight",
    "ssi_weight": "ssi_weight",
    "disparity_align_weight": "align_first_weight",
}
_WEIGHTS = ("spread_weight", "video_weight", "size_weight", "change_weight")
_SCALE = {"summary_draws": "gru_input_draws"} | {
    name: name for name in (*_CLIPS, "sub_strides", "noise", *_WEIGHTS)
}
# Accepted by either command, and without effect in it (or in one of them).
_WITHOUT_EFFECT = {"validation_frames", "cache_draws", "objective", *_TERMS, *_DISPARITY}

logger = logging.getLogger(__name__)


def former_command(values: Mapping[str, Any]) -> str | None:
    """Tell settings of a former command from those of today.

    Args:
        values: The settings of a training of DyFN.

    Returns:
        "stabilizer" or "scale"; None for settings of today, which have a `method`.
    """
    names = {*values}
    own = {STABILIZER, *_SCALE, *_WITHOUT_EFFECT} - {"validation_frames"}  # that is a base's too
    if "method" in names or not names & own:
        return None
    return SCALE if names & {"summary_draws", "sub_strides", "noise"} else STABILIZER


def translated(values: Mapping[str, Any], command: str, tell: bool = True) -> dict[str, Any]:
    """Put settings of a former command into the form of `dyfn-train dyfn`.

    Settings that had no effect in that command are left out. Settings of today stay as they are,
    so that a config of today with settings of then on top can be translated too.

    Args:
        values: The settings.
        command: "stabilizer" or "scale".
        tell: Whether to name in a warning what is left out.

    Returns:
        Settings of a DyFNRunConfig.
    """
    new = copy.deepcopy(dict(values))
    if STABILIZER in new:
        new["dyfn"] = {**new.get("dyfn", {}), **(new.pop(STABILIZER) or {})}
    method: dict[str, Any] = new.setdefault("method", {"kind": METHODS[command]})
    if command == SCALE:
        _move(new, method, _SCALE)
    else:
        _move(new, method, {name: name for name in (*_CLIPS, "cache_draws")})
        _move_objective(new, method)
        if method.get("cache_draws") == 0:
            _drop(method, {"cache", "cache_seed"} & {*method}, tell)
    _drop(new, {*new} & _WITHOUT_EFFECT, tell)
    return new


def _move_objective(new: dict[str, Any], method: dict[str, Any]) -> None:
    """The terms' weights, or the paper's objective, into an objective of their own."""
    given = new.pop("objective", None)
    former: dict[str, Any] = method.get("objective", {})
    if given is not None:
        own = former if former.get("kind") == "paper" else {}
        method["objective"] = {**own, "kind": "paper", **given}
        return
    kind = former.get("kind") or _kind_for(str(new.get("base")))
    objective = {**former, "kind": kind}
    if kind != "paper":
        _move(new, objective, _TERMS if kind == "terms" else _DISPARITY)
    method["objective"] = objective


def _kind_for(base: str) -> str:
    """The objective that the base's output asks for, as `dyfn-train stabilizer` chose it."""
    from dyfn_core.models.checkpoints import load_model  # torch, which --help does without

    try:
        return "disparity" if load_model(base).quantity == "disparity" else "terms"
    except (OSError, ValueError):
        return "terms"  # whoever builds the model says what is wrong with it


def _move(values: dict[str, Any], into: dict[str, Any], names: Mapping[str, str]) -> None:
    for old, new in names.items():
        if old in values:
            into[new] = values.pop(old)


def _drop(values: dict[str, Any], names: set[str], tell: bool) -> None:
    for name in sorted(names):
        del values[name]
    if names and tell:
        logger.warning("left out, as they had no effect: %s", ", ".join(sorted(names)))
