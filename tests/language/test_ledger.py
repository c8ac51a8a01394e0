"""The ledger against reality: tiny models that are actually built, run and optimised."""

import dataclasses
from pathlib import Path

import pytest
import torch
from transformers import AutoModelForCausalLM, Gemma4TextConfig, GPT2Config, LlamaConfig

from tightrope.algorithms.optimise import Adam
from tightrope.language import memory
from tightrope.language.generation.sample import cached_forward
from tightrope.language.memory import (
    DoesNotFit,
    Job,
    Ledger,
    amount,
    available_memory,
    job_of,
    ledger,
    require_fit,
)
from tightrope.language.model import lora
from tightrope.language.model.architecture import parts
from tightrope.language.model.load import without_dropout
from tightrope.language.settings import AlignSettings, ModelSettings, RewardSettings, SFTSettings

LLAMA = LlamaConfig(
    vocab_size=96, hidden_size=32, intermediate_size=80, num_hidden_layers=4, num_attention_heads=4,
    num_key_value_heads=2, max_position_embeddings=128, tie_word_embeddings=False,
)  # fmt: skip
TIED = LlamaConfig(**{**LLAMA.to_dict(), "tie_word_embeddings": True, "head_dim": 16})
GPT2 = GPT2Config(
    vocab_size=96, n_positions=128, n_embd=32, n_layer=3, n_head=4, bos_token_id=2, eos_token_id=3
)  # fmt: skip
CONFIGS = pytest.mark.parametrize("config", [LLAMA, TIED, GPT2], ids=["llama", "tied", "gpt2"])
ALIGN = Job(
    critic="head", batch_size=16, micro_batch_size=4, prompt_tokens=8, response_tokens=24, lora_rank=4
)


def real(config):
    """The model itself, with memory."""
    model = AutoModelForCausalLM.from_config(config, attn_implementation="sdpa")
    without_dropout(model)
    return model.eval()


def size_of(tensors) -> int:
    """Bytes of tensors."""
    return sum(x.numel() * x.element_size() for x in tensors)


def entry(found: Ledger, what: str) -> int:
    """The size of the one row of that name."""
    (row,) = [row for row in found.rows if row.what == what]
    return row.size


def total(config=LLAMA, **changes) -> int:
    """The peak of the usual job with these changes."""
    return ledger(config, dataclasses.replace(ALIGN, **changes)).total


@CONFIGS
def test_weights_gradients_and_moments_are_those_of_the_real_model(config) -> None:
    model = real(config)
    found = ledger(config, dataclasses.replace(ALIGN, tune="full"))
    assert entry(found, "policy: weights of the trunk") == size_of(model.parameters())
    assert entry(found, "reference: a frozen copy") == size_of(model.parameters())
    optimiser = Adam(model.parameters(), fused=True)
    model(torch.arange(10)[None]).logits.square().mean().backward()
    optimiser.step()
    assert entry(found, "policy: gradients") == size_of(p.grad for p in model.parameters())
    moments = [s[name] for s in optimiser.state.values() for name in ("exp_avg", "exp_avg_sq")]
    assert entry(found, "policy: Adam's two moments") == size_of(moments)


@CONFIGS
@pytest.mark.parametrize("layers", [None, 2])
def test_adapters_are_those_of_the_real_model(config, layers) -> None:
    model = real(config)
    lora.add_adapter(model, "policy", 4, 8.0, lora.top_layers(model, layers))
    adapter = size_of(lora.adapter_parameters(model, "policy"))
    found = ledger(config, dataclasses.replace(ALIGN, lora_layers=layers, critic="adapter", reward="adapter"))
    head = 4 * (config.hidden_size + 1)
    assert entry(found, "policy: weights of its adapter") == adapter
    assert entry(found, "critic: weights") == entry(found, "reward model: weights") == adapter + head
    assert entry(found, "critic: gradients") == adapter + head


@CONFIGS
def test_a_separate_critic_is_a_whole_model_of_which_the_base_is_trained(config) -> None:
    model = real(config)
    found = ledger(config, dataclasses.replace(ALIGN, critic="separate", reward="separate"))
    head = 4 * (config.hidden_size + 1)
    assert entry(found, "critic: weights") == size_of(model.parameters()) + head
    assert entry(found, "critic: gradients") == size_of(parts(model).base.parameters()) + head
    assert entry(found, "reward model: weights") == size_of(model.parameters()) + head


@CONFIGS
def test_the_cache_is_the_real_cache(config) -> None:
    rows, length = ALIGN.batch_size, ALIGN.prompt_tokens + ALIGN.response_tokens
    ones, places = torch.ones(rows, length, dtype=torch.int64), torch.arange(length).expand(rows, length)
    step = cached_forward(parts(real(config)).base, torch.zeros_like(ones), ones, places)
    cache = size_of(x for layer in step.cache.layers for x in (layer.keys, layer.values))
    assert entry(ledger(config, ALIGN), "KV cache") == cache


def test_the_cache_of_layers_that_differ_is_the_sum_of_theirs() -> None:
    """Two layers with heads of 8 numbers and two with 16; two heads, keys and values, float32."""
    config = Gemma4TextConfig(
        vocab_size=96, hidden_size=32, intermediate_size=64, num_hidden_layers=4, num_attention_heads=4,
        num_key_value_heads=2, head_dim=8, global_head_dim=16, vocab_size_per_layer_input=96,
        hidden_size_per_layer_input=8, num_kv_shared_layers=0,
        layer_types=["sliding_attention", "full_attention"] * 2,
    )  # fmt: skip
    assert memory.shapes_of(config, "float32").kv_cache == 4 * 2 * 2 * (8 + 16 + 8 + 16)


@CONFIGS
@pytest.mark.parametrize("length", [20, 100])
def test_activations_are_what_a_real_forward_pass_keeps(config, length) -> None:
    kept = memory.saved_bytes(parts(real(config)).base, length)
    job = Job(tune="full", micro_batch_size=1, prompt_tokens=length)
    found = entry(ledger(config, job), "policy: activations of a micro-batch")
    assert 0.8 * kept < found < 1.25 * kept


@CONFIGS
@pytest.mark.parametrize("layers", [None, 2])
def test_activations_of_an_adapter_are_those_of_the_adapted_layers(config, layers) -> None:
    model = real(config)
    lora.add_adapter(model, "policy", 4, 8.0, lora.top_layers(model, layers))
    with lora.using(model, "policy"):
        kept = memory.saved_bytes(parts(model).base, 60)
    job = Job(lora_rank=4, lora_layers=layers, micro_batch_size=1, prompt_tokens=60)
    found = entry(ledger(config, job), "policy: activations of a micro-batch")
    assert 0.8 * kept < found < 1.4 * kept


def test_a_model_of_seven_billion_takes_no_memory_to_be_counted() -> None:
    def resident() -> int:
        return int(Path("/proc/self/statm").read_text().split()[1]) * 4096

    config = LlamaConfig(
        vocab_size=32_000, hidden_size=4096, intermediate_size=11_008, num_hidden_layers=32,
        num_attention_heads=32, num_key_value_heads=32,
    )  # fmt: skip
    before = resident()
    found = ledger(config, dataclasses.replace(ALIGN, tune="full", critic="separate", dtype="bfloat16"))
    assert resident() - before < 200e6
    # weights in 2 bytes: policy, reference and critic once each, gradients and two moments of two of them
    assert 2 * 6.6e9 * 9 < found.sum_of("always") < 2 * 6.8e9 * 9


def test_what_cannot_be_measured_is_estimated(monkeypatch) -> None:
    """A layer that reads values fails on tensors without values."""
    measured = memory.shapes_of(LLAMA, "float32").saved

    def fails(base, length):
        raise NotImplementedError("Cannot copy out of meta tensor; no data!")

    monkeypatch.setattr(memory, "saved_bytes", fails)
    assert 0.5 * measured < memory.shapes_of(LLAMA, "float32").saved < 2 * measured


def test_each_saving_saves() -> None:
    usual = total()
    assert total(tune="full") > usual
    assert total(lora_layers=2) < usual
    assert total(lora_rank=8) > usual
    assert usual < total(critic="adapter") < total(critic="separate")
    assert usual < total(reward="adapter") < total(reward="separate")
    assert total(micro_batch_size=1) < usual < total(micro_batch_size=16)
    assert total(gradient_checkpointing=True) < usual
    assert total(dtype="bfloat16") < usual
    assert total(batch_size=64) > usual
    assert total(keeps_exact_kl=True) - usual == 16 * 24 * 32 * 4
    assert total(extra_tokens=100) > usual


def test_only_the_larger_of_the_two_phases_counts() -> None:
    found = ledger(LLAMA, ALIGN)
    larger, smaller = sorted((found.sum_of("rollout"), found.sum_of("update")), reverse=True)
    assert smaller > 0 and found.total == found.sum_of("always") + larger
    assert sum(row.size for row in found.rows) == found.total + smaller


def test_jobs_come_from_the_settings_of_the_commands() -> None:
    align = job_of(AlignSettings(critic="adapter", kl="exact-split"), reward="adapter", extra_tokens=7)
    assert (align.tune, align.critic, align.reward, align.reference) == ("lora", "adapter", "adapter", True)
    assert (align.batch_size, align.micro_batch_size, align.prompt_tokens) == (64, 64, 64)
    assert (align.response_tokens, align.keeps_exact_kl, align.extra_tokens) == (24, True, 7)
    assert job_of(AlignSettings(batch_size=16)).micro_batch_size == 16
    sft = job_of(SFTSettings(tune="full", micro_batch_size=2))
    assert (sft.tune, sft.reference, sft.critic, sft.micro_batch_size) == ("full", False, "none", 2)
    assert job_of(SFTSettings(minibatch_size=4, micro_batch_size=8)).micro_batch_size == 4
    pairs = job_of(RewardSettings(micro_batch_size=2))
    assert (pairs.critic, pairs.rows_per_example, pairs.language_head) == ("head", 2, False)
    with pytest.raises(ValueError, match="ModelSettings is not a job"):
        job_of(ModelSettings())


def test_supervised_jobs_hold_one_model_and_sample_nothing() -> None:
    names = {row.what for row in ledger(LLAMA, job_of(SFTSettings(tune="full"))).rows}
    absent = {"reference", "critic", "rollout", "KV cache"}
    assert not absent & {name.split(":")[0] for name in names}
    single = ledger(LLAMA, job_of(SFTSettings(minibatch_size=4)))
    pairs = ledger(LLAMA, job_of(RewardSettings(minibatch_size=4)))
    what = "model: activations of a micro-batch"
    assert entry(pairs, what) == 2 * entry(single, what)
    names = {row.what for row in pairs.rows}
    assert "logits of one chunk" not in names and "score head: weights" in names


@CONFIGS
def test_weights_that_are_trained_in_full_stay_float32_beside_their_lowered_copies(config) -> None:
    """Like load(): --dtype bfloat16 saves nothing there, and is not suggested."""
    model = real(config)
    found = ledger(config, job_of(SFTSettings(tune="full", dtype="bfloat16")))
    assert entry(found, "model: weights of the trunk") == size_of(model.parameters())
    lowered = entry(found, "model: copies of its weights in bfloat16")
    assert lowered == size_of(p for p in parts(model).layers.parameters() if p.dim() == 2) / 2
    with pytest.raises(DoesNotFit) as caught:
        require_fit(ledger(config, job_of(SFTSettings(tune="full"))), 1000)
    assert "--micro-batch-size" in str(caught.value) and "--dtype" not in str(caught.value)


def test_a_reward_model_does_not_train_the_language_head() -> None:
    found = ledger(LLAMA, job_of(RewardSettings(tune="full")))
    assert entry(found, "model: gradients") == size_of(parts(real(LLAMA)).base.parameters())


def test_a_job_that_fits_passes_and_one_that_does_not_gets_advice() -> None:
    job = dataclasses.replace(ALIGN, tune="full", critic="separate", micro_batch_size=16)
    found = ledger(LLAMA, job)
    require_fit(found, None)
    require_fit(found, int(found.total / 0.9) + 1)
    with pytest.raises(DoesNotFit, match="This job needs about") as caught:
        require_fit(found, int(found.total / 0.9) - 1)
    text = str(caught.value)
    for words in ("--micro-batch-size 4", "--tune lora", "--critic head", "--dtype bfloat16", "all of these"):
        assert f"  {words}: " in text
    lora_total = ledger(LLAMA, dataclasses.replace(job, tune="lora")).total
    assert f"--tune lora: {amount(lora_total)}, fits" in text
    with pytest.raises(DoesNotFit, match="all of these: .*, still too much"):
        require_fit(found, 1000)
    assert issubclass(DoesNotFit, ValueError)


def test_advice_names_only_what_would_help() -> None:
    job = Job(dtype="bfloat16", gradient_checkpointing=True, prompt_tokens=8, language_head=False)
    with pytest.raises(DoesNotFit) as caught:
        require_fit(ledger(LLAMA, job), 1000)
    assert str(caught.value).endswith("What would help:\n  a smaller model")


def test_the_table_shows_every_entry_and_the_peak() -> None:
    found = ledger(LLAMA, ALIGN)
    lines = found.text().splitlines()
    assert len(lines) == len(found.rows) + 1
    assert lines[-1].split() == ["memory", "at", "the", "peak", *amount(found.total).split()]
    assert len({len(line) for line in lines}) == 1
    assert [amount(x) for x in (812_000, 3.44e6, 12.1e9)] == ["812 kB", "3.4 MB", "12.1 GB"]


def test_too_many_adapted_layers_are_named() -> None:
    with pytest.raises(ValueError, match="lora_layers is 9, but the model has 4 layers"):
        total(lora_layers=9)


def machine(root: Path, files: dict[str, str]) -> Path:
    """A machine's files in a folder."""
    for name, text in files.items():
        (root / name).parent.mkdir(parents=True, exist_ok=True)
        (root / name).write_text(text)
    return root


MEMINFO = {"proc/meminfo": "MemTotal:  2000 kB\nMemFree: 10 kB\nMemAvailable:    1000 kB\n"}


def test_memory_of_a_machine_without_limits(tmp_path: Path) -> None:
    assert available_memory("cpu", tmp_path) is None
    assert available_memory("cpu", machine(tmp_path, MEMINFO)) == 1_024_000
    group = "sys/fs/cgroup/"
    unlimited = {"proc/self/cgroup": "0::/a\n", f"{group}a/memory.max": "max\n"}
    assert available_memory("cpu", machine(tmp_path, unlimited)) == 1_024_000


def test_the_tightest_control_group_counts(tmp_path: Path) -> None:
    """Version 2: 700 kB are left below, 400 kB and 100 kB of droppable pages above."""
    group = "sys/fs/cgroup/"
    files = {
        "proc/self/cgroup": "0::/pod/box\n",
        f"{group}pod/box/memory.max": "900000\n",
        f"{group}pod/box/memory.current": "200000\n",
        f"{group}pod/memory.max": "1000000\n",
        f"{group}pod/memory.current": "600000\n",
        f"{group}pod/memory.stat": "anon 5\ninactive_file 100000\n",
    }
    assert available_memory("cpu", machine(tmp_path, {**MEMINFO, **files})) == 500_000


def test_control_groups_of_the_first_version(tmp_path: Path) -> None:
    group = "sys/fs/cgroup/memory/box/"
    files = {
        "proc/self/cgroup": "12:cpu,cpuacct:/box\n4:memory:/box\n",
        f"{group}memory.limit_in_bytes": "900000\n",
        f"{group}memory.usage_in_bytes": "950000\n",
    }
    assert available_memory("cpu", machine(tmp_path, {**MEMINFO, **files})) == 0


def test_the_memory_of_this_machine_is_none_or_positive() -> None:
    assert available_memory("cpu") is None or available_memory("cpu") > 0


def told(settings: AlignSettings, **given) -> tuple[Ledger, str]:
    """The ledger that `make_roles` presents before it loads anything, and its text."""
    from tightrope.language.policy import roles

    class Stop(Exception):
        pass

    seen: dict = {}

    def hold(config, job):
        seen["ledger"] = ledger(config, job)
        return seen["ledger"]

    def stop(text: str) -> None:
        seen["text"] = text
        raise Stop

    with pytest.MonkeyPatch.context() as patch, pytest.raises(Stop):
        patch.setattr(memory, "ledger", hold)
        roles.make_roles(settings, None, stop, **given)
    return seen["ledger"], seen["text"]


@pytest.fixture(scope="module")
def folders(tmp_path_factory) -> tuple[str, str, int]:
    """A policy, a reward model of another size as `tightrope reward` leaves it, and that one's bytes."""
    from transformers import AutoModelForSequenceClassification

    top = tmp_path_factory.mktemp("models")
    LLAMA.save_pretrained(top / "policy")
    wide = LlamaConfig(**{**LLAMA.to_dict(), "hidden_size": 64, "head_dim": 16, "num_labels": 1})
    model = AutoModelForSequenceClassification.from_config(wide)
    model.to(torch.bfloat16).save_pretrained(top / "judge" / "model")
    return str(top / "policy"), str(top / "judge"), size_of(model.float().parameters())


def test_a_reward_model_and_a_gold_judge_count_by_their_own_size_in_float32(folders) -> None:
    policy, judge, size = folders
    settings = AlignSettings(model=policy, dtype="bfloat16", reward=judge, gold="length")
    row = "reward model judge: weights"
    assert entry(told(settings, own_reward=True)[0], row) == size
    assert entry(told(AlignSettings(model=policy, gold=judge))[0], row) == size
    found, text = told(dataclasses.replace(settings, gold=judge), own_reward=True)
    assert [entry.size for entry in found.rows if entry.what == row] == [size, size]
    assert text.count(row) == 2 and "reward model: weights" not in text
    assert "reward model" not in told(settings)[1]  # the reward is on the trunk, the gold judge is a function


def test_a_reward_model_that_is_not_known_is_taken_for_one_as_large_as_the_policy(folders) -> None:
    settings = AlignSettings(model=folders[0], dtype="bfloat16", reward="<list>")
    found = told(settings, own_reward=True)[0]
    assert entry(found, "reward model: weights") == size_of(real(LLAMA).parameters()) + 4 * (32 + 1)


def test_pretraining_texts_are_counted_for_every_row_of_a_micro_batch(folders) -> None:
    usual = dict(model=folders[0], ptx_weight=1.0, ptx_data="x.txt", ptx_per_response=3,
                 max_prompt_tokens=8, max_new_tokens=4, batch_size=16)  # fmt: skip
    for update, rows in (({"micro_batch_size": 4}, 4), ({"minibatch_size": 8}, 8), ({}, 16)):
        settings = AlignSettings().with_values(**usual, **update)
        assert told(settings)[0].job.extra_tokens == rows * 3 * (8 + 4)
