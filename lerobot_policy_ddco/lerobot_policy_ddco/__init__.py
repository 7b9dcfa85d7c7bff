"""A hierarchy of options as a LeRobot policy; LeRobot imports every installed package of such a name.

``ddco-pyro export RUN --lerobot FOLDER`` writes what ``--policy.path=FOLDER`` names.
"""

from lerobot_policy_ddco.configuration_ddco import DDCOConfig

__all__ = ["DDCOConfig"]
