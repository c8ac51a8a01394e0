"""Balance a pole: train, inspect single states, save, load, and check the learned policy. About ten seconds.

python examples/cartpole.py
"""

import tempfile
from pathlib import Path

import gymnasium

import tightrope


def play(agent: tightrope.PPO, seed: int) -> float:
    """The return of one episode in a plain Gymnasium environment."""
    env = gymnasium.make("CartPole-v1")
    observation, _ = env.reset(seed=seed)
    total, over = 0.0, False
    while not over:
        action, _ = agent.predict(observation)
        observation, reward, terminated, truncated, _ = env.step(action)
        total, over = total + float(reward), terminated or truncated
    return total


def main() -> None:
    """Train for 60,000 steps and check the policy, before and after a save and load."""
    agent = tightrope.PPO("CartPole-v1", seed=1)
    for report in agent.iterate(60_000):
        if "rollout/ep_rew_mean" in report.metrics:
            print(f"{report.step:6d} steps   return {report.metrics['rollout/ep_rew_mean']:6.1f}")

    upright, falling = [0.0, 0.0, 0.0, 0.0], [0.0, 0.0, 0.2, 2.0]
    print(f"V(upright) {agent.value(upright):.1f}   V(falling) {agent.value(falling):.1f}")
    assert agent.value(upright) > agent.value(falling)

    returns = [play(agent, seed) for seed in range(10)]
    print("ten episodes:", returns)
    assert sum(returns) / len(returns) >= 400

    with tempfile.TemporaryDirectory() as folder:
        agent.save(Path(folder) / "pole")
        again = tightrope.load(Path(folder) / "pole")
    assert play(again, seed=0) == returns[0]


if __name__ == "__main__":
    main()
