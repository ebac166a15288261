"""The update of rsl_rl's PPO without waiting for the device; on a GPU, an epoch is one CUDA graph."""

from collections.abc import Mapping
from typing import Any

import torch
from torch import nn

from lyceum_warp.graphs.capture import capturing


class CapturedUpdate:
    """Computes what ``PPO.update`` of rsl_rl computes, up to rounding and with fewer random numbers.

    rsl_rl's own launches each operation of a mini-batch alone, and reads its losses and the KL divergence on the
    host. Here the learning rate stays on the device, and so do the losses, which one copy brings to the host at the end
    of the update. The mini-batches are the same in every epoch, as there, so that one shuffled copy of the samples
    serves all epochs, and an epoch can be captured. Without a GPU the same operations run one by one.

    The caller takes observations into the normalisers.

    Args:
        ppo: rsl_rl's PPO with an ``MLPModel`` for each network and with Adam, in one process, without random network
            distillation or symmetries.
    """

    def __init__(self, ppo: Any) -> None:
        self.ppo = ppo
        storage = ppo.storage
        self.device = storage.rewards.device
        self.cuda = self.device.type == "cuda"
        self.count = ppo.num_mini_batches
        self.batch = storage.num_envs * storage.num_transitions_per_env // self.count
        self.rate = torch.zeros((), device=self.device)
        self._entropy_coef = torch.zeros((), device=self.device)  # changes from one replay to the next
        self._sums = torch.zeros(3, device=self.device)
        self._samples: dict[str, torch.Tensor] = {}
        self._parameters = [p for group in ppo.optimizer.param_groups for p in group["params"] if p.requires_grad]
        self.bind()

    def bind(self) -> None:
        """Take over the learning rate, Adam's moments and the normalisers' buffers, as after they were loaded."""
        self._buffers = [
            (part, name, buffer)
            for network in (self.ppo.actor, self.ppo.critic)
            for part in network.modules()
            for name, buffer in part.named_buffers(recurse=False)
        ]
        self.rate.fill_(float(self.ppo.learning_rate))
        for group in self.ppo.optimizer.param_groups:
            # one kernel for all parameters; without it, a graph has several for each of them
            group["fused"], group["foreach"] = True, False
            group["capturable"], group["lr"] = self.cuda, self.rate
        for entry in self.ppo.optimizer.state.values():
            entry["step"] = entry["step"].to(device=self.device, dtype=torch.float32)
        self._warm = False
        self._graph: torch.cuda.CUDAGraph | None = None

    def __call__(self) -> dict[str, float]:
        """Update the networks from the storage, which then is empty; returns the mean losses by rsl_rl's names."""
        ppo = self.ppo
        self._put_back_buffers()
        self._shuffle()
        self._entropy_coef.fill_(ppo.entropy_coef)
        self._sums.zero_()
        for _ in range(ppo.num_learning_epochs):
            self._run_epoch()
        ppo.storage.clear()
        means = self._sums / (ppo.num_learning_epochs * self.count)
        value, surrogate, entropy, ppo.learning_rate = torch.cat([means, self.rate[None]]).tolist()
        return {"value": value, "surrogate": surrogate, "entropy": entropy}

    @torch.no_grad()
    def _put_back_buffers(self) -> None:
        """Copy buffers that rsl_rl replaced, as a normaliser's standard deviation, to where the graph reads them."""
        for part, name, buffer in self._buffers:
            if (new := getattr(part, name)) is not buffer:
                buffer.copy_(new)
                setattr(part, name, buffer)

    @torch.no_grad()
    def _shuffle(self) -> None:
        """Copy the samples in a random order into tensors of fixed address, (mini-batches, samples, ...)."""
        storage = self.ppo.storage
        order = torch.randperm(self.count * self.batch, device=self.device)
        for name, source in self._sources(storage).items():
            rows = source.flatten(0, 1)
            if name not in self._samples:
                self._samples[name] = rows.new_empty(self.count, self.batch, *rows.shape[1:])
            torch.index_select(rows, 0, order, out=self._samples[name].flatten(0, 1))

    def _sources(self, storage: Any) -> dict[str, torch.Tensor]:
        """What a mini-batch holds, by name; the groups of observations by their own."""
        groups = {*self.ppo.actor.obs_groups, *self.ppo.critic.obs_groups}
        return {
            **{f"obs/{group}": storage.observations[group] for group in sorted(groups)},
            **{f"old/{i}": part for i, part in enumerate(storage.distribution_params)},
            "action": storage.actions, "log_prob": storage.actions_log_prob, "advantage": storage.advantages,
            "value": storage.values, "return": storage.returns,
        }  # fmt: skip

    def _run_epoch(self) -> None:
        if not self.cuda:
            self._epoch()
            return
        with torch.cuda.device(self.device):
            if not self._warm:
                self._warm_up()
                return
            if self._graph is None:
                self._graph = torch.cuda.CUDAGraph()
                with capturing(), torch.cuda.graph(self._graph, capture_error_mode="thread_local"):
                    self._epoch()
            self._graph.replay()

    def _warm_up(self) -> None:
        """Run an epoch directly, on another stream than the default one: it allocates Adam's moments."""
        stream = torch.cuda.Stream()
        stream.wait_stream(torch.cuda.current_stream())
        with torch.cuda.stream(stream):
            self._epoch()
        torch.cuda.current_stream().wait_stream(stream)
        self._warm = True

    def _epoch(self) -> None:
        for i in range(self.count):
            self._learn({name: rows[i] for name, rows in self._samples.items()})

    def _learn(self, samples: Mapping[str, torch.Tensor]) -> None:
        """Learn from a mini-batch (Schulman et al. 2017, "Proximal Policy Optimization Algorithms")."""
        ppo = self.ppo
        actor, critic, policy = ppo.actor, ppo.critic, ppo.actor.distribution
        obs = {name.removeprefix("obs/"): rows for name, rows in samples.items() if name.startswith("obs/")}
        policy.update(actor.mlp(actor.get_latent(obs)))
        value = critic.mlp(critic.get_latent(obs))
        self._adapt(policy, tuple(samples[f"old/{i}"] for i in range(len(policy.params))))

        advantage, limit = samples["advantage"].squeeze(-1), ppo.clip_param
        if ppo.normalize_advantage_per_mini_batch:
            advantage = (advantage - advantage.mean()) / (advantage.std() + 1e-8)
        ratio = torch.exp(policy.log_prob(samples["action"]) - samples["log_prob"].squeeze(-1))
        surrogate = torch.max(-advantage * ratio, -advantage * ratio.clamp(1.0 - limit, 1.0 + limit)).mean()
        error = (value - samples["return"]).square()
        if ppo.use_clipped_value_loss:
            near = samples["value"] + (value - samples["value"]).clamp(-limit, limit)
            error = torch.max(error, (near - samples["return"]).square())
        value_loss, entropy = error.mean(), policy.entropy.mean()
        loss = surrogate + ppo.value_loss_coef * value_loss - self._entropy_coef * entropy

        # not backward(), whose sums of gradients belong to the stream of the first call
        gradients = torch.autograd.grad(loss, self._parameters)
        for parameter, gradient in zip(self._parameters, gradients, strict=True):
            parameter.grad = gradient
        for network in (actor, critic):
            nn.utils.clip_grad_norm_(network.parameters(), ppo.max_grad_norm)
        ppo.optimizer.step()
        self._sums += torch.stack([value_loss, surrogate, entropy]).detach()

    @torch.no_grad()
    def _adapt(self, policy: Any, old: tuple[torch.Tensor, ...]) -> None:
        """Adapt the learning rate to the KL divergence from the policy that sampled."""
        ppo, wanted = self.ppo, self.ppo.desired_kl
        if ppo.schedule == "adaptive" and wanted is not None:
            kl = policy.kl_divergence(old, policy.params).mean()
            lower, higher = (self.rate / 1.5).clamp_min(1e-5), (self.rate * 1.5).clamp_max(1e-2)
            raised = torch.where((kl < wanted / 2.0) & (kl > 0.0), higher, self.rate)
            self.rate.copy_(torch.where(kl > wanted * 2.0, lower, raised))
