"""A scenario as an environment for reinforcement learning.

`dm` has dm_control's faces, `gym` Gymnasium's; both are of the same `episode`.
"""
