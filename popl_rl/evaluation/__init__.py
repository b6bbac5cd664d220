"""Evaluation of what was learnt, by what every hidden group of raters wants.

- What hypotheses do: ``acting`` rolls policies out, plans for reward functions or chooses items;
  ``ppo`` trains policies on reward functions, with episodes from ``ppo_episodes``.
- What that is worth: ``measures`` of episodes and rankings, ``optimum`` with exact returns,
  ``best_of_set`` and its worth in ``hindsight``, ``held_out_raters``, ``unexplained_raters``,
  ``guarantees``, ``ranking_agreement`` and ``left_data``; by the number of answers, to drawn or to
  ``chosen_questions``, in ``catering_curves``; ``references``: what the data's behaviours and the
  optimum are worth; by the number of answers learnt from, in ``learning_curves``.
- Real people: ``people`` who are held out, ``people_models`` of each of them, and
  ``people_statistics``.
- What is told: ``evaluator`` fills the ``results`` of a run by a ``protocol``, ``diagnostics`` puts
  into words what stands out, ``verdicts`` how well each group is served, ``statistics`` summarises
  groups and seeds, ``method_names`` says what methods are called, and ``suite`` what a benchmark
  compares.
"""
