"""Sequence networks in torch; imported only when a network is evaluated or trained.

Inputs (B, N_INPUTS, behind + T + ahead) and conditions (B, N_CONDITIONS, 1 or as long) give outputs
(B, 4, T): corrections of m and q, then the logarithms of their standard deviations. The latter do
not influence the training of the corrections. Attribute names are keys of the shipped weight files.

Conditions act by FiLM: a layer's channels are scaled and shifted by a function of the conditions
(Perez, Strub, de Vries, Dumoulin & Courville, AAAI 2018, arXiv:1709.07871). The convolutions are
dilated and residual (Bai, Kolter & Koltun 2018, arXiv:1803.01271), without padding. The recurrent
network is gated (Cho et al., EMNLP 2014, arXiv:1406.1078), bidirectional unless causal.
"""

from collections.abc import Sequence

from estimators.networks.inputs import N_CONDITIONS, N_INPUTS
from road_envs.core.extras import optional_import

with optional_import("a neural network"):
    import torch
    from torch import Tensor, nn


_EMBEDDING_SIZE = 32  # size of the embedding of the conditions


class _Head(nn.Module):
    """Output layer from channels (B, C, T) to (B, 4, T), initially zero."""

    def __init__(self, channels: int):
        super().__init__()
        self.mean = nn.Conv1d(channels, 2, 1)
        self.log_std = nn.Conv1d(channels, 2, 1)
        for weight in (*self.mean.parameters(), *self.log_std.parameters()):
            nn.init.zeros_(weight)

    def forward(self, h: Tensor) -> Tensor:
        # detached: the likelihood of the errors must not bend the means
        return torch.cat([self.mean(h), self.log_std(h.detach())], dim=1)


class _Film(nn.Module):
    """Scale and shift of channels by the embedded conditions, initially the identity."""

    def __init__(self, channels: int):
        super().__init__()
        self.both = nn.Conv1d(_EMBEDDING_SIZE, 2 * channels, 1)
        for weight in self.both.parameters():
            nn.init.zeros_(weight)

    def forward(self, h: Tensor, c: Tensor) -> Tensor:
        scale, shift = self.both(c).chunk(2, dim=1)
        return h * (1.0 + scale) + shift


class _ResidualBlock(nn.Module):
    """A dilated convolution with a skip connection; `early` of its span is cut from the front."""

    def __init__(self, channels: int, kernel: int, dilation: int, causal: bool):
        super().__init__()
        self.wide = nn.Conv1d(channels, channels, kernel, dilation=dilation)
        self.film = _Film(channels)
        self.narrow = nn.Conv1d(channels, channels, 1)
        self.span = (kernel - 1) * dilation
        self.early = self.span if causal else self.span // 2

    def forward(self, h: Tensor, c: Tensor) -> tuple[Tensor, Tensor]:
        c = _trim(c, self.early, self.span - self.early)
        y = self.narrow(nn.functional.gelu(self.film(self.wide(h), c), approximate="tanh"))
        return _trim(h, self.early, self.span - self.early) + y, c


class TemporalConvNet(nn.Module):
    """A temporal convolutional network over distance."""

    def __init__(self, channels: int, kernel: int, dilations: Sequence[int], causal: bool):
        super().__init__()
        self.embed = _embed_conditions()
        self.enter = nn.Conv1d(N_INPUTS, channels, kernel)
        self.blocks = nn.ModuleList(_ResidualBlock(channels, kernel, d, causal) for d in dilations)
        self.head = _Head(channels)
        span = kernel - 1 + sum(block.span for block in self.blocks)  # type: ignore[misc]
        self.early = kernel - 1 if causal else (kernel - 1) // 2
        self.behind = span if causal else span // 2
        self.ahead = span - self.behind

    def forward(self, x: Tensor, conditions: Tensor) -> Tensor:
        h, c = self.enter(x), self.embed(conditions)
        c = _trim(c, self.early, x.shape[2] - h.shape[2] - self.early)
        for block in self.blocks:
            h, c = block(h, c)
        return self.head(h)


class GatedRecurrentNet(nn.Module):
    """A gated recurrent network over distance; its context is a warm-up."""

    def __init__(self, channels: int, kernel: int, context: int, causal: bool):
        super().__init__()
        self.embed = _embed_conditions()
        self.enter = nn.Conv1d(N_INPUTS, channels, kernel)
        self.film = _Film(channels)
        self.gru = nn.GRU(channels, channels, batch_first=True, bidirectional=not causal)
        width = channels if causal else 2 * channels
        self.mix = nn.Conv1d(width + channels, channels, 1)
        self.late = _Film(channels)
        self.head = _Head(channels)
        self.early = kernel - 1 if causal else (kernel - 1) // 2
        self.behind, self.ahead = context, 0 if causal else context
        self.span = kernel - 1

    def forward(self, x: Tensor, conditions: Tensor) -> Tensor:
        c = _trim(self.embed(conditions), self.early, self.span - self.early)
        h = nn.functional.gelu(self.film(self.enter(x), c), approximate="tanh")
        r, _ = self.gru(h.transpose(1, 2))
        early, late = self.behind - self.early, self.ahead - (self.span - self.early)
        h = _trim(torch.cat([h, r.transpose(1, 2)], dim=1), early, late)
        y = nn.functional.gelu(self.late(self.mix(h), _trim(c, early, late)), approximate="tanh")
        return self.head(y)


def _embed_conditions() -> nn.Sequential:
    """Return the layers from conditions (B, N_CONDITIONS, T) to (B, _EMBEDDING_SIZE, T)."""
    first = nn.Conv1d(N_CONDITIONS, _EMBEDDING_SIZE, 1)
    second = nn.Conv1d(_EMBEDDING_SIZE, _EMBEDDING_SIZE, 1)
    return nn.Sequential(first, nn.GELU(), second, nn.GELU())


def _trim(x: Tensor, early: int, late: int) -> Tensor:
    """Return `x` (B, C, T) without its ends; constant conditions (T = 1) have none."""
    return x if x.shape[2] == 1 else x[:, :, early : x.shape[2] - late]
