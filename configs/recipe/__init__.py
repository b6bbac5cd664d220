"""Recipes of methods that several environments share."""
