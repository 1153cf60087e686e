"""Settings of a run as an editor sees them: written by scripts/typed_settings.py."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any, Literal, TypedDict

# fmt: off
Name = Literal[
    "td3", "td7", "sac", "tqc", "crossq", "sunrise", "sunrise-td3", "steve", "steve-td3", "ddpg",
    "trpo", "me-trpo", "multi-td3", "multi-td7", "multi-sac", "multi-tqc", "multi-crossq",
    "multi-sunrise", "multi-sunrise-td3", "multi-steve", "multi-steve-td3", "multi-ddpg",
    "td3-paper", "ddpg-original", "crossq-small", "quick", "crossq-lean", "crossq-bins",
    "crossq-wn", "td7-small", "frugal", "sunrise-official", "steve-paper", "me-trpo-paper"
]
# fmt: on


class RunSettings(TypedDict, total=False):
    """What `Trainer` takes besides algorithm and env, whichever algorithm has it."""

    env_kwargs: dict[str, Any]
    """keywords for gymnasium.make"""
    name: str
    """name of the run's folder, below its env"""
    steps: int | str
    """budget of env steps, of all members together unless --count member"""
    time: float | str | None
    """stop after this wall time, such as 2h; default no limit"""
    stop_at: float | None
    """stop when an evaluation reaches this mean return; default never"""
    stop_patience: int | None
    """stop after so many evaluations in a row, from the first update on, without a new best..."""
    start_from: str | None
    """start all members with the networks of this earlier run, policy file or champion:NAME"""
    seed: int
    """seed of every random stream"""
    env_timeout: float | str | None
    """end a run whose task takes longer for any call, such as 30s; default no limit"""
    wrap: Sequence[str]
    """put wrappers around the task, the innermost first; may be repeated"""
    renew_env: bool | None
    """make the task anew at each episode, so that none depends on those before it; default..."""
    randomize: dict[str, Any]
    """draw a keyword of the task anew for each training episode, such as mass=0.8,1.2; may..."""
    members: int
    """ensemble members: learners that share the replay"""
    rule: str
    """selection rule: who is copied to whom; see `pacesetter list rules`"""
    select_on: Literal["train", "eval"]
    """select by returns of training episodes, or of extra noise-free ones"""
    select_every: int | str
    """env steps between selections, with --select-on eval"""
    select_window: int | None
    """episodes per member behind each selection; default 1, with rescue or pbt 5"""
    select_after: int | str | None
    """env steps before the first selection; default --warmup"""
    count_selection_steps: bool
    """count the steps of extra selection episodes towards --steps"""
    copy: Literal["full", "weights", "actor"]
    """copy networks and optimiser state, only networks, or only the actor"""
    same_init: bool
    """start all members from the same weights"""
    count: Literal["all", "member"]
    """count --steps and intervals over all members, or per member"""
    wait: bool
    """let a member whose episode has ended wait until all have ended"""
    replay_scope: Literal["shared", "member"]
    """one shared replay, or one per member"""
    vary: dict[str, Any]
    """settings that differ between members, such as gamma=0.98,0.99; may be repeated; one of..."""
    vary_by: Literal["grid", "draw"]
    """spread members over the grid of --vary, or draw every value equally often"""
    eval_policy: Literal["champion", "ema"]
    """what is evaluated and saved: the champion's policy, or the mean action of all members'..."""
    mean_actions: Literal["auto", "on", "off"]
    """also evaluate the mean action of all members, and that of their EMA actors (with..."""
    ema_tau: float
    """step of the EMA actors per actor update"""
    snapshots: int
    """also evaluate the mean action of the champions of this many evaluations"""
    eval_every: int | str
    """env steps between evaluations"""
    eval_episodes: int
    """episodes per evaluation"""
    keep: int
    """keep the policies of this many last evaluations in policies/"""
    checkpoint_every: float | str
    """time between checkpoints, such as 5m"""
    device: Literal["auto", "cpu", "gpu", "tpu"]
    """device that runs the updates; auto takes JAX's own choice, a GPU before the CPU"""
    gamma: float
    """discount factor per env step"""
    normalize_observation: bool
    """normalize observations by running mean and standard deviation, clip at 10"""
    batch_size: int
    """transitions per minibatch"""
    replay_size: int | str
    """transitions kept; the oldest are overwritten first"""
    replay: Literal["uniform", "prioritized", "lap", "return"]
    """sample transitions uniformly, by TD error (PER or LAP) or by episode return"""
    replay_exponent: float | None
    """priority exponent alpha; 0 samples uniformly; default 0.6, or 0.4 for lap"""
    replay_importance: float | None
    """initial importance exponent beta, annealed to 1; 0 disables weights; default 0.4, or 0..."""
    replay_horizon: int | str | None
    """env steps until beta is 1; default --steps"""
    replay_to_go: bool
    """rank transitions by return to go instead of the whole episode's return"""
    n_step: int
    """rewards summed in an n-step target"""
    assess: int
    """training episodes that a policy plays unchanged before it may become the one that is..."""
    assess_after: int | str | None
    """updates of a member before assessments take several episodes; default 750000"""
    warmup: int | str
    """env steps of uniformly random actions at the start, all members"""
    warmup_updates: bool
    """also update during the warm-up"""
    updates_per_step: float
    """critic updates per env step of the member"""
    num_envs: int
    """envs per member, stepped in turn"""
    update_at: Literal["step", "episode"]
    """update after each step, or make all due updates when the episode ends"""
    update_every: int | str | None
    """env steps of a member between blocks of updates; default 1"""
    lr_end: float
    """share of every learning rate that is left at the end; it falls linearly"""
    lr_horizon: int | str | None
    """env steps until that share is reached; default --steps"""
    actor_observes: str | None
    """numbers of the flat observation that the actor sees, such as 0:17 or 0:8,12; critics..."""
    normalize_reward: bool
    """divide rewards by the running standard deviation of discounted returns"""
    precision: Literal["f32", "bf16"]
    """precision of large matrix products; accumulation is always float32"""
    hidden: Sequence[int]
    """widths of the hidden layers"""
    actor_learning_rate: float
    """Adam learning rate of the actor"""
    critic_learning_rate: float
    """Adam learning rate of the critics"""
    tau: float
    """step size of the soft target update"""
    critics: int
    """critics; the target uses their minimum"""
    critic_layer_norm: bool
    """use layer norm before each ReLU of the critics"""
    actor_layer_norm: bool
    """use layer norm before each ReLU of the actor"""
    quantiles: int
    """quantiles that each critic learns, usually 25; 0 learns only the mean"""
    policy_delay: int
    """critic updates per actor update"""
    target_noise: float
    """standard deviation of the target action's noise"""
    target_noise_clip: float
    """bound of the target action's noise"""
    exploration: str
    """noise on actions, or on the actor's weights"""
    exploration_noise: float
    """standard deviation of that noise, measured on actions"""
    encoder_hidden: Sequence[int]
    """widths of the two hidden layers of each encoder"""
    encoder_size: int
    """numbers in an embedding"""
    encoder_learning_rate: float
    """Adam learning rate of the encoders"""
    copy_every: int
    """critic updates between copies to the targets"""
    alpha_learning_rate: float
    """Adam learning rate of the log temperature"""
    initial_alpha: float
    """temperature at the start"""
    target_entropy: float | None
    """in nats; default minus the action size"""
    dropped: int
    """largest quantiles to drop from the target, per critic"""
    critic_hidden: Sequence[int]
    """widths of the critics' hidden layers"""
    adam_momentum: float
    """Adam's beta1 for actor and critics"""
    renorm_after: int | str
    """updates of a network with plain batch norm before batch renorm begins"""
    weight_norm: bool
    """divide the weights into each hidden unit by their L2 norm after each update"""
    next_batch_gradient: bool
    """let gradients flow through (s', a') in the batch statistics"""
    bins: int
    """bins of the return distribution that each critic learns, usually 51; rewards are then..."""
    ensemble: int
    """learners per member, which act in one env (N)"""
    mask_probability: float
    """chance that a learner trains on a transition (beta)"""
    backup_temperature: float
    """temperature T of the weighted Bellman backup; 0 weights all alike"""
    ucb: float
    """standard deviations added to a proposed action's mean value (lambda)"""
    reference: Literal["paper", "official"]
    """formulas as published, or as in the authors' code"""
    action_layer: int
    """critic layer that the action enters; 0 is the first"""
    critic_decay: float
    """L2 decay added to the critic's gradient"""
    output_bound: float | None
    """bound of initial output weights; default 1/sqrt(inputs)"""
    horizon: int
    """rollout horizon H in the models; 0 uses no model"""
    critic_members: int
    """critics whose disagreement weights the target; each learns from its own share of a..."""
    models: int
    """learned models, and as many reward heads; each learns from its own share of a minibatch"""
    model_hidden: Sequence[int]
    """widths of a model's hidden layers"""
    head_hidden: Sequence[int]
    """widths in the heads for reward and termination"""
    model_learning_rate: float
    """Adam learning rate of the models"""
    model_decay: float
    """L2 decay added to the models' gradient"""
    parallel_envs: int
    """envs per rollout, stepped in turn"""
    rollout_length: int | str
    """steps of each env per rollout"""
    initial_std: float
    """standard deviation of actions at the start"""
    gae_lambda: float
    """lambda of generalised advantage estimation"""
    max_kl: float
    """largest mean KL divergence per update, in nats"""
    damping: float
    """added to the Fisher matrix's diagonal"""
    gradient_steps: int
    """conjugate gradient steps per update"""
    backtracks: int
    """step lengths that the line search tries at most"""
    backtrack_ratio: float
    """factor from one tried step length to the next"""
    critic_epochs: int
    """passes of the critic per rollout"""
    critic_batch_size: int
    """observations per minibatch of the critic"""
    starts: int
    """resets per update that start imagined episodes; not counted as env steps"""
    known: bool
    """use the walker's known reward and termination instead of learning them"""
    model_noise: bool
    """models also learn a standard deviation, with which imagined steps are drawn"""
    model_batch_size: int
    """rows per minibatch of a model"""
    model_patience: int
    """passes without a fall of the held-out loss by 1% that end a fit"""
    model_rows: int | str
    """rows that all passes of one fit may go through together"""
    renew_every: int
    """iterations between fits that begin with new weights; 0 never does"""
    imagined_steps: int | str
    """imagined steps per policy update, rounded down to whole episodes of --horizon"""
    bootstrap: bool
    """add the critic's value where an imagined episode is cut at --horizon"""
    policy_updates: int
    """policy updates per iteration at most"""
    check_every: int
    """policy updates between evaluations in every model"""
    patience: int
    """policy updates without a kept policy before the iteration ends"""
    share: float
    """share of models whose return must not fall for a policy to be kept"""


class TrainerSettings(RunSettings, total=False):
    """And the folder of runs, and a file of settings."""

    runs: str | Path
    config: str | Path | None
