"""Suites of popl-benchmark. Not a group of Hydra's, which ``suite=`` must not name."""
