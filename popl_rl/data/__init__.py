"""Behaviour to be compared: environments, episodes, segments, and the comparisons of segments.

* ``environments``: environments built from settings; ``tables``: their transitions, solved exactly;
  ``enumeration``: tables found by trying every action; ``adapters``: environments of any spaces as
  learners take them; ``features``: frozen extractors of what is shown; ``plugged``: environments
  of other people and what they offer, checked wherever they are called.
* ``behaviours``: who acts while data are collected; ``rollouts``: whole episodes in lockstep;
  ``table_rollouts``: the same, looked up in a table; ``process_rollouts``: stepped in several
  processes.
* ``segments``: episodes cut into segments; ``store``: segments that several runs share;
  ``saved``: segments and preferences in a folder, checked whenever they are read.
* ``pairs``: random pairs of segments that may be compared.
* ``readers``: other people's data, from csv, jsonl, parquet, npz, Minari, chosen and rejected.
* ``bank``: segments as scoring reads them; ``comparisons``: preferences as learning reads them.
"""
