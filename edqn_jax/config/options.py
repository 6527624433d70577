"""Every option of the project: one frozen dataclass per module, nested into one `Config`.

The defaults are the `default` preset on the paper's map, the best that we know; `loading` has what random worlds, other
worlds from files and a GPU change. The string under a field is its help text on the command line.
"""

from __future__ import annotations

from dataclasses import dataclass, field, fields
from typing import Literal


@dataclass(frozen=True)
class WorldConfig:
    """Where to train and to fly."""

    name: str = "paper"
    """Where to train: `paper`, the path of an MJCF file, or random worlds."""
    flown: str = ""
    """World of the flight at the end of a run in random worlds: `paper` or the path of an MJCF file; training never
    uses it. Empty: the first test world. A world from a file is flown itself."""
    pool_size: int = 1024
    """Random training worlds, drawn before training (in random worlds only)."""
    missions: int = 8192
    """(world, start, goal) triples, generated before training, that resets draw from."""
    own_start_fraction: float = 0.25
    """Share of training missions that begin within `start_jitter_m` of the world's own start."""
    start_jitter_m: float = 1.0
    """Half width of the box around the world's own start that such starts are drawn from, metres."""
    moving_share: float = 0.0
    """Share of the obstacles of random worlds that move; 0 is none, and one half in the worlds `moving`."""
    moving_speed_m_s: float = 3.0
    """Speed of the fastest of them, m/s; each has its own, of at least 0.3 times this."""
    balls: int = 0
    """Balls in each random world, thrown at where the drone will be if it goes on as it flies then."""
    ball_speed_m_s: float = 6.0
    """Speed of these balls, m/s."""
    ball_gravity_m_s2: float = 0.0
    """Gravity that bends their way, m/s^2; at 0 they fly straight."""


@dataclass(frozen=True)
class DroneConfig:
    """The airframe and its inner loops: velocity, attitude and body rate, all at the physics rate."""

    airframe: str = "skydio_x2"
    """Mass, inertia and rotors."""
    physics: Literal["mjx", "rigid_body"] = "mjx"
    """Physics engine. `rigid_body`: the closed form of MJX's equations for this airframe, which compiles sooner."""
    physics_dt_s: float = 0.02
    """Physics step, seconds."""
    physics_steps: int = 13
    """Physics steps per decision: 13 x 0.02 s = 0.26 s."""
    body_radius_m: float = 0.36
    """Radius of the sphere that must not touch anything, metres."""
    velocity_gain: float = 4.5
    """Commanded horizontal acceleration per velocity error, 1/s."""
    climb_gain: float = 6.0
    """Commanded vertical acceleration per velocity error, 1/s."""
    attitude_gain: float = 10.0
    """Commanded body rate per tilt error, 1/s."""
    rate_gain: float = 20.0
    """Commanded angular acceleration per error of the rates about x and y, 1/s."""
    yaw_gain: float = 3.0
    """Commanded yaw rate per heading error, 1/s."""
    yaw_rate_gain: float = 10.0
    """Commanded angular acceleration per error of the rate about z, 1/s."""
    max_body_rate_rad_s: float = 6.0
    """Largest combined rate about x and y that the attitude loop may command, rad/s."""
    max_tilt_rad: float = 1.15
    """Largest tilt that the velocity loop may command, radians."""
    max_horizontal_m_s2: float = 12.0
    """Largest horizontal acceleration that the velocity loop may command, m/s^2."""
    max_climb_m_s2: float = 10.0
    """Largest upward acceleration that the velocity loop may command, m/s^2."""
    max_descent_m_s2: float = 6.5
    """Largest downward acceleration that the velocity loop may command, m/s^2; below gravity."""
    max_tilt_share: float = 0.8
    """Share of a rotor's range that torque about x and y may use; the rest is left to collective thrust."""
    max_yaw_rate_rad_s: float = 2.0
    """Rate limit of the yaw setpoint, and largest yaw rate that the heading loop may command, rad/s."""


@dataclass(frozen=True)
class CameraConfig:
    """A pinhole camera at the body's centre."""

    width: int = 32
    """Pixels across."""
    height: int = 24
    """Pixels down."""
    horizontal_fov_deg: float = 90.0
    """Horizontal field of view, degrees."""
    mount: Literal["level", "body"] = "level"
    """`level`: a gimbal removes roll and pitch. `body`: the camera takes the full attitude."""
    samples_across: int = 3
    """Rays per pixel across; texture is filtered analytically, rays only resolve silhouettes."""
    samples_down: int = 2
    """Rays per pixel down."""
    texture_contrast: float = 0.35
    """Amplitude of the procedural surface texture relative to the surface's brightness."""
    texture_period_m: float = 1.5
    """Period of the finer texture octave, metres; the coarser one is four times as long."""
    ambient: float = 0.4
    """Share of a surface's brightness that does not depend on the sun."""
    sun_azimuth_deg: float = 205.0
    """Direction towards the sun in the world's xy plane, degrees from +x."""
    sun_elevation_deg: float = 50.0
    """Height of the sun over the horizon, degrees."""
    sky_rgb: tuple[float, float, float] = (0.62, 0.74, 0.9)
    """Brightness of the sky."""


@dataclass(frozen=True)
class SurfaceConfig:
    """What the faces of the shapes of a world look like; geometry is the same under every pattern."""

    pattern: str = "plaid"
    """`plaid`: one for all, of `camera.texture_*`. For each shape its own: `drawn` (any of the next four), `blank`,
    `waves`, `noise`, `checks`; for tests, never among `drawn`: `bricks`, `posters`, `wood`. With a sun and a sky for
    each world."""
    contrast: float = 0.8
    """Most amplitude of a pattern relative to the surface's brightness; a shape's is uniform from 0 to this."""
    shortest_m: float = 0.2
    """Shortest period of waves, noise and checks, metres; a shape's is log-uniform."""
    longest_m: float = 10.0
    """Longest period, metres."""


LOOKS = ("plaid", "drawn", "blank", "waves", "noise", "checks", "bricks", "posters", "wood")
"""Values of `surface.pattern`."""


@dataclass(frozen=True)
class EventsConfig:
    """From a pair of log-brightness frames to events (Eq. 2-5)."""

    law: Literal["paper", "airsim", "esim"] = "paper"
    """Event law: the paper's, AirSim's (equal to its simulator event by event), or ESIM's, a sensor with memory."""
    profile: Literal["ideal", "dvs", "dark"] = "ideal"
    """Named sensor whose figures take the place of thresholds, refractory period, bandwidth and noise; options that are
    given beside it change one. `ideal`: no faults. `dvs`: the noisy sensor of v2e in 2021. `dark`: in low light."""
    frame_times_s: tuple[float, ...] = (-0.04, 0.0)
    """When frames are rendered relative to the decision, seconds; each must be a physics step."""
    stream: bool = False
    """Whether a window begins where the one before ended, so that `esim` and slow photoreceptors remember all that was
    seen. `frame_times_s` must then begin with the decision, at -0.26; with every physics step, nothing is missed."""
    threshold: float = 0.05
    """Th of Eq. 2 (`paper`): log-brightness change that makes events."""
    tolerance: float = 0.05
    """TOL of Eq. 4 (`paper`): log-brightness change per event."""
    contrast_on: float = 0.05
    """C+ (`esim`): log-brightness rise per event."""
    contrast_off: float = 0.05
    """C- (`esim`): log-brightness fall per event."""
    airsim_tolerance: float = 0.5
    """TOL of AirSim's event simulator (`airsim`)."""
    refractory_ns: float = 1000.0
    """Refractory period, nanoseconds; caps a pixel's events in a window (Eq. 3)."""
    log_epsilon: float = 1e-3
    """Added to brightness in [0, 1] before the logarithm of Eq. 1."""
    bandwidth_hz: float = 0.0
    """Cutoff frequency of a white pixel's photoreceptor, which lags behind the light; a darker pixel's is lower in
    proportion. 0 is infinite."""
    threshold_mismatch: float = 0.0
    """Standard deviation of the per-pixel threshold relative to the threshold; 0 is a perfect sensor."""
    leak_rate_hz: float = 0.0
    """Leakage noise: ON events per pixel and second."""
    shot_rate_hz: float = 0.0
    """Shot noise: events of either polarity per pixel and second."""
    hot_pixel_fraction: float = 0.0
    """Share of pixels that are hot: they fire at `hot_pixel_rate_hz` without any change of brightness."""
    hot_pixel_rate_hz: float = 50.0
    """Events per second of a hot pixel."""
    reference_lux: float = 10.0
    """Illuminance in which `bandwidth_hz` and `shot_rate_hz` are a white and a black pixel's, where `light` is on."""


@dataclass(frozen=True)
class EnvConfig:
    """The task: sensor, actions, outcomes, reward."""

    sensor: str = "events"
    """What the drone observes besides its own state."""
    actions: str = "moves"
    """What an action commands. `edqn train` learns moves alone."""
    speed_m_s: float = 4.0
    """Commanded speed per axis of a move, in the heading frame."""
    goal_radius_m: float = 2.0
    """Body centre within this distance of the goal, at any physics step, is success."""
    max_decisions: int = 200
    """Episode limit in decisions (the `threshold` of Table 1)."""
    drones: int = 1
    """Drones that fly together in one world, with missions that cross, at most 8; each sees and hits the others. As
    many environments in a row, and as many missions, are one group (docs/several_drones.md)."""
    action_delay: int = 0
    """Decisions between choosing a move and flying it: 0, or 1, with which the first decision of an episode hovers."""
    heading: Literal["goal", "flight"] = "goal"
    """Where the drone and its camera turn to. `goal`: towards the goal. `flight`: towards where a move flies;
    needs `position` to be false."""
    heading_hold_m: float = 2.0
    """Within this horizontal distance of the goal the heading setpoint is held (`goal`)."""
    position: bool = True
    """Whether the drone knows where it is in the flight volume, its height included. If not, it knows the way to the
    goal ahead and to the left in place of the horizontal distance. It knows its heading in any case."""
    reward: Literal["sparse", "progress", "potential", "geodesic"] = "progress"
    """`sparse`: Eq. 8. `progress`: adds metres gained. `potential`: the policy-invariant form. `geodesic`: as
    `progress`, with metres along the shortest way around obstacles, which training alone knows: all its missions in a
    world then end at that world's own goal, and what is not training counts straight metres."""
    progress_weight: float = 3.0
    """Reward per metre gained towards the goal (`progress`, `geodesic`, `potential`)."""
    path_weight: float = 1.5
    """Reward lost per metre flown (`progress`, `geodesic`), so that detours cost something."""
    potential_discount: float = 0.97
    """gamma of the potential (`potential`), the same as `agent.discount`: with another, another policy is the best."""
    goal_reward: float = 100.0
    """Reward at the goal (Eq. 8)."""
    collision_reward: float = -100.0
    """Reward at a collision (Eq. 8); random worlds on a GPU have -300."""
    left_volume_reward: float = -100.0
    """Reward for leaving the flight volume; Eq. 8 says 0, and the `paper` preset does too."""
    step_reward: float = -0.2
    """Reward of every decision; Eq. 8 says 0."""


@dataclass(frozen=True)
class AirConfig:
    """Wind, gusts and drag. With wind, gusts and `drag` off there is no air."""

    wind_m_s: float = 0.0
    """Largest steady wind, m/s; an episode's is level, of a speed from 0 to this in any direction. 0 is off."""
    gusts_m_s: float = 0.0
    """Standard deviation of either horizontal component of the gusts, m/s (Dryden's model in MIL-F-8785C). 0 is off."""
    gust_height_m: float = 10.0
    """Height above ground whose gusts are flown in, metres; it sets their lengths and how strong vertical ones are."""
    gust_airspeed_m_s: float = 5.0
    """Speed at which gusts pass by, m/s; with their lengths it sets how quickly they change."""
    drag: bool = False
    """Drag in still air, too; wind and gusts bring it in any case."""
    linear_drag_kg_s: float = 0.4
    """Drag of the rotors per airspeed, newtons per m/s."""
    drag_area_m2: float = 0.05
    """Drag coefficient times area of the body, m^2, from any side; its drag grows with the square of the airspeed."""


@dataclass(frozen=True)
class BodyConfig:
    """How the flown body differs from the airframe that the controller believes in, drawn for each episode."""

    mass_share: float = 0.0
    """Largest deviation of the mass, as a share of it; 0.2 is +-20 %. 0 is off."""
    inertia_share: float = 0.0
    """Largest deviation of the inertia, the same for all axes, as a share of it. 0 is off."""


@dataclass(frozen=True)
class MotorsConfig:
    """How motors differ from ideal ones, drawn for each episode; the controller does not know of it."""

    gain_share: float = 0.0
    """Largest deviation of each rotor's thrust, as a share of it; 0.2 is +-20 %. 0 is off."""
    lag_s: float = 0.0
    """Largest time constant with which thrusts follow their commands, seconds; an episode's is from 0 to this, the same
    for all rotors. 0 is off."""


@dataclass(frozen=True)
class NoiseConfig:
    """Errors of what the drone knows of its own position and velocity; what it does is not changed by them."""

    position_m: float = 0.0
    """Standard deviation of the noise on each coordinate of the own position, metres, anew at each decision."""
    velocity_m_s: float = 0.0
    """Standard deviation of the noise on each coordinate of the own velocity, m/s, anew at each decision."""
    position_bias_m: float = 0.0
    """Standard deviation of an error of each coordinate of the own position, metres, that stays for an episode."""
    velocity_bias_m_s: float = 0.0
    """Standard deviation of an error of each coordinate of the own velocity, m/s, that stays for an episode."""


@dataclass(frozen=True)
class LightConfig:
    """How much light there is, drawn for each episode. With 0 and 0 there is always enough for every sensor."""

    least_lux: float = 0.0
    """Least illuminance of a surface that faces the sun, lux; an episode's is log-uniform from this to `most_lux`. From
    0.1 on; 0 is off."""
    most_lux: float = 0.0
    """Most illuminance, lux; up to 10000, and 0 is off."""


@dataclass(frozen=True)
class ExposureConfig:
    """How a camera takes the frames of the sensors `frames` and `frame-pair`."""

    real: bool = False
    """Whether frames have an exposure time, motion blur, noise and 8 bits; needs `light`. If not, they are perfect."""
    shortest_s: float = 1e-4
    """Shortest exposure, seconds; the camera chooses it by the light."""
    longest_s: float = 0.02
    """Longest exposure, seconds."""
    target: float = 0.4
    """Mean level of a picture that exposure and gain are set for, as a share of white."""
    most_gain: float = 4.0
    """Largest gain, where the longest exposure is not enough; it amplifies noise, too."""
    sub_frames: int = 5
    """Pictures whose mean is one exposure: motion blur has so many steps, and rendering so many times the cost."""
    sensitivity_e_lux_s: float = 6000.0
    """Electrons of a white pixel per lux and second of light on the scene."""
    full_well_e: float = 10_000.0
    """Electrons that a pixel holds; at a gain of 1 they are white."""
    read_noise_e: float = 18.0
    """Standard deviation of the read noise, electrons."""


@dataclass(frozen=True)
class EncoderConfig:
    """The event VAE (section 3.2), or the VAE of another sensor's pictures, and when it learns."""

    architecture: Literal["patches", "pooled"] = "patches"
    """`patches`: events are counted per pixel, pixels are read in patches together with the own motion, patches are
    joined. `pooled`: the paper's sum over all events, without the own motion."""
    target: Literal["nearness", "sensed", "both"] = "nearness"
    """What the decoder draws. `nearness`: how near things are, a label of the simulator that only training needs;
    `sensed`: what the sensor shows, as in the paper; `both`."""
    code_size: int = 32
    """Values in the code z."""
    patch_pixels: int = 4
    """Side of a square patch, pixels (`patches`)."""
    patch_layers: tuple[int, ...] = (32, 16)
    """Widths of the ReLU layers that all patches share (`patches`)."""
    joint_layers: tuple[int, ...] = (128, 128)
    """Widths of the ReLU layers between joined patches and code (`patches`)."""
    features: int = 48
    """Pooled features per temporal channel (`pooled`)."""
    pixel_features: Literal["table", "network"] = "network"
    """f(x, y, p): a learned table over pixels and polarities, or a ReLU network on a positional encoding (`pooled`)."""
    time_frequencies: int = 1
    """Sinusoid pairs of the temporal embedding; phi(t) has 1 + 2 x this many channels (`pooled`)."""
    hidden: int = 128
    """Width of the ReLU layer between pooled features and code (`pooled`)."""
    decoder_hidden: tuple[int, ...] = (128, 128)
    """Widths of the decoder's ReLU layers."""
    decoder_bandwidth: float = 0.5
    """Share of the image's standing waves, along each axis, that the decoder draws; 1 draws all of them."""
    target_blur: int = 2
    """How many times the decoder's target is blurred by a binomial of three pixels; 0 is the sharp event image."""
    kl_weight: float = 0.05
    """beta: weight of the KL term per image against the reconstruction error per image."""
    learning_rate: float = 2e-3
    """Adam step size of the VAE."""
    warmup_decisions: int = 16_384
    """Decisions of the warm-up, random manoeuvres from which the VAE learns before the DQN starts; at most a quarter of
    all decisions. Unused by the sensors `event-image`, `ranges` and `blind`, which have no VAE."""
    warmup_updates_per_step: int = 6
    """VAE updates per training step of the warm-up."""
    batch_size: int = 256
    """Observations in a VAE update, drawn from the newest `replay_size`; a multiple of `train.shards`."""
    replay_size: int = 16_384
    """Observations that the VAE learns from, with what its decoder must draw of each."""
    mirror: bool = True
    """Mirror half of the observations of a VAE update left to right."""
    hold_decisions: int = 4
    """Mean length of a random manoeuvre of the warm-up, decisions."""
    retrain_at: tuple[float, ...] = ()
    """Shares of all decisions at which the VAE is trained again, on flights of the policy and at first on what is left
    of those before. The agent then uses the new encoder, and the replay starts anew, so that codes of two encoders are
    never mixed. A retraining that would leave the DQN less than a quarter of the run is left out."""
    retrain_decisions: int = 65_536
    """Decisions of each such training; at most an eighth of all decisions."""
    keep_learning: bool = False
    """Go on training the VAE after the warm-up, one update a training step. The agent does not use what it learns then,
    unless `retrain_at` says so. Unused where there is no VAE."""


@dataclass(frozen=True)
class AgentConfig:
    """What chooses moves: the deep Q-network (section 3.3, Eq. 7-10), or another learner."""

    learner: str = "dqn"
    """How it learns."""
    network: str = "mlp"
    """The Q-network."""
    hidden: tuple[int, ...] = (128, 128)
    """Widths of the hidden layers."""
    history: int = 2
    """Observations in the Q-network's input, the newest included."""
    last_move: bool = False
    """Whether the Q-network also sees the last move that was chosen; with `env.action_delay` it is yet to be flown."""
    code_scale: float = 0.5
    """Factor on the code before the Q-network, so that it does not outweigh the own state."""
    layer_norm: bool = False
    """Layer normalisation after each hidden layer."""
    dueling: bool = True
    """Dueling heads (Wang et al. 2016)."""
    double: bool = True
    """Double DQN targets (van Hasselt et al. 2016)."""
    n_step: int = 3
    """Steps of the return before the bootstrap."""
    discount: float = 0.97
    """gamma."""
    target_rate: float = 0.02
    """Polyak tau of the target network, per update."""
    average_rate: float = 0.002
    """Polyak rate, per update, of the averaged parameters that evaluation uses; 1 uses the newest parameters."""
    learning_rate: float = 1e-3
    """Adam step size at the start."""
    final_learning_rate: float = 1e-4
    """Adam step size at the end of training (linear decay)."""
    max_gradient_norm: float = 10.0
    """The global gradient norm is clipped to this."""
    huber_delta: float = 0.0
    """TD errors beyond this, in units of scaled reward, enter the loss linearly; 0 is the pure square of Eq. 9."""
    reward_scale: float = 0.02
    """Rewards are multiplied by this before learning."""
    batch_size: int = 256
    """Replayed samples per update."""
    updates_per_step: int = 8
    """Updates per training step (a training step is one decision of every environment)."""
    replay_size: int = 262_144
    """Observations that the replay holds."""
    turn: bool = False
    """Turn what is drawn from the replay by random quarter turns about the vertical, drone and world alike. Only for
    random worlds, which have no preferred direction but the sun's; a map that stays the same would be blurred. Off
    where a reward function of one's own is given, which may prefer one."""
    learning_starts: int = 8192
    """Observations in the replay before the first update."""
    random_decisions: int = 1000
    """Random decisions, of all environments together, before epsilon begins to fall."""
    exploration_start: float = 1.0
    """epsilon at the start."""
    exploration_end: float = 0.02
    """epsilon at the end."""
    exploration_fraction: float = 0.1
    """Share of the DQN phase over which epsilon falls linearly; unused when `exploration_episodes` > 0."""
    exploration_episodes: int = 0
    """Episodes per environment over which epsilon falls (`Max_eps_episode` of Table 1); 0 uses the fraction."""


@dataclass(frozen=True)
class PqnConfig:
    """PQN, `agent.learner pqn` (Gallici et al. 2024). It also reads network, discount, step sizes and exploration of
    `agent`.
    """

    rollout: int = 32
    """Decisions of each environment between learning."""
    epochs: int = 4
    """Passes over a rollout."""
    minibatches: int = 32
    """Updates of one pass; must divide `rollout` times the environments of a shard."""
    trace: float = 0.65
    """lambda of the returns; 0 looks one decision ahead."""
    average_rate: float = 0.01
    """Polyak rate, per update, of the averaged parameters that evaluation uses; 1 uses the newest parameters."""


@dataclass(frozen=True)
class TrainConfig:
    """The training run."""

    num_envs: int = 256
    """Parallel environments; a multiple of `shards`."""
    total_steps: int = 500_000
    """Decisions in all, warm-up included; rounded up to whole chunks."""
    schedule_steps: int = 0
    """Decisions that exploration, step size and retraining are planned for; what comes after them goes on as at their
    end. 0 is `total_steps`; a run that is continued beyond its end has its first total here."""
    max_episodes: int = 0
    """Stop after this many episodes as well (`Num_episodes` of Table 1); 0 is no limit."""
    chunk_steps: int = 64
    """Training steps in one compiled chunk."""
    shards: int = 8
    """Logical shards of environments and replay; the number of devices must divide it."""
    devices: int = 0
    """Devices to use; 0 uses the largest number that divides the shards."""
    seed: int = 0
    """Random seed of the run."""
    validation_every: int = 98_304
    """Decisions between validations, rounded up to whole chunks; 0 validates only at the end."""
    validation_missions: int = 128
    """Missions of each validation, and of the flights at the end, the first of which is in `world.flown`; in worlds
    from a file half of them begin near the world's start, or as many as in training (`world.own_start_fraction`) if
    that is more."""
    keep: Literal["best", "last"] = "best"
    """Parameters that the run keeps: those of the best validation (by SPL, the latest of equal ones), or the last."""
    checkpoint_every_s: float = 15.0
    """Seconds between checkpoints, from which an interrupted run is continued; more where saving one takes longer than
    3 % of that. There is one at the end, too; 0 saves none."""
    checkpoints: int = 2
    """Newest checkpoints that are kept."""
    debug: bool = False
    """Check every index, number, random key and shape of training; the first fault ends the run and is named. One
    device, and drones one after the other: for few environments."""


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
    train: TrainConfig = field(default_factory=TrainConfig)


CONDITIONS: dict[str, tuple[str, ...]] = {
    "env": ("action_delay", "drones"),
    "events": (
        *("profile", "threshold", "tolerance", "contrast_on", "contrast_off", "refractory_ns", "bandwidth_hz"),
        *("threshold_mismatch", "leak_rate_hz", "shot_rate_hz", "hot_pixel_fraction", "hot_pixel_rate_hz"),
        "reference_lux",
    ),
    **{
        group: tuple(option.name for option in fields(kind))
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
