"""Hydra configuration: YAML that differs from the defaults in popl_rl/config.py."""
