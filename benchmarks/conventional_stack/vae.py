"""The event VAE in PyTorch, the same networks as `edqn_jax/learn/perception/vae.py` with the patch encoder.

It encodes the event counts of a window and the drone's own motion, and draws `encoder.target` in standing waves. It
starts from parameters that `edqn_jax` draws. B is the batch, N the number of patches, K the number of pixels in one.
"""

from __future__ import annotations

import copy
from typing import Any

import jax
import numpy as np
from numpy.typing import NDArray

from edqn_jax.config import CameraConfig, EncoderConfig
from edqn_jax.extras import require_extra
from edqn_jax.learn.perception.code import MAX_LOG_VARIANCE, MAX_MEAN
from edqn_jax.learn.perception.patches import patch_places
from edqn_jax.learn.perception.vae import init_vae
from edqn_jax.learn.perception.waves import OUTPUT_SCALE, cosine_basis

torch = require_extra("torch")
nn = torch.nn

Tensor = Any
"""A `torch.Tensor`; a type checker need not have PyTorch."""

Params = Any
"""Nested dictionaries of arrays, as `edqn_jax.learn.perception.vae.init_vae` returns them."""


class Encoder(nn.Module):
    """Layers shared by all patches, layers over all patches joined, and the code: `PatchEncoder` of `edqn_jax`."""

    def __init__(self, config: EncoderConfig, camera: CameraConfig, params: Params) -> None:
        super().__init__()
        first, head = params["channel_0"], params["code"]
        # ON and OFF counts of a patch are one row, so both channels are one product.
        self.patch = _linear(first["kernel"], params["channel_1"]["kernel"], bias=first["bias"])
        self.place = _linear(params["place"]["kernel"])
        self.motion = _linear(params["motion"]["kernel"])
        later = [f"patch_{number}" for number in range(1, len(config.patch_layers))]
        self.shared = _layers([params[name] for name in later])
        self.joint = _layers([params[f"joint_{number}"] for number in range(len(config.joint_layers))])
        mean, log_variance = head["mean"], head["log_variance"]
        self.head = _linear(
            np.concatenate([mean["kernel"], log_variance["kernel"]], axis=1),
            bias=np.concatenate([mean["bias"], log_variance["bias"]]),
        )
        places = patch_places(camera.height, camera.width, config.patch_pixels)
        self.register_buffer("places", torch.from_numpy(places))

    def forward(self, counts: Tensor, motion: Tensor) -> tuple[Tensor, Tensor]:
        """Returns mean and log-variance, each [B, code_size], of `patches` [B, N, 2 K] and own motions [B, 7]."""
        z = self.patch(counts) + self.place(self.places) + self.motion(motion)[:, None]
        z = self.shared(z.relu())
        mean, log_variance = self.head(self.joint(torch.cat([z.flatten(1), motion], dim=1))).chunk(2, dim=1)
        return mean.clamp(-MAX_MEAN, MAX_MEAN), log_variance.clamp(-MAX_LOG_VARIANCE, MAX_LOG_VARIANCE)


class Decoder(nn.Module):
    """ReLU layers from a code to the amplitudes of standing waves: `Decoder` of `edqn_jax`."""

    def __init__(self, config: EncoderConfig, params: Params) -> None:
        super().__init__()
        self.hidden = _layers([params[f"Dense_{number}"] for number in range(len(config.decoder_hidden))])
        kernel, bias = params["kernel"], params["bias"]
        self.waves = _linear(kernel.reshape(len(kernel), -1), bias=bias.ravel())
        self.shape = bias.shape

    def forward(self, code: Tensor) -> Tensor:
        """Returns amplitudes [B, channels, P, Q] of codes [B, code_size]."""
        return (OUTPUT_SCALE * self.waves(self.hidden(code))).unflatten(1, self.shape)


class EventVAE(nn.Module):
    """Encoder and decoder with given parameters."""

    def __init__(self, config: EncoderConfig, camera: CameraConfig, params: Params) -> None:
        """Copies the parameters, those of `edqn_jax.learn.perception.vae.init_vae` for the same configuration."""
        super().__init__()
        params = jax.tree.map(np.asarray, params)
        self.config = config
        self.encoder = Encoder(config, camera, params["encoder"])
        self.decoder = Decoder(config, params["decoder"])
        _, rows, columns = self.decoder.shape
        self.register_buffer("down", _blurred_waves(camera.height, rows, config.target_blur))
        self.register_buffer("across", _blurred_waves(camera.width, columns, config.target_blur))

    def patches(self, counts: NDArray[np.int8]) -> Tensor:
        """Returns log(1 + count) of ON and of OFF events in patches, [B, N, 2 K], of signed counts [B, H, W]."""
        size = self.config.patch_pixels
        height, width = counts.shape[1:]
        image = nn.functional.pad(torch.from_numpy(counts), (0, -width % size, 0, -height % size))
        cut = image.unflatten(2, (-1, size)).unflatten(1, (-1, size)).transpose(2, 3)
        # Patches are cut from bytes, and a pixel's events have one polarity: one logarithm serves both.
        signed = cut.flatten(3).flatten(1, 2).float()
        level = signed.abs().log1p_().copysign_(signed)
        return torch.cat([level.clamp(min=0), level.neg_().clamp_(min=0)], dim=2)

    def target(self, counts: NDArray[np.int8], nearness: NDArray[np.float32]) -> Tensor:
        """Returns what the decoder must draw: amplitudes [B, channels, P, Q] of
        `edqn_jax.learn.perception.vae.decoder_target`.

        Args:
            counts: [B, H, W] signed event counts.
            nearness: [B, H, W] label; unused if the target is `sensed`.
        """
        channels = []
        if self.config.target != "nearness":
            signed = torch.from_numpy(counts).float()
            channels += [signed.clamp(min=0).log1p_(), (-signed).clamp(min=0).log1p_()]
        if self.config.target != "sensed":
            channels.append(torch.from_numpy(nearness))
        return ((torch.stack(channels, dim=1) @ self.across.T).mT @ self.down.T).mT

    def code(self, patches: Tensor, motion: NDArray[np.float32]) -> NDArray[np.float32]:
        """Returns the agent's code, the mean [B, code_size], of `patches` [B, N, 2 K] and own motions [B, 7]."""
        with torch.inference_mode():
            return self.encoder(patches, torch.from_numpy(motion))[0].numpy()

    def loss(self, patches: Tensor, motion: NDArray[np.float32], wanted: Tensor) -> Tensor:
        """Returns squared error of the amplitudes + `kl_weight` x KL, averaged over the batch.

        The part of the target in waves that cannot be drawn, a constant, is left out.

        Args:
            patches: [B, N, 2 K].
            motion: [B, 7] own motions.
            wanted: [B, channels, P, Q], see `target`.
        """
        mean, log_variance = self.encoder(patches, torch.from_numpy(motion))
        code = mean + torch.exp(0.5 * log_variance) * torch.randn_like(mean)
        error = nn.functional.mse_loss(self.decoder(code), wanted, reduction="sum")
        kl = 0.5 * torch.sum(mean.square() + log_variance.exp() - 1.0 - log_variance)
        return (error + self.config.kl_weight * kl) / len(patches)


def _linear(*kernels: NDArray[np.float32], bias: NDArray[np.float32] | None = None) -> Any:
    """Returns a linear layer of kernels [inputs, outputs], whose inputs are joined."""
    kernel = np.concatenate(kernels)
    layer = nn.Linear(*kernel.shape, bias=bias is not None)
    with torch.no_grad():
        layer.weight.copy_(torch.tensor(kernel.T))
        if bias is not None:
            layer.bias.copy_(torch.tensor(bias))
    return layer


def _layers(params: list[Params]) -> Any:
    """Returns ReLU layers."""
    layers = [(_linear(layer["kernel"], bias=layer["bias"]), nn.ReLU()) for layer in params]
    return nn.Sequential(*[part for layer in layers for part in layer])


def _blurred_waves(size: int, count: int, times: int) -> Tensor:
    """Returns [count, size]: the lowest standing waves of `size` pixels, of an image that is first blurred.

    A binomial (1, 2, 1) / 4 with edges repeated only scales a standing wave, by cos^2 of half its step per pixel.
    """
    factor = np.cos(0.5 * np.pi * np.arange(count) / size) ** (2 * times)
    return torch.from_numpy((factor[:, None] * cosine_basis(size, count)).astype(np.float32))


class Learner:
    """A VAE that learns, and the frozen copy that encodes for the agent."""

    def __init__(self, config: EncoderConfig, camera: CameraConfig, seed: int) -> None:
        torch.manual_seed(seed)
        self.learning = EventVAE(config, camera, init_vae(config, camera, jax.random.key(seed)))
        self.optimiser = torch.optim.Adam(self.learning.parameters(), lr=config.learning_rate, fused=True)
        self.samples = 0
        self.publish()

    def publish(self) -> None:
        """Copies the VAE for the agent. Codes of different copies must not be mixed in the replay."""
        self.acting = copy.deepcopy(self.learning).requires_grad_(False)

    def update(self, patches: Tensor, motion: NDArray[np.float32], wanted: Tensor) -> float:
        """Takes one Adam step and returns the loss; arguments as `EventVAE.loss`."""
        self.optimiser.zero_grad()
        loss = self.learning.loss(patches, motion, wanted)
        loss.backward()
        self.optimiser.step()
        self.samples += len(patches)
        return loss.item()
