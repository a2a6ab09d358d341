"""Settings of `dyfn-train dyfn`: nothing that has no effect is accepted, by any method."""

from __future__ import annotations

from pathlib import Path

import pytest

from dyfn_core.training.config import ConfigError, read_config
from dyfn_core.training.dyfn_config import DyFNRunConfig, LinearizedMethod, UnrolledMethod

LINEARIZED, UNROLLED = Path("train_dyfn_mini.yaml"), Path("train_dyfn_unrolled_mini.yaml")


def refused(path: Path, *overrides: str) -> str:
    with pytest.raises(ConfigError) as error:
        read_config(path, DyFNRunConfig, list(overrides))
    return str(error.value)


@pytest.mark.parametrize(
    "name",
    [
        "align_first_weight", "align_all_weight", "align_differentiable", "temporal_weight",
        "frame_weight", "windows", "decoded", "ssi_weight", "disparity_align_weight",
        "objective", "cache_draws",
    ],
)  # fmt: skip
@pytest.mark.parametrize("place", ["", "method."])
def test_the_linearized_method_refuses_what_only_the_other_uses(name: str, place: str) -> None:
    assert f"unknown key '{place}{name}'" in refused(LINEARIZED, f"{place}{name}=1")


@pytest.mark.parametrize(
    ("path", "setting", "told"),
    [
        (LINEARIZED, "method.size_wieght=1", "did you mean 'method.size_weight'"),
        (LINEARIZED, "temporal_weight=1", "unknown key 'temporal_weight'"),
        (LINEARIZED, "video_weight=1", "did you mean 'method.video_weight'"),
        (LINEARIZED, "summary_draws=1", "it is now 'method.gru_input_draws'"),
        (LINEARIZED, "stabilizer={}", "it is now 'dyfn'"),
        (LINEARIZED, "validation_frames=4", "unknown key 'validation_frames'"),
        (UNROLLED, "temporal_weight=1", "did you mean 'method.objective.temporal_weight'"),
        (UNROLLED, "method.gru_input_draws=1", "unknown key 'method.gru_input_draws'"),
        (UNROLLED, "method.objective.ssi_weight=1", "unknown key 'method.objective.ssi_weight'"),
        (UNROLLED, "method.objective={kind: paper, decoded: 4}", "unknown key 'decoded'"),
        (UNROLLED, "method.objective={kind: paper, windos: [1]}", "did you mean 'windows'?"),
        (UNROLLED, "method.objective={frame_weight: 1}", "method.objective.kind: key is missing"),
        (UNROLLED, "method.kind=unroled", "'unroled' is unknown, expected one of ['unrolled', 'l"),
        (
            UNROLLED,
            "method={}",
            "method.kind: key is missing, expected one of ['unrolled'",
        ),
        (UNROLLED, "method.length=99", "method: Value error, length 99 exceeds cache_length 24"),
        (UNROLLED, "method.strides=[3, 2]", "strides must rise from 1 or more"),
        (LINEARIZED, "method.sub_strides=[4, 4]", "do not fit into a cached clip of 48"),
        (LINEARIZED, "warm_start=true", "remove the `dyfn` settings"),
    ],
)
def test_what_cannot_be_used_is_named(path: Path, setting: str, told: str) -> None:
    assert told in refused(path, setting)


def test_images_too_small_for_a_level_are_refused_by_name() -> None:
    paper = "method.objective={kind: paper}"
    read_config(UNROLLED, DyFNRunConfig, [paper])  # 128 x 160 and more
    small = "stages=[{from_step: 0, batch: 1, sizes: [[96, 128]]}]"
    told = refused(UNROLLED, paper, small)
    assert "stages.sizes [96, 128]: the losses are computed at half of it" in told
    assert "L_local of alpha 1/32: no ball of an image of 48 x 64 has 8 pixels" in told
    assert "the smallest image of that shape is 55 x 73" in told
    fewer = "method.objective={kind: paper, levels: [{alpha: 0.25, anchors: 16, resolution: 16}]}"
    read_config(UNROLLED, DyFNRunConfig, [fewer, small])
    released = refused(UNROLLED, "method.objective={kind: paper, form: released}")
    assert "alpha 1/64" in released
    assert "has 32 pixels" in released


def test_cache_settings_need_a_cache() -> None:
    told = refused(UNROLLED, "method.cache_draws=0", "method.cache=x", "method.cache_seed=1")
    assert "cache and cache_seed without effect: cache_draws is 0" in told


def test_every_setting_of_a_run_is_written_and_read_again() -> None:
    for path, kind in ((LINEARIZED, LinearizedMethod), (UNROLLED, UnrolledMethod)):
        config = read_config(path, DyFNRunConfig, [])
        assert isinstance(config.method, kind)
        written = config.model_dump(mode="json")
        assert DyFNRunConfig.model_validate(written) == config
        assert set(written["method"]) == set(kind.model_fields)
    paper = read_config(UNROLLED, DyFNRunConfig, ["method.objective={kind: paper, edge: 0.5}"])
    assert DyFNRunConfig.model_validate(paper.model_dump(mode="json")) == paper
