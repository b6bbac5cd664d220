"""Two pages: people compare clips (``popl-label``), and find their own policy (``popl-serve``).

* ``label_app``, ``label_store``, ``labels``: comparing; who answers what; answers as data.
* ``serve_app``, ``serve_api``, ``person_store``, ``catering``, ``numbers``: finding a policy, by
  page and by program; who was served what; how it is found; what each policy does.
* ``clips``, ``rendering``: what people see of segments and policies, and drawing it.
* ``pages``, ``translations``: templates, forms, languages; ``guards``: what requests must pass.
* ``database``: answers on disk; ``server``: running it; ``extra``: whether that is installed.

Needs the extra ``web``: ``pip install 'popl_rl[web]'``.
"""
