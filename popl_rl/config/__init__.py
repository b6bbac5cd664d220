"""Settings, with their defaults and what they mean. Imports neither torch nor TorchRL.

``data``: environment, raters and segments; ``method``: methods, a section for each part;
``evaluation``: how the result is evaluated; ``people``: likewise, by held-out real people; ``run``:
a whole run; ``stored``: those of an earlier run; ``pages``: what people answer on; ``checks``: how
they check themselves; ``overrides``: what somebody typed that changes nothing, or may not change.
"""

from popl_rl.config.checks import MOST, MOST_SEED, Checker, check_workers, parse_epsilon
from popl_rl.config.data import DataConfig, EnvConfig, PPOSettings, RatersConfig, ResponseConfig
from popl_rl.config.evaluation import EvaluationConfig
from popl_rl.config.method import (
    SECTIONS,
    CloneSettings,
    EMSettings,
    KMeansSettings,
    LoReSettings,
    MethodConfig,
    MixtureSettings,
    NicheSettings,
    POPLSettings,
    RefinementSettings,
    Training,
    VPLSettings,
)
from popl_rl.config.overrides import (
    CHANGEABLE,
    OPEN,
    changed,
    changing_nothing,
    fixed,
    unread,
)
from popl_rl.config.pages import (
    LabelConfig,
    LabelSettings,
    PageSettings,
    ServeConfig,
    ServeSettings,
)
from popl_rl.config.people import PeopleConfig
from popl_rl.config.run import Config, EvaluateConfig, LoggerConfig, plain, validate
from popl_rl.config.stored import load_config

__all__ = [
    "CHANGEABLE",
    "MOST",
    "MOST_SEED",
    "OPEN",
    "SECTIONS",
    "Checker",
    "CloneSettings",
    "Config",
    "DataConfig",
    "EMSettings",
    "EnvConfig",
    "EvaluateConfig",
    "EvaluationConfig",
    "KMeansSettings",
    "LabelConfig",
    "LabelSettings",
    "LoReSettings",
    "LoggerConfig",
    "MethodConfig",
    "MixtureSettings",
    "NicheSettings",
    "POPLSettings",
    "PPOSettings",
    "PageSettings",
    "PeopleConfig",
    "RatersConfig",
    "RefinementSettings",
    "ResponseConfig",
    "ServeConfig",
    "ServeSettings",
    "Training",
    "VPLSettings",
    "changed",
    "changing_nothing",
    "check_workers",
    "fixed",
    "load_config",
    "parse_epsilon",
    "plain",
    "unread",
    "validate",
]
