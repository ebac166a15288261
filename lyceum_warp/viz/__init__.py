"""Learning curves and videos; what they need is the extra ``viz``."""

EXTRA = "pip install 'lyceum-warp[viz]'"
"""How to get what plots and videos need."""
