"""The contracts as functions that users run on their own classes.

    from tutelage.checks import check_env

    check_env(MyFleet(num_envs=4))

Each returns nothing if all is well. Otherwise it raises a `ContractError` that names the clause.
"""

from tutelage.checks.env import check_env
from tutelage.checks.policy import check_policy
from tutelage.checks.priority import check_priority
from tutelage.checks.supervisor import check_supervisor

__all__ = ["check_env", "check_policy", "check_priority", "check_supervisor"]
