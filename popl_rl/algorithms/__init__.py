"""Learning: losses, variation, POPL, and every method that it is compared with.

Nothing here imports raters: a learner cannot see who voted.

``problem``: what every method is given (``Problem``) and what every method is (``Method``).
``losses``: the CPL loss and the loop that descends it; ``draws``: what members draw from;
``expectation``: the E-step of mixtures; ``tie_threshold``: what raters call equal;
``variation``: how children differ from their parents; ``rater_similarity``: who wants alike.
``popl``: POPL; ``assembly``: POPL from its settings; ``refinement``: its last training;
``mixture_population``: POPL without rater ids.
``niches``: POPL for any number of groups; ``niche_search``: one of its searches; ``divisions``:
how it divides raters; ``agreement``: what searches agree upon; ``niche_members``: fresh members for
a division; ``trials``: numbers of niches tried out with them; ``divided_in_two``: two where one was
found; ``specialists``: a member for a rater; ``needed``: which members, and how many, raters
need; ``stacked_adam``: an optimiser for a population that grows and shrinks.
``multi_cpl``: CPL ensembles; ``cpl``: pooled CPL and the oracle; ``em``: EM mixtures;
``chosen_em``: EM that is not told how many; ``kmeans``: clusters of raters first; ``vpl``: a latent
variable; ``lore``: low-rank reward functions; ``brex``, ``dpl``, ``reward_baselines``: reward
learners that know no groups.
``trainer``: any method as a TorchRL Trainer with checkpoints; ``plugged``: methods and selection
rules of other people, checked wherever they are called.
"""
