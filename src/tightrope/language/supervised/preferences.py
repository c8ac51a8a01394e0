"""The second stage: a reward model from preferences, and its scores.

    L = -log sigmoid(r(chosen) - r(rejected)),  r(text) = w . h(last real token)      (Bradley, Terry 1952)

A trained score is put to mean 0 and deviation 1 on demonstrations: r = w' . h - shift. w' = w / deviation is
saved as the head, and shift = mean / deviation is stored in config.json, because the head has no bias.
"""

from __future__ import annotations

import copy
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from tightrope.language.data.batching import pad_right
from tightrope.language.data.examples import Pair, Rows, preference_pairs, read_rows, sft_examples
from tightrope.language.model import lora
from tightrope.language.model.architecture import ROUTER_UNUSED, parts, router_weight
from tightrope.language.model.load import HEAD, known_ids, weights_fingerprint, without_weights
from tightrope.language.model.saving import save_adapter
from tightrope.language.reward.model import SHIFT, RewardModel, write_head
from tightrope.language.settings import RewardSettings
from tightrope.language.supervised.fit import Objective, Stage, micro_batches, resume_stage, train_stage
from tightrope.language.supervised.prepare import GivenModel, Loaded, examples_of, precision
from tightrope.runs.durable import atomic_folder
from tightrope.training.events import Listener, Listeners

DEMONSTRATIONS = 1024  # texts on which scores are normalised, at most
BINS = 10


def make_head(width: int, seed: int) -> nn.Linear:
    """A head [1, d] from N(0, 1 / sqrt(d + 1)), the deviation; without bias (Stiennon et al. 2020)."""
    head = nn.utils.skip_init(nn.Linear, width, 1, bias=False)
    noise = torch.randn(1, width, generator=torch.Generator().manual_seed(seed))
    with torch.no_grad():
        head.weight.copy_(noise / math.sqrt(width + 1))
    return head


def pair_loss(difference: Tensor) -> Tensor:
    """-log sigmoid(r(chosen) - r(rejected)), summed over pairs [B]; nats."""
    return -nn.functional.logsigmoid(difference).sum()


def right_order(difference: Tensor) -> Tensor:
    """1 where the chosen one scores higher, 0 where it does not, 1/2 where both score the same; [B]."""
    return (difference.sign() + 1) / 2


def calibration(difference: Tensor) -> tuple[float, list[dict[str, float]]]:
    """The expected calibration error of sigmoid(|difference|), [N], and the table it comes from.

    A pair's confidence is that of the order the model prefers, 0.5 to 1. By BINS equal bins of confidence:
    pairs, mean confidence, accuracy; the error is the mean gap between the last two, weighted by pairs.
    """
    confidence = torch.sigmoid(difference.double().abs())
    right = right_order(difference.double())
    index = ((confidence - 0.5) * 2 * BINS).long().clamp(max=BINS - 1)
    table, error = [], 0.0
    for i in range(BINS):
        inside = index == i
        count = int(inside.sum())
        if count:
            mean, accuracy = float(confidence[inside].mean()), float(right[inside].mean())
            error += count / len(difference) * abs(accuracy - mean)
            begin, end = 0.5 + i / (2 * BINS), 0.5 + (i + 1) / (2 * BINS)
            table.append({"from": begin, "to": end, "pairs": count, "confidence": mean, "accuracy": accuracy})
    return error, table


def score_differences(model: RewardModel, pairs: Sequence[Pair]) -> Tensor:
    """r(chosen) - r(rejected) of pairs [B], differentiable; both texts of a pair in one forward pass."""
    texts = [pair.chosen for pair in pairs] + [pair.rejected for pair in pairs]
    tokens, real = (x.to(model.head.weight.device) for x in pad_right(texts))
    chosen, rejected = model.raw(tokens, real, right=True).chunk(2)
    return chosen - rejected


def longest(pair: Pair) -> int:
    """The tokens of the longer text of a pair."""
    return max(len(pair.chosen), len(pair.rejected))


@torch.no_grad()
def normalise(model: RewardModel, texts: Sequence[Sequence[int]], size: int) -> tuple[float, float]:
    """Put the scores to mean 0 and deviation 1 on these texts; returns what mean and deviation were.

    Scores that are all equal keep their scale.
    """
    parts_of = micro_batches(texts, size, len)
    batches = [tuple(x.to(model.head.weight.device) for x in pad_right(part)) for part in parts_of]
    scores = torch.cat([model.raw(tokens, real, right=True) for tokens, real in batches]).double()
    mean, deviation = float(scores.mean()), float(scores.std(correction=0))
    gain = 1 / deviation if deviation > 1e-6 else 1.0
    model.head.weight.mul_(gain)
    model.shift = mean * gain
    return mean, deviation


def train_reward(
    settings: RewardSettings,
    *,
    data: Rows | None = None,
    validation: Rows | None = None,
    demonstrations: Rows | None = None,
    model: GivenModel | None = None,
    listeners: Sequence[Listener] = (),
    run_dir: str | Path | None = None,
) -> dict[str, Any]:
    """Train a reward model; returns the summary that is also written to the run folder.

    ``data`` and ``validation`` replace the files that the settings name: rows in any format of
    `preference_pairs`; ``demonstrations``: rows of `sft_examples`. ``model``: a causal (model, tokenizer),
    whose trunk is trained in place. The run folder holds settings.json, metrics.jsonl, summary.json (with the
    calibration table) and ``model``, which AutoModelForSequenceClassification.from_pretrained loads, or
    AutoModel with the head in a file where transformers has no such class for the architecture; tuned by LoRA
    also ``adapter``, which PEFT loads and alignment puts on its own trunk.
    Raises ValueError for data or settings that cannot work, before anything is trained, and DoesNotFit, which
    is one, for too little memory, before the model is loaded.
    """
    given = {"data": data, "validation": validation, "demonstrations": demonstrations}
    return train_stage(REWARD_STAGE, settings, given, model, listeners, run_dir)


def resume_reward(
    run_dir: str | Path,
    *,
    data: Rows | None = None,
    validation: Rows | None = None,
    demonstrations: Rows | None = None,
    model: GivenModel | None = None,
    listeners: Sequence[Listener] = (),
) -> dict[str, Any]:
    """Continue a run of `train_reward`, as `resume_sft` does with one of `train_sft`."""
    given = {"data": data, "validation": validation, "demonstrations": demonstrations}
    return resume_stage(REWARD_STAGE, run_dir, given, model, listeners)


def _objective(
    settings: RewardSettings, loaded: Loaded, given: Mapping[str, Rows | None], listeners: Listeners
) -> Objective:
    base, _, language_head = parts(loaded.model)
    size = settings.micro_batch_size or settings.minibatch_size
    head = make_head(language_head.in_features, settings.seed).to(settings.device)
    model, skeleton = RewardModel(base, head, 0.0, loaded.tokenizer), reward_skeleton(loaded)
    if router_weight(loaded.model):
        listeners.warn(ROUTER_UNUSED.format("reward does not have it in its loss"))
    pairs, held, texts = _data(settings, loaded, given, listeners)

    def loss(items: Sequence[Pair]) -> tuple[Tensor, dict[str, Tensor]]:
        with precision(settings):
            found = score_differences(model, items)
        seen = found.detach()
        return pair_loss(found), {"accuracy": right_order(seen).sum(), "margin": seen.sum()}

    @torch.no_grad()
    def held_out() -> Tensor:
        with precision(settings):
            return torch.cat([score_differences(model, part) for part in micro_batches(held, size, longest)])

    def evaluate() -> dict[str, float]:
        if not held:
            return {}
        found = held_out()
        accuracy = float(right_order(found).mean())
        return {"reward/held_out_accuracy": accuracy, "reward/calibration_error": calibration(found)[0]}

    def save(folder: Path, newest: dict[str, float]) -> dict[str, Any]:
        table = calibration(held_out())[1] if held else []
        with precision(settings):
            mean, deviation = normalise(model, texts, size)
        refused = save_reward(skeleton, loaded, head.weight, model.shift, folder, newest)
        if refused:
            listeners.warn(f"{folder / 'adapter'}: {refused}")
        return {
            "pairs": len(pairs),
            "held_out_pairs": len(held),
            "calibration": table,
            "score_mean": mean,
            "score_deviation": deviation,
            "demonstrations": len(texts),
        }

    return Objective(
        "reward", "train", pairs, loss, lambda pair: 1, longest, evaluate, save,
        parameters=[*loaded.trained(base), *head.parameters()],
        data=f"{len(pairs)} pairs; {len(held)} held out",
    )  # fmt: skip


REWARD_STAGE = Stage("reward", RewardSettings, _objective)


def _data(
    settings: RewardSettings, loaded: Loaded, given: Mapping[str, Rows | None], listeners: Listeners
) -> tuple[list[Pair], list[Pair], list[tuple[int, ...]]]:
    """Pairs to train on, pairs held out (whole prompts, where there are many), and texts to normalise on."""
    reading: dict[str, Any] = {
        "eos": loaded.eos, "max_tokens": settings.max_tokens, "vocabulary": known_ids(loaded.model),
        "notify": listeners.warn,
    }  # fmt: skip
    pairs, held = examples_of(
        settings,
        given,
        lambda rows: preference_pairs(rows, loaded.tokenizer, **reading),
        lambda pair: pair.chosen[: pair.prompt_length],
    )
    texts = [pair.chosen for pair in pairs]
    source = settings.demonstrations if given["demonstrations"] is None else given["demonstrations"]
    if source is not None:
        texts = [example.tokens for example in sft_examples(read_rows(source), loaded.tokenizer, **reading)]
    order = np.random.default_rng([settings.seed, 2]).permutation(len(texts))[:DEMONSTRATIONS]
    return pairs, held, [texts[i] for i in order]


def reward_skeleton(loaded: Loaded) -> Any:
    """A model without weights that holds what is saved, made early, to learn if there is one: the class of
    AutoModelForSequenceClassification that scores with this trunk through a bias-free head called ``score``,
    where transformers has one; otherwise the bare trunk, which AutoModel loads.
    """
    from transformers import (
        MODEL_FOR_SEQUENCE_CLASSIFICATION_MAPPING,
        AutoModel,
        AutoModelForSequenceClassification,
    )

    config = copy.deepcopy(loaded.model.config)
    config.num_labels = 1
    if getattr(config, "pad_token_id", None) in loaded.eos:  # some configurations have no such field
        # transformers reads the score before the first padding id: where that is the EOS too, it would read
        # another token than the last one, silently. Without a padding id it refuses batches instead.
        config.pad_token_id = None
    scores = type(config) in MODEL_FOR_SEQUENCE_CLASSIFICATION_MAPPING
    for kind in (AutoModelForSequenceClassification, AutoModel) if scores else (AutoModel,):
        with torch.device("meta"):
            skeleton = without_weights(kind, config)
        if skeleton.state_dict().keys() == _state_of(skeleton, loaded, None, torch.empty(0)).keys():
            return skeleton
    raise ValueError(
        f"{type(loaded.model).__name__} names its weights as no class of transformers does that could score "
        "texts, so that a reward model of it could not be loaded again. Choose another model."
    )


def _state_of(skeleton: Any, loaded: Loaded, adapter: str | None, head: Tensor) -> dict[str, Tensor]:
    """The weights of the trunk, an adapter folded in, by a skeleton's names; with a head if it has one."""
    prefix = f"{loaded.model.base_model_prefix}."
    merged = lora.merged_state(loaded.model, adapter)
    state = {name: tensor.cpu() for name, tensor in merged.items() if name.startswith(prefix)}
    if _has_head(skeleton):
        return {**state, "score.weight": head.cpu()}
    return {name.removeprefix(prefix): tensor for name, tensor in state.items()}


def _has_head(skeleton: Any) -> bool:
    return isinstance(getattr(skeleton, "score", None), nn.Linear)


def save_reward(
    skeleton: Any, loaded: Loaded, head: Tensor, shift: float, path: Path, final: dict[str, float]
) -> str | None:
    """RUN/model for AutoModelForSequenceClassification.from_pretrained, or a bare trunk with its head in a
    file, and the adapter where there is one. Returns why PEFT does not open the adapter; None where it does.

    ``head`` [1, d] with the gain folded in; ``shift`` is what has to be subtracted from its scores.
    """
    head, scores = head.detach().contiguous(), _has_head(skeleton)
    skeleton.load_state_dict(_state_of(skeleton, loaded, loaded.adapter, head), strict=True, assign=True)
    setattr(skeleton.config, SHIFT, shift)
    with atomic_folder(path / "model") as folder:
        skeleton.save_pretrained(folder)
        loaded.tokenizer.save_pretrained(folder)
        text = card(shift, loaded.source, final, scores=scores)
        (folder / "README.md").write_text(text, encoding="utf-8")
        if not scores:
            write_head(folder / HEAD, head, shift)
    if loaded.adapter is None:
        return None
    with atomic_folder(path / "adapter") as folder:
        score = head if scores else None
        refused = save_adapter(loaded.model, loaded.adapter, folder, base_model=loaded.source, score=score)
        write_head(folder / HEAD, head, shift, weights_fingerprint(loaded.source))  # for alignment
    return refused


def card(shift: float, source: str, final: dict[str, float], *, scores: bool = True) -> str:
    """The model card: how the folder is loaded, and what has to be subtracted by hand elsewhere. ``scores``:
    transformers has a class that does.
    """
    accuracy, error = (final.get(f"reward/{name}") for name in ("held_out_accuracy", "calibration_error"))
    measured = "Nothing was held out, so its accuracy is not known."
    if accuracy is not None and error is not None:
        measured = f"On held-out pairs: accuracy {accuracy:.3f}, expected calibration error {error:.3f}."
    return f"""# Reward model

Trained by Bradley-Terry on preferences, from {"/".join(Path(source).parts[-2:])}. {measured}

{(WITH_CLASS if scores else WITHOUT_CLASS).format(shift=repr(shift), name=SHIFT)}"""


WITH_CLASS = """```python
from transformers import AutoModelForSequenceClassification

model = AutoModelForSequenceClassification.from_pretrained("this/folder", num_labels=1)
score = model(input_ids).logits[:, 0] - ({shift})
```

Scores have mean 0 and deviation 1 on demonstrations **after the shift {shift} is subtracted**. It is stored
in config.json as `{name}`; tightrope subtracts it, other programs do not. The gain is part of the head.

The score is read at the last token of a text, which should be its end-of-sequence token. Pad on the right,
with the `pad_token_id` of config.json; where that is null, score one text at a time.
"""

WITHOUT_CLASS = """transformers has no class that scores texts with this architecture. The folder holds the
model without a head, and `head.safetensors` the head and its shift:

```python
from safetensors.torch import load_file
from transformers import AutoModel

model, head = AutoModel.from_pretrained("this/folder"), load_file("this/folder/head.safetensors")
hidden = model(input_ids, use_cache=False).last_hidden_state[:, -1]
score = (hidden @ head["score.weight"].T)[:, 0] - head["shift"]
```

Scores have mean 0 and deviation 1 on demonstrations **after the shift {shift} is subtracted**.

The score is read at the last token of a text, which should be its end-of-sequence token. Score one text at a
time, or take the hidden state of each text's own last token.
"""
