"""The family table: every causal family of the installed transformers, tiny, through every stage.

    python benchmarks/families.py --out benchmarks/results/language/families.json   # all that it lacks
    python benchmarks/families.py gemma2 bamba --out FILE                           # these, once more
    python benchmarks/families.py --every 3 --columns doctor sft                    # each third, not written

A family is a model type in transformers' own mapping of causal language models. Its configuration is
made small by SMALL, a rule on the names of its numbers, and by EXCEPTIONS. Its weights are random at unit
scale, so that logits react to everything; every dropout of its configuration is at 0.2. Each family is built
and tried in a process of its own with a time limit, and its row is kept in the file: a stopped table goes on.

A cell is "ok" with the largest difference from an independent computation by transformers, "refused" with one
sentence of our own (of the doctor: with what it finds bad), "wrong" with the difference, or "crash": an error
that a user would see as a traceback.
"""

from __future__ import annotations

import argparse
import copy
import json
import math
import multiprocessing
import os
import re
import sys
import tempfile
import time
import traceback
from collections.abc import Callable, Sequence
from datetime import date
from pathlib import Path
from typing import Any

# name of a number in a configuration -> its value in a tiny model; the first rule that matches the whole name
SMALL = {
    r"hidden_size_per_layer_input|qk_(nope|rope)_head_dim|v_head_dim|linear_(key_|value_)?head_dim": 8,
    r"index_head_dim|kv_lora_rank|ple_embed_dim|d_rel|gated_norm_rank|head_dim|swa_head_dim": 8,
    r"(mamba_d_|ssm_)?state(_size)?|sliding_window(_size)?|attention_window_size|window_size": 8,
    r"local_attention|attention_chunk_size|rotary_dim|dim_head|attention_head_size": 8,
    r"mamba_(d_head|head_?dim)|qk_head_dim|q_lora_rank|o_lora_rank|attention_head_dim|head_dim_ssm": 16,
    r".*vocab_size(_per_layer_input)?": 64,
    r"hidden_size|d_model|n_embd|.*embedding_size|emb(edding)?_dim|word_embed_proj_dim|lru_width": 32,
    r"attention_hidden_size|router_hidden_size": 32,
    r".*intermediate_size.*|.*ffn.*(dim|size)|d_inner|dff|dim_ff|feed_forward_size": 64,
    r"mamba_d_ssm|prompt_mid_dim": 64,
    r"num_(hidden_|encoder_|decoder_)?layers|n_layers?|(en|de)coder_layers|num_blocks": 4,
    r"(swa_)?num_key_value_heads|num_kv_heads|num_query_groups|linear_num_key_heads|index_n_heads": 2,
    r".*(attention|mamba|linear|value)_heads|n_heads?|num_heads|mamba_(n|num)_heads": 4,
    r"(moe_)?num_(local_)?experts|n_routed_experts|zero_expert_num": 4,
    r"num_experts_per_tok(en)?|moe_(topk|k)": 2,
    r"n_group|topk_group|num_expert_group|(mamba_)?n_?groups|first_k_dense_replace|num_dense_layers": 1,
    r"num_nextn_predict_layers|num_kv_shared_layers": 0,
    r"max_position_embeddings|n_positions|n_ctx|max_seq_len|model_max_length": 96,
    r"context_length|original_max_position_embeddings|max_(source|target)_positions": 96,
    r"time_step_rank|mamba_dt_rank|laurel_rank": 4,
    r"max_window_layers": 2,
    r"index_topk": 96,  # no more than there are: where scores tie, the choice depends on a row's padding
    r"bos_token_id": 2,
    r"eos_token_id|eod_token_id": 3,
    r"pad_token_id": 0,
}  # fmt: skip
# what the rule cannot know
EXCEPTIONS: dict[str, dict[str, Any]] = {
    "bamba": {"attn_layer_indices": [1, 3]},
    "cohere_compass_text": {"layer_types": ["sliding_attention", "full_attention"] * 2},
    "deepseek_v2": {"num_experts_per_tok": 2, "topk_method": "greedy"},
    "diffllama": {"attention_dropout": 0.0},  # its class refuses others
    "dory": {"n_input_layers": 1, "n_recurrent_layers": 2, "n_output_layers": 1},
    "dots1": {"n_routed_experts": 4, "n_shared_experts": 1, "num_experts_per_tok": 2},
    "granitemoehybrid": {"layer_types": ["mamba", "attention"] * 2, "mamba_d_state": 8},
    "jamba": {"attn_layer_period": 2, "attn_layer_offset": 1, "expert_layer_period": 2},
    "mamba2": {"head_dim": 16},
    "olmo_hybrid": {"layer_types": ["linear_attention", "full_attention"] * 2},
    **{kind: {"head_dim": 8} for kind in ("hunyuan_v1_dense", "hunyuan_v1_moe")},
}
DROPOUT = 0.2
MOST_PARAMETERS = 8_000_000
LIMIT_SECONDS = 240
WORDS = ["<pad>", "<unk>", "<bos>", "<eos>", *"abcdefghijklmnopqrstuvwxyz .!?,'", "\n"]
ENDINGS = (3, 5, 7, 9, 11, 13, 15, 17, 19, 40, 45, 50)  # ids that end a response: rows end one after another
TEXTS = [
    "the cat sat.", "a dog ran off!", "no.", "who is there, and why?", "it was a long day", "yes yes yes",
    "once more", "and so it ends.",
]  # fmt: skip
TOLERANCE = 1e-3  # of logits at unit scale, of losses in nats, and of scores in deviations
KEPT = ("A_log", "dt_", "rglru", "conv", "recurrent_param", "time_", "decay", "rotary", "freq")


class Unfit(Exception):
    """What the doctor finds wrong with a model, or the card of an adapter says of PEFT."""


class CannotBuild(Exception):
    """Why there is no tiny model of a family."""


def families() -> dict[str, str]:
    """Model type -> class of its causal language model, as the installed transformers maps them."""
    from transformers.models.auto.modeling_auto import MODEL_FOR_CAUSAL_LM_MAPPING_NAMES

    return dict(MODEL_FOR_CAUSAL_LM_MAPPING_NAMES)


def small_config(kind: str) -> Any:
    """A configuration of this model type with every number small."""
    from transformers.models.auto.configuration_auto import CONFIG_MAPPING

    try:
        default = CONFIG_MAPPING[kind]()
        inner = default.get_text_config()
    except Exception as error:
        raise CannotBuild(f"its configuration has no defaults ({first_line(error)})") from error
    if inner is not default:
        raise CannotBuild("it has parts beside its text model")
    known = default.to_dict()
    names = set(known) | set(getattr(default, "attribute_map", {}).values())
    values: dict[str, Any] = {}
    for name in sorted(names):
        value = known[name] if name in known else _found(default, name)
        if isinstance(value, bool):
            continue
        if isinstance(value, int) or (value is None and name.endswith("_token_id")):
            small = next((small for rule, small in SMALL.items() if re.fullmatch(rule, name)), value)
            values[name] = small
        elif isinstance(value, float) and re.search("drop|jitter", name):
            values[name] = DROPOUT
    heads = [n for n in ("num_attention_heads", "n_head", "n_heads") if n in values]
    kv = [n for n in ("num_key_value_heads", "num_kv_heads") if n in values]
    if heads and kv and _found(default, heads[0]) == _found(default, kv[0]):
        values[kv[0]] = values[heads[0]]
    layers = _found(default, "num_hidden_layers")
    for name, value in known.items():
        if isinstance(value, list) and layers and len(value) == layers and not isinstance(value[0], float):
            kinds = list(dict.fromkeys(map(str, value)))
            several = [next(v for v in value if str(v) == k) for k in kinds]
            values[name] = [several[i % len(several)] for i in range(4)]
    if "is_decoder" in known:
        values["is_decoder"] = True
    values = {**values, **EXCEPTIONS.get(kind, {})}
    return CONFIG_MAPPING[kind](**{name: value for name, value in values.items() if value is not ...})


def _found(config: Any, name: str) -> Any:
    """A value under another name of it; None where each layer has its own."""
    try:
        return getattr(config, name, None)
    except Exception:
        return None


def first_line(error: BaseException) -> str:
    """What an error is, in one line."""
    return f"{type(error).__name__}: {(str(error).strip().splitlines() or [''])[0][:160]}"


def tokenizer() -> Any:
    """Characters; a few ids have no word."""
    from tokenizers import Regex, Tokenizer, decoders, models, pre_tokenizers
    from transformers import PreTrainedTokenizerFast

    inner = Tokenizer(models.WordLevel({w: i for i, w in enumerate(WORDS)}, unk_token="<unk>"))
    inner.pre_tokenizer = pre_tokenizers.Split(Regex("[\\s\\S]"), "isolated")
    inner.decoder = decoders.Fuse()
    return PreTrainedTokenizerFast(
        tokenizer_object=inner, pad_token="<pad>", unk_token="<unk>", bos_token="<bos>", eos_token="<eos>",
        model_max_length=96, clean_up_tokenization_spaces=False,
    )  # fmt: skip


def build(kind: str, folder: Path) -> str:
    """Write a tiny model of a family with its tokenizer into a folder. CannotBuild says why there is none."""
    import torch
    from transformers import AutoModelForCausalLM

    torch.manual_seed(0)
    try:
        config = small_config(kind)
        with torch.device("meta"):
            meta = AutoModelForCausalLM.from_config(copy.deepcopy(config), trust_remote_code=False)
        size = sum(p.numel() for p in meta.parameters())
        if size > MOST_PARAMETERS:
            raise CannotBuild(f"its smallest model has {size:,} parameters")
        model = AutoModelForCausalLM.from_config(config, trust_remote_code=False).eval()
        generator = torch.Generator().manual_seed(1)
        with torch.no_grad():
            for name, p in model.named_parameters():
                if any(word in name for word in KEPT) or name.endswith(".D"):
                    continue
                noise = torch.randn(p.shape, generator=generator)
                p.copy_(noise / p.shape[-1] ** 0.5) if p.dim() >= 2 else p.add_(noise * 0.1)
        model.tie_weights()
        ids = torch.arange(4, 12)[None]
        logits = model(input_ids=ids).logits
        if not bool(logits.isfinite().all()):
            raise CannotBuild("its logits are not finite with random weights")
        if model.generation_config is not None:
            model.generation_config.eos_token_id = list(ENDINGS)
        model.save_pretrained(folder)
        tokenizer().save_pretrained(folder)
    except CannotBuild:
        raise
    except Exception as error:
        raise CannotBuild(first_line(error)) from error
    return str(folder)


def doctor(folder: str, work: Path) -> float:
    """The self-check: nothing it finds is bad."""
    from tightrope.language.selfcheck import check_model

    bad = [f"{finding.what} ({finding.seen})" for finding in check_model(folder) if not finding.good]
    if bad:
        raise Unfit("; ".join(bad))
    return 0.0


def sft(folder: str, work: Path) -> float:
    """The first loss is transformers' cross-entropy of every text by itself."""
    import torch
    from transformers import AutoModelForCausalLM

    from tightrope.language import SFTSettings, train_sft
    from tightrope.language.model.load import load_causal

    words, model = tokenizer(), load_causal(folder)
    settings = SFTSettings(
        model=folder, lora_rank=4, learning_rate=0.01, max_tokens=48, minibatch_size=8, num_epochs=4,
        held_out=0.0, learning_rate_schedule="constant",
    )  # fmt: skip
    run = work / "sft"
    train_sft(settings, data=[{"text": text} for text in TEXTS], model=(model, words), run_dir=run)
    rows = [json.loads(line) for line in (run / "metrics.jsonl").read_text().splitlines()]
    found = next(row["sft/loss"] for row in rows if "sft/loss" in row)
    plain = AutoModelForCausalLM.from_pretrained(folder, trust_remote_code=False).eval()
    total, count = 0.0, 0
    with torch.no_grad():
        for text in TEXTS:
            ids = torch.tensor([[*words(text)["input_ids"], 3]])
            logs = plain(input_ids=ids).logits[0, :-1].float().log_softmax(1)
            total -= float(logs.gather(1, ids[0, 1:, None]).sum())
            count += ids.shape[1] - 1
    (work / "trained.json").write_text(json.dumps(_logits_of_trained(model)))
    return abs(total / count - found)


def _logits_of_trained(model: Any) -> list[Any]:
    from tightrope.language.model import lora

    with lora.using(model, "sft"):
        return _logits(model.eval())


def _logits(model: Any) -> list[Any]:
    import torch

    with torch.no_grad():
        return [model(input_ids=torch.arange(4, 20)[None]).logits[0].float().tolist()]


def _gap(a: list[Any], b: list[Any]) -> float:
    import torch

    one, two = torch.tensor(a), torch.tensor(b)
    return float((one - two).abs().max() / max(1.0, float(two.abs().max())))


def reload(folder: str, work: Path) -> float:
    """RUN/model of sft in plain transformers gives the logits of what was trained."""
    from transformers import AutoModelForCausalLM

    model = AutoModelForCausalLM.from_pretrained(work / "sft/model", trust_remote_code=False).eval()
    return _gap(_logits(model), json.loads((work / "trained.json").read_text()))


def peft(folder: str, work: Path) -> float:
    """RUN/adapter of sft on its base in PEFT gives the logits of what was trained."""
    from peft import PeftModel
    from transformers import AutoModelForCausalLM

    if not (work / "sft/adapter").is_dir():
        raise ValueError("no adapter folder was written")
    card = (work / "sft/adapter/README.md").read_text()
    if "PeftModel" not in card:
        raise Unfit(card.strip().splitlines()[-1])
    base = AutoModelForCausalLM.from_pretrained(folder, trust_remote_code=False).eval()
    model = PeftModel.from_pretrained(base, work / "sft/adapter").eval()
    return _gap(_logits(model), json.loads((work / "trained.json").read_text()))


def reward(folder: str, work: Path) -> float:
    """Scores of the saved model on the texts that they were normalised on have mean 0 and deviation 1;
    activations are checkpointed where the family can, which puts modules into training mode.
    """
    import torch

    from tightrope.language import RewardSettings, load_reward, train_reward

    words = tokenizer()
    rows = [{"chosen": a, "rejected": b} for a, b in zip(TEXTS[:4], TEXTS[4:], strict=True)]
    settings = RewardSettings(
        model=folder, lora_rank=4, max_tokens=48, minibatch_size=4, num_epochs=2, held_out=0.0,
        gradient_checkpointing=True,
    )  # fmt: skip
    try:
        train_reward(settings, data=rows, run_dir=work / "reward")
    except ValueError as error:
        if "--gradient-checkpointing" not in str(error):
            raise
        settings = settings.with_values(gradient_checkpointing=False)
        train_reward(settings, data=rows, run_dir=work / "reward")
    model = load_reward(work / "reward")
    scores = []
    for text in TEXTS[:4]:
        ids = torch.tensor([[*words(text)["input_ids"], 3]])
        scores.append(float(model.score(ids, torch.ones_like(ids, dtype=torch.bool))))
    found = torch.tensor(scores)
    return max(abs(float(found.mean())), abs(float(found.std(correction=0)) - 1))


def _align(folder: str, work: Path, tune: str) -> float:
    """What was sampled is what is trained, while rows end one after another, and the KL begins at 0."""
    from tightrope.language import align

    def letters(prompts: Any, completions: Sequence[str], **columns: Any) -> list[float]:
        return [float(text.count("a") + 0.1 * len(text)) for text in completions]

    run = work / f"align-{tune}"
    align(
        model=folder, prompts=["the ", "a dog ran", "no. and", "who?"], reward=letters, total_episodes=16,
        batch_size=8, minibatch_size=4, num_epochs=1, samples_per_prompt=2, max_new_tokens=12, tune=tune,
        lora_rank=4, learning_rate=1e-3, run_dir=run, seed=1, reward_timeout=None,
    )  # fmt: skip
    rows = [json.loads(line) for line in (run / "metrics.jsonl").read_text().splitlines()]
    gaps = [row["objective/sampling_gap"] for row in rows if "objective/sampling_gap" in row]
    kl = abs(next(row["objective/kl"] for row in rows if "objective/kl" in row))
    return max(*gaps, kl)


def align_lora(folder: str, work: Path) -> float:
    """Adapters."""
    return _align(folder, work, "lora")


def align_full(folder: str, work: Path) -> float:
    """Every weight."""
    return _align(folder, work, "full")


COLUMNS: dict[str, Callable[[str, Path], float]] = {
    "doctor": doctor, "sft": sft, "reload": reload, "peft": peft, "reward": reward, "align_lora": align_lora,
    "align_full": align_full,
}  # fmt: skip
AFTER = {"reload": "sft", "peft": "sft"}


def cell(column: str, folder: str, work: Path, row: dict[str, Any]) -> dict[str, Any]:
    """One verdict."""
    needs = AFTER.get(column)
    if needs is not None and row.get(needs, {}).get("verdict") not in ("ok", "wrong"):
        return {"verdict": "refused", "text": f"as {needs}"}
    try:
        value = COLUMNS[column](folder, work)
    except Unfit as error:
        return {"verdict": "refused", "text": str(error)}
    except Exception as error:
        if is_refusal(error):
            return {"verdict": "refused", "text": str(error)}
        frames = traceback.extract_tb(error.__traceback__)
        places = " < ".join(f"{Path(f.filename).name}:{f.lineno}" for f in reversed(frames[-6:]))
        return {"verdict": "crash", "text": f"{first_line(error)} at {places}"}
    good = math.isfinite(value) and value <= TOLERANCE
    shown = float(f"{value:.2g}") if math.isfinite(value) else str(value)
    return {"verdict": "ok" if good else "wrong", "value": shown}


def is_refusal(error: BaseException) -> bool:
    """Whether the command line would print this error as a sentence, and it is a short one."""
    from tightrope.cli import main

    words = (ValueError, OSError, RuntimeError, FloatingPointError)
    return isinstance(error, words) and main._is_ours(error) and len(str(error)) < 700


def tried(kind: str, columns: Sequence[str]) -> dict[str, Any]:
    """The row of one family."""
    begin = time.process_time()
    row: dict[str, Any] = {"class": families()[kind]}
    with tempfile.TemporaryDirectory() as place:
        try:
            folder = build(kind, Path(place) / "model")
        except CannotBuild as error:
            return {**row, "not_built": str(error)}
        for column in columns:
            row[column] = cell(column, folder, Path(place), row)
    return {**row, "seconds": round(time.process_time() - begin, 1)}


def _child(kind: str, columns: Sequence[str], pipe: Any) -> None:
    import torch

    torch.set_num_threads(1)
    with open(os.devnull, "w") as nothing:
        os.dup2(nothing.fileno(), 2)
        pipe.send(tried(kind, columns))


def in_process(kind: str, columns: Sequence[str]) -> dict[str, Any]:
    """`tried` in a process of its own, which shares what is imported here."""
    context = multiprocessing.get_context("fork")
    here, there = context.Pipe(duplex=False)
    process = context.Process(target=_child, args=(kind, columns, there))
    process.start()
    there.close()
    try:
        if here.poll(LIMIT_SECONDS):
            return here.recv()
        reason = f"no answer within {LIMIT_SECONDS} seconds"
    except EOFError:
        process.join()
        reason = f"the process ended with code {process.exitcode}"
    finally:
        if process.is_alive() and not here.closed:
            process.join(1)
        if process.is_alive():
            process.kill()
        process.join()
    return {"class": families()[kind], "not_built": reason}


def main(words: Sequence[str] | None = None) -> int:
    """Fill the table."""
    parser = argparse.ArgumentParser(description="The family table of the language story.")
    parser.add_argument("families", nargs="*", help="model types; none: all that the file lacks")
    parser.add_argument("--out", type=Path, help="the JSON file of the table")
    parser.add_argument("--every", type=int, default=1, help="only each n-th family")
    parser.add_argument("--columns", nargs="+", default=list(COLUMNS), choices=list(COLUMNS))
    given = parser.parse_args(words)
    import transformers

    import tightrope.language  # imported once, for all processes
    import tightrope.language.selfcheck
    import tightrope.language.supervised.sft  # noqa: F401

    table: dict[str, Any] = {"rows": {}}
    if given.out is not None and given.out.exists():
        table = json.loads(given.out.read_text(encoding="utf-8"))
    chosen = given.families or [k for k in sorted(families())[:: given.every] if k not in table["rows"]]
    for kind in chosen:
        row = in_process(kind, given.columns)
        verdicts = {c: row[c]["verdict"] for c in given.columns if c in row}
        print(
            f"{kind:<24}{row.get('not_built') or ' '.join(f'{c}={v}' for c, v in verdicts.items())}",
            flush=True,
        )
        for column in verdicts:
            if row[column]["verdict"] in ("wrong", "crash"):
                print(f"    {column}: {row[column].get('text', row[column].get('value'))}", flush=True)
        table["rows"][kind] = row
        if given.out is not None:
            import peft
            import torch

            table |= {
                "command": "python benchmarks/families.py --out benchmarks/results/language/families.json",
                "date": date.today().isoformat(),
                "versions": {m.__name__: m.__version__ for m in (torch, transformers, peft)},
                "tolerance": TOLERANCE,
            }
            table["rows"] = dict(sorted(table["rows"].items()))
            given.out.write_text(json.dumps(table, indent=1) + "\n", encoding="utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main())
