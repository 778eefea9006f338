"""The paper's tables and figures, measured here and put beside its numbers."""
