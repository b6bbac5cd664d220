"""raters."""
