"""What methods are called where people read."""

__all__ = ["METHODS", "method_name"]

METHODS = {
    "popl": "POPL (catered)",
    "popl_lexicase": "POPL (catered by lexicase)",
    "multi_cpl": "several CPL policies on everybody's answers (catered)",
    "multi_cpl_lexicase": "several CPL policies on everybody's answers (catered by lexicase)",
    "em": "EM mixture of CPL policies (catered)",
    "em_lexicase": "EM mixture of CPL policies (catered by lexicase)",
    "vpl": "VPL, latent variable (catered by its encoder)",
    "vpl_lexicase": "VPL, latent variable (catered by lexicase)",
    "cpl": "CPL on everybody's answers",
    "bradley_terry": "Bradley–Terry on everybody's answers",
    "brex": "B-REX (catered)",
    "brex_lexicase": "B-REX (catered by lexicase)",
    "dpl_mean_variance": "DPL, mean and variance",
    "dpl_mean_variance_risk_averse": "DPL, mean and variance, risk-averse",
    "dpl_categorical": "DPL, categorical",
    "dpl_categorical_risk_averse": "DPL, categorical, risk-averse",
    "oracle": "oracle (told the groups)",
    "clone": "clone of the data",
    "random": "random actions",
}
"""Names to print for the methods of a results table, in the order to show them in."""


def method_name(method: str) -> str:
    """Name to print for a method of a results table."""
    return METHODS.get(method, method)
