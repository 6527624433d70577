"""Options of what is flown and seen: worlds, drone, camera, sensors, task and disturbances."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Annotated, Literal

from edqn_jax.config.limits import (
    BELOW_1,
    COUNT,
    DEVIATION,
    FINITE,
    LAST_AT_0,
    LEAST_AND_MOST,
    NOT_NEGATIVE,
    ON_OR_OFF,
    POSITIVE,
    RATE,
    RISING_TIMES,
    SHARE,
    SHARES,
    TWO_TIMES,
    Limit,
    at_least,
    at_most,
    between,
    less_than,
    one_of,
)


@dataclass(frozen=True)
class WorldConfig:
    """Where to train and to fly."""

    name: str = "paper"
    """Where to train: `paper`, the path of an MJCF file, or random worlds."""
    flown: str = ""
    """World of the flight at the end of a run in random worlds: `paper` or the path of an MJCF file; training never
    uses it. Empty: the first test world. A world from a file is flown itself."""
    pool_size: Annotated[int, COUNT, at_most(1_000_000)] = 1024
    """Random training worlds, drawn before training (in random worlds only)."""
    missions: Annotated[int, COUNT, at_most(1_000_000)] = 8192
    """(world, start, goal) triples, generated before training, that resets draw from."""
    own_start_fraction: Annotated[float, SHARE] = 0.25
    """Share of training missions that begin within `start_jitter_m` of the world's own start."""
    start_jitter_m: Annotated[float, NOT_NEGATIVE] = 1.0
    """Half width of the box around the world's own start that such starts are drawn from, metres."""
    moving_share: Annotated[float, SHARE] = 0.0
    """Share of the obstacles of random worlds that move; 0 is none, and one half in the worlds `moving`."""
    # A random start is free of what moves as fast as this for the first two seconds (`sim/worlds/free_points.py`).
    moving_speed_m_s: Annotated[float, POSITIVE, at_most(5)] = 3.0
    """Speed of the fastest of them, m/s; each has its own, of at least 0.3 times this."""
    balls: Annotated[int, NOT_NEGATIVE, at_most(64)] = 0
    """Balls in each random world, thrown at where the drone will be if it goes on as it flies then."""
    ball_speed_m_s: Annotated[float, at_most(100), at_least(2)] = 6.0
    """Speed of these balls, m/s; of the fastest where `ball_slowest` is below 1."""
    ball_slowest: Annotated[float, RATE] = 1.0
    """Speed of the slowest ball in shares of `ball_speed_m_s`; each has its own."""
    ball_seconds: Annotated[tuple[float, float], LEAST_AND_MOST] = (1.5, 3.0)
    """How long before it would meet the drone a ball is launched: least and most, seconds. The slowest must fly 1.5 m
    in the least."""
    ball_radii_m: Annotated[tuple[float, float], LEAST_AND_MOST] = (0.3, 0.5)
    """Least and largest radius of these balls, metres."""
    ball_gravity_m_s2: Annotated[float, NOT_NEGATIVE] = 0.0
    """Gravity that bends their way, m/s^2; at 0 they fly straight."""


@dataclass(frozen=True)
class DroneConfig:
    """The airframe and its inner loops: velocity, attitude and body rate, all at the physics rate."""

    airframe: str = "skydio_x2"
    """Mass, inertia and rotors."""
    physics: Literal["mjx", "rigid_body"] = "mjx"
    """Physics engine. `rigid_body`: the closed form of MJX's equations for this airframe, which compiles sooner."""
    physics_dt_s: Annotated[float, POSITIVE] = 0.02
    """Physics step, seconds."""
    physics_steps: Annotated[int, COUNT] = 13
    """Physics steps per decision: 13 x 0.02 s = 0.26 s."""
    body_radius_m: Annotated[float, POSITIVE] = 0.36
    """Radius of the sphere that must not touch anything, metres."""
    velocity_gain: Annotated[float, POSITIVE] = 4.5
    """Commanded horizontal acceleration per velocity error, 1/s."""
    climb_gain: Annotated[float, POSITIVE] = 6.0
    """Commanded vertical acceleration per velocity error, 1/s."""
    attitude_gain: Annotated[float, POSITIVE] = 10.0
    """Commanded body rate per tilt error, 1/s."""
    rate_gain: Annotated[float, POSITIVE] = 20.0
    """Commanded angular acceleration per error of the rates about x and y, 1/s."""
    yaw_gain: Annotated[float, POSITIVE] = 3.0
    """Commanded yaw rate per heading error, 1/s."""
    yaw_rate_gain: Annotated[float, POSITIVE] = 10.0
    """Commanded angular acceleration per error of the rate about z, 1/s."""
    max_body_rate_rad_s: Annotated[float, POSITIVE] = 6.0
    """Largest combined rate about x and y that the attitude loop may command, rad/s."""
    max_tilt_rad: Annotated[float, POSITIVE, less_than(math.pi / 2, "pi/2")] = 1.15
    """Largest tilt that the velocity loop may command, radians."""
    max_horizontal_m_s2: Annotated[float, POSITIVE] = 12.0
    """Largest horizontal acceleration that the velocity loop may command, m/s^2."""
    max_climb_m_s2: Annotated[float, POSITIVE] = 10.0
    """Largest upward acceleration that the velocity loop may command, m/s^2."""
    max_descent_m_s2: Annotated[float, POSITIVE, less_than(9.81, "gravity, 9.81")] = 6.5
    """Largest downward acceleration that the velocity loop may command, m/s^2; below gravity."""
    max_tilt_share: Annotated[float, POSITIVE] = 0.8
    """Share of a rotor's range that torque about x and y may use; the rest is left to collective thrust."""
    max_yaw_rate_rad_s: Annotated[float, POSITIVE] = 2.0
    """Rate limit of the yaw setpoint, and largest yaw rate that the heading loop may command, rad/s."""


@dataclass(frozen=True)
class CameraConfig:
    """A pinhole camera at the body's centre."""

    width: Annotated[int, COUNT, at_most(1024)] = 32
    """Pixels across."""
    height: Annotated[int, COUNT, at_most(1024)] = 24
    """Pixels down."""
    horizontal_fov_deg: Annotated[float, between(1, 170)] = 90.0
    """Horizontal field of view, degrees."""
    mount: Literal["level", "body"] = "level"
    """`level`: a gimbal removes roll and pitch. `body`: the camera takes the full attitude."""
    samples_across: Annotated[int, COUNT, at_most(16)] = 3
    """Rays per pixel across; texture is filtered analytically, rays only resolve silhouettes."""
    samples_down: Annotated[int, COUNT, at_most(16)] = 2
    """Rays per pixel down."""
    texture_contrast: Annotated[float, DEVIATION] = 0.35
    """Amplitude of the procedural surface texture relative to the surface's brightness."""
    texture_period_m: Annotated[float, POSITIVE] = 1.5
    """Period of the finer texture octave, metres; the coarser one is four times as long."""
    ambient: Annotated[float, SHARE] = 0.4
    """Share of a surface's brightness that does not depend on the sun."""
    sun_azimuth_deg: Annotated[float, FINITE] = 205.0
    """Direction towards the sun in the world's xy plane, degrees from +x."""
    sun_elevation_deg: Annotated[float, between(0, 90)] = 50.0
    """Height of the sun over the horizon, degrees."""
    shadows: bool = False
    """Whether shapes cast shadows: what the sun does not reach has the ambient light alone."""
    sky_rgb: Annotated[tuple[float, float, float], SHARES] = (0.62, 0.74, 0.9)
    """Brightness of the sky."""


LOOKS = ("plaid", "drawn", "blank", "waves", "noise", "checks", "spots", "bricks", "posters", "wood")
"""Values of `surface.pattern`."""


@dataclass(frozen=True)
class SurfaceConfig:
    """What the faces of the shapes of a world look like; geometry is the same under every pattern."""

    pattern: Annotated[str, one_of(LOOKS)] = "plaid"
    """`plaid`: one for all, of `camera.texture_*`. For each shape its own: `drawn` (any of the next five), `blank`,
    `waves`, `noise`, `checks`, `spots`; for tests, never among `drawn`: `bricks`, `posters`, `wood`. With a sun and a
    sky for each world."""
    contrast: Annotated[float, SHARE] = 0.8
    """Most amplitude of a pattern relative to the surface's brightness; a shape's is uniform from 0 to this."""
    shortest_m: Annotated[float, between(0.05, 100)] = 0.2
    """Shortest period of waves, noise, checks and spots, metres; a shape's is log-uniform."""
    longest_m: Annotated[float, between(0.05, 100)] = 10.0
    """Longest period, metres."""


@dataclass(frozen=True)
class EventsConfig:
    """From a pair of log-brightness frames to events (Eq. 2-5)."""

    law: Literal["paper", "airsim", "esim"] = "paper"
    """Event law: the paper's, AirSim's (equal to its simulator event by event), or ESIM's, a sensor with memory."""
    profile: Literal["ideal", "dvs", "dark"] = "ideal"
    """Named sensor whose figures take the place of thresholds, refractory period, bandwidth and noise; options that are
    given beside it change one. `ideal`: no faults. `dvs`: the noisy sensor of v2e in 2021. `dark`: in low light."""
    frame_times_s: Annotated[tuple[float, ...], TWO_TIMES, LAST_AT_0, RISING_TIMES] = (-0.04, 0.0)
    """When frames are rendered relative to the decision, seconds; each must be a physics step."""
    stream: bool = False
    """Whether a window begins where the one before ended, so that `esim` and slow photoreceptors remember all that was
    seen. `frame_times_s` must then begin with the decision, at -0.26; with every physics step, nothing is missed."""
    threshold: Annotated[float, POSITIVE] = 0.05
    """Th of Eq. 2 (`paper`): log-brightness change that makes events."""
    tolerance: Annotated[float, POSITIVE] = 0.05
    """TOL of Eq. 4 (`paper`): log-brightness change per event."""
    contrast_on: Annotated[float, POSITIVE] = 0.05
    """C+ (`esim`): log-brightness rise per event."""
    contrast_off: Annotated[float, POSITIVE] = 0.05
    """C- (`esim`): log-brightness fall per event."""
    airsim_tolerance: Annotated[float, POSITIVE] = 0.5
    """TOL of AirSim's event simulator (`airsim`)."""
    refractory_ns: Annotated[float, NOT_NEGATIVE] = 1000.0
    """Refractory period, nanoseconds; caps a pixel's events in a window (Eq. 3). 0 is no cap."""
    log_epsilon: Annotated[float, POSITIVE] = 1e-3
    """Added to brightness in [0, 1] before the logarithm of Eq. 1."""
    bandwidth_hz: Annotated[float, NOT_NEGATIVE] = 0.0
    """Cutoff frequency of a white pixel's photoreceptor, which lags behind the light; a darker pixel's is lower in
    proportion. 0 is infinite."""
    threshold_mismatch: Annotated[float, NOT_NEGATIVE] = 0.0
    """Standard deviation of the per-pixel threshold relative to the threshold; 0 is a perfect sensor."""
    leak_rate_hz: Annotated[float, NOT_NEGATIVE] = 0.0
    """Leakage noise: ON events per pixel and second."""
    shot_rate_hz: Annotated[float, NOT_NEGATIVE] = 0.0
    """Shot noise: events of either polarity per pixel and second."""
    hot_pixel_fraction: Annotated[float, SHARE] = 0.0
    """Share of pixels that are hot: they fire at `hot_pixel_rate_hz` without any change of brightness."""
    hot_pixel_rate_hz: Annotated[float, NOT_NEGATIVE] = 50.0
    """Events per second of a hot pixel."""
    reference_lux: Annotated[float, POSITIVE] = 10.0
    """Illuminance in which `bandwidth_hz` and `shot_rate_hz` are a white and a black pixel's, where `light` is on."""
    least_contrast: Annotated[float, NOT_NEGATIVE] = 0.0
    """Least contrast of a sensor that is drawn for each episode and known to the networks, log-uniform from this to
    `most_contrast`: the thresholds of the law scale with it. From 0.01 on; 0 is off: thresholds are those above."""
    most_contrast: Annotated[float, NOT_NEGATIVE] = 0.0
    """Most contrast, log-brightness change per event; up to 1, and 0 is off."""
    faults_share: Annotated[float, SHARE] = 0.0
    """How far an episode's sensor may be better than this one: its share of mismatch, noise, refractory period and
    smear is uniform from 1 minus this to 1. 0 is off."""
    sensor_pixels: Annotated[int, COUNT, at_most(1000)] = 1
    """Pixels of the real sensor that one of ours stands for: 117 for 346 x 260 over 32 x 24. Counts are then the mean
    of so many pixels, whose faults average out; laws `paper` and `esim`."""


@dataclass(frozen=True)
class EnvConfig:
    """The task: sensor, actions, outcomes, reward."""

    sensor: str = "events"
    """What the drone observes besides its own state."""
    actions: str = "moves"
    """What an action commands. `edqn train` learns moves alone."""
    speed_m_s: Annotated[float, POSITIVE] = 4.0
    """Commanded speed per axis of a move, in the heading frame."""
    goal_radius_m: Annotated[float, POSITIVE] = 2.0
    """Body centre within this distance of the goal, at any physics step, is success."""
    max_decisions: Annotated[int, COUNT] = 200
    """Episode limit in decisions (the `threshold` of Table 1)."""
    drones: Annotated[int, Limit("from 1 to 8", lambda value: 1 <= value <= 8)] = 1
    """Drones that fly together in one world, with missions that cross, at most 8; each sees and hits the others. As
    many environments in a row, and as many missions, are one group (docs/several_drones.md)."""
    action_delay: Annotated[int, ON_OR_OFF] = 0
    """Decisions between choosing a move and flying it: 0, or 1, with which the first decision of an episode hovers."""
    delay_share: Annotated[float, RATE] = 1.0
    """Share of the episodes, drawn for each, in which `action_delay` delays."""
    setpoint_m_s2: Annotated[float, NOT_NEGATIVE] = 0.0
    """Least rate at which an autopilot lets the velocity it holds change, m/s^2; an episode's is between this and any,
    its inverse uniform. 0 is off: the commanded velocity is held at once."""
    setpoint_share: Annotated[float, RATE] = 1.0
    """Share of the episodes, drawn for each, in which `setpoint_m_s2` limits."""
    heading: Literal["goal", "flight"] = "goal"
    """Where the drone and its camera turn to. `goal`: towards the goal. `flight`: towards where a move flies;
    needs `position` to be false."""
    heading_hold_m: Annotated[float, NOT_NEGATIVE] = 2.0
    """Within this horizontal distance of the goal the heading setpoint is held (`goal`)."""
    position: bool = True
    """Whether the drone knows where it is in the flight volume, its height included. If not, it knows the way to the
    goal ahead and to the left in place of the horizontal distance. It knows its heading in any case."""
    reward: Literal["sparse", "progress", "potential", "geodesic"] = "progress"
    """`sparse`: Eq. 8. `progress`: adds metres gained. `potential`: the policy-invariant form. `geodesic`: as
    `progress`, with metres along the shortest way around obstacles, which training alone knows: all its missions in a
    world then end at that world's own goal, and what is not training counts straight metres."""
    progress_weight: Annotated[float, NOT_NEGATIVE] = 3.0
    """Reward per metre gained towards the goal (`progress`, `geodesic`, `potential`)."""
    path_weight: Annotated[float, NOT_NEGATIVE] = 1.5
    """Reward lost per metre flown (`progress`, `geodesic`), so that detours cost something."""
    closeness_weight: Annotated[float, NOT_NEGATIVE] = 0.0
    """Reward lost by a decision that ends at an obstacle; less in proportion to the clearance, and none from
    `closeness_m` on. 0 is off, in any reward."""
    closeness_m: Annotated[float, POSITIVE] = 0.6
    """Clearance of the body's sphere from which on closeness costs nothing, metres."""
    potential_discount: Annotated[float, SHARE] = 0.97
    """gamma of the potential (`potential`), the same as `agent.discount`: with another, another policy is the best."""
    goal_reward: Annotated[float, FINITE] = 100.0
    """Reward at the goal (Eq. 8)."""
    collision_reward: Annotated[float, FINITE] = -100.0
    """Reward at a collision (Eq. 8); random worlds on a GPU have -300."""
    left_volume_reward: Annotated[float, FINITE] = -100.0
    """Reward for leaving the flight volume; Eq. 8 says 0, and the `paper` preset does too."""
    step_reward: Annotated[float, FINITE] = -0.2
    """Reward of every decision; Eq. 8 says 0."""


@dataclass(frozen=True)
class AirConfig:
    """Wind, gusts and drag. With wind, gusts and `drag` off there is no air."""

    wind_m_s: Annotated[float, between(0, 100)] = 0.0
    """Largest steady wind, m/s; an episode's is level, of a speed from 0 to this in any direction. 0 is off."""
    gusts_m_s: Annotated[float, between(0, 100)] = 0.0
    """Standard deviation of either horizontal component of the gusts, m/s (Dryden's model in MIL-F-8785C). 0 is off."""
    # What MIL-F-8785C has formulas for: 10 to 1000 feet.
    gust_height_m: Annotated[float, between(3.048, 304.8)] = 10.0
    """Height above ground whose gusts are flown in, metres; it sets their lengths and how strong vertical ones are."""
    gust_airspeed_m_s: Annotated[float, between(0.1, 100)] = 5.0
    """Speed at which gusts pass by, m/s; with their lengths it sets how quickly they change."""
    drag: bool = False
    """Drag in still air, too; wind and gusts bring it in any case."""
    linear_drag_kg_s: Annotated[float, NOT_NEGATIVE] = 0.4
    """Drag of the rotors per airspeed, newtons per m/s."""
    drag_area_m2: Annotated[float, NOT_NEGATIVE] = 0.05
    """Drag coefficient times area of the body, m^2, from any side; its drag grows with the square of the airspeed."""


@dataclass(frozen=True)
class BodyConfig:
    """How the flown body differs from the airframe that the controller believes in, drawn for each episode."""

    mass_share: Annotated[float, DEVIATION] = 0.0
    """Largest deviation of the mass, as a share of it; 0.2 is +-20 %. 0 is off."""
    inertia_share: Annotated[float, DEVIATION] = 0.0
    """Largest deviation of the inertia, the same for all axes, as a share of it. 0 is off."""


@dataclass(frozen=True)
class MotorsConfig:
    """How motors differ from ideal ones, drawn for each episode; the controller does not know of it."""

    gain_share: Annotated[float, DEVIATION] = 0.0
    """Largest deviation of each rotor's thrust, as a share of it; 0.2 is +-20 %. 0 is off."""
    lag_s: Annotated[float, NOT_NEGATIVE] = 0.0
    """Largest time constant with which thrusts follow their commands, seconds; an episode's is from 0 to this, the same
    for all rotors. 0 is off."""


@dataclass(frozen=True)
class NoiseConfig:
    """Errors of what the drone knows of its own position and velocity; what it does is not changed by them."""

    position_m: Annotated[float, NOT_NEGATIVE] = 0.0
    """Standard deviation of the noise on each coordinate of the own position, metres, anew at each decision."""
    velocity_m_s: Annotated[float, NOT_NEGATIVE] = 0.0
    """Standard deviation of the noise on each coordinate of the own velocity, m/s, anew at each decision."""
    position_bias_m: Annotated[float, NOT_NEGATIVE] = 0.0
    """Standard deviation of an error of each coordinate of the own position, metres, that stays for an episode."""
    velocity_bias_m_s: Annotated[float, NOT_NEGATIVE] = 0.0
    """Standard deviation of an error of each coordinate of the own velocity, m/s, that stays for an episode."""


@dataclass(frozen=True)
class LightConfig:
    """How much light there is, drawn for each episode. With 0 and 0 there is always enough for every sensor."""

    least_lux: Annotated[float, NOT_NEGATIVE] = 0.0
    """Least illuminance of a surface that faces the sun, lux; an episode's is log-uniform from this to `most_lux`. From
    0.1 on; 0 is off."""
    most_lux: Annotated[float, NOT_NEGATIVE] = 0.0
    """Most illuminance, lux; up to 10000, and 0 is off."""
    told: bool = False
    """Whether the networks know the episode's illuminance, of sensors that depend on it."""


@dataclass(frozen=True)
class ExposureConfig:
    """How a camera takes the frames of the sensors `frames` and `frame-pair`."""

    rate_hz: Annotated[float, Limit("0, or from 1 to 1000", lambda value: value == 0 or 1 <= value <= 1000)] = 0.0
    """Frames a second, at a phase that is drawn for each episode: a decision sees the newest that is there, and the one
    before it that is nearest to `events.frame_times_s`. 0: frames end exactly at these times."""
    latency_s: Annotated[float, between(0, 1)] = 0.0
    """Seconds from the end of an exposure until the frame is there, for readout and transfer."""
    real: bool = False
    """Whether frames have an exposure time, motion blur, noise and levels; needs `light`. If not, they are perfect."""
    shortest_s: Annotated[float, POSITIVE] = 1e-4
    """Shortest exposure, seconds; the camera chooses it by the light."""
    longest_s: Annotated[float, POSITIVE] = 0.02
    """Longest exposure, seconds; never longer than the period of `rate_hz`."""
    target: Annotated[float, BELOW_1] = 0.4
    """Mean level of a picture that exposure and gain are set for, as a share of white."""
    most_gain: Annotated[float, between(1, 1000)] = 4.0
    """Largest gain, where the longest exposure is not enough; it amplifies noise, too."""
    sub_frames: Annotated[int, COUNT, at_most(64)] = 5
    """Pictures whose mean is one exposure: motion blur has so many steps, and rendering so many times the cost."""
    sensitivity_e_lux_s: Annotated[float, POSITIVE] = 6000.0
    """Electrons of a white pixel per lux and second of light on the scene."""
    full_well_e: Annotated[float, POSITIVE] = 10_000.0
    """Electrons that a pixel holds; at a gain of 1 they are white."""
    read_noise_e: Annotated[float, NOT_NEGATIVE] = 18.0
    """Standard deviation of the read noise, electrons."""
    bits: Annotated[int, Limit("8, 10 or 12", lambda value: value in (8, 10, 12))] = 8
    """Bits of a level."""
    metering_s: Annotated[float, NOT_NEGATIVE] = 0.0
    """Time constant with which exposure follows the brightness of the pictures, seconds. 0: the last decision's picture
    alone sets it."""
