"""Agreements between the parts of imud: types only."""
