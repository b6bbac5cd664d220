"""Scripts that read top-down: train a policy set, judge one again."""
