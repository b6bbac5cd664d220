"""Environments that ship with popl_rl, and the rater groups that live in them.

* ``two_doors``, ``two_doors_alike``: a small grid, solved exactly.
* ``hidden_utility``, ``hidden_plane``: nothing to learn but what people want.
* ``delivery``: a grid read from a file, on which real people have compared segments.
* ``cartpole``: Gymnasium's CartPole, the smallest continuous world.
* ``reacher``: MuJoCo's Reacher, quick or smooth.
* ``hopper``: MuJoCo's Hopper, fast or upright.
* ``half_cheetah``: MuJoCo's HalfCheetah, fast or with little effort.
* ``metaworld_tasks``: a robot arm at fifty tasks.
"""
