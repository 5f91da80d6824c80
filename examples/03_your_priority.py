"""A priority function of your own: robots that lean are helped before they fall.

A priority looks at a `FleetView` and returns (N, K) numbers, compared from left to right; all <= 0 means "needs nobody".
"""

from typing import Any

import numpy as np

from tutelage.checks import check_priority
from tutelage.envs.registry import make_fleet
from tutelage.experiments.assemble import assemble
from tutelage.experiments.config import RunConfig
from tutelage.experiments.prepare import prepare
from tutelage.fleet.loop import Loop
from tutelage.fleet.priority import Priority, parse
from tutelage.fleet.supervisor import PolicySupervisor, Team
from tutelage.fleet.tally import Counting, Tally
from tutelage.fleet.view import FleetView
from tutelage.learning.imitation import LearnerConfig


class Leaning:
    """Robots that fell first, then those whose torso leans by more than `limit` radians, the worst first."""

    def __init__(self, limit: float = 0.3) -> None:
        self.limit = limit

    def __call__(self, view: FleetView) -> np.ndarray:
        """(N, 2): violated or not; lean."""
        lean = np.abs(view.obs[:, 1])  # of Walker2d, the pitch of the torso
        return np.stack([view.violation, np.where((lean > self.limit) & ~view.violation, lean, 0.0)], axis=1).astype(float)

    def state_dict(self) -> dict[str, Any]:
        """It remembers nothing between timesteps."""
        return {}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Nothing to restore."""


def achieve(name: str, priority: Priority) -> None:
    """Run the loop with a priority, everything else being equal."""
    config = RunConfig(
        "Walker2d", priority="C.U.", robots=10, humans=2, threads=1, torch_threads=1,
        offline_pairs=2000, calibration_steps=50, learner=LearnerConfig(pretrain=300),
    )  # fmt: skip
    parts = prepare(assemble(config))
    tally = Tally(config.robots, config.humans)
    team = Team([PolicySupervisor(parts.actor)] * config.humans)
    Loop(parts.fleet, parts.policy, priority, team, learner=parts.learner, subscribers=[Counting(tally)]).run(400)
    m = tally.summary()
    print(f"{name:8} {m['violations']:4} falls {m['human_time']:5} human timesteps")


if __name__ == "__main__":
    check_priority(Leaning(), make_fleet("Walker2d", 4))
    achieve("C.", parse("C."))
    achieve("Leaning", Leaning())
