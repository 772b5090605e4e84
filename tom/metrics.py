"""The metric paths: their meaning, for tooltips, docs and `--help`, and which must be finite."""

from collections.abc import Mapping

import numpy as np
from torch import Tensor

from tom.errors import DivergedError

NLL_UNITS = (
    "mean over the target dimensions, z-scored (linear model: raw); the kind ensemble leaves the "
    "constant out and doubles it"
)
NLL = f"{NLL_UNITS}, mean-ensemble has the squared error in its place"
HELD_OUT = "each fit continues the same network with newly drawn held-out rows, so most were trained on before"
ENDS = "on rows that no fit of the head trains on, weighted; missing while they contain no end"
IN_SAMPLE = "rows the model was just fitted to"
EXAM = "the exam: the real steps between this fit and the next, which are not in its buffer"

METRICS: dict[str, str] = {
    "eval/return": "mean undiscounted return over the evaluation episodes",
    "eval/return_max": "running maximum of eval/return (the paper's metric)",
    "eval/return_std": "standard deviation of the return over the evaluation episodes",
    "eval/length": "mean length of the evaluation episodes, steps",
    "eval/success": "share of evaluation episodes that reach the goal (road-and-rocks)",
    "eval/return_random": "mean return of uniform actions in the same task (road-and-rocks)",
    "eval/return_expert": "mean return of the noisy expert in the same task (road-and-rocks)",
    "train/return": "undiscounted return of the last finished training episode",
    "train/length": "length of the last finished training episode, steps",
    "model/train_nll": f"negative log-likelihood in the last round of the fit, {NLL}; VaGram's weighs dimensions",
    "model/holdout_nll": "weighted holdout loss of the kept model, in the units of model/train_nll; not an error on new data: "
    f"{HELD_OUT}",
    "model/holdout_nll_uniform": "holdout loss with every transition and dimension counting the same; not an error on new data: "
    f"{HELD_OUT}",
    "model/holdout_mse": "holdout mean squared error of the predicted mean (z-scored targets); not an error on new data: "
    f"{HELD_OUT}",
    "model/ends_loss": f"cross entropy of the head that learns which states end an episode, {ENDS}",
    "model/ends_threshold": "probability at which a modelled episode ends: that with the best weighted F1 on rows that no fit of the head "
    "trains on, or on all rows while those contain no end (2: never)",
    "model/ends_calibration": f"expected calibration error of that head's probabilities (0: its odds are true), {ENDS}",
    "model/ends_caught": f"share of the real ends that reach the threshold, {ENDS}",
    "model/ends_false": f"share of the other rows that reach the threshold, {ENDS}",
    "model/rounds": "rounds of the fit before it stopped",
    "model/error_policy": f"one-step error of the predicted next state on the policy buffer (z-scored); in-sample: {IN_SAMPLE}",
    "model/error_other": f"one-step error of the predicted next state on the rest of the buffer (z-scored); in-sample: {IN_SAMPLE}",
    "model/rollout_error_policy": f"error after 5 modelled steps under the recorded actions, policy buffer (z-scored); in-sample: {IN_SAMPLE}",
    "model/rollout_error_other": "error after 5 modelled steps under the recorded actions, newest 20 000 "
    f"rows of the rest of the buffer (z-scored); in-sample: {IN_SAMPLE}",
    "model/error_expert": "one-step error on expert data, in full steps (road-and-rocks)",
    "model/error_road": "one-step error on the road under random actions, in full steps",
    "model/error_rocks": "one-step error on the rocks under random actions, in full steps",
    "exam/footprint": "energy distance of (s, a, s' - s) between the weighted buffer and the exam, over exam/footprint_uniform "
    f"(1: no nearer than without weights, 0: the policy itself; noise if the latter is not well above zero); {EXAM}",
    "exam/footprint_se": "standard error of exam/footprint over the policy's episodes, for the given buffer, by a jackknife over groups "
    "of whole episodes; absent with fewer than five (runs before 2026-11-26: over ten stretches, far too small there)",
    "exam/footprint_uniform": "energy distance (z-scored, unbiased) between the unweighted buffer and the exam",
    "exam/footprint_noise": "energy distance between two halves of the exam, over exam/footprint_uniform: a bound for the noise "
    "if they are whole episodes, far too large if they are halves of one episode",
    "exam/error": f"one-step error of the predicted next state, in standard deviations of a step's change in the buffer; {EXAM}",
    "exam/reward_error": f"one-step error of the predicted reward, in standard deviations of the buffer's reward; {EXAM}",
    "exam/nll": f"negative log-likelihood, unweighted, {NLL_UNITS}; mean-ensemble has none; {EXAM}",
    "exam/rollout_error": "error after 5 modelled steps under the recorded actions, in the units of exam/error",
    "exam/rollout_reward_error": "error of the fifth reward under the recorded actions, in the units of exam/reward_error",
    "exam/falls_caught": "share of the model's draws that end the episode where the exam's real step did",
    "exam/false_falls": "share of the model's draws that end the episode where the real step did not",
    "exam/critic_bias": "discounted return to go (with SAC's entropy) of the exam's finished episodes minus the critic's value; by the "
    "critics at the next fit, which have since been trained",
    "weights/ess": "effective sample size (sum w)^2 / sum w^2, as a share of the buffer",
    "weights/zeros": "share of transitions with weight zero",
    "weights/max": "largest weight (mean weight is 1)",
    "weights/raw_mean": "mean weight before normalisation: 1 at the exact optimum, less under the discounted flow where episodes terminate; "
    "always 1 under KL, and under the stationary flow unless `tom.conjugate` is released",
    "weights/age_correlation": "rank correlation of weight and position in the buffer (1: newest count most)",
    "weights/ends": "share of the weight on transitions that end an episode in a terminal state",
    "weights/ends_policy": "their share in the policy buffer (the discounted flow's optimum gives them less)",
    "weights/road_share": "share of the weight of all data that lies on the road, 30 % of the map (road-and-rocks)",
    "weights/road_ratio": "mean weight on the road over mean weight on rocks, random data only",
    "behaviour/divergence": "KL divergence of the current policy from the one that drew a row's action, at the row's state, in nats (median)",
    "behaviour/policies": "historical policies that PDML tells apart",
    "behaviour/clipped": "share of rows whose action's importance ratio was clipped",
    "discriminator/loss": "cross entropy of the discriminator, last steps",
    "discriminator/accuracy": "share of transitions that the discriminator classifies correctly",
    "discriminator/calibration": "expected calibration error of the discriminator, last steps (0: its odds are true, or .5 for every "
    "row); on the rows it is trained on, and without the averaging of its parameters",
    "dual/loss": "TOM's dual objective, last steps",
    "dual/holdout_loss": "TOM's dual objective on held-out episodes, for the kept Q (with tom.q_holdout)",
    "dual/steps": "gradient steps at which the kept Q had its lowest held-out loss (with tom.q_holdout)",
    "dual/q_mean": "mean of TOM's dual Q over the buffer",
    "dual/start_gap": "how far TOM's dual Q at start states is below its range on the buffer, in "
    "units of 1 + the width of that range (above 1: Q runs away)",
    "critic/loss": "SAC: sum of the twin critics' squared errors",
    "critic/q": "SAC: mean Q of the minibatch",
    "actor/loss": "SAC: temperature * log_prob - min Q",
    "actor/entropy": "SAC: minus mean log_prob of the sampled actions",
    "temperature/value": "SAC: entropy temperature",
    "rollout/reward": "mean model-predicted reward of the rollouts",
    "rollout/terminated": "share of rollout steps that end in a terminal state",
    "rollout/diverged": "share of rollout steps whose prediction was not finite (left out)",
    "rollout/exploded": "share of rollout steps that go 100 times beyond the largest start state",
    "planner/return": "return of the planner in the first fit's model, driven in the real task (road-and-rocks); "
    "VaGram's weights are uniform in that fit",
    "planner/success": "share of the planner's episodes that reach the goal (road-and-rocks)",
    "buffer/size": "transitions in the replay buffer",
    "time/wall_s": "seconds the run has taken, over all its resumes",
    "time/env_steps_per_s": "environment steps per second since the last row",
    "time/record_s": "seconds spent recording so far",
    "time/checkpoint_s": "seconds spent writing checkpoints so far",
}

BUILT_IN = frozenset(
    name
    for name in ("env_step", *METRICS)
    if not name.startswith(("discriminator/", "dual/", "weights/raw_mean"))
)
"""the names that a training records itself, whatever its learner"""


def describe(path: str) -> str:
    """The meaning of a metric path; the path itself if the table does not have it."""
    return METRICS.get(path, path)


SHORTER = "shorter rollouts (--rollout.length, --rollout.final-length)"
POLICY = f"try a lower --sac.lr, and {SHORTER} if the rollouts exploded before"
MODEL = "try a lower --model.lr"
DUAL = "try a lower --tom.q-lr or --tom.discriminator-lr"
FATAL: dict[str, str] = {
    **dict.fromkeys(("critic/loss", "critic/q", "actor/loss", "actor/entropy"), POLICY),
    "temperature/value": POLICY,
    **dict.fromkeys(("model/train_nll", "model/holdout_nll"), MODEL),
    "discriminator/loss": "try a lower --tom.discriminator-lr",
    **dict.fromkeys(("dual/loss", "dual/q_mean"), DUAL),
}
"""the metrics that must be finite, with advice for when one is not"""


def require_finite(values: Mapping[str, float | Tensor], env_step: int) -> None:
    """Raises DivergedError if a metric that must be finite is not."""
    for name, advice in FATAL.items():
        if name in values and not np.isfinite(float(values[name])):
            raise DivergedError(f"step {env_step}: {name} is {float(values[name])}: {advice}")
