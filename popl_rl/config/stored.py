"""The settings of an earlier run, from its ``config.yaml``."""

from pathlib import Path

from omegaconf import DictConfig, OmegaConf

__all__ = ["load_config"]


def load_config(run_dir: Path) -> DictConfig:
    """Read ``config.yaml`` of a run.

    Raises:
        FileNotFoundError: If the folder has none.
        ValueError: If it is not a mapping in YAML.
    """
    path = run_dir / "config.yaml"
    if not path.is_file():
        raise FileNotFoundError(f"{run_dir} has no config.yaml; give the folder of a run")
    try:
        cfg = OmegaConf.load(path)
    except Exception as error:  # OmegaConf passes on whatever its YAML reader raises
        raise ValueError(
            f"{path} is not valid YAML ({error}); restore it or start again"
        ) from error
    if not isinstance(cfg, DictConfig):
        raise ValueError(f"{path} must be a mapping of options to values, got {cfg!r}")
    return cfg
