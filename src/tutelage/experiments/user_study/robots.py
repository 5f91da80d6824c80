"""The robots of the user study: peg insertion with actions of twice the size, so that it does not take all day."""

from __future__ import annotations

from tutelage.envs.experts.peg_insertion import PegInserter
from tutelage.envs.tasks.peg_insertion import STEP, TWIST, PegInsertion


class QuickPegInsertion(PegInsertion):
    """As `PegInsertion`, but an action goes twice as far, and is disturbed by noise of covariance 0.02 (appendix B.4)."""

    step, twist = 2 * STEP, 2 * TWIST
    disturbance = "noise=0.1414"
    offline_pairs = 1364  # 30 demonstrations
    expert = "tutelage.experiments.user_study.robots:QuickInserter"


class QuickInserter(PegInserter):
    """The human for these robots."""

    step, twist = QuickPegInsertion.step, QuickPegInsertion.twist
