"""The shortest run: 20 walking robots, 2 humans, for a third of an episode."""

from tutelage.experiments.config import RunConfig
from tutelage.experiments.run import Run

config = RunConfig("Walker2d", priority="U.C.", robots=20, humans=2, steps=300)
run = Run.start(config)  # demonstrations, behaviour cloning, thresholds
metrics = run.run()
print(f"{metrics['violations']} falls, {metrics['hard_resets']} hard resets")
print(f"{metrics['human_time']} human timesteps, {metrics['teleoperation']} of them teleoperation")
print(f"run folder: {run.folder}")
