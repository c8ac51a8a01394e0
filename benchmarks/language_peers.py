"""The peer's side of language.py: PPO by TRL 1.12's trl.experimental.ppo, in the peer's own interpreter.

    python language_peers.py '{"folder": ..., "batch": 64, "tokens": 24, "iterations": 4}' RESULT.json

This file does not import tightrope. TRL removed PPO in 1.13.
"""

from __future__ import annotations

import importlib.metadata
import json
import os
import sys
import tempfile
from pathlib import Path
from typing import Any

OPENINGS = ["The film was very", "I went to see this", "The story of a man who", "What a waste of a good"]


def train(job: dict[str, Any]) -> dict[str, Any]:
    """Full fine-tuning of policy and critic, separate reference and reward model: TRL's only layout here."""
    os.environ.update(HF_HUB_OFFLINE="1", TRL_EXPERIMENTAL_SILENCE="1", WANDB_DISABLED="true")
    import torch
    from datasets import Dataset
    from transformers import AutoModelForCausalLM, AutoModelForSequenceClassification, AutoTokenizer
    from trl.experimental.ppo import PPOConfig, PPOTrainer

    torch.set_num_threads(job["threads"])
    folder = job["folder"]
    tokenizer = AutoTokenizer.from_pretrained(folder, padding_side="left", trust_remote_code=False)
    if tokenizer.pad_token is None:
        tokenizer.pad_token = tokenizer.eos_token
    policy, reference = (
        AutoModelForCausalLM.from_pretrained(folder, dtype=torch.float32, trust_remote_code=False)
        for _ in range(2)
    )
    kind = AutoModelForSequenceClassification
    reward, critic = (
        kind.from_pretrained(folder, num_labels=1, dtype=torch.float32, trust_remote_code=False)
        for _ in range(2)
    )
    for model in (policy, reference, reward, critic):
        model.config.pad_token_id = tokenizer.pad_token_id
    rows = [{"input_ids": tokenizer(text)["input_ids"]} for text in OPENINGS * 256]
    batch, count = job["batch"], job["batch"] * job["iterations"]
    with tempfile.TemporaryDirectory() as out:
        settings = PPOConfig(
            output_dir=out, per_device_train_batch_size=batch, gradient_accumulation_steps=1,
            num_mini_batches=1, num_ppo_epochs=4, total_episodes=count, response_length=job["tokens"],
            local_rollout_forward_batch_size=batch, report_to="none", use_cpu=True,
            num_sample_generations=0, save_strategy="no", bf16=False, logging_steps=1000,
        )  # fmt: skip
        data = Dataset.from_list(rows)
        trainer = PPOTrainer(
            args=settings, processing_class=tokenizer, model=policy, ref_model=reference, reward_model=reward,
            value_model=critic, train_dataset=data, eval_dataset=data,
        )  # fmt: skip
        trainer.train()
    return {"tokens": count * job["tokens"]}


def main(words: list[str]) -> None:
    """Run the job of the command line and write the result file."""
    if words[0] == "versions":
        names = ("trl", "transformers", "torch")
        result: Any = {name: importlib.metadata.version(name) for name in names}
    else:
        result = train(json.loads(words[0]))
    Path(words[-1]).write_text(json.dumps(result), encoding="utf-8")


if __name__ == "__main__":
    main(sys.argv[1:])
