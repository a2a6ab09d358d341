"""DyFN by itself: statistics out, statistics in, state as a value."""

from __future__ import annotations

from dataclasses import fields, replace

import pytest
import torch

from dyfn_core.models.dyfn import DyFNConfig, build_dyfn
from dyfn_core.prediction import StreamState
from tests.support.seeded import normal, redraw

KINDS = ["convgru", "gru"]


def latent(seed: int, batch: int = 1, size: tuple[int, int] = (6, 9)) -> torch.Tensor:
    return normal(seed, batch, 5, *size) * 3 + 2


def make(kind: str, form: str = "paper", pool: int = 1, trained: bool = True) -> torch.nn.Module:
    torch.manual_seed(1)
    module = build_dyfn(5, DyFNConfig(kind=kind, hidden=7, pool=pool, form=form))
    if trained:
        redraw((p for name, p in module.named_parameters() if "head" in name), 0.3, seed=100)
    return module.eval()


def memory_only(kind: str) -> torch.nn.Module:
    torch.manual_seed(1)
    config = DyFNConfig(kind=kind, hidden=7, form="residual", memory_only=True)
    module = build_dyfn(5, config)
    redraw(module.parameters(), 0.3, seed=100)
    return module.eval()


@pytest.mark.parametrize("kind", KINDS)
def test_memory_only_leaves_a_first_frame_alone_and_changes_later_ones(kind: str) -> None:
    module = memory_only(kind)
    with torch.no_grad():
        first, state = module(latent(0), None)
        second, _ = module(latent(1), state)
    assert torch.equal(first, latent(0))
    assert (second - latent(1)).abs().max() > 0.05


@pytest.mark.parametrize("kind", KINDS)
def test_memory_only_holds_for_each_stream_of_a_batch(kind: str) -> None:
    module = memory_only(kind)
    with torch.no_grad():
        _, state = module(latent(0), None)
        _, fresh = module(latent(0), None)
        fresh = replace(fresh, hidden=torch.zeros_like(fresh.hidden))
        if fresh.ema_mean is not None:
            nan = torch.full_like(fresh.ema_mean, torch.nan)
            fresh = replace(fresh, ema_mean=nan, ema_std=nan)
        both, _ = module(latent(1).expand(2, -1, -1, -1), stacked(state, fresh))
    assert torch.equal(both[1:], latent(1))
    assert not torch.equal(both[:1], latent(1))


def stacked(one: StreamState, other: StreamState) -> StreamState:
    parts = {
        field.name: None
        if getattr(one, field.name) is None
        else torch.cat([getattr(one, field.name), getattr(other, field.name)])
        for field in fields(StreamState)
    }
    return StreamState(**parts)


def test_memory_only_belongs_to_the_residual_form() -> None:
    with pytest.raises(ValueError, match="memory_only needs the form 'residual', got form 'paper'"):
        DyFNConfig(memory_only=True)


def test_paper_form_starts_with_the_released_statistics() -> None:
    with torch.no_grad():
        after, _ = make("convgru", trained=False)(latent(0), None)
    std, mean = torch.std_mean(after, dim=(-2, -1))
    torch.testing.assert_close(std, torch.full_like(std, 1.3132617), rtol=1e-4, atol=0)
    torch.testing.assert_close(mean, torch.zeros_like(mean), rtol=0, atol=1e-5)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("pool", [1, 4])
def test_residual_form_starts_as_the_identity(kind: str, pool: int) -> None:
    module, state = make(kind, "residual", pool, trained=False), None
    with torch.no_grad():
        for seed in range(3):
            features = latent(seed)
            after, state = module(features, state)
            torch.testing.assert_close(after, features, rtol=1e-5, atol=1e-5)


@pytest.mark.parametrize("form", ["paper", "residual"])
def test_output_statistics_are_the_predicted_ones(form: str) -> None:
    module, features = make("convgru", form), latent(0)
    with torch.no_grad():
        gamma, beta, mean, std, _ = module.statistics(features, None)
        after, _ = module(features, None)
    if form == "residual":
        gamma, beta = gamma.exp() * std, mean + std * beta
    got_std, got_mean = torch.std_mean(after, dim=(-2, -1))
    torch.testing.assert_close(got_std, gamma, rtol=1e-4, atol=1e-5)
    torch.testing.assert_close(got_mean, beta, rtol=1e-4, atol=1e-5)


def test_paper_form_is_its_equation() -> None:
    module, features = make("convgru"), latent(3)
    with torch.no_grad():
        after, state = module(features, None)
        after, state = module(features, state)
        _, previous = module(latent(3), None)
        hidden = previous.hidden
        cell = module.conv_gru_cell
        reset, update = torch.sigmoid(cell.conv_gates(torch.cat([features, hidden], 1))).split(7, 1)
        candidate = torch.tanh(cell.conv_candidate(torch.cat([features, reset * hidden], 1)))
        hidden = (1 - update) * hidden + update * candidate
        gamma = torch.nn.functional.softplus(module.gamma_head(hidden)).mean((-2, -1))
        beta = module.beta_head(hidden).mean((-2, -1))
        mean = features.mean((-2, -1), keepdim=True)
        std = features.std((-2, -1), keepdim=True)
        expected = gamma[..., None, None] * (features - mean) / (std + 1e-5) + beta[..., None, None]
    torch.testing.assert_close(state.hidden, hidden)
    torch.testing.assert_close(after, expected, rtol=1e-4, atol=1e-5)


def test_gru_corrects_a_moving_average() -> None:
    module, state = make("gru"), None
    first, second = latent(0), latent(1)
    with torch.no_grad():
        _, state = module(first, None)
        _, state = module(second, state)
        gamma, beta, _, _, _ = module.statistics(second, StreamState(*_before(module, first)))
    std1, mean1 = torch.std_mean(first, dim=(-2, -1))
    std2, mean2 = torch.std_mean(second, dim=(-2, -1))
    ema_mean, ema_std = 0.1 * mean2 + 0.9 * mean1, 0.1 * std2 + 0.9 * std1
    torch.testing.assert_close(state.ema_mean, ema_mean)
    torch.testing.assert_close(state.ema_std, ema_std)
    with torch.no_grad():
        expected = (ema_std + module.gamma_delta_head(state.hidden)).clamp(min=1e-5)
        torch.testing.assert_close(gamma, expected)
        torch.testing.assert_close(beta, ema_mean + module.beta_delta_head(state.hidden))


def _before(module: torch.nn.Module, features: torch.Tensor) -> tuple[torch.Tensor, ...]:
    _, state = module(features, None)
    return state.hidden, state.ema_mean, state.ema_std


@pytest.mark.parametrize("kind", KINDS)
def test_a_batch_of_streams_is_its_single_streams(kind: str) -> None:
    """Including a stream that joins later, at its first frame."""
    module = make(kind)
    with torch.no_grad():
        _, old = module(latent(0), None)
        both = StreamState.stack([old, None])
        batch, after = module(torch.cat([latent(1), latent(2)]), both)
        one, state_one = module(latent(1), old)
        two, state_two = module(latent(2), None)
    torch.testing.assert_close(batch, torch.cat([one, two]))
    for got, want in zip(after.unbind(), (state_one, state_two), strict=True):
        torch.testing.assert_close(got.hidden, want.hidden)
        if want.ema_mean is not None:
            torch.testing.assert_close(got.ema_mean, want.ema_mean)
            torch.testing.assert_close(got.ema_std, want.ema_std)


@pytest.mark.parametrize("kind", KINDS)
def test_state_is_a_value(kind: str) -> None:
    module = make(kind)
    with torch.no_grad():
        _, state = module(latent(0), None)
        kept = state.hidden.clone()
        first, _ = module(latent(1), state)
        again, _ = module(latent(1), state)
    assert torch.equal(first, again)
    assert torch.equal(state.hidden, kept)
    assert not [name for name, _ in module.named_buffers()]


def test_state_of_another_size_is_refused() -> None:
    module = make("convgru")
    with torch.no_grad():
        _, state = module(latent(0), None)
        with pytest.raises(ValueError, match=r"state is of shape \(1, 7, 6, 9\).*\(1, 7, 5, 9\)"):
            module(latent(0, size=(5, 9)), state)
        with pytest.raises(ValueError, match="state is of shape"):
            module(latent(0, batch=2), state)


def test_latent_of_one_cell_is_refused() -> None:
    with pytest.raises(ValueError, match="1 x 1 cells"):
        make("convgru")(latent(0, size=(1, 1)), None)


@pytest.mark.parametrize(
    "options", [{"kind": "kalman"}, {"form": "other"}, {"hidden": 0}, {"pool": 0}]
)
def test_bad_config_is_refused(options: dict) -> None:
    with pytest.raises(ValueError, match=next(iter(options))):
        DyFNConfig(**options)


def test_released_size() -> None:
    module = build_dyfn(512, DyFNConfig())
    assert sum(parameter.numel() for parameter in module.parameters()) == 5_572_352


def test_gradients_reach_every_parameter() -> None:
    for kind in KINDS:
        for form in ("paper", "residual"):
            module, state, loss = make(kind, form, 2), None, torch.zeros(())
            for seed in range(3):
                after, state = module(latent(seed), state)
                loss = loss + after.square().mean() + after.abs().pow(1.5).mean()
            loss.backward()
            still = [
                name
                for name, parameter in module.named_parameters()
                if parameter.grad is None or not parameter.grad.abs().sum() > 0
            ]
            assert not still, (kind, form)


@pytest.mark.parametrize("kind", KINDS)
def test_under_autocast_statistics_and_state_are_float32(kind: str) -> None:
    module = make(kind)
    exact, rounded = None, None
    for frame in range(3):
        expected, exact = module(latent(frame), exact)
        with torch.autocast("cpu", torch.bfloat16):
            found, rounded = module(latent(frame), rounded)
        assert found.dtype == torch.float32 and torch.equal(found, expected)
        assert torch.equal(rounded.hidden, exact.hidden)
    with torch.autocast("cpu", torch.bfloat16):
        assert module(latent(3).bfloat16(), rounded)[0].dtype == torch.float32
