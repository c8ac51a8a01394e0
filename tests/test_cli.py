"""Command line: every setting is a documented flag, mistakes get advice and exit code 2, stdout is clean."""

from __future__ import annotations

import dataclasses
import json
import os
import subprocess
import sys
import time
import types
from pathlib import Path
from typing import Any

import pytest

from tightrope.cli import display, flags, options
from tightrope.cli.main import main
from tightrope.control.settings import ALGORITHM_SETTINGS, TrainSettings
from tightrope.metrics.table import METRICS
from tightrope.settings.fields import range_text
from tightrope.training.events import Evaluated, Finished, Listeners, Started, Updated

ALGORITHMS = list(ALGORITHM_SETTINGS)


def run_main(capsys: pytest.CaptureFixture[str], *words: str) -> tuple[int, str, str]:
    code = main(list(words))
    captured = capsys.readouterr()
    return code, captured.out, captured.err


def resolved(*words: str) -> tuple[str, dict[str, Any]]:
    _, values, _ = options.training_options("train", list(words))
    return values.pop("env"), values


# ---------------------------------------------------------------------------- the flags


@pytest.mark.parametrize("algorithm", ALGORITHMS)
def test_every_setting_is_a_flag_with_doc_range_and_default(algorithm: str) -> None:
    parser = options.training_parser("train", algorithm)
    text = " ".join(parser.format_help().split())
    known = parser.flags()
    for kind in (TrainSettings, ALGORITHM_SETTINGS[algorithm]):
        for field in dataclasses.fields(kind):
            if field.name in ("env", "update"):
                continue
            assert field.name.replace("_", "-") in known
            assert field.metadata["doc"].endswith(".")
            help_text = flags.help_text(field, optional=field.default is None)
            assert "default" in help_text
            assert range_text(field.metadata) in help_text
            assert " ".join(field.metadata["doc"].split()[:3]) in text


@pytest.mark.parametrize(
    "make", [*ALGORITHMS, options.evaluate_parser, options.record_parser, options.resume_parser]
)
def test_every_option_has_help_and_fits_100_columns(make: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("COLUMNS", "200")
    parser = options.training_parser("train", make) if isinstance(make, str) else make()
    assert all(action.help for action in parser._actions)
    assert max(map(len, parser.format_help().splitlines())) <= 100


def test_every_setting_is_in_a_named_group() -> None:
    assert "more" not in options.training_parser("train").format_help().split("\n\n")
    listed = [name for names in options.GROUPS.values() for name in names]
    assert sorted(listed) == sorted(flags.settings_fields(TrainSettings))


def as_words(kind: type, value: dict[str, Any]) -> list[str]:
    words = []
    for name in flags.settings_fields(kind):
        flag, x = name.replace("_", "-"), value[name]
        if isinstance(x, bool):
            words.append(f"--{flag}" if x else f"--no-{flag}")
        elif isinstance(x, list):
            words += [f"--{flag}", *map(str, x)]
        else:
            words.append(f"--{flag}={'none' if x is None else x}")
    return words


CHANGED = {
    "ppo": {"clip": 0.1, "target_kl": 0.015, "recompute_advantages": True, "clip_schedule": "linear"},
    "a2c": {"gae_lambda": 0.9, "max_grad_norm": None, "normalise_advantages": False},
    "reinforce": {"baseline": False, "entropy_weight": 0.02},
}


@pytest.mark.parametrize("algorithm", ALGORITHMS)
@pytest.mark.parametrize("changed", [False, True])
def test_flags_express_every_setting_and_parse_back(algorithm: str, changed: bool) -> None:
    values = (
        {"hidden": (32,), "shared": True, "log_std_init": -0.5, "seed": 7} | CHANGED[algorithm]
        if changed
        else {}
    )
    settings = TrainSettings().with_values(algorithm=algorithm, **values)
    data = settings.to_json()
    words = as_words(TrainSettings, data) + as_words(ALGORITHM_SETTINGS[algorithm], data["update"])
    env, said = resolved("Task-v0", *words)
    assert env == "Task-v0"
    assert dataclasses.replace(TrainSettings().with_values(**said), env=settings.env) == settings


@pytest.mark.parametrize("algorithm", ALGORITHMS)
def test_a_settings_file_runs_again_and_flags_win(tmp_path: Path, algorithm: str) -> None:
    settings = TrainSettings(env="Task-v0").with_values(
        algorithm=algorithm, gamma=0.9, hidden=(8, 8), num_workers=3
    )
    (tmp_path / "settings.json").write_text(json.dumps(settings.to_json()))
    for path in (tmp_path, tmp_path / "settings.json"):
        env, values = resolved("--settings", str(path))
        assert TrainSettings(env=env).with_values(**values) == settings
    env, values = resolved("Other-v0", "--settings", str(tmp_path), "--gamma", "0.8", "--num-workers", "none")
    expected = settings.with_values(env="Other-v0", gamma=0.8, num_workers=None)
    assert TrainSettings(env=env).with_values(**values) == expected


def test_another_update_rule_leaves_the_files_own_settings(tmp_path: Path) -> None:
    data = TrainSettings().with_values(clip=0.1, gamma=0.9, num_envs=4).to_json()
    (tmp_path / "settings.json").write_text(json.dumps(data))
    _, values = resolved("--settings", str(tmp_path), "--algorithm", "a2c")
    assert values["algorithm"] == "a2c"
    assert values["num_envs"] == 4
    assert not {"clip", "gamma"} & set(values)


def test_only_what_is_given_overrides_the_preset() -> None:
    assert resolved("Task-v0", "--num_envs", "4", "--total-steps=1e6") == (
        "Task-v0",
        {"num_envs": 4, "total_steps": 1_000_000},
    )
    assert resolved("Task-v0", "--total-steps", "100_000", "--hidden")[1] == {
        "total_steps": 100_000,
        "hidden": (),
    }


def test_dry_run_prints_the_settings_and_stops(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    os.chdir(tmp_path)
    code, out, _ = run_main(capsys, "train", "CartPole-v1", "--dry-run", "--clip", "0.1", "--seed", "5")
    settings = TrainSettings.from_json(json.loads(out))
    assert (code, settings.env, settings.seed) == (0, "CartPole-v1", 5)
    assert settings.to_json()["update"]["clip"] == 0.1
    assert list(tmp_path.iterdir()) == []


# ---------------------------------------------------------------------------- settings of the language story


def shown(capsys: pytest.CaptureFixture[str], *words: str) -> dict[str, Any]:
    """The settings that a command resolves."""
    code, out, err = run_main(capsys, *words, "--dry-run")
    assert code == 0, err
    found = json.loads(out)
    found.pop("origins")
    return found


def origins(capsys: pytest.CaptureFixture[str], *words: str) -> dict[str, str]:
    """Where the value of each setting comes from."""
    code, out, err = run_main(capsys, *words, "--dry-run", "--json")
    assert code == 0, err
    return json.loads(out)["origins"]


def test_a_dry_run_tells_where_each_value_comes_from(
    capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    found = origins(capsys, "train", "LunarLander-v3", "--num-envs", "4", "--clip", "0.1")
    names = {*TrainSettings().to_json(), *TrainSettings().to_json()["update"]} - {"update"}
    assert set(found) == names
    told = {
        "num_envs": "flag", "clip": "flag", "env": "flag", "gamma": "preset", "num_steps": "preset",
        "total_steps": "preset", "normalise_rewards": "preset", "clip_high": "default", "hidden": "default",
    }  # fmt: skip
    assert {name: found[name] for name in told} == told
    _, out, _ = run_main(capsys, "train", "LunarLander-v3", "--num-envs", "4", "--dry-run")
    (tmp_path / "settings.json").write_text(out)  # what was printed can be run
    again = origins(capsys, "train", "--settings", str(tmp_path), "--gamma", "0.9")
    assert (again["num_envs"], again["hidden"], again["gamma"]) == ("settings file", "settings file", "flag")
    found = origins(capsys, "align", "--recipe", "ziegler2019", "--seed", "3")
    assert (found["kl_goal"], found["seed"], found["top_k"]) == ("recipe", "flag", "default")


def test_help_says_where_a_preset_decides() -> None:
    """The default shown of such a setting would hold for no task, or only for tasks without a preset."""
    shown = {action.dest: action.help or "" for action in options.training_parser("train")._actions}
    for name, default in (
        ("normalise_observations", "preset"), ("entropy_weight", "preset"), ("gamma", "0.99, or preset"),
        ("learning_rate", "0.0003, or preset"), ("total_steps", "100000, or preset"),
        ("clip_schedule", "constant"), ("evaluate_every", "0.05"), ("reseed_after", "0, or preset"),
    ):  # fmt: skip
        assert shown[name].endswith(f"default {default})"), shown[name]


@pytest.mark.parametrize("command", ["sft", "reward", "align"])
def test_settings_of_a_language_run_run_again_and_flags_win(
    capsys: pytest.CaptureFixture[str], tmp_path: Path, command: str
) -> None:
    first = shown(capsys, command, "--data", "rows.jsonl", "--seed", "3", "--num-epochs", "2")
    (tmp_path / "settings.json").write_text(json.dumps(first))
    for path in (tmp_path, tmp_path / "settings.json"):
        assert shown(capsys, command, "--settings", str(path)) == first
    changed = shown(capsys, command, "--settings", str(tmp_path), "--seed", "4", "--learning-rate", "0.5")
    assert changed["seed"] == 4 and changed.get("update", changed)["learning_rate"] == 0.5
    assert changed["data"] == "rows.jsonl" and changed.get("update", changed)["num_epochs"] == 2


def test_the_settings_of_another_command_are_refused(
    capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    for command in ("sft", "reward", "align"):
        (tmp_path / "settings.json").write_text(json.dumps(shown(capsys, command)))
        for other in {"sft", "reward", "align"} - {command}:
            code, _, err = run_main(capsys, other, "--settings", str(tmp_path), "--dry-run")
            assert code == 2 and f"the settings of {command}, expected those of {other}" in err
    (tmp_path / "settings.json").write_text(json.dumps(TrainSettings().to_json()))
    code, _, err = run_main(capsys, "align", "--settings", str(tmp_path), "--dry-run")
    assert code == 2 and "the settings of train" in err


@pytest.mark.parametrize(
    ("values", "typed", "again"),
    [
        ({"data": "<list>"}, "--data FILE", "rows.jsonl"),
        ({"reward": "score"}, "--reward FILE.py:function", "length"),
        ({"reward": "mine.py:score"}, "--reward mine.py:score", "mine.py:score"),
        ({"reward": "mine.py:score=0.5"}, "--reward mine.py:score=0.5", "length=2"),
        ({"reward": "x.py:f; rm -r ~"}, "--reward FILE.py:function", "length"),  # no file writes commands
        ({"gold": "mine.py:score"}, "--gold mine.py:score", "none"),
    ],
)
def test_what_was_an_object_or_code_is_named_again(
    capsys: pytest.CaptureFixture[str], tmp_path: Path, values: dict[str, str], typed: str, again: str
) -> None:
    settings = {**shown(capsys, "align", "--reward", "length"), **values}
    (tmp_path / "settings.json").write_text(json.dumps(settings))
    code, _, err = run_main(capsys, "align", "--settings", str(tmp_path), "--dry-run")
    assert code == 2 and err.endswith(f"tightrope align --settings {tmp_path} {typed}\n"), err
    assert str(*values.values()) in err
    flag = typed.partition(" ")[0]
    found = shown(capsys, "align", "--settings", str(tmp_path), flag, again)
    assert found[flag[2:]] == (None if again == "none" else again)


def test_a_language_settings_file_is_checked(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    for values, message in (
        ({"batch_sise": 3}, "Did you mean 'batch_size'"),
        ({"batch_size": "8"}, "batch_size is '8' (str); expected int"),
        ({"update": 3}, "update is 3"),
        ([], "the settings are list"),
    ):
        (tmp_path / "settings.json").write_text(json.dumps(values))
        code, _, err = run_main(capsys, "align", "--settings", str(tmp_path), "--dry-run")
        assert code == 2 and message in err


def test_a_flag_that_gathers_may_be_repeated() -> None:
    parser = flags.Parser("x", "x", "x")
    parser.add_argument("--prompt", action="append")
    assert parser.read(["--prompt", "a", "--prompt", "b"]) == {"prompt": ["a", "b"]}


def test_recipes_list_what_they_leave_out(capsys: pytest.CaptureFixture[str]) -> None:
    text = " ".join(options.training_parser("align").format_help().split())
    assert "without its normalisation of rewards" in text
    assert "without its language-modelling loss on correct responses" in text
    ziegler = shown(capsys, "align", "--recipe", "ziegler2019")
    assert ziegler["tune"] == "full" and ziegler["update"]["learning_rate"] == 1e-5


# ---------------------------------------------------------------------------- settings as JSON


@pytest.mark.parametrize(
    ("data", "message"),
    [
        ([], "list"),
        ({"algorithm": "sac"}, "sac"),
        ({"update": 3}, "update is 3"),
        ({"num_env": 3}, "Did you mean 'num_envs'"),
        ({"update": {"clipp": 3}}, "Did you mean 'clip'"),
        ({"algorithm": "a2c", "update": {"clip": 0.2}}, "A2CSettings has no setting named 'clip'"),
        ({"num_envs": "8"}, "num_envs is '8' .str.; expected int"),
        ({"num_envs": 8.0}, "expected int"),
        ({"num_envs": True}, "expected int"),
        ({"num_envs": None}, "expected int"),
        ({"shared": 1}, "expected bool"),
        ({"hidden": [64, "64"]}, "whole numbers"),
        ({"hidden": 64}, "whole numbers"),
        ({"update": {"gamma": "0.9"}}, "expected float"),
        ({"update": {"target_kl": False}}, "expected float or None"),
        ({"update": {"gamma": 1.5}}, "gamma is 1.5"),
    ],
)
def test_a_settings_file_is_checked(data: Any, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        TrainSettings.from_json(data)


def test_numbers_without_a_point_are_floats_where_floats_are_due() -> None:
    values = TrainSettings.values_from_json({"update": {"gamma": 1}})
    assert type(values["gamma"]) is float


# ---------------------------------------------------------------------------- mistakes


@pytest.mark.parametrize(
    ("given", "meant"),
    [
        ("n_steps", "num-steps"),
        ("n-envs", "num-envs"),
        ("n_epochs", "num-epochs"),
        ("update_epochs", "num-epochs"),
        ("num_ppo_epochs", "num-epochs"),
        ("noptepochs", "num-epochs"),
        ("batch_size", "minibatch-size"),
        ("num-minibatches", "minibatch-size"),
        ("clip_range", "clip"),
        ("clip_coef", "clip"),
        ("cliprange", "clip"),
        ("clip_range_vf", "value-clip"),
        ("cliprange_value", "value-clip"),
        ("ent_coef", "entropy-weight"),
        ("vf-coef", "value-weight"),
        ("lam", "gae-lambda"),
        ("lambda", "gae-lambda"),
        ("lr", "learning-rate"),
        ("total_timesteps", "total-steps"),
        ("timesteps", "total-steps"),
        ("kl_coef", "kl-beta"),
        ("init_kl_coef", "kl-beta"),
        ("norm_adv", "normalise-advantages"),
        ("anneal_lr", "learning-rate-schedule"),
        ("no-norm-adv", "no-normalise-advantages"),
        ("use_sde", "std gsde"),
        ("squash", "action-bounds squash"),
        ("no-squash", "action-bounds"),
        ("net_arch", "hidden"),
        ("activation_fn", "activation"),
        ("normalize-observations", "normalise-observations"),
        ("normalize_advantages", "normalise-advantages"),
        ("normalize_advantage", "normalise-advantages"),
        ("whiten_rewards", "normalise-rewards"),
        ("learnin-rate", "learning-rate"),
        ("num_env", "num-envs"),
        ("totl-steps", "total-steps"),
    ],
)
def test_a_wrong_flag_is_answered_with_the_right_one(
    capsys: pytest.CaptureFixture[str], given: str, meant: str
) -> None:
    for words in ([f"--{given}", "1"], [f"--{given}=1"]):
        code, out, err = run_main(capsys, "train", "CartPole-v1", *words)
        assert (code, out) == (2, "")
        assert f"Did you mean --{meant}?" in err
        assert "Traceback" not in err


def test_every_peer_name_leads_to_a_real_flag() -> None:
    known = {flag for algorithm in ALGORITHMS for flag in options.training_parser("train", algorithm).flags()}
    for name, meant in flags.PEER_NAMES.items():
        assert meant.replace("_", "-").split()[0] in known
        assert name.replace("_", "-") not in known


@pytest.mark.parametrize(
    ("words", "parts"),
    [
        (["trian"], ["no command 'trian'", "tightrope train"]),
        (["train"], ["Which task?"]),
        (["train", "CartPole-v1", "--clip", "x"], ["--clip", "'x'", "a number"]),
        (["train", "CartPole-v1", "--num-envs", "2.5"], ["--num-envs", "'2.5'", "whole number"]),
        (["train", "CartPole-v1", "--num-envs", "none"], ["--num-envs", "'none'"]),
        (["train", "CartPole-v1", "--clip", "-1"], ["clip is -1.0", "0 < x"]),
        (["train", "CartPole-v1", "--gamma", "nan"], ["gamma is nan"]),
        (["train", "CartPole-v1", "--activation", "tahn"], ["'tahn'", "Did you mean tanh?"]),
        (["train", "CartPole-v1", "--algorithm", "pppo"], ["'pppo'", "Did you mean ppo?"]),
        (["train", "--hidden", "8", "CartPole-v1"], ["'CartPole-v1'", "before"]),
        (["train", "CartPole-v1", "--settings", "nowhere.json"], ["nowhere.json", "no such file"]),
        (["train", "CartPole-v1", "--env-module", "nowhere.py"], ["nowhere.py", "no such file"]),
        (["train", "CartPole-v1", "--env-module", "no_such_module"], ["no_such_module", "no such module"]),
        (["train", "CartPole-v1", "--algorithm", "a2c", "--clip", "0.2"], ["of ppo, not of a2c", "--gamma"]),
        (
            ["train", "CartPole-v1", "--algorithm=a2c", "--n_epochs", "2"],
            ["--num-epochs", "of ppo, not of a2c"],
        ),
        (["train", "CartPole-v1", "--no-baseline"], ["--baseline", "of reinforce, not of ppo"]),
        (["evaluate"], ["RUN"]),
        (["evaluate", "run", "--episode", "3"], ["Did you mean --episodes?"]),
        (["evaluate", "run", "--episodes", "0"], ["at least 1"]),
        (["resume", "run", "--total-timesteps", "3"], ["Did you mean --total-steps?"]),
        (["record", "run", "--seed", "-3"], ["at least 0"]),
        (["sample", "run", "--count", "0"], ["--count", "at least 1"]),
        (["sample", "run", "--recorded", "--count=-3"], ["--count", "at least 1"]),
        (["align", "--gold", "length", "--gold", "gold.py:r"], ["--gold was given twice"]),
        (["train", "X", "--num_envs=2", "--num-envs", "3"], ["--num-envs was given twice"]),
        (["train", "X", "--shared", "--no-shared"], ["--shared and --no-shared was given twice"]),
        (["sft", "--settings", "nowhere"], ["nowhere", "no such file"]),
    ],
)
def test_a_mistake_is_exit_code_2_and_a_message(
    capsys: pytest.CaptureFixture[str], words: list[str], parts: list[str]
) -> None:
    code, out, err = run_main(capsys, *words)
    assert (code, out) == (2, "")
    for part in parts:
        assert part in err
    assert "Traceback" not in err


def test_a_folder_that_is_not_empty_is_not_used(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    from tightrope.runs.run import Run

    (tmp_path / "mine.txt").write_text("mine")
    fake_training(lambda settings, run_dir, listeners: Run.create(run_dir, {}, "name"))
    code, _, err = run_main(capsys, "train", "CartPole-v1", "--run-dir", str(tmp_path))
    assert code == 2
    assert "not empty" in err


def test_an_error_inside_other_code_keeps_its_traceback() -> None:
    fake_training(lambda settings, run_dir, listeners: int("this is a bug, not a user's mistake"))
    with pytest.raises(ValueError, match="a bug"):
        main(["train", "CartPole-v1"])


def test_a_file_never_names_code(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    data = TrainSettings(env="evil_module:Task-v0").to_json()
    (tmp_path / "settings.json").write_text(json.dumps(data))
    code, _, err = run_main(capsys, "train", "--settings", str(tmp_path))
    assert code == 2
    assert "evil_module:Task-v0" in err
    assert "evil_module" not in sys.modules
    assert resolved("evil_module:Task-v0", "--settings", str(tmp_path))[0] == "evil_module:Task-v0"


def test_the_users_module_is_imported(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "my_helper_for_tasks.py").write_text("STARTED = []\n")
    (tmp_path / "my_tasks.py").write_text(
        "import my_helper_for_tasks\nmy_helper_for_tasks.STARTED.append(1)\n"
    )
    code, _, _ = run_main(
        capsys, "train", "CartPole-v1", "--dry-run", "--env-module", str(tmp_path / "my_tasks.py")
    )
    assert code == 0
    assert sys.modules["my_helper_for_tasks"].STARTED == [1]


# ---------------------------------------------------------------------------- what is printed


SETTINGS = {"env": "CartPole-v1", "algorithm": "ppo", "seed": 1, "total_steps": 1000}
SUMMARY = {
    "steps": 1000,
    "wall_seconds": 2.0,
    "best": float("inf"),
    "final": {"eval/mean_reward": 480.0, "eval/std_reward": 5.0, "eval/episodes": 10.0},
}


@pytest.fixture(autouse=True)
def clean_process(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Any:
    """Undo what a command may change: working folder, sys.path, modules."""
    path, folder = list(sys.path), os.getcwd()
    before = {
        name: sys.modules.get(name) for name in ("tightrope.control.train", "tightrope.control.evaluate")
    }
    yield
    sys.path[:] = path
    os.chdir(folder)
    for name, module in before.items():
        sys.modules.pop(name, None)
        if module is not None:
            sys.modules[name] = module
    for name in ("my_tasks", "my_helper_for_tasks"):
        sys.modules.pop(name, None)


def fake_training(train: Any) -> None:
    module = types.ModuleType("tightrope.control.train")
    module.train = module.resume = train  # type: ignore[attr-defined]
    sys.modules["tightrope.control.train"] = module


def a_run(folder: Path, stop_at: int | None = None) -> Any:
    """A training function that reports 100 updates like the real one, without learning anything."""
    from tightrope.runs.run import Run

    def train(settings: TrainSettings, run_dir: str | None, listeners: Any) -> dict[str, Any]:
        report = Listeners(listeners)
        with Run.create(folder / "run", settings.to_json(), "name") as run:
            report.warn("clip is high")
            report(Started(str(run.path), SETTINGS, 0, 1000, ("engine: fused",)))
            for update in range(1, 101):
                values = {"rollout/ep_rew_mean": float(update), "train/approx_kl": 0.01, "time/fps": 5000.0}
                values |= {"rollout/ep_len_mean": 20.0, "train/clip_fraction": 0.1}
                run.record(10 * update, update / 50, values)
                report(Updated(10 * update, 1000, update / 50, values))
                if update % 20 == 0:
                    report(Evaluated(10 * update, {"eval/mean_reward": 3.0, "eval/std_reward": 1.0}))
                if update == stop_at:
                    raise KeyboardInterrupt
            run.finish(SUMMARY)
        report(Finished(SUMMARY))
        return SUMMARY

    return train


def test_json_is_the_last_line_and_nothing_else(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    fake_training(a_run(tmp_path))
    code, out, err = run_main(capsys, "train", "CartPole-v1", "--json")
    assert code == 0
    assert "NaN" not in out
    assert "Infinity" not in out
    result = json.loads(out)
    assert result["run_dir"] == str(tmp_path / "run")
    assert result["best"] is None
    assert result["final"]["eval/mean_reward"] == 480.0
    assert "warning: clip is high" in err
    assert "engine: fused" in err


def test_plain_lines_are_about_twenty_and_aligned(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    fake_training(a_run(tmp_path))
    code, out, err = run_main(capsys, "train", "CartPole-v1")
    lines = out.splitlines()
    head = next(i for i, line in enumerate(lines) if "steps/s" in line)
    table = lines[head : head + 22]
    assert code == 0
    assert len({len(line) for line in table}) == 1
    assert [line.split()[0] for line in table[1:]] == ["10", *(f"{50 * k:,}" for k in range(1, 21))]
    assert "\x1b" not in out
    assert "warning: clip is high" in err
    run = tmp_path / "run"
    assert "mean return 480.0 ± 5.00 over 10 episodes" in out
    assert f"next         tightrope evaluate {run}" in out
    assert f"tightrope record {run}" in out
    assert "1,000 steps in 0:02 (500 steps/s)" in out


def test_quiet_prints_the_end_only(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    fake_training(a_run(tmp_path))
    code, out, err = run_main(capsys, "train", "CartPole-v1", "--quiet")
    assert code == 0
    assert [line.split()[0] for line in out.splitlines()] == ["evaluation", "training", "run"]
    assert err == "warning: clip is high\n"
    fake_training(a_run(tmp_path / "b"))
    _, out, err = run_main(capsys, "train", "CartPole-v1", "--quiet", "--json")
    assert len(out.splitlines()) == 1
    assert err == "warning: clip is high\n"


def test_ctrl_c_prints_how_to_resume(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    module = tmp_path / "my_tasks.py"
    module.write_text("")
    folder = tmp_path / "with space"
    fake_training(a_run(folder, stop_at=7))
    code, _, err = run_main(capsys, "train", "CartPole-v1", "--env-module", str(module))
    assert code == 130
    assert f"tightrope resume '{folder / 'run'}' --env-module {module}" in err
    assert "step 70" in err
    assert "Traceback" not in err


def test_ctrl_c_before_the_run(capsys: pytest.CaptureFixture[str]) -> None:
    def stop(settings: Any, run_dir: Any, listeners: Any) -> None:
        raise KeyboardInterrupt

    fake_training(stop)
    code, _, err = run_main(capsys, "train", "CartPole-v1")
    assert (code, err) == (130, "Stopped before the run began.\n")


def test_evaluate_passes_what_is_given_and_prints_the_interval(capsys: pytest.CaptureFixture[str]) -> None:
    seen: dict[str, Any] = {}

    def evaluate_run(path: str, **values: Any) -> dict[str, Any]:
        seen.update(values, path=path)
        return {"mean_return": 100.0, "std_return": 10.0, "ci95": 2.0, "episodes": 96}

    module = types.ModuleType("tightrope.control.evaluate")
    module.evaluate_run = evaluate_run  # type: ignore[attr-defined]
    sys.modules["tightrope.control.evaluate"] = module
    code, out, _ = run_main(capsys, "evaluate", "runs/a", "--episodes", "96", "--best")
    assert (code, seen) == (0, {"path": "runs/a", "episodes": 96, "best": True})
    run_main(capsys, "evaluate", "runs/a", "--env-kwargs", "gravity=-5", "map_name=4x4")
    assert seen["env_kwargs"] == {"gravity": -5, "map_name": "4x4"}
    assert "mean return 100.00" in out
    assert "98.00 to 102.00" in out
    code, out, _ = run_main(capsys, "evaluate", "runs/a", "--json")
    assert json.loads(out.splitlines()[-1])["mean_return"] == 100.0


# ---------------------------------------------------------------------------- speed, process


@pytest.mark.parametrize("words", [["--help"], ["train", "--help"], ["evaluate", "--help"]])
def test_help_is_quick_and_needs_no_heavy_package(words: list[str]) -> None:
    heavy = "torch numba gymnasium numpy rich safetensors"
    code = (
        "import sys\nfrom tightrope.cli.main import main\ntry:\n    code = main(sys.argv[1:])\n"
        "except SystemExit as end:\n    code = end.code\n"
        f"print('heavy:', [m for m in '{heavy}'.split() if m in sys.modules])\nsys.exit(code)"
    )
    begin = time.perf_counter()
    result = subprocess.run([sys.executable, "-c", code, *words], capture_output=True, text=True, check=False)
    seconds = time.perf_counter() - begin
    assert result.returncode == 0, result.stderr
    assert result.stdout.splitlines()[-1] == "heavy: []"
    assert seconds < 1.5  # 0.1 s on an idle machine; the promise is 0.5


def test_python_dash_m_is_the_same() -> None:
    result = subprocess.run(
        [sys.executable, "-m", "tightrope", "train", "X", "--lr", "1"],
        capture_output=True,
        text=True,
        check=False,
    )
    assert (result.returncode, result.stdout) == (2, "")
    assert "--learning-rate" in result.stderr


# ---------------------------------------------------------------------------- panel and curves


def test_the_panel_paints_rarely_and_shows_the_progress_of_the_run(tmp_path: Path) -> None:
    import io

    class Terminal(io.StringIO):
        def isatty(self) -> bool:
            return True

    stream = Terminal()
    report = display.Display(display.CONTROL, stream, live=True)
    begin = time.monotonic()
    with report:
        a_run(tmp_path)(TrainSettings(), None, [report])
    paints = stream.getvalue().count("CartPole-v1")
    assert 2 <= paints <= 4 + 4 * (time.monotonic() - begin)
    last = stream.getvalue().rpartition("CartPole-v1")[2]
    for part in (
        "1,000 of 1,000 steps",
        "100.0",
        "KL 0.0100",
        "clipped 10.0 %",
        "5,000 steps/s",
        "3.00 ± 1.00",
        "█",
    ):
        assert part in last
    assert "engine: fused" in stream.getvalue()


@pytest.mark.parametrize("environment", [{"NO_COLOR": "1"}, {"TERM": "dumb"}, {"CI": "true"}])
def test_no_panel_where_it_is_not_wanted(environment: dict[str, str]) -> None:
    terminal = types.SimpleNamespace(isatty=lambda: True)
    assert display.can_live(terminal, {"TERM": "xterm"})  # type: ignore[arg-type]
    assert not display.can_live(terminal, environment)  # type: ignore[arg-type]
    assert not display.can_live(types.SimpleNamespace(isatty=lambda: False), {})  # type: ignore[arg-type]


def test_curves_rise_with_their_values() -> None:
    assert display.sparkline([1, 2, 3, 4, 5, 6, 7, 8], 8) == display.BARS
    assert display.sparkline([5.0, 5.0], 8) == "▁▁"
    assert display.sparkline([], 8) == ""
    assert len(display.sparkline(list(range(1000)), 30)) == 30
    lines = display.curve([(10 * k, float(k)) for k in range(200)], width=40, height=4)
    assert len(lines) == 5
    filled = [sum(not c.isspace() for c in line.partition("│")[2]) for line in lines[:4]]
    assert filled == sorted(filled)
    assert filled[-1] >= 39
    assert lines[-1].split() == ["0", "1,990", "steps"]
    assert display.curve([(1, 1.0)]) == []
    assert len(display.curve([(1, 5.0), (2, 5.0)])) == 9
    assert display.curve([(1, float("nan")), (2, 1.0)]) == []


def test_figures_are_short() -> None:
    assert [display.number(x) for x in (1234.56, 12.25, 0.01234, 0.0, None, float("nan"))] == [
        "1,234.6",
        "12.25",
        "0.0123",
        "0.00",
        "-",
        "-",
    ]
    assert [display.clock(x) for x in (7, 67.4, 3725, float("nan"))] == ["0:07", "1:07", "1:02:05", "-"]


def test_a_reader_that_leaves_does_not_end_the_run(tmp_path: Path) -> None:
    import io

    class Gone(io.StringIO):
        def write(self, text: str) -> int:
            raise BrokenPipeError

    report = display.Display(display.CONTROL, Gone())
    with report:
        summary = a_run(tmp_path)(TrainSettings(), None, [report])
    assert summary == SUMMARY
    assert report.step == 1000


def test_time_left_counts_this_runs_steps_only(monkeypatch: pytest.MonkeyPatch) -> None:
    now = [100.0]
    monkeypatch.setattr(time, "monotonic", lambda: now[0])
    progress = display.Display(display.CONTROL, sys.stdout)
    progress(Started("run", SETTINGS, 400, 1000, ()))
    now[0] += 10.0
    progress(Updated(600, 1000, 1.0, {}))
    assert progress.seconds_left() == pytest.approx(20.0)


VIEWS = {"control": display.CONTROL, "align": display.ALIGN, "sft": display.SFT, "reward": display.REWARD}


@pytest.mark.parametrize("name", VIEWS)
def test_every_column_shows_declared_metrics(name: str) -> None:
    for column in VIEWS[name].columns:
        assert all(metric in METRICS for metric in column.metrics)
        assert len(column.form(*(12345.678 for _ in column.metrics))) < 2 * column.width


@pytest.mark.parametrize("name", VIEWS)
def test_every_view_has_lines_and_a_panel(name: str) -> None:
    """The newest figure of each column stays; the last update has a line or is in the panel."""
    import io

    view = VIEWS[name]
    for live in (False, True):
        stream = io.StringIO()
        with display.Display(view, stream, live=live) as shown:
            shown(Started("run", SETTINGS, 0, 1000, ("a fact",)))
            first, *others = (metric for column in view.columns for metric in column.metrics)
            shown(Updated(10, 1000, 1.0, dict.fromkeys(others, 0.25)))
            shown(Updated(20, 1000, 2.0, {first: 0.5, others[0]: float("nan")}))
            shown(Finished({}))
        last = stream.getvalue().splitlines()[-8:]
        text = "\n".join(last)
        cells = [
            column.form(*(0.5 if m == first else 0.25 for m in column.metrics)) for column in view.columns
        ]
        assert all(cell in text for cell in cells), text
        assert "a fact" in stream.getvalue() and view.counted in stream.getvalue()


@pytest.mark.parametrize("width", [80, 60, 40])
@pytest.mark.parametrize("name", VIEWS)
def test_the_panel_is_whole_in_any_width_and_there_before_the_run(
    name: str, width: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    import io
    import re

    class Terminal(io.StringIO):
        def isatty(self) -> bool:
            return True

        def text(self) -> str:
            return re.sub(r"\x1b\[[0-9;?]*[A-Za-z]|\r", "", self.getvalue())

    monkeypatch.setenv("COLUMNS", str(width))
    monkeypatch.setenv("TERM", "xterm-256color")
    view, stream = VIEWS[name], Terminal()
    with display.Display(view, stream, live=True, title="tightrope align · runs/sft") as shown:
        first = stream.text()
        assert "tightrope align" in first and "loading" in first
        shown(Started("run", SETTINGS | {"model": "a/very/long/name/of/a/model" * 3}, 0, 4_000_000, ()))
        values = {metric: 1234.5 for column in view.columns for metric in column.metrics}
        for step in range(1, 50):
            shown(Updated(step * 80_000, 4_000_000, 1.0, values))
        shown(Finished({}))
    last = stream.text().rpartition("╭")[2]
    cells = [column.form(*(1234.5 for _ in column.metrics)) for column in view.columns]
    shortest = ("3,920,000 of 4,000,000", "98 %", "left", *cells)
    assert all(cell in last for cell in shortest), last
    plain = [line for line in last.splitlines() if line.startswith("│")]
    assert all(len(line) <= width and line.endswith("│") for line in plain), last
