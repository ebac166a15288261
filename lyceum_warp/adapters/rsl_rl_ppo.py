"""rsl_rl's PPO with another estimate of what an episode that was cut off would still have brought."""

from typing import Any

import torch

from lyceum_warp.adapters.rsl_rl_release import check_rsl_rl

check_rsl_rl()  # its error says more than that of the imports below

from rsl_rl.algorithms import PPO  # noqa: E402
from tensordict import TensorDict  # noqa: E402


class FinalObservationPPO(PPO):  # type: ignore[misc]
    """rsl_rl's PPO, which takes the value of an episode's final observation for the rest of a truncated one.

    rsl_rl's own adds gamma V(observation before the last step) to the last reward, because its environments do not keep
    the final observation (rsl_rl issue 151). This one adds gamma V(final observation), the critic's groups of
    ``extras["final_obs"]``, as ``RslRlVecEnv`` gives them.

    In a runner's configuration it is ``algorithm.class_name``.
    """

    def process_env_step(
        self, obs: TensorDict, rewards: torch.Tensor, dones: torch.Tensor, extras: dict[str, Any]
    ) -> None:
        """Store a step; see rsl_rl's ``PPO``.

        Args:
            obs: Observations after the step, of a new episode where one began.
            rewards: (nworld,).
            dones: Whether an episode ended, (nworld,).
            extras: ``time_outs`` and ``final_obs``.

        Raises:
            KeyError: ``extras`` lacks one of them.
        """
        hidden = self.critic.get_hidden_state()
        final = self.critic(extras["final_obs"].to(self.device)).detach().squeeze(-1)
        self.critic.reset(hidden_state=hidden)  # where it is recurrent: no step led from the final observation
        rest = torch.where(extras["time_outs"].to(self.device), final, 0.0)
        others = {name: entry for name, entry in extras.items() if name != "time_outs"}
        super().process_env_step(obs, rewards + self.gamma * rest, dones, others)
