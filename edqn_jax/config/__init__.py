"""Every option, its default and its limits, and how a configuration is loaded."""

from edqn_jax.config.options import (
    CONDITIONS,
    AgentConfig,
    AirConfig,
    BodyConfig,
    CameraConfig,
    Config,
    DroneConfig,
    EncoderConfig,
    EnvConfig,
    EventsConfig,
    ExposureConfig,
    LightConfig,
    MotorsConfig,
    NoiseConfig,
    TrainConfig,
    WorldConfig,
)
from edqn_jax.config.presets import PRESETS, preset
from edqn_jax.config.registry import FAMILIES, LEARNERS, MIXTURES, NETWORKS, SENSORS, SHAPES

__all__ = [
    "CONDITIONS",
    "FAMILIES",
    "LEARNERS",
    "MIXTURES",
    "NETWORKS",
    "PRESETS",
    "SENSORS",
    "SHAPES",
    "AgentConfig",
    "AirConfig",
    "BodyConfig",
    "CameraConfig",
    "Config",
    "DroneConfig",
    "EncoderConfig",
    "EnvConfig",
    "EventsConfig",
    "ExposureConfig",
    "LightConfig",
    "MotorsConfig",
    "NoiseConfig",
    "TrainConfig",
    "WorldConfig",
    "preset",
]
