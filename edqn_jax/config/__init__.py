"""Every option, its default and its limits, and how a configuration is loaded."""

from edqn_jax.config.learning import AgentConfig, EncoderConfig, TrainConfig
from edqn_jax.config.options import CONDITIONS, EXACT, Config
from edqn_jax.config.presets import PRESETS, get_preset
from edqn_jax.config.registry import (
    ACTION_SETS,
    AIRFRAMES,
    ENCODERS,
    FAMILIES,
    LEARNERS,
    MIXTURES,
    NETWORKS,
    SENSORS,
    SHAPES,
)
from edqn_jax.config.simulation import (
    AirConfig,
    BodyConfig,
    CameraConfig,
    DroneConfig,
    EnvConfig,
    EventsConfig,
    ExposureConfig,
    LightConfig,
    MotorsConfig,
    NoiseConfig,
    SurfaceConfig,
    WorldConfig,
)

__all__ = [
    "ACTION_SETS",
    "AIRFRAMES",
    "CONDITIONS",
    "ENCODERS",
    "EXACT",
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
    "SurfaceConfig",
    "TrainConfig",
    "WorldConfig",
    "get_preset",
]
