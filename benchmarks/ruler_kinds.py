"""The runs of ruler.py, as words of the command line."""

from __future__ import annotations

TASKS = "ruler_tasks.py"  # a copy of it is in the folder of the runs
TRAIN = (
    "--seed 1 --threads 1 --num-envs 4 --num-steps 64 --num-epochs 2 --total-steps 4096 --evaluate-every 0.3 "
    "--evaluation-episodes 2 --checkpoint-every 0.2 --vector-backend serial"
)
ONCE = TRAIN.replace("--num-epochs 2 ", "")  # A2C and REINFORCE have no epochs
TUNE = "--seed 1 --threads 1 --num-epochs 2 --minibatch-size 4 --max-tokens 24 --checkpoint-every 0.2"
ALIGN = (
    "--seed 1 --threads 1 --data prompts.jsonl --total-episodes 48 --batch-size 8 --minibatch-size 4 "
    f"--num-epochs 2 --max-new-tokens 6 --checkpoint-every 0.2 --evaluate-every 0.5 --gold {TASKS}:vowels"
)
OWN = f"--env-module {TASKS}"
# kind -> the words after `tightrope`, where the last value of a flag counts; or a job of ruler_tasks.py
KINDS: dict[str, str] = {
    "cartpole-compiled": f"train CartPole-v1 {TRAIN} --engine fused",
    "cartpole-torch": f"train CartPole-v1 {TRAIN} --engine torch --total-steps 2048",
    "cartpole-extras": f"train CartPole-v1 {TRAIN} --engine torch --total-steps 2048 --shared "
    "--vector-backend vector --value-clip 0.2 --dual-clip 3 --recompute-advantages --target-kl 0.05 "
    "--entropy-weight 0.01 --entropy-weight-schedule cosine --micro-batch-size 48",
    "cartpole-kl-penalty": f"train CartPole-v1 {TRAIN} --total-steps 2048 --kl-beta 0.5 --kl-adapt 0.01",
    "pendulum-normalised": f"train Pendulum-v1 {TRAIN} --normalise-observations --normalise-rewards",
    "pendulum-gsde": f"train Pendulum-v1 {TRAIN} --std gsde --total-steps 2048",
    "pendulum-state-squash": f"train Pendulum-v1 {TRAIN} --std state --action-bounds squash "
    "--total-steps 2048",
    "masks-workers": f"train RulerShelf-v0 {OWN} {TRAIN} --vector-backend workers --num-workers 2",
    "image": f"train RulerPicture-v0 {OWN} {TRAIN} --num-steps 16 --total-steps 512 --num-epochs 1",
    "a2c": f"train CartPole-v1 {ONCE} --algorithm a2c",
    "reinforce": f"train CartPole-v1 {ONCE} --algorithm reinforce",
    "agents-in-python": "agents",
    "sft": f"sft --data texts.jsonl {TUNE}",
    "sft-full-packed": f"sft --data texts.jsonl {TUNE} --tune full --pack",
    "reward": f"reward --data pairs.jsonl {TUNE} --lora-layers 2",
    "align-head": f"align {ALIGN} --reward {TASKS}:vowels --critic head --whiten-rewards --kl-goal 1",
    "align-adapter": f"align {ALIGN} --reward reward --critic adapter --kl exact-split --critic-from-reward "
    "--lora-layers 2",
    "align-separate": f"align {ALIGN} --reward reward --critic separate --tune full --learning-rate 1e-5 "
    "--critic-warmup 1 --ptx-weight 0.1 --ptx-data plain.txt --truncation bootstrap",
    "align-in-python": "judged",
}
