"""The events of a window, dense, and what is read from them: images, pictures, and the stream that people exchange.

Inside the compiled step events are never a list. Between two frames a pixel's events all have one polarity
and even spacing, so `EventField` holds them exactly; `to_stream` turns it into the `(t, x, y, p)` stream.

With noise a pixel may have events of both polarities between two frames: the rows of a field are then the ON events
of every frame pair and after them the OFF events, and in a row noise and signal of a pixel are one
(`event_noise.merge_fields`).

Shapes: F frame pairs (2 F rows when noise events are on), H rows, W columns.
"""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
from flax import struct
from jax import Array
from numpy.typing import NDArray

STREAM_DTYPE = np.dtype([("t", "<i8"), ("x", "<u2"), ("y", "<u2"), ("p", "i1")])
"""One event of a stream: time in microseconds, column, row, polarity in {-1, +1}."""

MICROSECOND = 1e-6


@struct.dataclass
class EventField:
    """Events of one window, dense: in each row a pixel's events have one polarity and even spacing."""

    count: Array  # [F, H, W] int32, events of the pixel in this frame pair
    polarity: Array  # [F, H, W] int8 in {-1, 0, +1}; 0 where count is 0
    t_first: Array  # [F, H, W] float32 seconds from the start of the window
    t_step: Array  # [F, H, W] float32 seconds between a pixel's events
    window_s: float = struct.field(pytree_node=False)  # length of the window, seconds
    divides_window: bool = struct.field(pytree_node=False, default=False)
    """Whether `t_first` is 0 and `t_step` the window over `count` everywhere: Eq. 5 between one pair of frames."""
    with_noise: bool = struct.field(pytree_node=False, default=False)
    """Whether the rows are the ON events of every frame pair and then the OFF events, 2 F in all."""
    unit: Array | None = None
    """[] what an event counts for the encoder, see `in_units`; None is 1. With `sensor_pixels` counts are of all these
    pixels together."""


def in_units(field: EventField) -> Array:
    """Returns the counts [..., F, H, W] float32 as encoders read them.

    Where the contrast is drawn, they are log-brightness changes over `contrast.REFERENCE`; of sensors with several
    pixels under one of ours they are the mean of these.
    """
    counts = field.count.astype(jnp.float32)
    return counts if field.unit is None else counts * field.unit[..., None, None, None]


def event_image(field: EventField) -> Array:
    """Returns ON minus OFF events per pixel over the window, `[H, W]` int32."""
    return jnp.sum(field.count * field.polarity, axis=-3)


def image_in_units(field: EventField) -> Array:
    """Returns ON minus OFF events per pixel over the window `[..., H, W]`, as encoders read them, see `in_units`."""
    return event_image(field) if field.unit is None else jnp.sum(in_units(field) * field.polarity, axis=-3)


def event_picture(image: NDArray, background: str = "white") -> NDArray[np.uint8]:
    """Returns a red-blue picture of a signed event image (Fig. 6): `[H, W]` to `[H, W, 3]`, ON red and OFF blue.

    One event already has half the colour's strength; more events approach it.

    Raises:
        ValueError: if the background is neither `white` nor `black`.
    """
    if background not in ("white", "black"):
        raise ValueError(f"the background is 'white' or 'black', not '{background}'")
    image = np.asarray(image).astype(np.float64)
    paper = np.full(3, 255.0 if background == "white" else 0.0)
    ink = np.where(image[..., None] > 0, np.array([230.0, 30.0, 30.0]), np.array([40.0, 70.0, 240.0]))
    strength = np.where(image == 0, 0.0, 1.0 - 0.5 * 0.5 ** (np.abs(image) - 1))[..., None]
    return np.rint(paper + strength * (ink - paper)).astype(np.uint8)


def to_stream(field: EventField, window_start_us: int = 0) -> NDArray:
    """Returns the stream of a field: [N] of `STREAM_DTYPE`, sorted by time (host side, NumPy).

    Times are rounded to the microsecond. Ties keep the order row, column.
    """
    count = np.asarray(field.count)
    row, y, x = np.nonzero(count)
    number = count[row, y, x]
    first = np.asarray(field.t_first, np.float64)[row, y, x]
    step = np.asarray(field.t_step, np.float64)[row, y, x]
    pixel = np.repeat(np.arange(number.size), number)
    index = np.arange(pixel.size) - (np.cumsum(number) - number)[pixel]
    stream = np.empty(pixel.size, STREAM_DTYPE)
    stream["t"] = window_start_us + np.rint((first[pixel] + index * step[pixel]) * 1e6).astype(np.int64)
    stream["x"], stream["y"] = x[pixel], y[pixel]
    stream["p"] = np.asarray(field.polarity)[row, y, x][pixel]
    return stream[np.argsort(stream["t"], kind="stable")]
