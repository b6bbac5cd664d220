"""How raters answer."""
