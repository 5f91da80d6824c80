"""The action discrepancy classifier f of SafeDAgger and LazyDAgger (eq. 2.4)."""

from __future__ import annotations

import warnings
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from tutelage.fleet.discrepancy import discrepancy
from tutelage.learning.dataset import AggregatedDataset
from tutelage.learning.descent import Descent
from tutelage.policies.ensemble import EnsemblePolicy
from tutelage.policies.networks import as_tensor, hidden_layers, network, stored_as
from tutelage.policies.weights import load_module_state, module_state
from tutelage.seeding import rng_state, set_rng_state

Array = NDArray[Any]


class DiscrepancyClassifier:
    """f(s), the estimated probability that L(pi_R(s), pi_H(s)) >= beta_H: where the human would do something else.

    Trained by cross-entropy on D and on held-out human data D_S that the policy is not trained on (lines 3 and 19 of
    algorithm 1). Labels are made with the policy as it is when a batch is drawn, so they follow it as it learns.

    Args:
        policy: pi_R.
        dataset: D, shared with the learner.
        beta_h: beta_H, as a fraction of the largest discrepancy; set it before training.
        batch: pairs in a gradient step.
        learning_rate: of Adam.
        hidden: widths of the hidden layers; default: 128 and 128 (appendix A.1), for images those of the policy.
        rng: the seeded stream of batches; seed: of the initial weights.
    """

    def __init__(
        self,
        policy: EnsemblePolicy,
        dataset: AggregatedDataset,
        rng: np.random.Generator,
        seed: int,
        *,
        beta_h: float = np.nan,
        batch: int = 256,
        learning_rate: float = 1e-3,
        hidden: tuple[int, ...] | None = None,
    ) -> None:
        self.policy, self.dataset, self.rng, self.beta_h, self.batch = policy, dataset, rng, beta_h, batch
        shape, width = policy.obs_shape, dataset.actions.rows.shape[1]
        self.held_out = AggregatedDataset(shape, width, 1, rng, bootstrap=False, dtype=stored_as(shape))
        self.net = network(shape, 1, 1, hidden_layers(shape, hidden, (128, 128)), torch.Generator().manual_seed(seed))
        self.descent = Descent(self.net, learning_rate)

    @torch.no_grad()
    def __call__(self, obs: Array) -> Array:
        """f(s) of each robot: (N, D) or (N, H, W, 3) -> (N,) in [0, 1]."""
        return self._logit(as_tensor(obs)).sigmoid().numpy()

    def discrepancies(self, obs: Array, actions: Array) -> Array:
        """L(pi_R(s), a_H) for human data (n, D), (n, A): (n,)."""
        middle, half = (b.numpy() for b in (self.policy.action_middle, self.policy.action_half))
        return discrepancy(self.policy.act(obs), actions, middle - half, middle + half)

    def updates(self, n: int) -> float:
        """n gradient steps; returns the last loss (NaN where there are no data)."""
        total, loss = len(self.dataset) + len(self.held_out), float("nan")
        for _ in range(n if total else 0):
            index = self.rng.integers(total, size=self.batch)
            mine = index < len(self.dataset)
            parts = ((self.dataset, index[mine]), (self.held_out, index[~mine] - len(self.dataset)))
            obs = torch.cat([data.obs.rows[torch.from_numpy(rows)] for data, rows in parts])
            actions = torch.cat([data.actions.rows[torch.from_numpy(rows)] for data, rows in parts])
            unsafe = torch.from_numpy(self.discrepancies(obs.numpy(), actions.numpy()) >= self.beta_h).float()
            losses = torch.nn.functional.binary_cross_entropy_with_logits(self._logit(obs), unsafe)[None]
            loss = self.descent.step(losses)
        self.policy.forget()
        return loss

    def warn_if_blind(self) -> None:
        """Warn where the data show one class only: then f says the same everywhere."""
        data = [d for d in (self.dataset, self.held_out) if len(d)]
        if not data:
            warnings.warn("the classifier has no data: it will guess until a human has helped", stacklevel=2)
            return
        unsafe = (
            np.concatenate([self.discrepancies(d.obs.rows.numpy(), d.actions.rows.numpy()) for d in data]) >= self.beta_h
        )
        if unsafe.all() or not unsafe.any():
            kind, does, move = ("unsafe", "always", "higher") if unsafe.all() else ("safe", "never", "lower")
            warnings.warn(
                f"at beta_H = {self.beta_h:.3g} all {len(unsafe)} human data are {kind}: the classifier will {does} ask; "
                f"choose a {move} beta_h",
                stacklevel=2,
            )

    def _logit(self, obs: torch.Tensor) -> torch.Tensor:
        return self.net(self.policy.normalise(obs))[0, :, 0]  # type: ignore[no-any-return]

    def state_dict(self) -> dict[str, Any]:
        """Network, optimiser, held-out data and random state."""
        return {
            "beta_h": self.beta_h, "net": module_state(self.net), "adam": self.descent.state_dict(),
            "held_out": self.held_out.state_dict(), "rng": rng_state(self.rng),
        }  # fmt: skip

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore what `state_dict` returned."""
        self.beta_h = state["beta_h"]
        load_module_state(self.net, state["net"])
        self.descent.load_state_dict(state["adam"])
        self.held_out.load_state_dict(state["held_out"])
        set_rng_state(self.rng, state["rng"])
