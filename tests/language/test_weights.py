"""Every weight of a model is the one of its file: what is missing, or has no place, is refused by name."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from pathlib import Path

import pytest
import torch
from language.tiny import padded, saved, tiny_gpt2, tiny_of
from safetensors.torch import load_file, save_file
from torch import Tensor

from tightrope.language import align, selfcheck
from tightrope.language.model.load import load_causal
from tightrope.language.model.weights import WrongWeights
from tightrope.language.reward.model import SHIFT, load_reward
from tightrope.language.settings import SFTSettings
from tightrope.language.supervised.sft import train_sft

State = dict[str, Tensor]


@pytest.fixture(scope="module")
def models(tmp_path_factory) -> dict[str, str]:
    """Whole folders, by name."""
    folder = tmp_path_factory.mktemp("models")
    own = {
        "llama": tiny_of("Llama"),
        "tied": tiny_of("Llama", tie_word_embeddings=True),
        "mixtral": tiny_of("Mixtral", num_local_experts=4, num_experts_per_tok=2),
        "gpt2": tiny_gpt2(),
        "reward": tiny_of("Llama", "SequenceClassification", num_labels=1),
    }
    return {name: saved(folder / name, model) for name, model in own.items()}


def changed(folder: str, to: Path, change: Callable[[State], State]) -> str:
    """A copy of a model folder with other weights."""
    shutil.copytree(folder, to)
    state = {name: x.clone() for name, x in change(load_file(to / "model.safetensors")).items()}
    save_file(state, to / "model.safetensors", metadata={"format": "pt"})
    return str(to)


def without(*words: str) -> Callable[[State], State]:
    return lambda state: {k: x for k, x in state.items() if not all(word in k for word in words)}


def prefixed(prefix: str) -> Callable[[State], State]:
    return lambda state: {prefix + k: x for k, x in state.items()}


def unmerged(state: State) -> State:
    """As PEFT's model saves itself, its wrapper's names taken off."""
    name = "model.layers.0.self_attn.q_proj"
    lora = {f"{name}.lora_{x}.default.weight": torch.ones(2, 16) for x in "AB"}
    return {k.replace(f"{name}.", f"{name}.base_layer."): x for k, x in state.items()} | lora


def with_more(**more: Tensor) -> Callable[[State], State]:
    return lambda state: {**state, **{k.replace("__", "."): x for k, x in more.items()}}


WRONG = {
    "a layer's MLP": ("llama", without("layers.1.mlp"), r"lacks 3 of the 30 .*layers\.1\.mlp\.down.*again"),
    "a whole layer": ("llama", without("layers.2."), r"lacks 9 of .*input_layernorm.* and 6 more"),
    "the head": ("llama", without("lm_head"), r"lacks 1 .*lm_head\.weight.*tie_word_embeddings"),
    "an expert": ("mixtral", without("layers.1", "experts.3"), r"shape .*experts\.down_proj is \[3, 16"),
    "all experts": ("mixtral", without("layers.1", "experts"), r"lacks 2 of .*layers\.1\.mlp\.experts"),
    "a part of an expert": ("mixtral", without("layers.1", "experts.1.w1"), "belong together.*experts"),
    "a prefix": ("llama", prefixed("module."), r"lacks .*begin with 'module\.'"),
    "PEFT's prefix": ("llama", prefixed("base_model.model."), r"'base_model\.model\.' .*merge_and_unload"),
    "PEFT's prefix, tied": ("gpt2", prefixed("base_model.model."), "lacks .*merge_and_unload"),
    "PEFT's layers": ("llama", unmerged, "lacks 1 .*q_proj.*merge_and_unload"),
    "a vocabulary": (
        "tied", lambda s: {k: x[:60] if "embed" in k else x for k, x in s.items()},
        r"embed_tokens\.weight is \[60, 16\], expected \[64, 16\].*config\.json",
    ),
    "an empty shard": (
        "llama", lambda s: {k: x[:0] if "layers.1" in k else x for k, x in s.items()},
        r"9 weights of another shape .*\[0\], expected \[16\].* and 6 more",
    ),
    "a bias": (
        "llama", with_more(model__layers__0__self_attn__q_proj__bias=torch.ones(16)),
        r"1 weights .*have no place: model\.layers\.0\.self_attn\.q_proj\.bias",
    ),
    "scales": (
        "llama", with_more(model__layers__0__mlp__up_proj__weight_scale_inv=torch.ones(1)), "not quantised"
    ),
    "a norm": (
        "llama", with_more(model__layers__0__self_attn__q_norm__weight=torch.ones(4)),
        r"1 weights .*have no place: model\.layers\.0\.self_attn\.q_norm\.weight",
    ),
    "a layer": (
        "llama", lambda s: s | {k.replace("layers.1", "layers.7"): x for k, x in s.items() if ".1." in k},
        r"9 weights .*have no place: model\.layers\.7\..* config\.json",
    ),
    "an adapter beside": (
        "llama", with_more(model__layers__0__mlp__up_proj__lora_A__weight=torch.ones(2, 16)), "merge_and"
    ),
}  # fmt: skip


@pytest.mark.parametrize("case", WRONG)
def test_weights_that_are_not_the_file_s_are_refused_with_their_names(models, tmp_path, case):
    kind, change, words = WRONG[case]
    folder = changed(models[kind], tmp_path / "model", change)
    with pytest.raises(ValueError, match=words) as caught:
        load_causal(folder)
    assert len(str(caught.value)) < 600 and "\n" not in str(caught.value)


@pytest.mark.parametrize("name", ["llama", "tied", "mixtral", "gpt2"])
@pytest.mark.filterwarnings("error")
def test_whole_models_load_without_a_word(models, name):
    load_causal(models[name])


def test_what_older_versions_computed_and_saved_is_no_weight(models, tmp_path):
    extra = with_more(
        model__layers__0__self_attn__masked_bias=torch.ones(1),
        model__layers__0__self_attn__turn__inv_freq=torch.ones(2),
    )
    with pytest.warns(UserWarning, match="holds 2 weights that LlamaForCausalLM does not use"):
        load_causal(changed(models["llama"], tmp_path / "model", extra))


def test_a_reward_model_is_no_policy_also_with_a_tied_head(tmp_path):
    """A tied head lacks nothing: it is the embedding, which a reward model has too."""
    model = tiny_of("Llama", "SequenceClassification", num_labels=1, tie_word_embeddings=True)
    with pytest.raises(ValueError, match="LlamaForSequenceClassification, which scores"):
        load_causal(saved(tmp_path / "reward", model))


def test_weights_of_parts_that_the_model_lacks_are_told_once(models, tmp_path):
    """A value head, a vision tower: the model is whole without them. Three models are made of the file."""
    extra = with_more(v_head__summary__weight=torch.ones(1, 16), vision__layer__weight=torch.ones(2))
    folder = changed(models["llama"], tmp_path / "model", extra)
    told = []
    align(
        model=folder, prompts=["a b", "c d"], reward="length", tune="full", critic="separate", seed=1,
        total_episodes=4, batch_size=4, minibatch_size=4, max_new_tokens=3, run_dir=tmp_path / "run",
        listeners=[lambda event: told.append(getattr(event, "text", ""))],
    )  # fmt: skip
    words = "holds 2 weights that LlamaForCausalLM does not use: v_head.summary.weight, vision.layer.weight"
    assert sum(words in text for text in told) == 1


def test_no_command_goes_on_with_weights_that_are_made_up(models, tmp_path):
    broken = changed(models["llama"], tmp_path / "model", without("layers.1.mlp"))
    with pytest.raises(WrongWeights, match="lacks 3"):
        train_sft(SFTSettings(model=broken), data=[{"text": "a b c"}], run_dir=tmp_path / "sft")
    with pytest.raises(WrongWeights, match="lacks 3"):
        align(model=broken, prompts=["a"], reward="length", run_dir=tmp_path / "align")
    assert not (tmp_path / "sft").exists() and not (tmp_path / "align").exists()


def test_the_doctor_says_which_weights_are_missing(models, tmp_path):
    broken = changed(models["llama"], tmp_path / "model", without("layers.1.mlp"))
    (found,) = selfcheck.check_model(broken)
    assert not found.good and found.what == selfcheck.WEIGHTS
    assert "model.layers.1.mlp.down_proj.weight" in found.seen and "again" in found.advice
    whole = selfcheck.check_model(models["llama"])
    assert [finding.good for finding in whole if finding.what == selfcheck.WEIGHTS] == [True]


def test_a_reward_model_without_its_head_is_refused_also_as_a_reward(models, tmp_path):
    folder = changed(models["reward"], tmp_path / "reward", without("score"))
    with pytest.raises(WrongWeights, match=r"score\.weight.*no trained reward model.*tightrope reward"):
        load_reward(folder)
    with pytest.raises(WrongWeights, match=r"score\.weight"):
        align(model=models["llama"], prompts=["a"], reward=folder, run_dir=tmp_path / "run")


def test_the_bias_of_a_reward_head_is_used(models, tmp_path):
    """transformers' class has no bias, and leaves out the one in the file."""
    tokens, real, _ = padded()
    before = load_reward(models["reward"]).score(tokens, real)
    folder = changed(models["reward"], tmp_path / "reward", with_more(score__bias=torch.tensor([2.5])))
    config = json.loads(Path(folder, "config.json").read_text())
    Path(folder, "config.json").write_text(json.dumps({**config, SHIFT: 1.0}))
    model = load_reward(folder)
    assert model.shift == -1.5 and model.head.bias is None
    torch.testing.assert_close(model.score(tokens, real), before + 1.5)


def test_the_bias_that_a_class_gives_its_head_is_used(models, monkeypatch):
    from transformers import LlamaForSequenceClassification as Kind

    tokens, real, _ = padded()
    before, build = load_reward(models["reward"]).score(tokens, real), Kind.__init__

    def with_bias(self, config):
        build(self, config)
        self.score.bias = torch.nn.Parameter(torch.tensor([0.5]))

    monkeypatch.setattr(Kind, "__init__", with_bias)
    model = tiny_of("Llama", "SequenceClassification", num_labels=1)
    model.load_state_dict(
        {**load_file(Path(models["reward"], "model.safetensors")), "score.bias": torch.ones(1)}
    )
    folder = saved(Path(models["reward"]).parent / "biased", model)
    torch.testing.assert_close(load_reward(folder).score(tokens, real), before + 1.0)
