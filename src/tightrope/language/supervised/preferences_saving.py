"""What reward modelling leaves: a folder that plain transformers loads, an adapter for PEFT and alignment."""

from __future__ import annotations

import copy
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from tightrope.language.model import lora
from tightrope.language.model.load import weights_fingerprint, without_weights
from tightrope.language.model.saving import save_adapter
from tightrope.language.reward.model import SHIFT
from tightrope.language.supervised.prepare import Loaded
from tightrope.runs.durable import atomic_folder


def reward_skeleton(loaded: Loaded) -> Any:
    """The model class that scores with this trunk, without weights; made early, to learn if there is one."""
    from transformers import AutoModelForSequenceClassification

    config = copy.deepcopy(loaded.model.config)
    config.num_labels = 1
    if config.pad_token_id in loaded.eos:
        # transformers reads the score before the first padding id: where that is the EOS too, it would read
        # another token than the last one, silently. Without a padding id it refuses batches instead.
        config.pad_token_id = None
    with torch.device("meta"):
        skeleton = without_weights(AutoModelForSequenceClassification, config)
    if not isinstance(getattr(skeleton, "score", None), nn.Linear) or skeleton.score.bias is not None:
        raise ValueError(
            f"{type(skeleton).__name__} has no bias-free head called score, so that a reward model of it "
            "would not load elsewhere. Llama, Qwen, Mistral, GPT-2 and similar models have one."
        )
    return skeleton


def save_reward(
    skeleton: Any, loaded: Loaded, head: Tensor, shift: float, path: Path, final: dict[str, float]
) -> None:
    """RUN/model for AutoModelForSequenceClassification.from_pretrained, and the adapter where there is one.

    ``head`` [1, d] with the gain folded in; ``shift`` is what has to be subtracted from its scores.
    """
    from safetensors.torch import save_file

    prefix, head = f"{loaded.model.base_model_prefix}.", head.detach().contiguous()
    merged = lora.merged_state(loaded.model, loaded.adapter)
    state = {name: tensor for name, tensor in merged.items() if name.startswith(prefix)}
    state = {name: tensor.cpu() for name, tensor in {**state, "score.weight": head}.items()}
    skeleton.load_state_dict(state, strict=True, assign=True)
    setattr(skeleton.config, SHIFT, shift)
    with atomic_folder(path / "model") as folder:
        skeleton.save_pretrained(folder)
        loaded.tokenizer.save_pretrained(folder)
        (folder / "README.md").write_text(card(shift, loaded.source, final), encoding="utf-8")
    if loaded.adapter is not None:
        with atomic_folder(path / "adapter") as folder:
            save_adapter(loaded.model, loaded.adapter, folder, base_model=loaded.source, score=head)
            # the head with its shift, for alignment
            shifted = {"score.weight": head.cpu(), "shift": torch.tensor(shift, dtype=torch.float64)}
            trunk = weights_fingerprint(loaded.source)
            save_file(shifted, folder / "head.safetensors", metadata={"trunk": trunk} if trunk else None)


def card(shift: float, source: str, final: dict[str, float]) -> str:
    """The model card: how the folder is loaded, and what has to be subtracted by hand elsewhere."""
    accuracy, error = (final.get(f"reward/{name}") for name in ("held_out_accuracy", "calibration_error"))
    measured = "Nothing was held out, so its accuracy is not known."
    if accuracy is not None and error is not None:
        measured = f"On held-out pairs: accuracy {accuracy:.3f}, expected calibration error {error:.3f}."
    return f"""# Reward model

Trained by Bradley-Terry on preferences, from {"/".join(Path(source).parts[-2:])}. {measured}

```python
from transformers import AutoModelForSequenceClassification

model = AutoModelForSequenceClassification.from_pretrained("this/folder", num_labels=1)
score = model(input_ids).logits[:, 0] - ({shift!r})
```

Scores have mean 0 and deviation 1 on demonstrations **after the shift {shift!r} is subtracted**. It is stored
in config.json as `{SHIFT}`; tightrope subtracts it, other programs do not. The gain is part of the head.

The score is read at the last token of a text, which should be its end-of-sequence token. Pad on the right,
with the `pad_token_id` of config.json; where that is null, score one text at a time.
"""
