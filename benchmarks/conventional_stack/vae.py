"""The event VAE in PyTorch: encodes the event counts of a window into a code, and decodes it."""

from __future__ import annotations

import copy
from typing import Any

import numpy as np
from numpy.typing import NDArray

from edqn_jax.config import CameraConfig, EncoderConfig
from edqn_jax.packages import require

torch = require("torch")
nn = torch.nn

Tensor = Any
"""A `torch.Tensor`; a type checker need not have PyTorch."""

_MAX_LOG_VARIANCE = 6.0


class EventVAE(nn.Module):
    """Encoder and decoder with ReLU layers of our widths, over log(1 + count) of ON and OFF events."""

    def __init__(self, config: EncoderConfig, camera: CameraConfig) -> None:
        super().__init__()
        self.config = config
        pixels = 2 * camera.height * camera.width
        self.encoder = _layers((pixels, config.hidden, 2 * config.code_size))
        self.decoder = _layers((config.code_size, *config.decoder_hidden, pixels))
        # Codes are nearly noiseless at first; the KL term increases the variance.
        with torch.no_grad():
            self.encoder[-1].bias[config.code_size :] = -4.0

    def encode(self, image: Tensor) -> tuple[Tensor, Tensor]:
        """Returns mean and log-variance, each [B, code_size], of images [B, 2 H W]."""
        mean, log_variance = self.encoder(image).chunk(2, dim=-1)
        return mean, log_variance.clamp(-_MAX_LOG_VARIANCE, _MAX_LOG_VARIANCE)

    def code(self, image: Tensor) -> NDArray[np.float32]:
        """Returns the code of images [B, 2 H W] for the agent: the mean, [B, code_size]."""
        with torch.inference_mode():
            return self.encode(image)[0].numpy()

    def loss(self, image: Tensor) -> Tensor:
        """Returns squared reconstruction error of an image + `kl_weight` x KL, averaged over the batch."""
        mean, log_variance = self.encode(image)
        code = mean + torch.exp(0.5 * log_variance) * torch.randn_like(mean)
        error = nn.functional.mse_loss(self.decoder(code), image, reduction="sum")
        kl = 0.5 * torch.sum(mean.square() + log_variance.exp() - 1.0 - log_variance)
        return (error + self.config.kl_weight * kl) / len(image)


def _layers(widths: tuple[int, ...]) -> Any:
    layers: list[Any] = []
    for inputs, outputs in zip(widths[:-1], widths[1:], strict=True):
        layers += [nn.Linear(inputs, outputs), nn.ReLU()]
    return nn.Sequential(*layers[:-1])


def images(counts: NDArray[np.int8]) -> Tensor:
    """Returns log(1 + count) of ON and of OFF events, [B, 2 H W], of signed counts [B, H, W]."""
    signed = torch.from_numpy(counts).flatten(1).float()
    return torch.cat([signed.clamp(min=0), (-signed).clamp(min=0)], dim=1).log1p_()


class Learner:
    """A VAE that learns, and the frozen copy that encodes for the agent."""

    def __init__(self, config: EncoderConfig, camera: CameraConfig, seed: int) -> None:
        torch.manual_seed(seed)
        self.learning = EventVAE(config, camera)
        self.optimiser = torch.optim.Adam(self.learning.parameters(), lr=config.learning_rate, fused=True)
        self.samples = 0
        self.publish()

    def publish(self) -> None:
        """Copies the VAE for the agent. Codes of different copies must not be mixed in the replay."""
        self.acting = copy.deepcopy(self.learning).requires_grad_(False)

    def update(self, image: Tensor) -> float:
        """Takes one Adam step on images [B, 2 H W] and returns the loss."""
        self.optimiser.zero_grad()
        loss = self.learning.loss(image)
        loss.backward()
        self.optimiser.step()
        self.samples += len(image)
        return loss.item()

    def code(self, image: Tensor) -> NDArray[np.float32]:
        """Returns the agent's code of images [B, 2 H W]: the mean, [B, code_size]."""
        return self.acting.code(image)
