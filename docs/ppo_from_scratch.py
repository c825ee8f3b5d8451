"""PPO on the task headings in plain PyTorch, after CleanRL: a start for an algorithm of your own.

Run it from the checkout: ``PYTHONPATH=. .venv/bin/python docs/ppo_from_scratch.py``.
"""

import gymnasium
import numpy as np
import torch
from torch import nn
from torch.distributions import Categorical


class Agent(nn.Module):
    """Scores of 16 headings by one network, of no claim and 3 claims by another, and the value of all features."""

    def __init__(self) -> None:
        super().__init__()
        self.heading = nn.Sequential(nn.Linear(6 + 12 + 2, 32), nn.Tanh(), nn.Linear(32, 1))
        self.claim = nn.Sequential(nn.Linear(14 + 12, 32), nn.Tanh(), nn.Linear(32, 1))
        self.value = nn.Sequential(nn.Linear(16 * 6 + 3 * 14 + 12, 64), nn.Tanh(), nn.Linear(64, 1))
        angles = torch.arange(16) * 2 * torch.pi / 16
        self.register_buffer("angles", torch.stack([angles.cos(), angles.sin()], 1))

    def forward(
        self, obs: dict[str, torch.Tensor], masks: torch.Tensor
    ) -> tuple[Categorical, Categorical, torch.Tensor]:
        """Return the distributions of headings and of claims, and the values."""
        robot, count = obs["robot"][:, None], len(masks)
        turned = torch.cat([obs["headings"], robot.expand(-1, 16, -1), self.angles.expand(count, -1, -1)], 2)
        claims = self.claim(torch.cat([obs["candidates"], robot.expand(-1, 3, -1)], 2))[..., 0]
        claims = torch.cat([torch.ones(count, 1), claims], 1).where(masks[:, 16:], torch.tensor(-1e8))
        everything = torch.cat([value.flatten(1) for value in obs.values()], 1)
        headings = self.heading(turned)[..., 0] + 1.5 * self.angles[:, 0]  # at first it drives on
        return Categorical(logits=headings), Categorical(logits=claims), self.value(everything)[:, 0]


def train(updates: int = 300, robots: int = 48, decisions: int = 48, **settings: object) -> list[float]:
    """Return the returns of all episodes that ended; `settings` are those of the environment."""
    envs = gymnasium.make_vec("agents.rl:CyclicLoopHeadings-v0", num_envs=robots, **settings)
    agent, returns, running = Agent(), [], np.zeros(robots)
    optimizer = torch.optim.Adam(agent.parameters(), 7e-4)
    obs = envs.reset(seed=0)[0]
    for _ in range(updates):
        steps = []
        for _ in range(decisions):
            seen, masks = {k: torch.tensor(v) for k, v in obs.items()}, torch.tensor(envs.action_masks())
            with torch.no_grad():
                heading, claim, value = agent(seen, masks)
                choice = torch.stack([heading.sample(), claim.sample()], 1)
                log_prob = heading.log_prob(choice[:, 0]) + claim.log_prob(choice[:, 1])
            obs, reward, terminated, truncated, _ = envs.step(choice.numpy())
            done, running = terminated | truncated, running + reward
            returns += running[done].tolist()
            running[done] = 0
            steps.append((seen, masks, choice, log_prob, value, torch.tensor(0.1 * reward).float(), torch.tensor(done)))
        with torch.no_grad():
            masks, following = torch.tensor(envs.action_masks()), torch.zeros(robots)
            later = agent({k: torch.tensor(v) for k, v in obs.items()}, masks)[2]
        advantages = []
        for *_, value, reward, done in reversed(steps):  # generalized advantage estimation
            following = reward + 0.99 * later * ~done - value + 0.99 * 0.95 * following * ~done
            advantages.insert(0, following)
            later = value
        seen = {k: torch.cat([step[0][k] for step in steps]) for k in steps[0][0]}
        masks, choice, log_prob, value = (torch.cat([step[i] for step in steps]) for i in (1, 2, 3, 4))
        advantage = torch.cat(advantages)
        target = value + advantage
        for rows in (part for _ in range(5) for part in torch.randperm(len(target)).chunk(4)):
            heading, claim, value = agent({k: v[rows] for k, v in seen.items()}, masks[rows])
            ratio = (heading.log_prob(choice[rows, 0]) + claim.log_prob(choice[rows, 1]) - log_prob[rows]).exp()
            normal = (advantage[rows] - advantage[rows].mean()) / (advantage[rows].std() + 1e-8)
            gain = torch.min(ratio * normal, ratio.clamp(0.8, 1.2) * normal).mean()
            entropy = (heading.entropy() + claim.entropy()).mean()
            optimizer.zero_grad()
            (0.5 * (value - target[rows]).square().mean() - gain - 0.01 * entropy).backward()
            nn.utils.clip_grad_norm_(agent.parameters(), 0.5)
            optimizer.step()
        print(f"{len(returns)} episodes, the last 100 with a mean return of {np.mean(returns[-100:] or [0]):.1f}")
    envs.close()
    return returns


if __name__ == "__main__":
    torch.set_num_threads(1)
    train(map_name="generated:train", noise="calibrated")
