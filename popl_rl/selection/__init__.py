"""Who becomes a parent: lexicase selection, its variants, and other rules to compare it with.

Pure functions of scores ``[member, case]``; nothing here imports other parts of popl_rl.

* ``lexicase``: lexicase selection, plain and with epsilon; its parts are ``behaviours`` (members
  that score alike), ``epsilon`` and ``dynamic_epsilon`` (how far behind the best one may be),
  ``pools`` (the members left) and ``rounds`` (the order of cases).
* ``compiled`` and ``kernels``: selection on passes by numba, where that is installed.
* ``rules``: tournaments, best sum, random parents, NSGA-II.
* ``downsampling``: which cases to score, and which raters to take; by ``farthest_first`` traversal.
* ``mad``: the median absolute deviation.
* ``arguments``: checks of arguments that all of these share.
"""
