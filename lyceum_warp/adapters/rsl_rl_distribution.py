"""rsl_rl's Gaussian distribution of actions, sampled without waiting for the device."""

import torch

from lyceum_warp.adapters.rsl_rl_release import check_rsl_rl

check_rsl_rl()  # its error says more than that of the import below

from rsl_rl.modules import GaussianDistribution  # noqa: E402


class AsynchronousGaussian(GaussianDistribution):  # type: ignore[misc]
    """rsl_rl's GaussianDistribution, which samples by ``torch.randn``.

    rsl_rl's own samples by ``torch.normal``, which reads the smallest standard deviation on the host to check it: each
    step then waits until the device has done the one before.
    """

    def sample(self) -> torch.Tensor:
        """Draw actions, (..., actions)."""
        mean, std = self.params
        return torch.addcmul(mean, std, torch.randn_like(mean)).detach()
