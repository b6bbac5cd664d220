"""Figures and animations, drawn with Matplotlib's objects and without pyplot.

- Of a run: ``run_figures`` draws all that there is data for, with ``run_plots`` (learning,
  selection, members and occupancy), ``member_plots``, ``recovery_plots``, ``reward_figures`` and
  ``motion_figures``.
- Of learnt utilities over a line of states: ``utility_plots``, ``agreement_plots`` and
  ``majority_plots``, which share ``state_lines``.
- Of motion: ``motion_plots`` and ``animation``.
- Of a benchmark: ``benchmark_plots`` and ``benchmark_curves``, which share ``benchmark_style``;
  ``guarantee_plots`` of what its sets guarantee.
- Of real people: ``people_plots``, and ``delivery_plots`` of where they drive.
- ``style`` has the colours and headlines of all.
"""
