"""What the drone saw at every decision of a flight, as PNGs with a frame below the other."""

from __future__ import annotations

import base64
import io
from collections.abc import Mapping
from typing import Any

import matplotlib
import numpy as np
from matplotlib.colors import Colormap, Normalize
from PIL import Image

from edqn_jax.config import Config
from edqn_jax.learn.perception import embedding
from edqn_jax.learn.policy import PolicyParams
from edqn_jax.report.images import NEARNESS, RECONSTRUCTED_EVENTS, Look, error_caption, look_of, scale_of
from edqn_jax.report.sights import FlightRenderer, SensorImages
from edqn_jax.sim.camera.camera import on_screen

LEVELS = 64
"""Colours of a picture; more make the file larger and no better to look at."""

NEARNESS_COLOURS = "inferno"
"""Bright is near, black far away."""


def flight_pictures(
    sights: FlightRenderer, params: PolicyParams | None, trajectory: Mapping[str, np.ndarray]
) -> dict[str, Any]:
    """Returns the pictures of a flight as plain JSON data, one frame for each whole decision.

    `width`, `height` of a frame, the number of `frames`, the `busiest` of them, in which most is seen, and of each of
    the `panels` its `name` and `png`, base64: brightness, what the sensor shows, what the decoder draws from the code,
    and what it should have drawn.

    Args:
        sights: of the world of the flight; its sensor shows an image.
        params: of the policy that flew; None of a function, which draws nothing.
        trajectory: the columns of `trajectory.csv`.
    """
    config = sights.config
    shown, look = sights.shown(params, trajectory), look_of(config.env.sensor)
    panels = [
        ("brightness", on_screen(shown.luma), Normalize(0.0, 1.0), "gray"),
        (look.name, shown.image, scale_of(shown.image, look, share=0.75), look.colours),
        *_decoder_images(config, shown, look),
    ]
    count, height, width = shown.image.shape
    return {
        "width": width,
        "height": height,
        "frames": count,
        "busiest": int(np.argmax(np.abs(shown.image).sum((1, 2)) if look.signed else shown.image.std((1, 2)))),
        "panels": [{"name": name, "png": picture_strip(images, norm, colour)} for name, images, norm, colour in panels],
    }


def _decoder_images(
    config: Config, shown: SensorImages, look: Look
) -> list[tuple[str, np.ndarray, Normalize, str | Colormap]]:
    """Returns name, images, scale and colours of what a decoder draws and of what it should draw, if there is one."""
    if shown.reconstruction is None or shown.target is None:
        return []
    nearness = embedding.needs_nearness(config)
    title = NEARNESS if nearness else RECONSTRUCTED_EVENTS if look.signed else look
    colours = NEARNESS_COLOURS if nearness else title.colours
    # Quiet moments are to be seen, too.
    scale = Normalize(0.0, max(float(np.quantile(shown.target, 0.999)), 1e-6)) if title.signed is False else None
    scale = scale or scale_of(shown.target, title)
    return [
        (
            f"predicted {title.name}{_error_of(shown)}" if nearness else f"{title.name}, from the code",
            shown.reconstruction,
            scale,
            colours,
        ),
        (f"true {title.name}" if nearness else f"{title.name}, blurred", shown.target, scale, colours),
    ]


def _error_of(shown: SensorImages) -> str:
    """Returns the error of the predicted distances of a flight as the end of a panel's name."""
    assert shown.predicted is not None and shown.distance is not None
    # A panel is narrow.
    return f" ({error_caption(shown.predicted, shown.distance).removeprefix('distance ')})"


def picture_strip(images: np.ndarray, norm: Normalize, colours: str | Colormap) -> str:
    """Returns images [D, H, W] as one PNG [D H, W] in colours, base64."""
    colour_map = matplotlib.colormaps[colours] if isinstance(colours, str) else colours
    levels = np.asarray(np.clip(norm(np.asarray(images, np.float64)), 0, 1)) * (LEVELS - 1)
    picture = Image.fromarray(levels.round().astype(np.uint8).reshape(-1, images.shape[-1]), mode="L")
    picture = Image.frombytes("P", picture.size, picture.tobytes())
    palette = np.round(255 * colour_map(np.linspace(0, 1, LEVELS))[:, :3]).astype(np.uint8)
    picture.putpalette(palette.tobytes())
    file = io.BytesIO()
    picture.save(file, format="PNG", optimize=True)
    return base64.b64encode(file.getvalue()).decode("ascii")
