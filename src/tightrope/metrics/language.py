"""The metrics of the language story; `metrics.table` adds them to the others.

A name without a suffix is a sum over the response, averaged over responses. A mean over tokens has
``token_mean`` in its name. The two differ by the length of the responses, so they never share a name.
"""

from __future__ import annotations

from tightrope.metrics.declare import metric

LANGUAGE_TABLE = (
    metric(
        "objective/kl",
        "nats",
        "any",
        "KL of the policy to the reference, k1 summed over each response, mean over responses: unbiased, "
        "noisy, slightly negative at times. About 0 at first; past 10 to 15 look at the samples.",
        negative=True,
    ),
    metric(
        "objective/kl_k2",
        "nats",
        "any",
        "The same by k2 = log_ratio^2 / 2, summed over each response: less noise, biased where KL is large.",
    ),
    metric(
        "objective/kl_k3",
        "nats",
        "any",
        "The same by k3 = ratio - 1 - log ratio, summed over each response: unbiased, never negative, with "
        "rare huge values where the policy avoids what the reference likes.",
    ),
    metric(
        "objective/kl_exact",
        "nats",
        "any",
        "The same with the KL of each step computed over the whole vocabulary: the least noise.",
    ),
    metric(
        "objective/kl_token_mean",
        "nats/token",
        "any",
        "k1 to the reference, mean over all response tokens of the rollout: objective/kl divided by "
        "objective/response_length.",
        negative=True,
    ),
    metric("objective/kl_beta", "1", "any", "Weight of the KL to the reference in this update."),
    metric(
        "objective/scores",
        "score",
        "up",
        "Mean score of the responses that count, as the reward gives it, before scaling, clipping and KL.",
        negative=True,
    ),
    metric(
        "objective/scores_std",
        "score",
        "any",
        "Standard deviation of the scores over the responses that count.",
    ),
    metric(
        "objective/rlhf_reward",
        "score",
        "up",
        "Mean over the responses that count of the sum of all rewards per step: what PPO maximises, score "
        "and KL penalty, before whiten_rewards divides them.",
        negative=True,
    ),
    metric(
        "objective/non_score_reward",
        "score",
        "any",
        "The part of objective/rlhf_reward that the KL penalty adds, over the responses that count: minus "
        "kl_beta times k1, with exact-split times the exact KL of the states after the first; 0 where the KL "
        "is in the loss alone.",
        negative=True,
    ),
    metric(
        "objective/entropy",
        "nats",
        "any",
        "-logp of the sampled tokens summed over each response, mean over responses; a fall to a fraction of "
        "the first value means that all responses become alike.",
    ),
    metric(
        "objective/entropy_exact",
        "nats",
        "any",
        "The same with the entropy of each step computed over the whole vocabulary: less noise.",
    ),
    metric(
        "objective/entropy_token_mean",
        "nats/token",
        "any",
        "-logp of the sampled tokens, mean over all response tokens of the rollout: objective/entropy "
        "divided by objective/response_length, so that long responses weigh more.",
    ),
    metric(
        "objective/response_length",
        "tokens",
        "any",
        "Mean tokens of a response, its EOS or stop string included.",
    ),
    metric(
        "objective/eos_fraction",
        "fraction",
        "any",
        "Share of responses that ended with an end-of-sequence token.",
    ),
    metric(
        "objective/stop_fraction",
        "fraction",
        "any",
        "With stop: share of responses that ended with a stop string.",
    ),
    metric(
        "objective/truncated_fraction",
        "fraction",
        "any",
        "Share of responses that were cut at max_new_tokens.",
    ),
    metric(
        "objective/masked_samples",
        "responses",
        "down",
        "Responses of this rollout that do not train anything: no reward could be given to them, or with "
        "critic none to no other response to their prompt.",
    ),
    metric(
        "objective/distinct_2",
        "fraction",
        "any",
        "Different pairs of neighbouring tokens over all pairs of the rollout: falls towards 0 as responses "
        "repeat themselves or each other. Comparable between rollouts of one size alone.",
    ),
    metric(
        "objective/sampling_gap",
        "nats",
        "down",
        "Largest |difference| of the log-probabilities of sampling, with a cache, and of the forward pass "
        "that trains, over the tokens of this rollout: 0 up to rounding.",
    ),
    metric(
        "objective/gold_predicted_peak_kl",
        "nats",
        "any",
        "KL at which the gold score is predicted to be highest, by the fit of d (alpha - beta log d), "
        "d = sqrt(KL); absent while the points do not decide it.",
    ),
    metric(
        "train/kl_loss", "nats", "any", "KL term of the loss, mean over steps, before kl_beta.", negative=True
    ),
    metric(
        "train/ptx_loss",
        "nats/token",
        "down",
        "-logp of the tokens of pretraining text beside PPO (InstructGPT), mean over these tokens, before "
        "ptx_weight.",
    ),
    metric("time/generate_seconds", "s", "down", "Seconds of this update that sampling responses took."),
    metric(
        "time/score_seconds",
        "s",
        "down",
        "Seconds of this update that rewards took on the finished responses.",
    ),
    metric(
        "time/tokens_per_second",
        "tokens/s",
        "up",
        "Response tokens of this update over the seconds of sampling them.",
    ),
    metric("sft/loss", "nats/token", "down", "-logp of the tokens to be learnt, mean over the minibatch."),
    metric(
        "sft/router_loss",
        "1",
        "down",
        "Router auxiliary loss of a mixture of experts, before its coefficient; part of sft/loss where "
        "config.json asks for it (output_router_logits). At its least where experts are used evenly.",
    ),
    metric("sft/held_out_loss", "nats/token", "down", "The same on examples that are not trained on."),
    metric("sft/learning_rate", "1", "any", "Adam's step size in this update.", high=1e-2),
    metric("sft/grad_norm", "1", "any", "Norm of all gradients together, before it is limited."),
    metric("sft/tokens", "tokens", "any", "Tokens learnt from so far; those of every epoch count."),
    metric(
        "reward/loss",
        "nats",
        "down",
        "-log sigmoid(chosen - rejected), mean over the minibatch; ln 2 is chance.",
    ),
    metric(
        "reward/accuracy",
        "fraction",
        "up",
        "Share of the minibatch's pairs whose chosen one scores higher; equal scores count half.",
    ),
    metric("reward/held_out_accuracy", "fraction", "up", "The same on pairs not trained on; 0.5 is chance."),
    metric(
        "reward/calibration_error",
        "fraction",
        "down",
        "Expected calibration error on held-out pairs: mean gap between sigmoid(chosen - rejected) and how "
        "often it is right.",
        high=0.1,
    ),
    metric(
        "reward/margin",
        "score",
        "any",
        "Mean of chosen - rejected over the minibatch, before scores are put to deviation 1.",
        negative=True,
    ),
    metric(
        "eval/gold",
        "score",
        "up",
        "Mean score by the gold judge of responses to held-out prompts: what the over-optimisation monitor "
        "follows.",
        negative=True,
    ),
    metric("eval/gold_masked", "responses", "down", "Of these, how many the gold judge gave no score."),
)
