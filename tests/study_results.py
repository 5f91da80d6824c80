"""Result files as a study writes them, with made-up numbers."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np

STEPS, RATE = 1000, {"C. (BC)": 10.0, "Random": 60.0, "U.C.": 55.0, "C.U.R.": 80.0}
"""Timesteps, and tasks completed by each algorithm (about)."""


def result(algorithm: str, seed: int, successes: float, hard_resets: float, evaluated: bool = True) -> dict[str, Any]:
    """A result file as the study writes it."""
    t = np.linspace(20, STEPS, 50)
    done, fell = successes + seed, hard_resets + seed
    idle = 5 * fell * np.minimum(t / 250, 1)  # nobody is idle after timestep 250
    curves = {
        "t": t, "successes": done * t / STEPS, "hard_resets": fell * np.minimum(t / 250, 1), "idle_time": idle,
        "human_time": 2.0 * t, "rohe": done * t / STEPS * 0.1 / (1 + 0.02 * t),
    }  # fmt: skip
    metrics = {
        "successes": done, "hard_resets": fell, "idle_time": 5 * fell, "human_time": 2000.0, "rohe": done * 0.1 / 21,
    }  # fmt: skip
    frozen = {"evaluation": {**metrics, "steps": STEPS}} if evaluated else {}
    expert = {"expert": {**metrics, "successes": 90.0, "steps": STEPS}} if algorithm == "C.U.R." and evaluated else {}
    config = {
        "robots": 20, "humans": 2, "steps": STEPS, "t_teleop": 5, "t_reset": 5, "disturbance": "moderate",
        "offline_pairs": 5000, "thresholds": {"initial": 250, "uncertainty": 0.01 + 0.001 * seed, "risk": 0.4},
    }  # fmt: skip
    curves = {name: list(map(float, values)) for name, values in curves.items()}
    return {"algorithm": algorithm, "seed": seed, "metrics": metrics, **frozen, **expert, "curves": curves, "config": config}


def write(folder: Path, kind: str, task: str, rates: dict[str, float], seeds: int = 3, evaluated: bool = True) -> Path:
    """Result files of a study."""
    for algorithm, rate in rates.items():
        for seed in range(seeds):
            path = folder / kind / task / f"{algorithm.lower().replace('.', '').replace(' ', '')}-s{seed}.json"
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_text(json.dumps(result(algorithm, seed, rate, 1000 / rate, evaluated)))
    return folder
