"""Runs and benchmarks: from settings to objects, to files and to reports.

- From settings: ``builders`` makes what is learnt, ``data`` the segments and preferences
  (``asked`` keeps which groups gave them), ``label_data`` segments for people to compare, and
  ``evaluators`` the evaluator; ``behaviours`` are what the data show, ``ppo_policies`` what groups
  want. Settings objects go no further than this package.
- A run's folder: ``run_folder``, ``metrics``, ``loggers``, and its ``report``; ``progress`` and
  ``foresight`` tell how far it is and how long it will take; ``run_manifest``,
  ``run_sets`` and ``plug_ins`` tell whether what is in it belongs together.
- A benchmark: ``suites`` reads what is compared, ``cells`` plans it and collects what came out,
  ``costs`` foretells what it takes, ``jobs`` runs it in processes, ``benchmark_tables`` and
  ``benchmark_report`` tell the results; ``guarantees`` counts what its sets guarantee.
- ``steps``: the steps of a training run, in their order, of which ``run_start`` is the first;
  ``preflight``: what is looked at before it
  has a folder; ``learning_curve``: what fewer answers teach; ``reevaluation`` of a finished one.
- Real people: ``encoding`` of their texts, ``people`` who are held out, ``people_training``,
  ``people_steps`` of a run, its ``people_report`` and ``people_reevaluation``;
  ``kept_tables`` of what was done before a kill; ``delivery_study``, ``argument_study`` and
  ``jailbreak_study``, and ``response_study`` of how people answer.
- ``markdown`` lays out the tables of all reports, ``tables`` those of the README files, with
  ``wins_table`` and ``table_rows``.
"""
