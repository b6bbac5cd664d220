"""Hypotheses about what people want: networks, populations of them, and the sets that are returned.

* ``policies``, ``reward_functions``, ``style_codes``: the kinds of hypotheses, and their sizes.
* ``convolutions``: what policies begin with where observations are images.
* ``population``, ``style_population``: many of one kind as one stack of parameters; ``layers``,
  ``trunk_cache`` and ``style_scores`` make it fast.
* ``scoring``: scores of segments, margins of comparisons, values of cases.
* ``preference_likelihood``, ``calibration``: how likely answers are, and how firm scores are.
* ``questions``: which pair to ask a person about next.
* ``hypothesis_set``, ``policy_set``, ``encoded_policy_set``, ``reward_set``: the result of
  training, catering to one person (``catered``), one for all; ``sets`` makes and reads a set of
  any kind, in the form of ``set_files``.
* ``schedules``: learning rates; ``text_features``: what reward functions read of texts.
"""
