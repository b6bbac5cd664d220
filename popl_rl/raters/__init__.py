"""Who is asked, what they want and how they answer. Only data and evaluation read it, no learner.

- ``groups``: hidden groups of raters; ``checks``: what a rater's function may return.
- ``response``: how people answer once both segments have a utility; ``people``: individual raters.
- ``pairs``: which pairs may be asked about, in training and in evaluation.
- ``collector``: ``PreferenceCollector`` asks raters as queries are written to a replay buffer.
- ``values``: values of states, fitted to segments, for regret without a transition table.
- ``condorcet``: majority preferences that go in circles.
"""
