"""Any Gymnasium environment as a fleet: say what a violation is, what success is, and who the human is.

Ten carts balance a pole. They start with no data at all, so that everything they know they learn from one human.
"""

import numpy as np

from tutelage.checks import check_env
from tutelage.envs.gymnasium_fleet import GymnasiumFleet, Outcome
from tutelage.fleet.allocation import FleetDAgger
from tutelage.fleet.loop import Loop
from tutelage.fleet.priority import PriorityConfig, parse
from tutelage.fleet.supervisor import PolicySupervisor, Team
from tutelage.fleet.tally import Counting, Tally
from tutelage.learning.dataset import AggregatedDataset
from tutelage.learning.imitation import ImitationLearner, LearnerConfig
from tutelage.policies.ensemble import EnsemblePolicy
from tutelage.seeding import derive, stream

ROBOTS, HUMANS, STEPS, SEED = 10, 1, 600, 0


def fell(outcome: Outcome) -> np.ndarray:
    """The constraint c(s): the environment ends an episode when the pole tips over. (N,) bool."""
    return outcome.terminated


def balanced(outcome: Outcome) -> np.ndarray:
    """Success: the pole is still up after 100 timesteps. (N,) bool."""
    return outcome.truncated


class Balancer:
    """The human: a linear controller of cart position, pole angle and their velocities."""

    def act(self, obs: np.ndarray) -> np.ndarray:
        """(n, 4) observations -> (n, 1) forces."""
        return np.clip(obs @ [[1.0], [10.0], [1.5], [1.5]], -3, 3).astype(np.float32)


fleet = GymnasiumFleet("InvertedPendulum-v5", num_envs=ROBOTS, horizon=100, violation=fell, success=balanced)
check_env(fleet)  # names the first broken promise, if any

width, actions = fleet.single_observation_space.shape[0], len(fleet.action_low)
policy = EnsemblePolicy(width, fleet.action_low, fleet.action_high, hidden=(64, 64), seed=derive(SEED, "policy"))
dataset = AggregatedDataset((width,), actions, policy.members, stream(SEED, "dataset"))
learner = ImitationLearner(policy, dataset, LearnerConfig(batch=64), seed=SEED)
tally = Tally(ROBOTS, HUMANS)
loop = Loop(
    fleet,
    policy,
    parse("U.C.", PriorityConfig(uncertainty=0.001)),
    Team([PolicySupervisor(Balancer())] * HUMANS),
    FleetDAgger(t_teleop=5, t_reset=5),
    learner,
    subscribers=[Counting(tally)],
    seed=SEED,
)
for until in range(100, STEPS + 1, 100):
    loop.run(until)
    m = tally.summary()
    print(f"timestep {until}: {m['successes']} successes, {m['violations']} falls, {m['human_time']} human timesteps")
