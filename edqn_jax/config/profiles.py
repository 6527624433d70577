"""Named event sensors: options of `events` that belong together, with published figures (docs/sensors_in_light.md)."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

# v2e's `--dvs_params noisy` of June 2021 to May 2022; its refractory period is 0 since (docs/sensors_in_light.md).
# The standard deviation of its thresholds, 0.05, is relative to them here.
_DVS = {
    **dict.fromkeys(("threshold", "tolerance", "contrast_on", "contrast_off"), 0.2),
    "refractory_ns": 1e7,
    "bandwidth_hz": 30.0,
    "threshold_mismatch": 0.25,
    "leak_rate_hz": 0.1,
    "shot_rate_hz": 5.0,
    "hot_pixel_fraction": 0.0,
}

_FAULTS = ("bandwidth_hz", "threshold_mismatch", "leak_rate_hz", "shot_rate_hz", "hot_pixel_fraction")

PROFILES: dict[str, Mapping[str, Any]] = {
    "ideal": {"refractory_ns": 1000.0, **dict.fromkeys(_FAULTS, 0.0)},
    "dvs": _DVS,
    # The same pixel in a tenth of the light, with the leak and shot noise of recordings in dim light (DND21).
    "dark": {**_DVS, "bandwidth_hz": 3.0, "leak_rate_hz": 0.2, "shot_rate_hz": 10.0},
}
"""By `events.profile`. `ideal` leaves the thresholds as they are: they are chosen for a world and its window."""
