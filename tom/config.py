"""All settings of a run, frozen; the resolved copy is saved with the run.

The docstring below a field is its help text on the command line.
"""

from collections.abc import Mapping
from typing import Annotated, Any, ClassVar, Literal, Self

from pydantic import BaseModel, ConfigDict, Field

Fraction = Annotated[float, Field(ge=0, le=1)]
Discount = Annotated[float, Field(ge=0, lt=1)]
Positive = Annotated[float, Field(gt=0)]
NonNegative = Annotated[float, Field(ge=0)]
Whole = Annotated[int, Field(ge=0, lt=2**63)]
Count = Annotated[int, Field(ge=1, lt=2**40)]
"""bounded, since torch cannot even ask for what is far beyond any memory"""


class Config(BaseModel):
    """A frozen group of settings; an unknown name or a value out of bounds is an error."""

    model_config = ConfigDict(
        frozen=True, extra="forbid", use_attribute_docstrings=True, allow_inf_nan=False
    )  # JSON, which a run's settings are kept in, has neither infinity nor NaN

    def but(self, **changes: Any) -> Self:
        """A checked copy with some values changed; nested groups take a dict of changes."""
        return type(self).model_validate(merged(self.model_dump(), changes))


class ModelConfig(Config):
    """The dynamics model and how it is fitted."""

    kind: Literal["mdn", "ensemble", "mean-ensemble", "linear"] = "mdn"
    """mixture density network, Gaussian ensemble, mean-only ensemble (VaGram), or least squares"""
    hidden: Count = 200
    """units per hidden layer"""
    layers: Count = 4
    """hidden layers"""
    components: Count = 10
    """mixture components per output dimension (mdn)"""
    members: Count = 7
    """networks in the ensemble"""
    elites: Count = 5
    """ensemble members that predict: the best by holdout error"""
    lr: Positive = 1e-3
    """Adam's learning rate"""
    batch_size: Count = 256
    rounds: Count = 30
    """maximum rounds per fit"""
    batches_per_round: Count = 100
    """minibatches per round"""
    patience: Count = 5
    """a fit stops after more than this many rounds without a gain"""
    min_gain: NonNegative = 0.01
    """smallest relative fall of the weighted holdout loss that counts as a gain, since the last"""
    holdout: Annotated[float, Field(ge=0, lt=1)] = 0.2
    """share of the buffer held out"""
    holdout_max: Count = 5000
    """maximum held-out transitions (of the model; the head that learns ends holds out its share)"""
    weights: Literal["sample", "scale"] = "sample"
    """draw minibatches by weight, or draw uniformly and scale the loss (never both)"""
    weight_clip: Positive = 10.0
    """upper bound of the weights (mean 1) before a fit, of the learners TOM and ratio only"""
    uniform_share: Fraction = 0.0
    """share of uniform weights mixed into the fit's, so that no row counts less than this share"""
    termination: str | None = Field(default=None, exclude_if=lambda value: value is None)
    """which modelled next observations end an episode: module:function, never, or learnt by a head
    of the model [the task's own rule; learnt if it has none]"""


class SacConfig(Config):
    """Soft actor-critic, the policy optimiser."""

    hidden: Count = 256
    layers: Count = 2
    lr: Positive = 3e-4
    batch_size: Count = 256
    tau: Annotated[float, Field(gt=0, le=1)] = 0.005
    """step of the target critics towards the critics at each update"""
    discount: Discount = 0.99
    target_entropy: float | None = None
    """entropy that the temperature aims for; default -dim(A)"""
    initial_temperature: Positive = 1.0


class RolloutConfig(Config):
    """Rollouts of the policy in the learnt model."""

    starts: Count = 100_000
    """start states per fit"""
    length: Count = 1
    """steps of a rollout at the start of training"""
    final_length: Count = 1
    """steps of a rollout at the end of the schedule, if longer than at the start"""
    schedule_start: Whole = 20
    """epoch (1 000 env steps after exploration) at which rollouts begin to grow"""
    schedule_end: Whole = 150
    """epoch at which they stop growing"""
    retain: Count = 1
    """epochs (1 000 env steps) whose rollouts stay in the model buffer; at least one fit's"""
    weighted_starts: bool = True
    """draw start states by weight (uniformly until the learner has weights)"""
    uniform_share: Fraction = 0.0
    """share of uniform weights mixed into the start states' weights"""
    chunk: Count = 2000
    """rows predicted at once (they stay in the processor's cache)"""

    def length_at(self, step: int) -> int:
        """Rollout length `step` env steps after exploration, by Janner's schedule over epochs."""
        if self.final_length <= self.length:
            return self.length
        span = max(self.schedule_end - self.schedule_start, 1)
        share = (step / 1000 - self.schedule_start) / span
        grown = self.length + share * (self.final_length - self.length)
        return int(min(max(grown, self.length), self.final_length))

    def kept_at(self, step: int, fit_every: int) -> int:
        """Rows of the model buffer at that step: `retain` epochs' rollouts, as Janner's code."""
        fits = max(self.retain * 1000 // fit_every, 1)
        return self.starts * self.length_at(step) * fits


class TomConfig(Config):
    """Transition occupancy matching: discriminator, dual Q, weights (paper, section 4.3)."""

    divergence: Literal["chi2", "full-chi2", "kl"] = "chi2"
    """f: (x-1)^2/2, (x-1)^2, or KL with normalised weights"""
    conjugate: Literal["clamped", "released"] = "clamped"
    """chi2's conjugate over x >= 0, or the unclamped parabola of the released code"""
    flow: Literal["discounted", "restart", "stationary"] = "discounted"
    """constraint on the weights: the paper's; one where a new start follows an end; or that with
    discount 1 and mean weight 1"""
    discount: Discount = 0.99
    """discount of the flow (a stationary flow has none)"""
    discriminator: bool = True
    """false: r is 1 on the policy buffer and 0 elsewhere (an ablation of the released code)"""
    discriminator_input: Literal["transitions", "state-actions"] = "transitions"
    """what r is a ratio of: (s, a, s') as in the paper, or (s, a), which is the same r with less
    noise where one environment made both buffers"""
    discriminator_steps: Whole = 100
    discriminator_batch: Count = 256
    discriminator_lr: Positive = 3e-4
    discriminator_hidden: Count = 256
    discriminator_reset: bool = True
    """reinitialise the discriminator at every fit"""
    label_smoothing: Annotated[float, Field(ge=0, lt=0.5)] = 0.0
    """label of replay rows (the released code: 0.1)"""
    gradient_penalty: NonNegative = 0.0
    """weight of the discriminator's gradient penalty (the released code: 10)"""
    q_steps: Count = 1000
    q_batch: Count = 256
    q_lr: Positive = 3e-4
    q_hidden: Count = 256
    q_weight_decay: NonNegative = 1e-4
    q_reset: bool = False
    """reinitialise Q at every fit (default: continue from the last fit)"""
    q_holdout: Annotated[float, Field(ge=0, le=0.5)] = 0.0
    """share of episodes held out from the dual: Q is reinitialised at every fit and stops at their
    lowest loss (0: Q trains for all q_steps)"""
    q_check_every: Count = 100
    """steps between two checks of the held-out loss"""
    q_patience: Count = 5
    """checks without a new lowest loss after which a Q with held-out episodes stops training"""
    q_bias_step: Annotated[float, Field(ge=0, le=1)] = 0.0
    """damped Newton step of Q's output bias, which carries the weights' mean (0: only Adam)"""
    q_non_negative: bool = False
    """keep Q >= 0 as printed in the paper (costs a quarter of the weights' mass in the median)"""
    semi_gradient: bool = False
    """stop the gradient through Q(s', a') (breaks the dual: for comparison only)"""
    parameter_average: Annotated[float, Field(ge=0, lt=1)] = 0.0
    """decay of the averaged parameters of both networks that give r and weights (0: the last)"""
    action_samples: Count = 4
    """actions averaged for E_{a'~pi}[Q(s', a')], which sits inside f* (the released code: one)"""
    warmup: Count = 1000
    """on-policy steps before TOM starts; uniform weights until then"""

    _presets: ClassVar[dict[str, dict[str, Any]]] = {
        "paper": {"action_samples": 1},
        # Measured against exact solutions of small MDPs: see docs/learners/tom.md.
        "exact": {
            "action_samples": 10,
            "discriminator_input": "state-actions",
            "discriminator_steps": 2000,
            "parameter_average": 0.999,
            "q_bias_step": 0.1,
            "q_lr": 1e-3,
            "q_reset": True,
            "q_steps": 3000,
            "q_weight_decay": 0.0,
        },
    }

    @classmethod
    def preset(cls, name: Literal["paper", "exact"]) -> Self:
        """`paper`: the paper's table (appendix C.1); `exact`: what matches exact weights best."""
        return cls.model_validate(cls._presets[name])


class PmacConfig(Config):
    """PMAC's recency weights (paper, appendix C.2)."""

    decay: Annotated[float, Field(gt=0, lt=1)] = 0.996
    """share that stays with earlier policies' transitions at a policy change"""


class VagramConfig(Config):
    """VaGram's value-gradient weights."""

    clip_quantile: Annotated[float, Field(gt=0, le=1)] = 0.95
    """quantile at which weights are clipped"""


class PdmlConfig(Config):
    """PDML's distance of each historical policy (Wang et al. 2023)."""

    rows_per_policy: Count = 250
    """on-policy rows, counted from the newest, that count as one policy's (250: a fit's)"""
    newest_rate: Annotated[float, Field(gt=0, lt=1)] = 0.02
    """the newest policy's minimum share of all policies' weight"""
    exploration: Fraction = 0.05
    """weight of an exploration row over that of a row of the oldest policy"""
    warmup: Whole = 1000
    """on-policy rows before it starts; uniform weights until then"""


class PolicyDistanceConfig(Config):
    """Weights by the distance of the policies then and now at each row's own state."""

    floor: Positive = 0.05
    """divergence added to every row's, in nats: it bounds a row's weight"""
    warmup: Whole = 1000
    """on-policy rows before it starts; uniform weights until then"""


class PmerConfig(Config):
    """Rows of large model error more often (Tao et al. 2026)."""

    share: Fraction = 0.5
    """share of the rows drawn by error; the others are drawn uniformly"""
    sharpness: NonNegative = 1.0
    """rows are drawn by error in proportion to error^sharpness"""


class ActionRatioConfig(Config):
    """The importance ratio of the row's action."""

    clip: Positive = 10.0
    """upper bound of the ratios"""


class EvaluationConfig(Config):
    """Evaluation of the policy (mean actions) in a separate environment."""

    every: Count = 1000
    """env steps between evaluations"""
    episodes: Count = 10


class RunConfig(Config):
    """What every run has."""

    env: str
    learner: str
    seed: Whole = 0
    """seed of every random stream"""
    steps: Count = 10_000
    """total environment steps (offline: steps of policy optimisation in the model)"""
    preset: str = "paper"
    device: str = "cpu"
    """cpu or cuda (plain torch; almost untried)"""
    threads: Annotated[int, Field(ge=1, le=256)] = 1
    """torch's threads (two: one run up to 1.5 times as fast; a run on each core gains more)"""
    matmul: Literal["auto", "default", "onednn"] = "auto"
    """fp32 matrix products on a CPU: probe, torch's default, or oneDNN"""
    checkpoint_every: Whole = 2000
    """steps between two checkpoints (0: only at the end or when stopped)"""
    bins: Annotated[int, Field(ge=1, le=10_000)] = 100
    """bins of a weight profile, oldest to newest"""
    snapshots: Whole = 12
    """number of fits whose single weights and policy are kept (0: only the last fit's); a recording
    of SAC keeps its policy as often"""
    tom: TomConfig = TomConfig()
    pmac: PmacConfig = PmacConfig()
    vagram: VagramConfig = VagramConfig()

    @property
    def total_steps(self) -> int:
        """The last step of the run's events."""
        return self.steps


class OnlineConfig(RunConfig):
    """MBPO in a MuJoCo task (Algorithm 2)."""

    exploration_steps: Count = 5000
    """uniformly random steps before training"""
    fit_every: Count = 250
    """env steps between model fits"""
    updates_per_step: Count = 5
    """SAC updates for each env step"""
    real_ratio: Fraction = 0.05
    """share of real transitions in a SAC minibatch"""
    replay_capacity: Count = 1_000_000
    policy_capacity: Count = 1000
    """size of the policy buffer: the policy's last on-policy transitions"""
    model: ModelConfig = ModelConfig()
    sac: SacConfig = SacConfig()
    rollout: RolloutConfig = RolloutConfig()
    evaluation: EvaluationConfig = EvaluationConfig()


SAC_ALONE = "sac"
"""stands for the learner in a recording of SAC, which fits no model"""


class SacRecordingConfig(RunConfig):
    """SAC alone in a MuJoCo task after as many random steps, its whole replay kept in order."""

    learner: str = SAC_ALONE
    steps: Count = 200_000
    """environment steps of SAC; as many random ones come before them"""
    exploration_steps: Whole = 1000
    """uniformly random steps at the start of SAC's own"""
    updates_per_step: Count = 1
    """SAC updates for each env step"""
    sac: SacConfig = SacConfig()
    evaluation: EvaluationConfig = EvaluationConfig(every=5000, episodes=5)

    @property
    def total_steps(self) -> int:
        return 2 * self.steps


OWN_LOOP = "own-loop"
"""stands for the learner in the record of a training loop of the user's own"""


class OwnLoopConfig(RunConfig):
    """A training loop of the user's own (docs/your-own-loop.md), or live weights of its buffer."""

    learner: str = OWN_LOOP
    """own-loop: the record of the loop itself; else the learner whose weights its buffer gets"""
    steps: Count = 1_000_000
    """planned env steps: progress, and which fits' weights are kept, follow from it"""
    preset: str = ""
    own: dict[str, Any] = {}
    """what the user gave as configuration"""
    every: Count = 5000
    """of live weights: env steps between two fits"""


class RoadConfig(RunConfig):
    """Offline model-based RL on road-and-rocks with a linear model (paper, section 5.1)."""

    env: str = "road-and-rocks"
    steps: Count = 3000
    """steps of policy optimisation in the model"""
    map_seed: Whole | None = None
    """seed of the rocks; default the run's seed"""
    turn: float = 180.0
    """mean turn of the steering on rocks, degrees"""
    spread: NonNegative = 90.0
    """half-width of the turn's uniform spread, degrees"""
    random_transitions: Count = 10_000
    expert_trajectories: Count = 10
    expert_first: bool = False
    """store the expert data before the random data (PMAC's weights follow the order)"""
    updates_per_step: Count = 1
    """SAC updates for each step of policy optimisation"""
    rollout_every: Count = 50
    """steps of policy optimisation between rollouts in the model"""
    fit_every: Count = 500
    """steps of policy optimisation between two records of weights and model"""
    # A footprint of one trajectory: see docs/road-and-rocks.md.
    tom: TomConfig = TomConfig(
        discriminator_steps=1000,
        discriminator_hidden=128,
        q_steps=2000,
        q_hidden=128,
        action_samples=8,
        warmup=1,
    )
    sac: SacConfig = SacConfig(hidden=128, lr=2e-3, tau=0.02, initial_temperature=0.1)
    rollout: RolloutConfig = RolloutConfig(starts=1000, length=5, final_length=5, retain=60)
    """model rollouts; `retain` counts rollouts, not fits: the model stays, so all may stay"""
    evaluation: EvaluationConfig = EvaluationConfig(every=100, episodes=20)


def merged(base: Mapping[str, Any], changes: Mapping[str, Any]) -> dict[str, Any]:
    """`base` updated with `changes`, group by group."""
    result = dict(base)
    for name, value in changes.items():
        held = result.get(name)
        if isinstance(held, Mapping) and isinstance(value, Mapping):
            result[name] = merged(held, value)
        else:
            result[name] = value
    return result
