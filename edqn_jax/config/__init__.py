"""Every option, its default and its limits, and how a configuration is loaded."""

from edqn_jax.config.options import (
    CONDITIONS,
    FAMILIES,
    MIXTURES,
    AgentConfig,
    AirConfig,
    BodyConfig,
    CameraConfig,
    Config,
    DroneConfig,
    EncoderConfig,
    EnvConfig,
    EventsConfig,
    MotorsConfig,
    NoiseConfig,
    TrainConfig,
    WorldConfig,
)
from edqn_jax.config.presets import PRESETS, preset

__all__ = [
    "CONDITIONS",
    "FAMILIES",
    "MIXTURES",
    "PRESETS",
    "AgentConfig",
    "AirConfig",
    "BodyConfig",
    "CameraConfig",
    "Config",
    "DroneConfig",
    "EncoderConfig",
    "EnvConfig",
    "EventsConfig",
    "MotorsConfig",
    "NoiseConfig",
    "TrainConfig",
    "WorldConfig",
    "preset",
]
