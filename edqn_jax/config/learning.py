"""Options of what learns: perception, learners and the training run."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Literal

from edqn_jax.config.limits import (
    COUNT,
    GRADIENT_NORM,
    NOT_NEGATIVE,
    POSITIVE,
    RATE,
    RISING_SHARES,
    SHARE,
    WIDTHS,
    at_most,
    less_than,
)


@dataclass(frozen=True)
class EncoderConfig:
    """The event VAE (section 3.2), or the VAE of another sensor's pictures, and when it learns."""

    architecture: str = "patches"
    """How the encoder reads what the sensor shows."""
    target: Literal["nearness", "sensed", "both"] = "nearness"
    """What the decoder draws. `nearness`: how near things are, a label of the simulator that only training needs;
    `sensed`: what the sensor shows, as in the paper; `both`."""
    levelled: bool = False
    """Whether the events of a camera on the body are moved to where a level one would have them, by roll and pitch,
    before they are encoded; the label is drawn level then, too."""
    code_size: Annotated[int, COUNT] = 32
    """Values in the code z."""
    patch_pixels: Annotated[int, COUNT] = 4
    """Side of a square patch, pixels (`patches`)."""
    patch_overlap: Annotated[int, NOT_NEGATIVE] = 0
    """Pixels by which a patch reaches into those around it, on each side (`patches`)."""
    patch_layers: Annotated[tuple[int, ...], WIDTHS] = (32, 16)
    """Widths of the ReLU layers that all patches share (`patches`)."""
    joint_layers: Annotated[tuple[int, ...], WIDTHS] = (128, 128)
    """Widths of the ReLU layers between joined patches and code (`patches`)."""
    features: Annotated[int, COUNT] = 48
    """Pooled features per temporal channel (`pooled`)."""
    pixel_features: Literal["table", "network"] = "network"
    """f(x, y, p): a learned table over pixels and polarities, or a ReLU network on a positional encoding (`pooled`)."""
    time_frequencies: Annotated[int, NOT_NEGATIVE] = 1
    """Sinusoid pairs of the temporal embedding; phi(t) has 1 + 2 x this many channels (`pooled`)."""
    hidden: Annotated[int, COUNT] = 128
    """Width of the ReLU layer between pooled features and code (`pooled`)."""
    decoder_hidden: Annotated[tuple[int, ...], WIDTHS] = (128, 128)
    """Widths of the decoder's ReLU layers."""
    decoder_bandwidth: Annotated[float, RATE] = 0.5
    """Share of the image's standing waves, along each axis, that the decoder draws; 1 draws all of them."""
    target_blur: Annotated[int, NOT_NEGATIVE] = 2
    """How many times the decoder's target is blurred by a binomial of three pixels; 0 is the sharp event image."""
    kl_weight: Annotated[float, NOT_NEGATIVE] = 0.05
    """beta: weight of the KL term per image against the reconstruction error per image."""
    learning_rate: Annotated[float, POSITIVE] = 2e-3
    """Adam step size of the VAE."""
    final_learning_rate: Annotated[float, NOT_NEGATIVE] = 0.0
    """Step size at the end of the warm-up and of each retraining, to which it changes linearly in each of them; 0 keeps
    `learning_rate`."""
    warmup_decisions: Annotated[int, NOT_NEGATIVE] = 16_384
    """Decisions of the warm-up, random manoeuvres from which the VAE learns before the DQN starts; at most a quarter of
    all decisions. Unused by the sensors `event-image`, `ranges` and `blind`, which have no VAE."""
    warmup_updates_per_step: Annotated[int, COUNT] = 6
    """VAE updates per training step of the warm-up."""
    batch_size: Annotated[int, COUNT] = 256
    """Observations in a VAE update, drawn from the newest `replay_size`; a multiple of `train.shards`."""
    replay_size: Annotated[int, COUNT] = 16_384
    """Observations that the VAE learns from, with what its decoder must draw of each."""
    mirror: bool = True
    """Mirror half of the observations of a VAE update left to right."""
    hold_decisions: Annotated[int, COUNT] = 4
    """Mean length of a random manoeuvre of the warm-up, decisions."""
    retrain_at: Annotated[tuple[float, ...], RISING_SHARES] = ()
    """Shares of all decisions at which the VAE is trained again, on flights of the policy and at first on what is left
    of those before. The agent then uses the new encoder, and the replay starts anew, so that codes of two encoders are
    never mixed. A retraining that would leave the DQN less than a quarter of the run is left out."""
    retrain_decisions: Annotated[int, COUNT] = 65_536
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
    hidden: Annotated[tuple[int, ...], WIDTHS] = (128, 128)
    """Widths of the hidden layers."""
    history: Annotated[int, COUNT] = 2
    """Observations in the Q-network's input, the newest included."""
    last_move: bool = False
    """Whether the Q-network also sees the last move that was chosen; with `env.action_delay` it is yet to be flown."""
    code_scale: Annotated[float, POSITIVE] = 0.5
    """Factor on the code before the Q-network, so that it does not outweigh the own state."""
    layer_norm: bool = False
    """Layer normalisation after each hidden layer."""
    dueling: bool = True
    """Dueling heads (Wang et al. 2016)."""
    double: bool = True
    """Double DQN targets (van Hasselt et al. 2016)."""
    n_step: Annotated[int, COUNT] = 3
    """Steps of the return before the bootstrap."""
    discount: Annotated[float, SHARE] = 0.97
    """gamma."""
    target_rate: Annotated[float, RATE] = 0.02
    """Polyak tau of the target network, per update."""
    average_rate: Annotated[float, RATE] = 0.002
    """Polyak rate, per update, of the averaged parameters that evaluation uses; 1 uses the newest parameters."""
    learning_rate: Annotated[float, POSITIVE] = 1e-3
    """Adam step size at the start."""
    final_learning_rate: Annotated[float, NOT_NEGATIVE] = 1e-4
    """Adam step size at the end of training (linear decay)."""
    max_gradient_norm: Annotated[float, GRADIENT_NORM] = 10.0
    """The global gradient norm is clipped to this."""
    huber_delta: Annotated[float, NOT_NEGATIVE] = 0.0
    """TD errors beyond this, in units of scaled reward, enter the loss linearly; 0 is the pure square of Eq. 9."""
    reward_scale: Annotated[float, POSITIVE] = 0.02
    """Rewards are multiplied by this before learning."""
    batch_size: Annotated[int, COUNT] = 256
    """Replayed samples per update."""
    updates_per_step: Annotated[int, COUNT] = 8
    """Updates per training step (a training step is one decision of every environment)."""
    replay_size: Annotated[int, COUNT] = 262_144
    """Observations that the replay holds."""
    turn: bool = False
    """Turn what is drawn from the replay by random quarter turns about the vertical, drone and world alike. Only for
    random worlds, which have no preferred direction but the sun's; a map that stays the same would be blurred. Off
    where a reward function of one's own is given, which may prefer one."""
    learning_starts: Annotated[int, NOT_NEGATIVE] = 8192
    """Observations in the replay before the first update."""
    random_decisions: Annotated[int, NOT_NEGATIVE] = 1000
    """Random decisions, of all environments together, before epsilon begins to fall."""
    exploration_start: Annotated[float, SHARE] = 1.0
    """epsilon at the start."""
    exploration_end: Annotated[float, SHARE] = 0.02
    """epsilon at the end."""
    exploration_fraction: Annotated[float, SHARE] = 0.1
    """Share of the DQN phase over which epsilon falls linearly; unused when `exploration_episodes` > 0."""
    exploration_episodes: Annotated[int, NOT_NEGATIVE] = 0
    """Episodes per environment over which epsilon falls (`Max_eps_episode` of Table 1); 0 uses the fraction."""


@dataclass(frozen=True)
class PqnConfig:
    """PQN, `agent.learner pqn` (Gallici et al. 2024). It also reads network, discount, step sizes and exploration of
    `agent`.
    """

    rollout: Annotated[int, COUNT] = 32
    """Decisions of each environment between learning."""
    epochs: Annotated[int, COUNT] = 4
    """Passes over a rollout."""
    minibatches: Annotated[int, COUNT] = 32
    """Updates of one pass; must divide `rollout` times the environments of a shard."""
    trace: Annotated[float, SHARE] = 0.65
    """lambda of the returns; 0 looks one decision ahead."""
    average_rate: Annotated[float, RATE] = 0.01
    """Polyak rate, per update, of the averaged parameters that evaluation uses; 1 uses the newest parameters."""


@dataclass(frozen=True)
class ImitationConfig:
    """Imitation, `agent.learner imitation` (DAgger, Ross et al. 2011). It also reads network, step sizes, updates and
    replay of `agent`.
    """

    teacher: str = ""
    """Policy that is imitated: the folder of a run that was trained with `env.sensor depth`, and with the same camera,
    commands and own state."""
    teacher_moves: Annotated[float, SHARE] = 1.0
    """beta: share of the moves that the teacher takes at first; the others are the student's."""
    teacher_fraction: Annotated[float, SHARE] = 0.1
    """Share of the training after the warm-up over which `teacher_moves` falls linearly to 0."""


@dataclass(frozen=True)
class TrainConfig:
    """The training run."""

    num_envs: Annotated[int, COUNT, at_most(1_000_000)] = 256
    """Parallel environments; a multiple of `shards`."""
    total_steps: Annotated[int, COUNT] = 500_000
    """Decisions in all, warm-up included; rounded up to whole chunks."""
    schedule_steps: Annotated[int, NOT_NEGATIVE] = 0
    """Decisions that exploration, step size and retraining are planned for; what comes after them goes on as at their
    end. 0 is `total_steps`; a run that is continued beyond its end has its first total here."""
    max_episodes: Annotated[int, NOT_NEGATIVE] = 0
    """Stop after this many episodes as well (`Num_episodes` of Table 1); 0 is no limit."""
    chunk_steps: Annotated[int, COUNT, at_most(100_000)] = 64
    """Training steps in one compiled chunk."""
    shards: Annotated[int, COUNT, at_most(1_000_000)] = 8
    """Logical shards of environments and replay; the number of devices must divide it."""
    devices: Annotated[int, NOT_NEGATIVE] = 0
    """Devices to use; 0 uses the largest number that divides the shards."""
    products: Literal["auto", "float32", "bfloat16"] = "auto"
    """Factors of the products in updates of encoder and Q-network: rounded to bfloat16 or not; sums are in float32.
    auto is bfloat16 on CPUs where that is faster (with AMX, or AMD's from Zen 4 on), else float32."""
    seed: Annotated[int, NOT_NEGATIVE, less_than(2**32, "2**32")] = 0
    """Random seed of the run."""
    validation_every: Annotated[int, NOT_NEGATIVE] = 98_304
    """Decisions between validations, rounded up to whole chunks; 0 validates only at the end."""
    validation_missions: Annotated[int, COUNT, at_most(100_000)] = 128
    """Missions of each validation, and of the flights at the end, the first of which is in `world.flown`; in worlds
    from a file half of them begin near the world's start, or as many as in training (`world.own_start_fraction`) if
    that is more."""
    keep: Literal["best", "last"] = "best"
    """Parameters that the run keeps: those of the best validation (by SPL, the latest of equal ones), or the last."""
    checkpoint_every_s: Annotated[float, NOT_NEGATIVE] = 15.0
    """Seconds between checkpoints, from which an interrupted run is continued; more where saving one takes longer than
    3 % of that. There is one at the end, too; 0 saves none."""
    checkpoints: Annotated[int, COUNT] = 2
    """Newest checkpoints that are kept."""
    debug: bool = False
    """Check every index, number, random key and shape of training; the first fault ends the run and is named. One
    device, and drones one after the other: for few environments."""
