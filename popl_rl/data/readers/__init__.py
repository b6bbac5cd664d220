"""Readers of other people's data: a path becomes segments, preferences and names.

* ``opening``: data by whichever reader fits; ``imported``: what a reader gives.
* ``table``: comparisons in csv, jsonl or parquet, beside items or segments; ``files``: those files,
  in pieces; ``items``: what is compared, by id; ``answers``: what people wrote as an answer.
* ``rankings``: rankings of several items, stage by stage.
* ``npz``: arrays of pairs of segments as CPL publishes them; ``chosen``: chosen and rejected texts;
  ``minari``: segments of a local Minari data set.
* ``problems``: refusals with row numbers; ``summary``: what was found, in one screen; ``writing``:
  the same data as csv, npz, or a folder of ours, which it also reads.
"""
