"""The controls: what they do to a latent's statistics, and the table beside a result."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import pytest
import torch

from dyfn_core.evaluation.variants import (
    VARIANTS,
    gap_closed,
    harmed,
    score_variants,
    variant_table,
)
from dyfn_core.models.controls import StatisticsControl, ema_control, frozen_control, stabilized_by
from dyfn_core.scoring.variants import VariantScore
from tests.support.pinhole import PinholeModel, picture
from tests.support.seeded import normal


def statistics(features: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    std, mean = torch.std_mean(features, dim=(-2, -1))
    return mean, std


def test_first_frame_passes_unchanged_and_frozen_keeps_its_statistics() -> None:
    first, second = normal(0, 1, 4, 6, 8), 3 * normal(1, 1, 4, 6, 8) + 2
    control = frozen_control(4)
    same, state = control(first, None)
    torch.testing.assert_close(same, first, rtol=1e-4, atol=1e-4)
    changed, _ = control(second, state)
    for ours, theirs in zip(statistics(changed), statistics(first), strict=True):
        torch.testing.assert_close(ours, theirs, rtol=1e-3, atol=1e-3)


def test_ema_moves_a_tenth_of_the_way() -> None:
    first, second = normal(0, 1, 4, 6, 8), 3 * normal(1, 1, 4, 6, 8) + 2
    control = ema_control(4)
    _, state = control(first, None)
    changed, _ = control(second, state)
    expected = 0.9 * statistics(first)[0] + 0.1 * statistics(second)[0]
    torch.testing.assert_close(statistics(changed)[0], expected, rtol=1e-3, atol=1e-3)


def test_alpha_one_changes_nothing_and_alpha_beyond_is_refused() -> None:
    control, state = StatisticsControl(2, 1.0), None
    for seed in range(3):
        features = normal(seed, 1, 2, 5, 5)
        changed, state = control(features, state)
        torch.testing.assert_close(changed, features, rtol=1e-4, atol=1e-4)
    with pytest.raises(ValueError, match=r"1\.5"):
        StatisticsControl(2, 1.5)


def frames() -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """A fixed scene; the image's depth channel is darker from frame to frame."""
    for index in range(4):
        image = picture(seed=1)
        depth = image[..., 0] / 255 + 0.5
        image[..., 0] = np.round(image[..., 0] * (1 - 0.15 * index))
        yield image, depth


def test_frozen_statistics_win_where_only_the_statistics_drift(pinhole: PinholeModel) -> None:
    scores = score_variants(pinhole, [frames])
    assert list(scores) == ["ramp", "constant", "base", "ema", "frozen"]
    assert scores["base"].image_abs_rel < 0.01 < scores["base"].video_abs_rel
    assert scores["frozen"].video_abs_rel < 0.01
    assert gap_closed(scores, "frozen") > 0.9
    assert 0 < gap_closed(scores, "ema") < gap_closed(scores, "frozen")


def test_model_has_its_own_stabilizer_again_afterwards(pinhole_with_dyfn: PinholeModel) -> None:
    own = pinhole_with_dyfn.stabilizer
    scores = score_variants(pinhole_with_dyfn, [frames])
    assert set(scores) == set(VARIANTS)
    assert pinhole_with_dyfn.stabilizer is own
    with (
        pytest.raises(RuntimeError, match="stop"),
        stabilized_by(pinhole_with_dyfn, None) as model,
    ):
        assert model.stabilizer is None
        raise RuntimeError("stop")
    assert pinhole_with_dyfn.stabilizer is own


def test_table_has_a_row_per_variant_and_the_gap(pinhole: PinholeModel) -> None:
    rows = variant_table({"made": score_variants(pinhole, [frames])}).splitlines()
    assert rows[0] == "|  | made image | made video | made gap closed |"
    assert [row.split("|")[1].strip() for row in rows[2:]] == list(VARIANTS[:-1])
    assert rows[-1].rstrip("| ").endswith("%")


def test_sequence_without_truth_is_refused(pinhole: PinholeModel) -> None:
    blind = [(picture(), np.zeros((48, 64), np.float32))]
    with pytest.raises(ValueError, match="no frame with enough valid depth"):
        score_variants(pinhole, [lambda: blind])


def test_harm_is_named_by_data_set_with_its_size() -> None:
    base = VariantScore(0.1, 0.9, 0.200, 0.8)
    results = {
        name: {"base": base, "dyfn": replace(base, video_abs_rel=video)}
        for name, video in (("better", 0.150), ("as good", 0.2019), ("worse", 0.220))
    }
    results["without"] = {"base": base}
    assert harmed(results, 0.01) == {"worse": pytest.approx(0.1)}
    assert harmed(results, 0.11) == {}
    assert set(harmed(results, -0.01)) == {"as good", "worse"}
