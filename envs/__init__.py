"""Environments that ship with popl_rl, and the rater groups that live in them."""
