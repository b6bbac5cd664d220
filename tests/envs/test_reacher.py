"""Reacher: each script does what one group wants, and not the other."""

from popl_rl.config import plain
from popl_rl.evaluation.acting import Rolling
from popl_rl.evaluation.measures import group_returns
from popl_rl.experiments.data import build_groups, build_world


def test_each_group_finds_its_script_in_the_data(config_of):
    config = plain(config_of("env=reacher", "env.noise=[0]"))
    world = build_world(config.env)
    groups = build_groups(config.raters, world)
    assert [group.name for group in groups] == ["quick", "smooth"]
    acting = Rolling(world, episodes=5, max_steps=50, seed=0)
    (quick, smooth), (quick_of_gentle, smooth_of_gentle), wander = (
        group_returns(acting.behaviours([name]), groups)[0].tolist()
        for name in ("reach_hard", "reach_gently", "wander")
    )
    assert quick > quick_of_gentle + 1 > wander[0] + 2
    assert smooth_of_gentle > smooth + 5 > wander[1]
