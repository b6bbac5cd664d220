"""The console commands: thin, so that Ctrl-C finds them ready while the rest is still imported."""

from importlib import import_module

from popl_rl.interruption import importing


def _run(module: str) -> None:
    with importing(always=True):
        cli = import_module(f"popl_rl.trainers.{module}").cli
    cli()


def train() -> None:
    """``popl-train``."""
    _run("train_popl")


def evaluate() -> None:
    """``popl-evaluate``."""
    _run("evaluate_policies")


def summarize() -> None:
    """``popl-summarize``."""
    _run("summarize_runs")


def benchmark() -> None:
    """``popl-benchmark``."""
    _run("run_benchmark")


def label() -> None:
    """``popl-label``."""
    _run("label_pairs")


def serve() -> None:
    """``popl-serve``."""
    _run("serve_policies")


def import_people() -> None:
    """``popl-import``."""
    _run("import_data")


def export() -> None:
    """``popl-export``."""
    _run("export_data")


def people() -> None:
    """``popl-people``."""
    _run("judge_people")


def study() -> None:
    """``popl-study``."""
    _run("run_study")
