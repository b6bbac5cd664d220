"""Rater groups."""
