"""Every option of the project: one frozen dataclass per module, nested into one `Config`.

The defaults are the `default` preset on the paper's map, the best that we know; `presets` has what random worlds, other
worlds from files and a GPU change. The string under a field is its help text on the command line, its limits stand in
its type.
"""

from __future__ import annotations

from dataclasses import dataclass, field, fields

from edqn_jax.config.learning import AgentConfig, EncoderConfig, ImitationConfig, PqnConfig, TrainConfig
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


@dataclass(frozen=True)
class Config:
    """All options."""

    world: WorldConfig = field(default_factory=WorldConfig)
    drone: DroneConfig = field(default_factory=DroneConfig)
    camera: CameraConfig = field(default_factory=CameraConfig)
    surface: SurfaceConfig = field(default_factory=SurfaceConfig)
    events: EventsConfig = field(default_factory=EventsConfig)
    env: EnvConfig = field(default_factory=EnvConfig)
    air: AirConfig = field(default_factory=AirConfig)
    body: BodyConfig = field(default_factory=BodyConfig)
    motors: MotorsConfig = field(default_factory=MotorsConfig)
    noise: NoiseConfig = field(default_factory=NoiseConfig)
    light: LightConfig = field(default_factory=LightConfig)
    exposure: ExposureConfig = field(default_factory=ExposureConfig)
    encoder: EncoderConfig = field(default_factory=EncoderConfig)
    agent: AgentConfig = field(default_factory=AgentConfig)
    pqn: PqnConfig = field(default_factory=PqnConfig)
    imitation: ImitationConfig = field(default_factory=ImitationConfig)
    train: TrainConfig = field(default_factory=TrainConfig)


CONDITIONS: dict[str, tuple[str, ...]] = {
    "camera": ("shadows",),
    "env": ("action_delay", "delay_share", "setpoint_m_s2", "setpoint_share", "drones"),
    "events": (
        *("profile", "threshold", "tolerance", "contrast_on", "contrast_off", "refractory_ns", "bandwidth_hz"),
        *("threshold_mismatch", "leak_rate_hz", "shot_rate_hz", "hot_pixel_fraction", "hot_pixel_rate_hz"),
        *("reference_lux", "least_contrast", "most_contrast", "faults_share", "sensor_pixels"),
    ),
    **{
        group: tuple(option.name for option in fields(kind) if option.name != "told")
        for group, kind in (
            ("air", AirConfig),
            ("body", BodyConfig),
            ("motors", MotorsConfig),
            ("noise", NoiseConfig),
            ("light", LightConfig),
            ("exposure", ExposureConfig),
            ("surface", SurfaceConfig),
        )
    },
}
"""Options by group that a policy may be flown with other values of than it was trained with."""

EXACT: dict[str, dict[str, bool | float]] = {
    "air": {"drag": False, "wind_m_s": 0.0, "gusts_m_s": 0.0},
    "body": {"mass_share": 0.0, "inertia_share": 0.0},
    "motors": {"gain_share": 0.0, "lag_s": 0.0},
    "env": {"setpoint_m_s2": 0.0, "action_delay": 0},
    "noise": {"position_m": 0.0, "velocity_m_s": 0.0, "position_bias_m": 0.0, "velocity_bias_m_s": 0.0},
}
"""Conditions without disturbances: nominal body and motors, no air, no delay, no errors of the state."""
